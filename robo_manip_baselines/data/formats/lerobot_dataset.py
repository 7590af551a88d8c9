"""Files of a LeRobot dataset v3.0: pieces of one episode each become shards, and metadata.

Legend: T steps of an episode, N steps of all episodes, n elements of a feature, C colour channels.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from robo_manip_baselines.data.demonstrations import Demonstrations
from robo_manip_baselines.data.episode import EpisodeReader
from robo_manip_baselines.data.formats.video import VideoEncoding, VideoReader, join_videos
from robo_manip_baselines.runs.documents import read_json
from robo_manip_baselines.runs.errors import RequestError
from robo_manip_baselines.runs.files import to_json, write_json

if TYPE_CHECKING:
    import pyarrow

CODEBASE_VERSION = "v3.0"
"""Version of the layout, LeRobot's name for it."""

CHUNK = "chunk-{chunk_index:03d}/file-{file_index:03d}"
DATA_PATH = f"data/{CHUNK}.parquet"
VIDEO_PATH = f"videos/{{video_key}}/{CHUNK}.mp4"
EPISODES_PATH = f"meta/episodes/{CHUNK}.parquet"
TASKS_PATH = "meta/tasks.parquet"
OWN_PATH = "meta/robo_manip_baselines.json"
"""Request and attributes of every episode; LeRobot does not read it."""

OWN_SCHEMA = "robo_manip_baselines/lerobot_export"
OWN_VERSION = 1

MANIFEST_BYTES = 2**30
"""Largest size of that file that is read: some kB an episode."""

CHUNK_SIZE = 1000
"""Files in a folder."""

QUANTILES = (0.01, 0.10, 0.50, 0.90, 0.99)

DEFAULT_FEATURES = {
    "timestamp": "float32",
    "frame_index": "int64",
    "episode_index": "int64",
    "index": "int64",
    "task_index": "int64",
}
"""Features of every dataset, one number each."""

RECORDED = "recorded."
"""Prefix of the features that hold the fields of an episode file as they are."""

IMAGE_SIDE = 150
"""Pixels to which LeRobot thins images out before it measures them, if a side has 300 or more."""


@dataclass(frozen=True)
class DatasetPlan:
    """Everything that decides the content of a dataset, as JSON in ``request``."""

    fps: int
    task: str
    robot_type: str
    encoding: VideoEncoding
    limits: tuple[int, int]  # bytes of a shard of data, of videos
    recorded: tuple[str, ...]  # fields that are exported as they are
    request: dict[str, Any]

    def is_written(self, out: Path) -> bool:
        """Return whether a folder is a finished export by this plan."""
        try:
            found = read_json(out / OWN_PATH, limit=MANIFEST_BYTES)
        except RequestError:
            return False
        return found.get("request") == self.request


def shards(sizes: Iterable[int], limit: int) -> list[int]:
    """Return for each piece of these sizes the number of the file it goes into.

    A file holds pieces in their order, as many as fit into ``limit`` bytes, and at least one.
    """
    numbers: list[int] = []
    filled, number = 0, 0
    for size in sizes:
        if numbers and filled + size > limit:
            filled, number = 0, number + 1
        filled += size
        numbers.append(number)
    return numbers


def _place(template: str, number: int, **names: str) -> str:
    chunk, file = divmod(number, CHUNK_SIZE)
    return template.format(chunk_index=chunk, file_index=file, **names)


def _groups(numbers: Sequence[int], pieces: Sequence[Path]) -> Iterator[tuple[int, list[Path]]]:
    for number in range(numbers[-1] + 1):
        yield number, [p for n, p in zip(numbers, pieces, strict=True) if n == number]


def join_pieces(
    given: Demonstrations, pieces: Sequence[Path], plan: DatasetPlan, dataset: Path
) -> None:
    """Write the shards and the metadata of a dataset."""
    cameras = given.spec.cameras
    keys = {camera: f"observation.images.{camera}" for camera in cameras}
    of_data = shards([(p / "data.parquet").stat().st_size for p in pieces], plan.limits[0])
    of_video = {
        camera: shards([(p / f"{camera}.mp4").stat().st_size for p in pieces], plan.limits[1])
        for camera in cameras
    }
    _join_data(given, pieces, of_data, dataset)
    for camera, key in keys.items():
        for number, members in _groups(of_video[camera], pieces):
            path = dataset / _place(VIDEO_PATH, number, video_key=key)
            path.parent.mkdir(parents=True, exist_ok=True)
            join_videos([piece / f"{camera}.mp4" for piece in members], path)
    found = [read_json(piece / "piece.json") for piece in pieces]
    counts = {
        camera: np.array([piece["histograms"][camera] for piece in found]) for camera in cameras
    }
    of_episodes = _episode_rows(given, pieces, plan, of_data, of_video, counts)
    _write_parquet(of_episodes, dataset / _place(EPISODES_PATH, 0))
    _write_tasks([plan.task], dataset / TASKS_PATH)
    features = _features(given, pieces[0], plan, keys)
    info = {
        "codebase_version": CODEBASE_VERSION,
        "robot_type": plan.robot_type,
        "total_episodes": len(pieces),
        "total_frames": int(given.offsets[-1]),
        "total_tasks": 1,
        "chunks_size": CHUNK_SIZE,
        "data_files_size_in_mb": plan.limits[0] // 2**20,
        "video_files_size_in_mb": plan.limits[1] // 2**20,
        "fps": plan.fps,
        "splits": {"train": f"0:{len(pieces)}"},
        "data_path": DATA_PATH,
        "video_path": VIDEO_PATH if cameras else None,
        "features": features,
    }
    write_json(dataset / "meta" / "info.json", info)
    write_json(dataset / "meta" / "stats.json", _statistics(given, dataset, features, counts))
    own = {
        "schema": OWN_SCHEMA,
        "schema_version": OWN_VERSION,
        "request": plan.request,
        "env_id": given.env_id,
        "episodes": [{"episode_index": i, **piece["episode"]} for i, piece in enumerate(found)],
    }
    write_json(dataset / OWN_PATH, own)


def _join_data(
    given: Demonstrations, pieces: Sequence[Path], numbers: Sequence[int], dataset: Path
) -> None:
    """Write the shards of the arrays, a row group for each episode."""
    import pyarrow.parquet

    offset = 0
    for number, members in _groups(numbers, pieces):
        path = dataset / _place(DATA_PATH, number)
        path.parent.mkdir(parents=True, exist_ok=True)
        writer = None
        for piece in members:
            table = pyarrow.parquet.read_table(piece / "data.parquet")
            first, steps = int(given.offsets[offset]), int(given.lengths[offset])
            for name, values in (
                ("episode_index", np.full(steps, offset)),
                ("index", first + np.arange(steps)),
                ("task_index", np.zeros(steps, np.int64)),
            ):
                table = table.append_column(name, pyarrow.array(values))
            writer = writer or pyarrow.parquet.ParquetWriter(path, table.schema)
            writer.write_table(table)
            offset += 1
        assert writer is not None
        writer.close()


def _episode_rows(
    given: Demonstrations,
    pieces: Sequence[Path],
    plan: DatasetPlan,
    of_data: Sequence[int],
    of_video: Mapping[str, Sequence[int]],
    counts: Mapping[str, NDArray[np.int64]],
) -> list[dict[str, Any]]:
    """Return the metadata of every episode: place, times in the videos, statistics."""
    import pyarrow.parquet

    rows: list[dict[str, Any]] = []
    begin = dict.fromkeys(of_video, 0)  # frame of the file at which the next episode begins
    for index, piece in enumerate(pieces):
        first, steps = int(given.offsets[index]), int(given.lengths[index])
        chunk, file = divmod(of_data[index], CHUNK_SIZE)
        row: dict[str, Any] = {
            "episode_index": index,
            "tasks": [plan.task],
            "length": steps,
            "data/chunk_index": chunk,
            "data/file_index": file,
            "dataset_from_index": first,
            "dataset_to_index": first + steps,
        }
        for camera, numbers in of_video.items():
            if index and numbers[index] != numbers[index - 1]:
                begin[camera] = 0
            start = begin[camera]
            begin[camera] = start + steps
            chunk, file = divmod(numbers[index], CHUNK_SIZE)
            prefix = f"videos/observation.images.{camera}"
            row |= {
                f"{prefix}/chunk_index": chunk,
                f"{prefix}/file_index": file,
                f"{prefix}/from_timestamp": start / plan.fps,
                f"{prefix}/to_timestamp": (start + steps) / plan.fps,
            }
        table = pyarrow.parquet.read_table(piece / "data.parquet")
        measured = {name: vector_statistics(_values(table, name)) for name in table.column_names}
        places = {
            "episode_index": np.full((steps, 1), index),
            "index": first + np.arange(steps)[:, None],
            "task_index": np.zeros((steps, 1)),
        }
        measured |= {name: vector_statistics(values) for name, values in places.items()}
        frames = len(sample_steps(steps))
        measured |= {
            f"observation.images.{camera}": image_statistics(count[index], frames)
            for camera, count in counts.items()
        }
        row |= {
            f"stats/{name}/{statistic}": value
            for name, statistics in measured.items()
            for statistic, value in statistics.items()
        }
        rows.append({**row, "meta/episodes/chunk_index": 0, "meta/episodes/file_index": 0})
    return rows


def _values(table: pyarrow.Table, name: str) -> NDArray[Any]:
    """Return a column as a (N, n) array."""
    column = table.column(name).combine_chunks()
    flat = column.flatten() if hasattr(column, "flatten") else column
    return flat.to_numpy(zero_copy_only=False).reshape(len(column), -1)


def _statistics(
    given: Demonstrations,
    dataset: Path,
    features: Mapping[str, Any],
    counts: Mapping[str, NDArray[np.int64]],
) -> dict[str, Any]:
    """Return the statistics of every feature over all episodes."""
    import pyarrow.parquet

    files = sorted((dataset / "data").rglob("*.parquet"))
    result: dict[str, Any] = {}
    for name, item in features.items():
        if item["dtype"] == "video":
            count = counts[name.rpartition(".")[2]].sum(axis=0)
            frames = sum(len(sample_steps(int(steps))) for steps in given.lengths)
            result[name] = image_statistics(count, frames)
            continue
        # A feature at a time, so that a long dataset fits into memory.
        parts = [_values(pyarrow.parquet.read_table(f, columns=[name]), name) for f in files]
        result[name] = vector_statistics(np.concatenate(parts))
    return result


def _features(
    given: Demonstrations, piece: Path, plan: DatasetPlan, keys: Mapping[str, str]
) -> dict[str, Any]:
    """Return type, shape and names of every feature."""
    import pyarrow.parquet

    schema = pyarrow.parquet.read_schema(piece / "data.parquet")
    with EpisodeReader(given.paths[0]) as episode:
        names: dict[str, list[str] | None] = {
            "observation.state": given.spec.vector_names(episode.task.names),
            "action": list(given.action_names),
            f"{RECORDED}action": list(given.action_names),
            f"{RECORDED}joint_position": episode.attributes["joint_names"],
            f"{RECORDED}joint_velocity": episode.attributes["joint_names"],
        }
    features: dict[str, Any] = {}
    for column in schema:
        is_list = hasattr(column.type, "list_size")
        kind = column.type.value_type if is_list else column.type
        dtype = {"float": "float32", "double": "float64"}.get(str(kind), str(kind))
        shape = [column.type.list_size if is_list else 1]
        own = names.get(column.name)
        features[column.name] = {"dtype": dtype, "shape": shape, "names": own}
    default = {name: features.pop(name, None) for name in DEFAULT_FEATURES}
    for camera, key in keys.items():
        features[key] = {
            "dtype": "video",
            "shape": [*given.spec.image_size, 3],
            "names": ["height", "width", "channels"],
            "info": _video_info(piece / f"{camera}.mp4", plan),
        }
    for name, dtype in DEFAULT_FEATURES.items():
        features[name] = default[name] or {"dtype": dtype, "shape": [1], "names": None}
    return features


def _video_info(path: Path, plan: DatasetPlan) -> dict[str, Any]:
    with VideoReader(path) as video:
        info = video.info
    preset = plan.encoding.preset
    return {
        "video.height": info.size[0],
        "video.width": info.size[1],
        "video.codec": info.codec,
        "video.pix_fmt": info.pixel_format,
        "video.fps": plan.fps,
        "video.channels": 3,
        "has_audio": False,
        "video.g": plan.encoding.gop,
        "video.crf": plan.encoding.crf,
        "video.preset": int(preset) if preset else None,
        "video.fast_decode": 0,
        "video.video_backend": "pyav",
        "video.extra_options": {},
        "is_depth_map": False,
    }


def _write_parquet(rows: Sequence[Mapping[str, Any]], path: Path) -> None:
    import pyarrow.parquet

    path.parent.mkdir(parents=True, exist_ok=True)
    table = pyarrow.Table.from_pydict({name: [row[name] for row in rows] for name in rows[0]})
    pyarrow.parquet.write_table(table, path)


def _write_tasks(tasks: Sequence[str], path: Path) -> None:
    """Write the tasks as pandas does with the text as the index, which LeRobot expects."""
    import pyarrow.parquet

    table = pyarrow.table({"task_index": pyarrow.array(range(len(tasks)), "int64"), "task": tasks})

    def column(name: str, kind: str, stored: str) -> dict[str, Any]:
        return {
            "name": name,
            "field_name": name,
            "pandas_type": kind,
            "numpy_type": stored,
            "metadata": None,
        }

    pandas = {
        "index_columns": ["task"],
        "column_indexes": [
            {
                "name": None,
                "field_name": None,
                "pandas_type": "unicode",
                "numpy_type": "object",
                "metadata": {"encoding": "UTF-8"},
            }
        ],
        "columns": [column("task_index", "int64", "int64"), column("task", "unicode", "object")],
        "creator": {"library": "pyarrow", "version": pyarrow.__version__},
        "pandas_version": "2.0.0",
    }
    table = table.replace_schema_metadata({"pandas": to_json(pandas, 0)})
    pyarrow.parquet.write_table(table, path)


# -- statistics ----------------------------------------------------------------------------------


def sample_steps(steps: int) -> list[int]:
    """Return the steps whose images are measured: T ** 0.75 of them, 100 to 10,000, as LeRobot."""
    number = max(min(steps, 100), min(int(steps**0.75), 10_000))
    return np.round(np.linspace(0, steps - 1, number)).astype(int).tolist()


def histogram(image: NDArray[np.uint8]) -> NDArray[np.int64]:
    """Return (C, 256) counts of the values of a thinned-out image."""
    height, width = image.shape[:2]
    every = (width if width > height else height) // IMAGE_SIDE
    thin = image[::every, ::every] if max(height, width) >= 2 * IMAGE_SIDE else image
    return np.stack([np.bincount(thin[..., c].ravel(), minlength=256) for c in range(3)])


def vector_statistics(values: NDArray[Any]) -> dict[str, list[float]]:
    """Return minimum, maximum, mean, standard deviation, count and quantiles of (N, n) numbers."""
    numbers = values.astype(np.float64)
    quantiles = np.quantile(numbers, QUANTILES, axis=0)
    return {
        "min": numbers.min(axis=0).tolist(),
        "max": numbers.max(axis=0).tolist(),
        "mean": numbers.mean(axis=0).tolist(),
        "std": numbers.std(axis=0).tolist(),
        "count": [len(numbers)],
        **{_quantile_name(q): row.tolist() for q, row in zip(QUANTILES, quantiles, strict=True)},
    }


def image_statistics(counts: NDArray[np.int64], frames: int) -> dict[str, Any]:
    """Return statistics of pixels in 0 … 1, each of shape (C, 1, 1), from (C, 256) counts.

    Args:
        counts: of each value of each channel.
        frames: number of images that were counted.
    """
    levels = np.arange(256) / 255.0
    total = counts.sum(axis=1)
    mean = counts @ levels / total
    variance = np.maximum(counts @ levels**2 / total - mean**2, 0.0)
    reached = np.cumsum(counts, axis=1)
    found = [np.flatnonzero(row) for row in counts]
    result = {
        "min": levels[[row[0] for row in found]],
        "max": levels[[row[-1] for row in found]],
        "mean": mean,
        "std": np.sqrt(variance),
        **{
            _quantile_name(q): levels[(reached < q * total[:, None]).sum(axis=1)] for q in QUANTILES
        },
    }
    shaped: dict[str, Any] = {
        name: values.reshape(3, 1, 1).tolist() for name, values in result.items()
    }
    return {**shaped, "count": [frames]}


def _quantile_name(quantile: float) -> str:
    return f"q{round(100 * quantile):02d}"
