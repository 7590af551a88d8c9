"""The recorded motion that comes with the package keeps its promises."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from face_prediction.motion.library import RecordedMotion, load_motion
from face_prediction.motion.report import BEGIN, END, tables
from face_prediction.tracking.geometry import rotation_angle

WINDOW = 361  # 12 s at 30 frames a second
REACH = 0.08  # m on each axis
FACING = 35.0  # degrees


@pytest.fixture(scope="module")
def path(repository: Path) -> Path:
    return repository / "robo_manip_baselines/envs/mujoco/face/assets/face_motion.npz"


@pytest.fixture(scope="module")
def library(path: Path) -> RecordedMotion:
    return load_motion(path)


def test_three_minutes_of_five_people_in_runs_of_twelve_seconds(library: RecordedMotion) -> None:
    assert library.fps == 30.0
    assert library.seconds >= 180.0
    assert len(set(library.run_subject.tolist())) >= 5
    assert library.run_length.min() >= WINDOW


def test_it_is_small(path: Path) -> None:
    assert path.stat().st_size < 2_000_000


def test_every_permitted_start_keeps_the_mouth_within_reach(library: RecordedMotion) -> None:
    for index in range(len(library.run_start)):
        mouth = library.mouth[library.run(index)].astype(float)
        for start in range(len(mouth) - WINDOW + 1):
            moved = mouth[start : start + WINDOW] - mouth[start]
            assert np.abs(moved).max() <= REACH + 1e-6  # stored as float32


def test_heads_face_the_camera(library: RecordedMotion) -> None:
    angle = np.degrees(rotation_angle(library.orientation, np.array([1.0, 0, 0, 0])))
    assert angle.max() <= FACING + 1e-3  # stored as float32


def test_motion_is_what_a_head_can_do(library: RecordedMotion) -> None:
    limits = library.metadata["settings"]["limits"]
    for index in range(len(library.run_start)):
        part = library.run(index)
        mouth, orientation = library.mouth[part].astype(float), library.orientation[part]
        speed = np.linalg.norm(np.diff(mouth, axis=0), axis=1) * library.fps
        assert speed.max() < 2 * limits["max_speed"]
        assert np.median(speed) < 0.15
        assert np.all(np.sum(orientation[1:] * orientation[:-1], axis=1) > 0)  # no sign flips
        turn = np.degrees(rotation_angle(orientation[1:], orientation[:-1])) * library.fps
        assert turn.max() <= limits["max_turn_rate"]
        assert library.jaw[part].min() >= 0
        assert library.jaw[part].max() < 0.06  # a wide yawn


def test_the_mouth_is_before_the_camera(library: RecordedMotion) -> None:
    assert library.mouth[:, 2].max() < -0.1


def test_every_clip_is_attributed_and_every_cut_counted(library: RecordedMotion) -> None:
    clips = set(library.run_clip.tolist())
    assert set(library.metadata["attribution"]) == clips
    for row in library.metadata["attribution"].values():
        assert row["licence"] not in ("", "not stated")
        assert row["source"]
    causes = ("kept", "no_face", "spike", "turned_away", "too_short", "out_of_reach")
    for row in library.metadata["clips"].values():
        assert sum(row[cause] for cause in causes) == row["frames"]
    kept = sum(row["kept"] for row in library.metadata["clips"].values())
    assert kept == len(library.time)
    for detector in library.metadata["detectors"]:
        assert detector["running_mode"] == "image"
        assert detector["smoothed"] is False


def test_the_page_shows_this_library(library: RecordedMotion, repository: Path) -> None:
    page = repository / "docs/face_motion.md"
    text = page.read_text(encoding="utf-8")
    generated = text.split(BEGIN)[1].split(END)[0]
    assert tables(library) in generated, "run export-motion again with --report docs/face_motion.md"
    for clip in set(library.run_clip.tolist()):
        assert f"(images/motion_{clip}.png)" in generated
        assert (page.parent / "images" / f"motion_{clip}.png").stat().st_size < 80_000
