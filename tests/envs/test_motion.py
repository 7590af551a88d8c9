"""The motion library and the segments drawn from it."""

from __future__ import annotations

import contextlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from robo_manip_baselines.envs.mujoco.face.motion import (
    LIBRARIES,
    MotionLibrary,
    MotionSegment,
    library_file,
    pin_library,
)
from robo_manip_baselines.envs.mujoco.tasks.face_env import world_of
from robo_manip_baselines.envs.mujoco.tasks.registry import make_env, without_library_path
from robo_manip_baselines.runs.errors import RequestError

FPS = 30.0


def content(lengths: tuple[int, ...] = (500, 360, 420)) -> dict[str, Any]:
    """A library of runs that move in ways a test can tell apart."""
    frames = np.concatenate([np.arange(length) for length in lengths])
    angle = 0.001 * frames
    quaternion = Rotation.from_rotvec(angle[:, None] * [0.0, 1.0, 0.0]).as_quat(scalar_first=True)
    return {
        "schema": np.array("recorded_face_motion"),
        "version": np.array(1),
        "fps": np.array(FPS),
        "time": (frames / FPS).astype(np.float32),
        "mouth": np.stack([1e-4 * frames, 2e-4 * frames, -0.5 + 3e-4 * frames], -1).astype("f4"),
        "orientation": quaternion.astype(np.float32),
        "jaw": (1e-5 * frames).astype(np.float32),
        "run_start": np.cumsum([0, *lengths[:-1]]),
        "run_length": np.array(lengths),
        "run_clip": np.array([f"clip{i}" for i in range(len(lengths))]),
        "run_subject": np.array([f"subject{i}" for i in range(len(lengths))]),
        "metadata": np.array("{}"),
    }


def save(folder: Path, **changes: Any) -> Path:
    path = folder / "library.npz"
    values = {**content(), **changes}
    np.savez(path, **{name: value for name, value in values.items() if value is not None})
    return path


@pytest.fixture
def library(tmp_path: Path) -> MotionLibrary:
    return MotionLibrary.load(save(tmp_path))


def test_segment_maps_the_cameras_axes_to_the_worlds(library: MotionLibrary) -> None:
    segment = library.segment(0, 100)
    displacement, _, _ = segment.at(1.0)
    # In 30 frames: camera x +3 mm, y +6 mm, z +9 mm; world x is camera z, y is x, z is y.
    np.testing.assert_allclose(displacement, [9e-3, 3e-3, 6e-3], atol=1e-7)  # float32 storage


def test_segment_starts_without_displacement_and_follows_the_recording(
    library: MotionLibrary,
) -> None:
    segment = library.segment(2, 17)
    first = int(library.run_start[2]) + 17
    moved = library.mouth[first : first + 361] - library.mouth[first]
    displacement, orientation, jaw = segment.at(np.arange(361) / FPS)
    np.testing.assert_allclose(displacement, moved[:, [2, 0, 1]], atol=1e-12)
    np.testing.assert_allclose(jaw, library.jaw[first : first + 361], atol=1e-12)
    alike = np.abs((orientation * library.orientation[first : first + 361]).sum(axis=1))
    np.testing.assert_allclose(alike, 1.0, atol=1e-6)


def foretold(**changes: Any) -> dict[str, Any]:
    """Predictions that say in every frame: the mouth goes on as I say, not as it will."""
    mouth = content()["mouth"]
    ahead = np.arange(1, 6)[:, None] * [0.0, 0.01, 0.0]  # camera y, world z
    return {"predicted_mouth": (mouth[:, None] + ahead).astype(np.float32), **changes}


def test_predictions_are_read_and_relative_to_the_start(tmp_path: Path) -> None:
    assert MotionLibrary.load(save(tmp_path)).segment(0, 0).prediction_error(0.0) is None
    library = MotionLibrary.load(save(tmp_path, **foretold()))
    segment = library.segment(0, 100)
    assert segment.predicted is not None
    # Frame 30: the mouth has moved by camera (3, 6, 9) mm, and is foretold to rise by 10 mm each.
    wanted = [[9e-3, 3e-3, 6e-3 + 0.01 * k] for k in range(1, 6)]
    np.testing.assert_allclose(segment.predicted[30], wanted, atol=1e-6)
    error = segment.prediction_error(1.0)
    assert error is not None
    wanted = [[-3e-4 * k, -1e-4 * k, 0.01 * k - 2e-4 * k] for k in range(1, 6)]
    np.testing.assert_allclose(error, wanted, atol=1e-6)
    # The error of the last frame is held, and is known at the ends.
    late = segment.prediction_error([1.0 - 1e-4, 1.0 + 0.02, -1.0, 100.0])
    assert late is not None
    assert late.shape == (4, 5, 3)
    np.testing.assert_array_equal(late[1], error)
    assert not np.array_equal(late[0], error)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (foretold(predicted_mouth=np.zeros((3, 5, 3))), "'predicted_mouth' is float64"),
        (foretold(predicted_mouth=np.zeros((1280, 25, 3))), r"shape \(1280, 25, 3\); at most 24 H"),
        (foretold(predicted_mouth=np.zeros((1280, 0, 3))), "'predicted_mouth' is of no frame"),
        (foretold(predicted_mouth=np.full((1280, 5, 3), np.nan)), "holds NaN"),
        (foretold(predicted_mouth=np.zeros((1280, 5, 3), int)), "is int64"),
        (foretold(fps=np.array(25.0)), "of frames at 30 a second, 'fps' is 25.0"),
    ],
)
def test_wrong_predictions_are_refused(
    tmp_path: Path, changes: dict[str, Any], message: str
) -> None:
    with pytest.raises(RequestError, match=message):
        MotionLibrary.load(save(tmp_path, **changes))


@given(st.floats(min_value=-1.0, max_value=20.0))
def test_interpolation_is_the_obvious_one(time: float) -> None:
    rng = np.random.default_rng(0)
    frames = 40
    first = Rotation.random(1, rng=rng)
    rotations = first * Rotation.from_rotvec(0.05 * rng.standard_normal((frames, 3)))
    moved, turned = rng.standard_normal((frames, 3)), rotations.as_quat(scalar_first=True)
    segment = MotionSegment(FPS, moved, turned, rng.random(frames), "", "", start=0, index=0)
    displacement, orientation, jaw = segment.at(time)
    position = min(max(time * FPS, 0.0), frames - 1.0)
    low = min(int(position), frames - 2)
    share = position - low
    between = (1 - share) * segment.displacement[low] + share * segment.displacement[low + 1]
    np.testing.assert_allclose(displacement, between, atol=1e-9)
    between = (1 - share) * segment.jaw[low] + share * segment.jaw[low + 1]
    np.testing.assert_allclose(jaw, between, atol=1e-9)
    step = (rotations[low].inv() * rotations[low + 1]).as_rotvec()
    expected = rotations[low] * Rotation.from_rotvec(share * step)
    difference = expected.inv() * Rotation.from_quat(orientation, scalar_first=True)
    assert difference.magnitude() < 1e-7  # rad


def test_starts_are_uniform_over_every_frame_that_leaves_twelve_seconds(
    library: MotionLibrary,
) -> None:
    # 500 and 420 frames leave 140 and 60 starts; 360 frames are 11.97 s and leave none.
    assert library.starts().tolist() == [140, 0, 60]
    rng = np.random.default_rng(1)
    drawn = [library.draw(rng) for _ in range(4000)]
    share = np.mean([segment.clip == "clip0" for segment in drawn])
    # Four standard deviations of a binomial share of 0.7 in 4000 draws.
    assert abs(share - 0.7) < 4 * np.sqrt(0.7 * 0.3 / 4000)
    assert {s.start for s in drawn if s.clip == "clip0"} == set(range(140))
    assert {s.start for s in drawn if s.clip == "clip2"} == set(range(60))
    assert all(len(segment.jaw) >= 361 for segment in drawn)


def test_clips_restrict_the_draw(library: MotionLibrary) -> None:
    rng = np.random.default_rng(0)
    assert {library.draw(rng, clips=["clip2"]).clip for _ in range(20)} == {"clip2"}
    with pytest.raises(RequestError, match=r"unknown clip 'clip9'.*valid: clip0, clip1, clip2"):
        library.draw(rng, clips=["clip9"])
    with pytest.raises(RequestError, match=r"no run .* lasts 12 s in clips clip1"):
        library.draw(rng, clips=["clip1"])


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"schema": np.array("other")}, "schema 'other', expected 'recorded_face_motion'"),
        ({"schema": None}, "schema 'none'"),
        ({"version": np.array(2)}, "version 2"),
        ({"version": np.array("one")}, "version one"),
        ({"fps": np.array(0.0)}, "'fps' must be positive"),
        ({"fps": np.array([30.0, 30.0])}, "'fps' is float64"),
        ({"jaw": None}, "'jaw' is missing"),
        ({"metadata": np.array("{")}, "'metadata' is damaged"),
        ({"metadata": np.array("[" * 100_000)}, "'metadata' is damaged"),
        ({"mouth": np.zeros((1280, 2), "f4")}, "'mouth' is float32"),
        ({"mouth": np.zeros(1280, "f4")}, "'mouth' is float32"),
        ({"mouth": np.full((1280, 3), np.nan, "f4")}, "'mouth' holds NaN"),
        ({"orientation": np.full((1280, 4), 0.4, "f4")}, "not of unit length"),
        ({"jaw": np.zeros(7, "f4")}, "'jaw' is float32 .7,., expected kind 'f' and shape .1280,"),
        ({"jaw": np.full(1280, -0.01, "f4")}, "'jaw' is negative at row 0"),
        ({"time": np.zeros(1280, "f4")}, "'time' does not increase in the run from frame 0 on"),
        ({"run_clip": np.array(["a"])}, "'run_clip' is <U1 .1,., expected"),
        ({"run_start": np.array([0, 500, 1000])}, "outside the frames"),
        ({"run_start": np.array([0, 500, 2**63 - 1])}, "outside the frames"),
        ({"run_start": np.array([0, 500, -1])}, "'run_start' is negative at row 2"),
        ({"run_length": np.array([500, 360, 0])}, "'run_length' must be positive"),
    ],
)
def test_damaged_libraries_are_refused_by_name(
    tmp_path: Path, changes: dict[str, Any], message: str
) -> None:
    path = save(tmp_path, **changes)
    with pytest.raises(RequestError, match=f"library.npz': .*{message}") as caught:
        MotionLibrary.load(path)
    assert "\n" not in str(caught.value)


def test_truncated_and_missing_files_are_refused_by_name(tmp_path: Path) -> None:
    path = save(tmp_path)
    whole = path.read_bytes()
    for length in (0, 10, len(whole) // 2, len(whole) - 1):
        path.write_bytes(whole[:length])
        with pytest.raises(RequestError, match=r"library.npz': damaged or not an .npz file"):
            MotionLibrary.load(path)
    with pytest.raises(RequestError, match=r"nowhere.npz' does not exist"):
        MotionLibrary.load(tmp_path / "nowhere.npz")


def test_pickles_are_never_loaded(tmp_path: Path) -> None:
    path = tmp_path / "library.npz"
    np.savez(path, **{**content(), "jaw": np.array([{}], dtype=object)})
    with pytest.raises(RequestError, match="'jaw' holds Python objects") as caught:
        MotionLibrary.load(path)
    assert "allow_pickle" not in str(caught.value)


@pytest.fixture(scope="module")
def extended() -> MotionLibrary:
    return MotionLibrary.load("extended")


def test_a_library_that_ships_is_loaded_by_its_name(extended: MotionLibrary) -> None:
    assert library_file("extended") == LIBRARIES["extended"] == library_file(Path("extended"))
    assert extended.sha256 == MotionLibrary.load(LIBRARIES["extended"]).sha256
    assert extended.predicted is None
    with pytest.raises(RequestError, match=r"'extnded' does not exist; .*one that ships: extended"):
        MotionLibrary.load("extnded")


def test_the_extended_library_holds_the_default_one(extended: MotionLibrary) -> None:
    default = MotionLibrary.load()
    frames, runs = len(default.mouth), len(default.run_start)
    np.testing.assert_array_equal(extended.mouth[:frames], default.mouth)
    assert extended.run_clip[:runs] == default.run_clip
    # A seed finds another start in it, and so the digests differ.
    assert extended.motion_sha256 != default.motion_sha256


@pytest.mark.parametrize("people", ["train", "test"])
def test_the_people_of_the_extended_library_are_all_drawn(
    extended: MotionLibrary, people: str
) -> None:
    part = extended.part(people)
    rng = np.random.default_rng(0)
    drawn = [part.draw(rng).subject for _ in range(150)]
    # Of 6 or 7 people drawn uniformly, one is missed in 150 draws with odds below 1e-8.
    assert set(drawn) == set(part.run_subject)
    before = set(MotionLibrary.load().part(people).run_subject)
    assert before < set(part.run_subject)


def test_the_default_library_is_the_one_of_published_results() -> None:
    """The digest of its motion; that of the whole file changes with the predictions."""
    assert MotionLibrary.load().motion_sha256.startswith("1dba6fd2fb3a6a4a")


def test_what_was_recorded_with_a_library_that_ships_names_it(extended: MotionLibrary) -> None:
    path, sha256 = str(LIBRARIES["extended"]), extended.sha256
    named = {"motion_library": "extended", "motion_sha256": sha256}
    assert pin_library({"motion_library": "extended"}) == named
    assert without_library_path(named) == named
    assert without_library_path({"motion_library": path, "motion_sha256": sha256}) == named
    default = MotionLibrary.load().sha256
    assert without_library_path({"motion_sha256": default}) == {}
    with contextlib.closing(make_env("FeedingEnv", cameras=(), people="test", **named)) as env:
        env.reset(seed=0)
        assert world_of(env).segment.clip in extended.run_clip


def test_the_extended_library_has_no_forecasts_to_show() -> None:
    arguments: dict[str, Any] = {"obs": "current_pred", "corruption": {"error": "model"}}
    with pytest.raises(RequestError, match="holds no predicted mouth"):
        make_env("FeedingEnv", cameras=(), motion_library="extended", **arguments)
