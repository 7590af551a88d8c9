"""The recorded motions that come with the package keep their promises."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from face_prediction.commands.predict import require_same_motion
from face_prediction.motion.library import RecordedMotion, load_motion
from face_prediction.motion.motion import MotionSettings
from face_prediction.motion.report import BEGIN, END, SPLICE_MARKS, splice_tables, tables
from face_prediction.tracking.geometry import rotation_angle
from robo_manip_baselines.runs.errors import RequestError

WINDOW = 361  # 12 s at 30 frames a second
REACH = 0.08  # m on each axis
FACING = 35.0  # degrees


@pytest.fixture(scope="module")
def assets(repository: Path) -> Path:
    return repository / "robo_manip_baselines/envs/mujoco/face/assets"


@pytest.fixture(scope="module", params=["face_motion.npz", "face_motion_extended.npz"])
def path(assets: Path, request: pytest.FixtureRequest) -> Path:
    return assets / request.param


@pytest.fixture(scope="module")
def library(path: Path) -> RecordedMotion:
    return load_motion(path)


@pytest.fixture(scope="module")
def recorded(assets: Path) -> RecordedMotion:
    return load_motion(assets / "face_motion.npz")


@pytest.fixture(scope="module")
def extended(assets: Path) -> RecordedMotion:
    return load_motion(assets / "face_motion_extended.npz")


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
    rows = [*library.metadata["clips"].values(), *library.metadata.get("splices", {}).values()]
    kept = sum(row["kept"] for row in rows)
    assert kept == len(library.time)
    for detector in library.metadata["detectors"]:
        assert detector["running_mode"] == "image"
        assert detector["smoothed"] is False


def test_the_page_shows_these_libraries(
    recorded: RecordedMotion, extended: RecordedMotion, repository: Path
) -> None:
    page = repository / "docs/face_motion.md"
    text = page.read_text(encoding="utf-8")
    parts = (
        ((BEGIN, END), tables(recorded), set(recorded.run_clip.tolist())),
        (SPLICE_MARKS, splice_tables(extended), set(extended.metadata["splices"])),
    )
    for (begin, end), content, clips in parts:
        generated = text.split(begin)[1].split(end)[0]
        assert content in generated, "run export-motion again with --report docs/face_motion.md"
        for clip in clips:
            assert f"(images/motion_{clip}.png)" in generated
            assert (page.parent / "images" / f"motion_{clip}.png").stat().st_size < 80_000


def test_the_extended_library_begins_with_the_other_bit_for_bit(
    recorded: RecordedMotion, extended: RecordedMotion
) -> None:
    frames, runs = len(recorded.time), len(recorded.run_start)
    for name in ("time", "mouth", "orientation", "jaw"):
        np.testing.assert_array_equal(getattr(extended, name)[:frames], getattr(recorded, name))
    for name in ("run_start", "run_length", "run_clip", "run_subject"):
        np.testing.assert_array_equal(getattr(extended, name)[:runs], getattr(recorded, name))


def test_the_extended_library_has_more_people_and_nobody_has_most(
    recorded: RecordedMotion, extended: RecordedMotion
) -> None:
    assert extended.seconds >= 370.0
    subjects = extended.run_subject.tolist()
    assert len(set(subjects)) >= 13
    for person in set(subjects):
        own = extended.run_length[extended.run_subject == person]
        assert (own - 1).sum() / extended.fps <= 0.20 * extended.seconds
    # Whom a policy has seen in demonstrations stays in that part.
    people = extended.metadata["people"]
    assert set(people["train"]) | set(people["test"]) == set(subjects)
    assert {"latentsync_demo2", "pexels_3063838", "us_gov_whitehouse2021"} <= set(people["train"])
    assert {"clm", "obama", "pexels_8090198"} <= set(people["test"])
    assert {"intel_asl_a", "intel_asl_b"} <= set(people["test"])  # filmed in one room


def test_marks_of_spliced_runs_are_true(recorded: RecordedMotion, extended: RecordedMotion) -> None:
    assert recorded.blended is None
    assert recorded.mirrored is None
    blended, mirrored = extended.blended, extended.mirrored
    assert blended is not None
    assert mirrored is not None
    before = len(recorded.time)
    assert not blended[:before].any()
    assert not mirrored[:before].any()
    blend = round(extended.metadata["splice_settings"]["blend"] * extended.fps)
    for name, row in extended.metadata["splices"].items():
        own = np.flatnonzero(extended.run_clip == name)
        frames = np.concatenate([np.arange(len(blended))[extended.run(run)] for run in own])
        assert blended[frames].mean() == pytest.approx(row["blended"], abs=1e-3)
        assert mirrored[frames].mean() == pytest.approx(row["mirrored"], abs=1e-3)
        assert blended[frames].sum() <= (len(row["stretches"]) - 1) * (blend - 1)
        # Each stretch at most once in each direction.
        used = [(s["clip"], s["first"], s["mirrored"]) for s in row["stretches"]]
        assert len(set(used)) == len(used)


def test_spliced_runs_are_not_forecast(extended: RecordedMotion) -> None:
    with pytest.raises(RequestError, match="has spliced runs, of which there is no track"):
        require_same_motion(extended, [], MotionSettings())
