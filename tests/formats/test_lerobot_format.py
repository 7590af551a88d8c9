"""LeRobot datasets: the layout, checked without the code that wrote it; interruption."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest

pytest.importorskip("pyarrow", reason="the format lerobot needs the extra formats")

import pyarrow.parquet

from robo_manip_baselines.data import EpisodeReader, episode_path, list_episodes, write_episode
from robo_manip_baselines.data.demonstrations import load_demonstrations
from robo_manip_baselines.data.example import make_arrays, make_attributes
from robo_manip_baselines.data.formats import lerobot, lerobot_dataset
from robo_manip_baselines.data.formats.lerobot import LeRobotRequest, export_lerobot
from robo_manip_baselines.data.formats.lerobot_dataset import (
    histogram,
    image_statistics,
    sample_steps,
    shards,
    vector_statistics,
)
from robo_manip_baselines.data.formats.video import VideoEncoding
from robo_manip_baselines.observation import Corruption, ObservationSpec
from robo_manip_baselines.runs.errors import RequestError

LOSSLESS = VideoEncoding("lossless", 0, gop=3)
REQUEST = LeRobotRequest(encoding=LOSSLESS)
Tree = Callable[[Path], dict[str, bytes]]

ARROW = {
    "float32": "float",
    "float64": "double",
    "bool": "bool",
    "int8": "int8",
    "int64": "int64",
}
DEFAULTS = {"timestamp", "frame_index", "episode_index", "index", "task_index"}
STATISTICS = {"min", "max", "mean", "std", "count", "q01", "q10", "q50", "q90", "q99"}


def read_videos(root: Path, info: dict[str, Any], key: str, row: dict[str, Any]) -> np.ndarray:
    """Decode the frames of an episode, found by its times alone, as a reader of LeRobot does."""
    places = {n: row[f"videos/{key}/{n}"] for n in ("chunk_index", "file_index")}
    path = root / info["video_path"].format(video_key=key, **places)
    first, last = (row[f"videos/{key}/{n}_timestamp"] for n in ("from", "to"))
    with av.open(str(path)) as container:
        frames = [(f.time, f.to_ndarray(format="rgb24")) for f in container.decode(video=0)]
    half = 0.5 / info["fps"]
    inside = [(time, image) for time, image in frames if first - half < time < last - half]
    # LeRobot refuses frames that are more than 1e-4 s off.
    expected = first + np.arange(row["length"]) / info["fps"]
    np.testing.assert_allclose([time for time, _ in inside], expected, atol=1e-4)
    return np.stack([image for _, image in inside])


def validate(root: Path) -> dict[str, Any]:
    """Check a dataset against LeRobot's v3.0 layout; return its ``info.json``."""
    info = json.loads((root / "meta/info.json").read_text())
    features = info["features"]
    assert info["codebase_version"] == "v3.0"
    assert set(features) >= DEFAULTS | {"action", "observation.state"}
    assert all("/" not in name for name in features)
    for item in features.values():
        assert set(item) >= {"dtype", "shape", "names"}
        assert (
            item["names"] is None
            or len(item["names"]) == item["shape"][-1]
            or len(item["names"]) == len(item["shape"])
        )

    tasks = pyarrow.parquet.read_table(root / "meta/tasks.parquet")
    pandas = json.loads(tasks.schema.metadata[b"pandas"])
    assert pandas["index_columns"] == ["task"]
    assert tasks.column("task_index").to_pylist() == list(range(info["total_tasks"]))
    texts = tasks.column("task").to_pylist()

    files = sorted((root / "meta/episodes").rglob("*.parquet"))
    rows = [row for path in files for row in pyarrow.parquet.read_table(path).to_pylist()]
    assert [row["episode_index"] for row in rows] == list(range(info["total_episodes"]))
    assert sum(row["length"] for row in rows) == info["total_frames"]
    assert info["splits"] == {"train": f"0:{len(rows)}"}

    videos = [name for name, item in features.items() if item["dtype"] == "video"]
    place: dict[str, tuple[int, int]] = {}
    end = 0
    for row in rows:
        assert set(row["tasks"]) <= set(texts)
        assert (row["dataset_from_index"], row["dataset_to_index"]) == (end, end + row["length"])
        end += row["length"]
        path = root / info["data_path"].format(
            chunk_index=row["data/chunk_index"], file_index=row["data/file_index"]
        )
        table = pyarrow.parquet.read_table(path)
        for name, item in features.items():
            if item["dtype"] == "video":
                continue
            kind = table.schema.field(name).type
            if item["shape"] == [1]:
                assert str(kind) == ARROW[item["dtype"]]
            else:
                assert (kind.list_size, str(kind.value_type)) == (
                    item["shape"][0],
                    ARROW[item["dtype"]],
                )
        assert set(table.column_names) == set(features) - set(videos)
        own = table.filter(pyarrow.compute.field("episode_index") == row["episode_index"])
        assert own.num_rows == row["length"]
        frame = np.array(own.column("frame_index"))
        np.testing.assert_array_equal(frame, np.arange(row["length"]))
        np.testing.assert_array_equal(own.column("index"), row["dataset_from_index"] + frame)
        np.testing.assert_allclose(own.column("timestamp"), frame / info["fps"], atol=1e-6)
        done = own.column("next.done").to_pylist()
        assert done == [False] * (row["length"] - 1) + [True]
        for key in videos:
            images = read_videos(root, info, key, row)
            assert list(images.shape[1:]) == features[key]["shape"]
            at = (row[f"videos/{key}/chunk_index"], row[f"videos/{key}/file_index"])
            assert at >= place.get(key, (0, 0))
            place[key] = at
        measured = {name.split("/")[1] for name in row if name.startswith("stats/")}
        assert measured == set(features)

    stats = json.loads((root / "meta/stats.json").read_text())
    assert set(stats) == set(features)
    for name, found in stats.items():
        assert set(found) == STATISTICS
        shape = (3, 1, 1) if name in videos else tuple(features[name]["shape"])
        assert all(np.shape(value) == shape for key, value in found.items() if key != "count")
        assert np.shape(found["count"]) == (1,)
    return info


def column(root: Path, name: str) -> np.ndarray:
    tables = [pyarrow.parquet.read_table(p) for p in sorted((root / "data").rglob("*.parquet"))]
    return np.array(pyarrow.concat_tables(tables).column(name).to_pylist())


def test_an_export_is_a_dataset_of_lerobot(one_arm: Path, tmp_path: Path) -> None:
    root = tmp_path / "dataset"
    rows = export_lerobot(one_arm, root, REQUEST)
    info = validate(root)
    assert (info["total_episodes"], info["total_frames"], info["fps"]) == (3, 38, 50)
    assert info["robot_type"] == "vx300s"
    assert rows["frames"] == "38, 50 a second"
    # Nothing beside it is left, and a failure is no demonstration.
    assert [path.name for path in tmp_path.iterdir()] == ["dataset"]


def test_an_export_holds_what_was_recorded(one_arm: Path, tmp_path: Path) -> None:
    root = tmp_path / "dataset"
    export_lerobot(one_arm, root, LeRobotRequest(obs="current", encoding=LOSSLESS))
    info = json.loads((root / "meta/info.json").read_text())
    spec = ObservationSpec("current", cameras=("top", "front_close"), image_size=(24, 32))
    given = load_demonstrations(one_arm, spec)
    np.testing.assert_array_equal(column(root, "observation.state"), given.state)
    np.testing.assert_array_equal(column(root, "action"), given.action)
    assert info["features"]["observation.state"]["names"][14:] == [
        "mouth x",
        "mouth y",
        "mouth z",
        "distance",
    ]
    rows = pyarrow.parquet.read_table(root / "meta/episodes/chunk-000/file-000.parquet").to_pylist()
    own = json.loads((root / "meta/robo_manip_baselines.json").read_text())
    for path, row, saved in zip(list_episodes(one_arm), rows, own["episodes"], strict=True):
        with EpisodeReader(path) as episode:
            part = slice(row["dataset_from_index"], row["dataset_to_index"])
            for name, values in episode.arrays.items():
                found = column(root, f"recorded.{name}")[part]
                np.testing.assert_array_equal(found.reshape(values.shape), values)
            success = episode.array("is_success")
            np.testing.assert_array_equal(column(root, "next.success")[part], success)
            reward = column(root, "next.reward")[part]
            assert reward.sum() == 1.0
            assert reward.argmax() == success.argmax()
            for camera in episode.cameras:
                images = read_videos(root, info, f"observation.images.{camera}", row)
                original = [episode.frame(camera, step) for step in range(len(episode))]
                np.testing.assert_array_equal(images, original)
            assert saved["attributes"]["seed"] == episode.attributes["seed"]
            assert saved["attributes"]["content_sha256"] == episode.attributes["content_sha256"]


def test_statistics_are_those_of_the_data(one_arm: Path, tmp_path: Path) -> None:
    root = tmp_path / "dataset"
    export_lerobot(one_arm, root, REQUEST)
    stats = json.loads((root / "meta/stats.json").read_text())
    action = column(root, "action").astype(np.float64)
    np.testing.assert_allclose(stats["action"]["mean"], action.mean(axis=0))
    np.testing.assert_allclose(stats["action"]["std"], action.std(axis=0))
    np.testing.assert_allclose(stats["action"]["q90"], np.quantile(action, 0.9, axis=0))
    assert stats["action"]["count"] == [len(action)]
    images = []
    for path in list_episodes(one_arm):
        with EpisodeReader(path) as episode:
            images += [episode.frame("top", step) for step in range(len(episode))]
    pixels = np.stack(images).reshape(-1, 3) / 255.0  # small: all frames, not thinned out
    found = stats["observation.images.top"]
    np.testing.assert_allclose(np.ravel(found["mean"]), pixels.mean(axis=0))
    np.testing.assert_allclose(np.ravel(found["std"]), pixels.std(axis=0))
    np.testing.assert_allclose(np.ravel(found["max"]), pixels.max(axis=0))
    expected = np.quantile(pixels, 0.5, axis=0, method="inverted_cdf")
    np.testing.assert_allclose(np.ravel(found["q50"]), expected)


def test_large_images_are_thinned_out_before_they_are_measured() -> None:
    image = np.zeros((480, 640, 3), np.uint8)
    counts = histogram(image)
    assert counts[:, 0].tolist() == [120 * 160] * 3  # every fourth pixel, as 640 // 150 = 4
    found = image_statistics(counts, 1)
    assert found["max"] == [[[0.0]], [[0.0]], [[0.0]]]
    assert len(sample_steps(600)) == 121  # 600 ** 0.75
    assert sample_steps(3) == [0, 1, 2]


def test_statistics_of_vectors_take_booleans() -> None:
    found = vector_statistics(np.array([[True], [False], [False], [True]]))
    assert found["mean"] == [0.5]
    assert found["count"] == [4]


def test_shards_hold_whole_episodes_in_order(one_arm: Path, tmp_path: Path) -> None:
    assert shards([4, 4, 4], 8) == [0, 0, 1]
    assert shards([9, 1, 8], 8) == [0, 1, 2]
    root = tmp_path / "dataset"
    plan = lerobot._plan
    with pytest.MonkeyPatch.context() as patch:  # shards of a byte: an episode in each

        def small(*args: Any) -> Any:
            made = plan(*args)
            object.__setattr__(made, "limits", (1, 1))
            return made

        patch.setattr(lerobot, "_plan", small)
        patch.setattr(lerobot_dataset, "CHUNK_SIZE", 2)
        export_lerobot(one_arm, root, REQUEST)
    names = [f"chunk-{n // 2:03d}/file-{n % 2:03d}" for n in range(3)]
    found = sorted(p.relative_to(root / "data").as_posix() for p in root.glob("data/*/*"))
    assert found == [f"{name}.parquet" for name in names]
    text = (root / "meta/info.json").read_text()
    info = {**json.loads(text), "data_files_size_in_mb": 1}
    (root / "meta/info.json").write_text(json.dumps(info))
    validate(root)


@pytest.mark.parametrize("frames", [5, 20, 38])
def test_a_killed_export_goes_on_to_the_same_bytes(
    frames: int, one_arm: Path, tmp_path: Path, tree: Tree
) -> None:
    whole, killed = tmp_path / "whole", tmp_path / "killed"
    export_lerobot(one_arm, whole, REQUEST)
    script = f"""
import os
from pathlib import Path
from robo_manip_baselines.data.formats import lerobot, video
add, seen = video.VideoWriter.add, []
def dying(self, image):
    seen.append(1)
    if len(seen) == {2 * frames}:
        os._exit(9)
    add(self, image)
lerobot.VideoWriter.add = dying
encoding = video.VideoEncoding("lossless", 0, gop=3)
request = lerobot.LeRobotRequest(encoding=encoding)
lerobot.export_lerobot(Path({str(one_arm)!r}), Path({str(killed)!r}), request)
"""
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, check=False)
    assert done.returncode == 9, done.stderr
    assert not killed.exists()
    export_lerobot(one_arm, killed, REQUEST)
    assert tree(killed) == tree(whole)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["killed", "whole"]


def test_an_interrupted_export_keeps_the_episodes_that_are_done(
    one_arm: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made: list[int] = []
    write = lerobot._write_piece

    def stop(given: Any, index: int, *args: Any) -> None:
        if len(made) == 2:
            raise KeyboardInterrupt
        made.append(index)
        write(given, index, *args)

    monkeypatch.setattr(lerobot, "_write_piece", stop)
    root = tmp_path / "dataset"
    with pytest.raises(KeyboardInterrupt):
        export_lerobot(one_arm, root, REQUEST)
    made.clear()
    export_lerobot(one_arm, root, REQUEST)
    assert made == [2]


def test_an_export_that_is_done_is_done(one_arm: Path, tmp_path: Path, tree: Tree) -> None:
    root = tmp_path / "dataset"
    export_lerobot(one_arm, root, REQUEST)
    before = tree(root)
    export_lerobot(one_arm, root, REQUEST)
    assert tree(root) == before
    with pytest.raises(RequestError, match="no export of these episodes with these options"):
        export_lerobot(one_arm, root, LeRobotRequest(obs="current", encoding=LOSSLESS))
    assert tree(root) == before


def test_begun_with_other_options_it_starts_afresh(one_arm: Path, tmp_path: Path) -> None:
    staging = tmp_path / ".dataset.export.partial"
    staging.mkdir()
    (staging / "request.json").write_text("{}")
    (staging / "piece_000000").mkdir()
    root = tmp_path / "dataset"
    export_lerobot(one_arm, root, REQUEST)
    validate(root)


def test_corruption_is_that_of_training(one_arm: Path, tmp_path: Path) -> None:
    corruption = Corruption(error="uniform")
    root = tmp_path / "dataset"
    request = LeRobotRequest(obs="current_pred", corruption=corruption, cameras=("none",))
    export_lerobot(one_arm, root, request)
    spec = ObservationSpec("current_pred", cameras=(), corruption=corruption)
    given = load_demonstrations(one_arm, spec)
    np.testing.assert_array_equal(column(root, "observation.state"), given.state)
    info = validate(root)
    assert info["video_path"] is None


def test_two_arms_and_no_recorded_fields(two_arms: Path, tmp_path: Path) -> None:
    root = tmp_path / "dataset"
    export_lerobot(two_arms, root, LeRobotRequest(recorded=False, encoding=LOSSLESS))
    info = validate(root)
    assert info["robot_type"] == "bi_vx300s"
    assert info["features"]["action"]["shape"] == [14]
    assert not any(name.startswith("recorded.") for name in info["features"])


def test_a_missing_library_is_one_line(
    one_arm: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(lerobot, "find_spec", lambda name: None)
    with pytest.raises(RequestError, match=r"needs pyarrow.*\[formats\]"):
        export_lerobot(one_arm, tmp_path / "dataset", REQUEST)
    assert not any(tmp_path.iterdir())


def test_fields_that_some_episodes_lack_are_named(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    for seed in range(2):
        arrays = make_arrays(12, seed, version=4)
        if seed:
            arrays["intervention"] = np.zeros(12, bool)
        path = episode_path(tmp_path / "episodes", seed, True)
        write_episode(path, arrays, {}, make_attributes(seed))
    root = tmp_path / "dataset"
    export_lerobot(tmp_path / "episodes", root, REQUEST)
    assert "intervention: not in every episode" in caplog.text
    features = validate(root)["features"]
    assert "recorded.intervention" not in features
    assert "recorded.qpos" in features
