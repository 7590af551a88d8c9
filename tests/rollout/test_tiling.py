"""Tiles show the right video in the right place, all at once, to the end of the longest."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import av
import numpy as np
import pytest

from robo_manip_baselines.observation import ObservationSpec
from robo_manip_baselines.rollout.results import RESULTS, EpisodeResult
from robo_manip_baselines.rollout.tiling import STRIP, VIEWS, find_tiles, write_tiles
from robo_manip_baselines.rollout.videos import VideoWriter, video_name
from robo_manip_baselines.runs.errors import RequestError

SCRIPT = Path(__file__).parents[2] / "bin" / "Dataset.py"
COLOURS = {"low": (200, 30, 30), "high": (30, 30, 200)}
HEIGHT, PART = 48, 64


def make_result(condition: str, seed: int) -> EpisodeResult:
    return EpisodeResult(
        env="FeedingEnv",
        seed=seed,
        is_success=True,
        is_success_strict=False,
        completion_time=4.0,
        steps=600,
        failure="",
        motion_clip="clip",
        motion_subject="person",
        columns={
            "time_since_lift": 8.02,
            "closest_distance": 0.0123,
            "closest_offset": (0.001, -0.002, -0.012),
            "cube_offset": (-0.011, -0.003, -0.01),
            "face_force": 1.5,
            "force_time_1": 0.5,
            "force_time_10": 0.02,
            "force_time_30": 0.0,
            "dwell": 0.12,
        },
        policy="Act",
        condition=condition,
        observation=ObservationSpec("current").to_json(),
        train_seed=0,
        checkpoint="ab12",
        versions={"numpy": "2"},
    )


def evaluate(folder: Path, condition: str, lengths: dict[int, int], fps: float = 25.0) -> Path:
    """Write videos as an evaluation does: the brightness of view i is a fraction of the colour."""
    lines = []
    for seed, length in lengths.items():
        result = make_result(condition, seed)
        lines.append(result.to_line() + "\n")
        if not length:
            continue
        with VideoWriter(folder / "videos" / video_name(result), fps) as video:
            for _ in range(length):
                views = [
                    np.full((HEIGHT, PART, 3), COLOURS[condition]) * (number + 1) // len(VIEWS)
                    for number in range(len(VIEWS))
                ]
                video.write(np.concatenate(views, axis=1).astype(np.uint8))
    folder.mkdir(exist_ok=True)
    (folder / RESULTS).write_text("".join(lines))
    return folder


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Evaluations of two conditions; of seed 1002 only one has a video."""
    evaluate(tmp_path / "results" / "a", "low", {1000: 5, 1001: 9, 1002: 7})
    evaluate(tmp_path / "results" / "b", "high", {1000: 4, 1001: 3, 1002: 0})
    return tmp_path / "results"


def decoded(path: Path) -> list[np.ndarray]:
    with av.open(str(path)) as container:
        return [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]


def tile_of(image: np.ndarray, row: int, column: int, width: int) -> np.ndarray:
    """(H, W, 3): the inner part of a tile, without its strip."""
    height = image.shape[0] // 2
    top = row * height + STRIP
    return image[top + 4 : (row + 1) * height - 4, column * width + 4 : (column + 1) * width - 4]


def test_rows_are_conditions_and_columns_seeds(folder: Path) -> None:
    tiling = find_tiles([folder], columns=4)
    assert list(tiling.rows) == ["low, training seed 0", "high, training seed 0"]
    assert tiling.seeds == (1000, 1001, 1002)
    assert find_tiles([folder], columns=2).seeds == (1000, 1001)  # both have a video of those
    assert list(find_tiles([folder / "b"], columns=4).rows) == ["high, training seed 0"]


@pytest.mark.parametrize("view", ["angle", "front_close_zoom"])
def test_all_play_at_once_until_the_last_ends(folder: Path, tmp_path: Path, view: str) -> None:
    path = tmp_path / "tiles.mp4"
    write_tiles(path, find_tiles([folder], columns=3), view=view, width=PART)
    frames = decoded(path)
    assert len(frames) == 9
    share = (VIEWS.index(view) + 1) / len(VIEWS)
    for image in (frames[0], frames[-1]):
        assert image.shape == (2 * (HEIGHT + STRIP), 3 * PART, 3)
        for row, condition in enumerate(COLOURS):
            for column in range(2):
                part = tile_of(image, row, column, PART).reshape(-1, 3).mean(axis=0)
                assert part == pytest.approx(np.array(COLOURS[condition]) * share, abs=8)
        assert tile_of(image, 1, 2, PART).mean() < 40  # no video


def test_all_views_at_once(folder: Path, tmp_path: Path) -> None:
    path = tmp_path / "tiles.mp4"
    write_tiles(path, find_tiles([folder], columns=1), view="all", width=len(VIEWS) * PART)
    assert decoded(path)[0].shape == (2 * (HEIGHT + STRIP), len(VIEWS) * PART, 3)


def test_what_cannot_be_tiled_is_one_line(folder: Path, tmp_path: Path) -> None:
    with pytest.raises(RequestError, match=r"no results\.jsonl with videos beside it"):
        find_tiles([tmp_path / "results" / "a" / "videos"], columns=4)
    evaluate(tmp_path / "again", "low", {1000: 5})
    with pytest.raises(RequestError, match="are both of low, training seed 0, seed 1000"):
        find_tiles([folder, tmp_path / "again"], columns=4)
    with pytest.raises(RequestError, match="unknown view 'side'"):
        write_tiles(tmp_path / "tiles.mp4", find_tiles([folder], 1), view="side")
    with pytest.raises(RequestError, match="smaller --width"):
        write_tiles(tmp_path / "tiles.mp4", find_tiles([folder], 3), width=4096)
    evaluate(tmp_path / "fast", "low", {1005: 3}, fps=50.0)
    with pytest.raises(RequestError, match=r"has 50 frames/s .* 25 and .*; evaluate them alike"):
        write_tiles(tmp_path / "tiles.mp4", find_tiles([folder / "b", tmp_path / "fast"], 9))
    video = next((folder / "a" / "videos").glob("*1000*"))
    whole = video.read_bytes()
    video.write_bytes(whole[: len(whole) - 40])  # of the last frames: the index is at the front
    with pytest.raises(RequestError, match="is damaged: "):
        write_tiles(tmp_path / "tiles.mp4", find_tiles([folder], 1))
    video.write_bytes(b"no video")
    with pytest.raises(RequestError, match="is no video"):
        write_tiles(tmp_path / "tiles.mp4", find_tiles([folder], 1))
    assert not list(tmp_path.glob("*.mp4"))
    assert not list(tmp_path.glob(".*"))


def test_the_command(folder: Path, tmp_path: Path) -> None:
    command = [sys.executable, str(SCRIPT), "tile", str(folder), "--out", str(tmp_path / "t.mp4")]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "2 conditions, 3 seeds" in done.stdout
    assert decoded(tmp_path / "t.mp4")
    done = subprocess.run([*command[:3], "nowhere"], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr.count("\n")) == (2, 1)
