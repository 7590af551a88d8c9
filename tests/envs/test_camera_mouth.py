"""The mouth by a camera: timing, losses, lifting back to the truth, and what it leaves alone."""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from face_prediction.live.mouth import MouthTracker
from face_prediction.live.streaming import LiveForecast
from face_prediction.tracking import detector
from face_prediction.tracking.geometry import Crop
from robo_manip_baselines.envs.mujoco.cell.rendering import project
from robo_manip_baselines.envs.mujoco.cell.scene import MOUTH_BASE
from robo_manip_baselines.envs.mujoco.face import camera_mouth, perception
from robo_manip_baselines.envs.mujoco.face.camera_mouth import CAMERA, IMAGE_SIZE
from robo_manip_baselines.envs.mujoco.face.model import rotate
from robo_manip_baselines.envs.mujoco.tasks.face_env import FaceEnv, world_of
from robo_manip_baselines.envs.mujoco.tasks.registry import make_env
from robo_manip_baselines.observation import FRAME_PERIOD, MAX_HORIZON, ObservationSpec
from robo_manip_baselines.runs.errors import RequestError

pytestmark = pytest.mark.gl

Floats = NDArray[np.float64]
SEED = 1000
BLIND = {"obs": "current_pred", "horizon": 5, "cameras": ()}


class FakeTracker:
    """Tracker that knows the world: the true mouth at each image, which it marks by horizon.

    Attributes:
        times: of its images.
        lost: numbers of the images in which it finds nothing.
    """

    def __init__(self, lost: tuple[int, ...] = ()) -> None:
        self.times: list[float] = []
        self.lost, self.world, self.is_closed = lost, None, False

    def reset(self) -> None:
        self.times.clear()

    def update(self, image: Any, time: float, depth: Any = None) -> Floats | None:
        assert image.shape == (*IMAGE_SIZE, 3)
        self.times.append(time)
        if len(self.times) - 1 in self.lost:
            return None
        assert self.world is not None
        ahead = time + np.arange(MAX_HORIZON + 1) * FRAME_PERIOD
        eye = self.world.data.camera(CAMERA)
        return (self.world.mouth_at(ahead) - eye.xpos) @ eye.xmat.reshape(3, 3)

    def close(self) -> None:
        self.is_closed = True


Open = Callable[..., tuple[FaceEnv, FakeTracker]]


@pytest.fixture
def open_world(monkeypatch: pytest.MonkeyPatch) -> Iterator[Open]:
    """Make an environment whose tracker is a `FakeTracker`."""
    made: list[FaceEnv] = []

    def open_one(*, lost: tuple[int, ...] = (), **kwargs: Any) -> tuple[FaceEnv, FakeTracker]:
        tracker = FakeTracker(lost)
        monkeypatch.setattr(camera_mouth, "find_tracker", lambda: lambda fov, ahead: tracker)
        kwargs = {**BLIND, "mouth_source": "camera", **kwargs}
        made.append(world_of(make_env("FeedingEnv", **kwargs)))
        tracker.world = made[-1]
        return made[-1], tracker

    yield open_one
    for world in made:
        world.close()


def hold(world: FaceEnv) -> NDArray[np.float32]:
    """Action that keeps the arm where it is."""
    return world.data.ctrl[world._actuators].astype(np.float32)


def test_thirty_images_a_second_whatever_the_control_period(open_world: Open) -> None:
    world, tracker = open_world()
    world.reset(seed=SEED)
    for _ in range(50):
        world.step(hold(world))
    assert len(tracker.times) == 31
    # at the physics step nearest to each thirtieth
    np.testing.assert_allclose(tracker.times, np.arange(31) / 30, atol=1.01e-3)
    assert world.camera_mouth is not None
    assert world.camera_mouth.frames == 31


@pytest.mark.parametrize("latency", [0, 1, 3])
def test_a_report_arrives_after_the_latency(open_world: Open, latency: int) -> None:
    world, tracker = open_world(camera_latency=latency)
    world.reset(seed=SEED)
    for _ in range(30):
        world.step(hold(world))
        target = world.observed_target
        assert target is not None
        known = [t for t in tracker.times if t + latency / 30 <= world.time + 1e-6]
        assert float(target.time) == (known[-1] if known else 0.0)
        ahead = float(target.time) + np.arange(MAX_HORIZON + 1) * FRAME_PERIOD
        np.testing.assert_allclose(target.position, world.mouth_at(ahead), atol=1e-12)


def test_the_vector_shows_the_report(open_world: Open) -> None:
    world, _ = open_world(camera_latency=2)
    world.reset(seed=SEED)
    for _ in range(30):
        observation, *_ = world.step(hold(world))
    timed = observation["prediction"][:24].reshape(6, 4)
    target = world.observed_target
    assert target is not None
    assert timed[0, 0] == pytest.approx(float(target.time))
    assert world.time - 4 / 30 < timed[0, 0] < world.time - 2 / 30 + 1e-6
    np.testing.assert_allclose(timed[:, 1:], target.position[:6], atol=1e-6)
    assert world.observation_space.contains(observation)


def test_history_is_what_was_reported(open_world: Open) -> None:
    world, _ = open_world(obs="history", camera_latency=1)
    world.reset(seed=SEED)
    reported = []
    for _ in range(50):
        observation, *_ = world.step(hold(world))
        reported.append((world.time, observation["mouth"][:3]))
    past = observation["history"].reshape(5, 3)
    for ago, place in enumerate(past, start=1):
        moment = world.time - ago / 30
        then = [mouth for at, mouth in reported if at <= moment + 1e-6][-1]
        # the report before or after that control step
        assert np.abs(place - then).max() < 1e-3


def test_a_lost_face_leaves_the_last_report_and_is_counted(open_world: Open) -> None:
    world, tracker = open_world(lost=tuple(range(5, 10)), camera_latency=0)
    world.reset(seed=SEED)
    for _ in range(16):  # until 0.32 s, image 9
        world.step(hold(world))
    target = world.observed_target
    assert target is not None
    assert float(target.time) == tracker.times[4]
    assert world.frames_without_detection == 5
    world.step(hold(world))
    world.step(hold(world))
    assert float(world.observed_target.time) == tracker.times[10]  # type: ignore[union-attr]
    assert world.frames_without_detection == 5
    world.reset(seed=SEED)
    assert world.frames_without_detection == 0


def test_before_the_first_sight_the_mouth_is_where_a_head_is_placed(open_world: Open) -> None:
    world, _ = open_world(lost=(0, 1))
    world.reset(seed=SEED)
    np.testing.assert_array_equal(world.observed_target.position[0], MOUTH_BASE)  # type: ignore[union-attr]
    for _ in range(6):
        world.step(hold(world))
    assert np.abs(world.observed_target.position[0] - MOUTH_BASE).max() > 1e-3  # type: ignore[union-attr]


def test_the_camera_leaves_the_world_alone(open_world: Open) -> None:
    """Rendering within a control step changes nothing that follows, to the last bit."""
    states = []
    for source in ("truth", "camera"):
        world, _ = open_world(mouth_source=source)
        world.reset(seed=SEED)
        rng = np.random.default_rng(0)
        low, high = world.action_space.low, world.action_space.high
        for _ in range(20):
            world.step(rng.uniform(low, high).astype(np.float32))
        states.append(np.concatenate([world.data.qpos, world.data.qvel]))
    np.testing.assert_array_equal(*states)


def test_the_servo_goes_by_the_camera(open_world: Open) -> None:
    world, tracker = open_world()
    expert = world.task.make_expert("servo", world)
    assert getattr(expert, "goes_by_observation", False)
    world.reset(seed=SEED)
    true = world.mouth_at(world.time + 0.1)
    np.testing.assert_allclose(world.forecast_mouth(world.time, 0.1), true, atol=1e-3)
    shift = np.array([0.0, 0.05, 0.0])
    original = tracker.update
    tracker.update = lambda *args: original(*args) + shift  # type: ignore[method-assign]
    world.reset(seed=SEED)
    assert np.abs(world.forecast_mouth(world.time, 0.1) - true).max() > 0.02


def test_the_truth_is_forecast_where_nothing_is_observed(open_world: Open) -> None:
    world, _ = open_world(mouth_source="truth")
    world.reset(seed=SEED)
    assert world.observed_target is None
    assert world.frames_without_detection is None
    np.testing.assert_array_equal(world.forecast_mouth(0.5, 0.1), world.mouth_at(0.6))


def test_a_copy_is_refused_and_closing_frees_the_tracker(open_world: Open) -> None:
    world, tracker = open_world()
    with pytest.raises(RequestError, match="cannot be copied"):
        copy.deepcopy(world)
    world.close()
    assert tracker.is_closed


class Still:
    """Forecast that nothing moves."""

    def reset(self) -> None:
        pass

    def update(self, time: float, landmarks: Any, image: Any) -> LiveForecast:
        ahead = np.repeat(landmarks[None, :, :2], MAX_HORIZON, axis=0)
        return LiveForecast(ahead, Crop(0, 0, 1), False, 1)


# Across the view the lifting is exact but for the mean of pixels; along it, the head's proportions
# are not quite those of the canonical face, which a depth image corrects.
@pytest.mark.parametrize(("source", "across", "along"), [("camera", 1, 15), ("depth_camera", 1, 4)])
def test_projected_landmarks_are_lifted_back(
    source: str, across: float, along: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    worlds: list[FaceEnv] = []

    def find(image: Any, time: float) -> Floats:
        """The truth, projected: a detector without error."""
        (world,) = worlds
        number = world.model.body("face/head").id
        points = world.face.deform(world.face.jaw_angle(world.jaw_opening))
        turned = rotate(world.data.xquat[number], points) + world.data.xpos[number]
        pixels = project(world.model, world.data, CAMERA, turned, IMAGE_SIZE)
        return np.column_stack([pixels / IMAGE_SIZE[::-1], np.zeros(len(pixels))])

    def open_tracker(fov: float, ahead: int) -> MouthTracker:
        return MouthTracker(lambda: find, Still(), fov)

    monkeypatch.setattr(camera_mouth, "find_tracker", lambda: open_tracker)
    env = make_env("FeedingEnv", **BLIND, mouth_source=source, camera_latency=0)
    worlds.append(world := world_of(env))
    errors = []
    for seed in (1000, 1003):
        world.reset(seed=seed)
        for _ in range(12):
            world.step(hold(world))
        target = world.observed_target
        assert target is not None
        wrong = target.position[0] - world.mouth_at(float(target.time))
        errors.append(1e3 * wrong @ world.data.camera(CAMERA).xmat.reshape(3, 3))
    env.close()
    assert np.abs(errors)[:, :2].max() < across
    assert np.abs(errors)[:, 2].max() < along


# -- spec -----------------------------------------------------------------------------------------


def test_the_source_is_in_name_and_json_only_where_it_is_a_camera() -> None:
    truth, camera = ObservationSpec("current"), ObservationSpec("current", mouth_source="camera")
    assert "mouth_source" not in truth.to_json()
    assert "camera_latency" not in truth.to_json()
    assert truth.name == "current"
    assert camera.name == "current_camera"
    late = ObservationSpec("current", mouth_source="depth_camera", camera_latency=3)
    assert late.name == "current_depth_camera_latency3"
    for spec in (camera, late, ObservationSpec("current", mouth_source="camera")):
        assert ObservationSpec.from_json(spec.to_json()) == spec
    # a latency without a camera means nothing
    assert ObservationSpec("current", camera_latency=5) == truth


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"mouth_source": "eye"}, "unknown mouth source 'eye'.*valid: camera, depth_camera, truth"),
        ({"mouth_source": "camera", "camera_latency": -1}, "camera_latency -1: must be 0 to 900"),
        ({"mouth_source": "camera", "camera_latency": "fast"}, "number of frames.*or measured"),
        (
            {"mouth_source": "camera", "corruption": {"delay": 2}},
            "goes without 'delay2'; leave the corruption out",
        ),
    ],
)
def test_wrong_requests_are_refused(kwargs: dict[str, Any], message: str) -> None:
    with pytest.raises(RequestError, match=message):
        make_env("FeedingEnv", **BLIND, **kwargs)


def test_a_missing_tracker_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(perception, "TRACKER", "no_such_package.mouth:open_tracker")
    with pytest.raises(RequestError, match="mouth_source camera: its tracker cannot be imported"):
        make_env("FeedingEnv", **BLIND, mouth_source="camera")


def test_a_missing_model_is_one_line(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(detector.find_model, "__defaults__", ("http://localhost:9/none", "", None))
    with pytest.raises(RequestError, match=r"no model at .* then put it there$"):
        make_env("FeedingEnv", **BLIND, mouth_source="camera")


# -- the real detector ----------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.shared
def test_the_detector_finds_the_face_and_gives_the_same_twice(
    shared_dir: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("mediapipe")
    cache = tmp_path / "face_prediction"
    cache.mkdir()
    (cache / "face_landmarker.task").symlink_to(shared_dir / "faces/face_landmarker.task")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    world = world_of(make_env("FeedingEnv", **BLIND, mouth_source="camera"))
    vectors = []
    for _ in range(2):
        world.reset(seed=SEED)
        actor = world.task.make_expert("servo", world)
        actor.reset()
        errors = []
        for _ in range(60):  # the arm fetches the cube, away from the face
            world.step(actor.act())
            target = world.observed_target
            assert target is not None
            wrong = target.position[0] - world.mouth_at(float(target.time))
            errors.append(wrong @ world.data.camera(CAMERA).xmat.reshape(3, 3))
        vectors.append(world.vector.copy())
        assert world.frames_without_detection == 0
        # 3 px of the 1.15 mm that a pixel is there
        assert np.sqrt((np.array(errors)[:, :2] ** 2).sum(axis=1)).mean() < 4e-3
        assert np.abs(np.array(errors)[:, 2]).mean() < 0.04
    np.testing.assert_array_equal(*vectors)
    world.close()
