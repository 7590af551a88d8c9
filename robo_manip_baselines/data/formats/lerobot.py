"""LeRobot dataset v3.0: Parquet and MP4 shards of many episodes, and metadata beside them.

Each episode is converted into a piece of its own in a hidden folder beside the output; at the end
the pieces are joined to shards, and the dataset gets its name. A run that was killed goes on with
the pieces that are there, and the result is the same, byte for byte.

Legend: T steps of an episode, N steps of all episodes, n elements of a feature, C colour channels.
"""

from __future__ import annotations

import json
import logging
import math
import shutil
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass, field
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from robo_manip_baselines.data.demonstrations import Demonstrations, load_demonstrations
from robo_manip_baselines.data.episode import EpisodeReader
from robo_manip_baselines.data.files import list_episodes
from robo_manip_baselines.data.formats.lerobot_dataset import (
    CODEBASE_VERSION,
    RECORDED,
    DatasetPlan,
    histogram,
    join_pieces,
    sample_steps,
)
from robo_manip_baselines.data.formats.video import VideoEncoding, VideoWriter
from robo_manip_baselines.envs.mujoco.tasks.registry import entry_of_id
from robo_manip_baselines.observation import CAMERAS, Corruption, ObservationSpec
from robo_manip_baselines.runs.documents import parse_json, read_json
from robo_manip_baselines.runs.errors import RequestError
from robo_manip_baselines.runs.extras import install_command
from robo_manip_baselines.runs.files import (
    atomic_folder,
    disk_errors,
    flush_to_disk,
    locked_file,
    remove_temporaries,
    write_json,
)
from robo_manip_baselines.runs.progress import ProgressBar

if TYPE_CHECKING:
    import pyarrow

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class LeRobotRequest:
    """Choices of an export.

    Attributes:
        obs, horizon, object_pose, relative, corruption: content of ``observation.state``, see
            `ObservationSpec`.
        cameras: to be exported; all that were recorded if None.
        recorded: whether every field of the episode files is exported, too, as features named
            ``recorded.<field>``, which no policy takes as input.
        encoding: of the videos.
        data_file_mb, video_file_mb: largest size of a shard, in MB of 2**20 bytes.
    """

    obs: str = "baseline"
    horizon: int = 2
    object_pose: bool = False
    relative: bool = False
    corruption: Corruption = field(default_factory=Corruption)
    cameras: tuple[str, ...] | None = None
    recorded: bool = True
    encoding: VideoEncoding = field(default_factory=VideoEncoding)
    data_file_mb: int = 100
    video_file_mb: int = 200

    def spec(self, attributes: Mapping[str, Any]) -> ObservationSpec:
        """Return what is observed of episodes with these attributes."""
        cameras = tuple(c for c in CAMERAS if c in attributes["cameras"])
        return ObservationSpec(
            obs=self.obs,
            horizon=self.horizon,
            cameras=cameras if self.cameras is None else self.cameras,
            image_size=tuple(attributes["image_size"]) if cameras else (480, 640),
            object_pose=self.object_pose,
            relative=self.relative,
            arms="both" if attributes["joint_names"][0].startswith("left/") else "right",
            corruption=self.corruption,
        )


def require_pyarrow() -> None:
    """Require the library that writes Parquet files.

    Raises:
        RequestError: it is not installed; says how to install it.
    """
    if find_spec("pyarrow") is None:
        raise RequestError(
            f"the format lerobot needs pyarrow, which is not installed; run: "
            f"{install_command('formats')}"
        )


def export_lerobot(folder: Path, out: Path, request: LeRobotRequest) -> dict[str, str]:
    """Write the demonstrations of a folder as a LeRobot dataset.

    Args:
        folder: as ``bin/Rollout.py`` writes it; ``failed/`` is left out.
        out: folder of the dataset; a run that was killed is continued.
        request: choices.

    Returns:
        Rows of the closing table: name -> text.

    Raises:
        RequestError: the episodes cannot be exported like this, or ``out`` is something else.
        EpisodeFileError: an episode is damaged.
        WriteError: the disk is full, or fails.
    """
    require_pyarrow()
    paths = list_episodes(folder)
    if not paths:
        raise RequestError(f"'{folder}' holds no episode_*.hdf5 file")
    with EpisodeReader(paths[0]) as episode:
        spec = request.spec(episode.attributes)
    given = load_demonstrations(folder, spec)
    plan = _plan(given, request)
    with locked_file(out):
        remove_temporaries(out.parent)
        if not out.exists():
            _write_dataset(given, plan, out)
        elif not plan.is_written(out):
            raise RequestError(
                f"'{out}': is there already and no export of these episodes with these options; "
                "choose another folder"
            )
        shutil.rmtree(_staging(out), ignore_errors=True)
    size = sum(path.stat().st_size for path in out.rglob("*") if path.is_file())
    return {
        "dataset": str(out),
        "format": f"LeRobot {CODEBASE_VERSION}",
        "episodes": str(len(given.paths)),
        "frames": f"{given.offsets[-1]}, {plan.fps} a second",
        "observation.state": f"{given.state.shape[1]} elements ({spec.name})",
        "cameras": ", ".join(spec.cameras) or "none",
        "size": f"{size / 1e6:.1f} MB",
    }


def _plan(given: Demonstrations, request: LeRobotRequest) -> DatasetPlan:
    """Return the plan of an export; raises as `export_lerobot` does."""
    fps = round(1.0 / given.control_period)
    if not math.isclose(fps * given.control_period, 1.0, rel_tol=1e-6):
        raise RequestError(
            f"control period {given.control_period} s: a LeRobot dataset has a whole number of "
            "frames a second"
        )
    for name in ("data_file_mb", "video_file_mb"):
        if getattr(request, name) < 1:
            raise RequestError(f"{name} {getattr(request, name)}: must be 1 or more")
    with EpisodeReader(given.paths[0]) as episode:
        own = episode.attributes.get("instruction")
    entry = entry_of_id(given.env_id)
    recorded = _common_fields(given.paths) if request.recorded else ()
    chosen = {
        "spec": given.spec.to_json(),
        "recorded": recorded,
        "encoding": asdict(request.encoding),
        "data_file_mb": request.data_file_mb,
        "video_file_mb": request.video_file_mb,
        "content": given.content_hash,
    }
    return DatasetPlan(
        fps,
        own or entry.instruction or entry.name,
        "vx300s" if len(given.spec.arm_names) == 1 else "bi_vx300s",
        request.encoding,
        (request.data_file_mb * 2**20, request.video_file_mb * 2**20),
        recorded,
        parse_json(json.dumps(chosen), "request"),  # as it is read back
    )


def _common_fields(paths: Sequence[Path]) -> tuple[str, ...]:
    """Return the fields that all episodes hold, with the same shape of a row."""
    shapes: list[dict[str, tuple[int, ...]]] = []
    for path in paths:
        with EpisodeReader(path) as episode:
            shapes.append({name: values.shape[1:] for name, values in episode.arrays.items()})
    common = [n for n, shape in shapes[0].items() if all(s.get(n) == shape for s in shapes)]
    left_out = {name for found in shapes for name in found} - set(common)
    if left_out:
        names = ", ".join(sorted(left_out))
        logger.warning(
            "%s: not in every episode, or of other sizes; not exported as recorded", names
        )
    return tuple(common)


def _staging(out: Path) -> Path:
    return out.with_name(f".{out.name}.export.partial")


def _write_dataset(given: Demonstrations, plan: DatasetPlan, out: Path) -> None:
    """Convert the episodes that have no piece yet, then join the pieces."""
    staging = _staging(out)
    begun = staging / "request.json"
    if begun.exists() and read_json(begun) != plan.request:
        shutil.rmtree(staging)  # of other options or episodes: nobody asks for it any more
    with disk_errors(out):
        staging.mkdir(parents=True, exist_ok=True)
        remove_temporaries(staging)
        write_json(begun, plan.request)
        pieces = [staging / f"piece_{seed:06d}" for seed in given.seeds]
        done = [int(n) for n, piece in zip(given.lengths, pieces, strict=True) if piece.exists()]
        with ProgressBar(int(given.offsets[-1]), "frame", "export", done=sum(done)) as bar:
            for index, piece in enumerate(pieces):
                if not piece.exists():
                    _write_piece(given, index, plan, piece, bar)
        dataset = staging / "dataset"
        shutil.rmtree(dataset, ignore_errors=True)
        join_pieces(given, pieces, plan, dataset)
        for path in sorted(dataset.rglob("*")):
            flush_to_disk(path)
        dataset.rename(out)
        flush_to_disk(out.parent)


# -- pieces ----------------------------------------------------------------------------------------


def _write_piece(
    given: Demonstrations, index: int, plan: DatasetPlan, folder: Path, bar: ProgressBar
) -> None:
    """Write the arrays, the videos and the histograms of the images of one episode."""
    import pyarrow.parquet

    rows = slice(int(given.offsets[index]), int(given.offsets[index + 1]))
    with atomic_folder(folder) as piece, EpisodeReader(given.paths[index]) as episode:
        columns = _columns(episode, given.state[rows], given.action[rows], plan)
        pyarrow.parquet.write_table(_table(columns), piece / "data.parquet")
        histograms = _write_videos(episode, given.spec.cameras, plan, piece, bar)
        attributes = {
            name: _plain(value)
            for name, value in episode.attributes.items()
            if name not in ("schema", "cameras")
        }
        own = {
            "file": given.paths[index].name,
            "seed": given.seeds[index],
            "phases": episode.attributes["phase_names"],
            "attributes": attributes,
        }
        write_json(piece / "piece.json", {"histograms": histograms, "episode": own})


def _columns(
    episode: EpisodeReader, state: NDArray[Any], action: NDArray[Any], plan: DatasetPlan
) -> dict[str, NDArray[Any]]:
    """Return the (T, n) arrays of an episode by the name of their feature."""
    steps, success = len(episode), episode.array("is_success")
    is_last = np.arange(steps) == steps - 1
    is_first_success = success & (np.cumsum(success) == 1)
    columns = {
        "observation.state": state,
        "action": action,
        "next.reward": is_first_success.astype(np.float32),
        "next.success": success,
        "next.done": is_last,
    }
    columns |= {f"{RECORDED}{name}": episode.array(name) for name in plan.recorded}
    columns["timestamp"] = (np.arange(steps) / plan.fps).astype(np.float32)
    columns["frame_index"] = np.arange(steps)
    return {name: values.reshape(steps, -1) for name, values in columns.items()}


def _table(columns: Mapping[str, NDArray[Any]]) -> pyarrow.Table:
    """Return (T, n) arrays as columns: numbers where n = 1, lists of fixed length otherwise."""
    import pyarrow

    arrays = {}
    for name, values in columns.items():
        flat = pyarrow.array(np.ascontiguousarray(values).reshape(-1))
        width = values.shape[1]
        is_list = width > 1
        arrays[name] = pyarrow.FixedSizeListArray.from_arrays(flat, width) if is_list else flat
    return pyarrow.table(arrays)


def _write_videos(
    episode: EpisodeReader,
    cameras: Sequence[str],
    plan: DatasetPlan,
    folder: Path,
    bar: ProgressBar,
) -> dict[str, list[list[int]]]:
    """Write a video for each camera; return (C, 256) counts of pixel values of a sample of frames.

    LeRobot measures such a sample, too, of thinned-out images.
    """
    sampled = set(sample_steps(len(episode)))
    counts = {camera: np.zeros((3, 256), np.int64) for camera in cameras}
    size = tuple(episode.attributes["image_size"])
    with ExitStack() as stack:
        writers = {
            camera: stack.enter_context(
                VideoWriter(folder / f"{camera}.mp4", size, plan.fps, plan.encoding)
            )
            for camera in cameras
        }
        for step in range(len(episode)):
            for camera, writer in writers.items():
                image = episode.frame(camera, step)
                writer.add(image)
                if step in sampled:
                    counts[camera] += histogram(image)
            bar.advance()
    return {camera: count.tolist() for camera, count in counts.items()}


def _plain(value: Any) -> Any:
    """Return an attribute as JSON has it: NaN is null."""
    if isinstance(value, np.ndarray):
        return value.tolist()
    return None if isinstance(value, float) and math.isnan(value) else value
