"""The mouth in metres from images: pose, lifting, distance, losses. No detector and no images."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import pytest
from numpy.typing import NDArray

from face_prediction.live.mouth import (
    LIP_SHIFT,
    OUTER_LIPS,
    MouthTracker,
    agreed_excess,
    head_pose_of_points,
)
from face_prediction.live.streaming import LiveForecast
from face_prediction.tracking.geometry import (
    CANONICAL_MOUTH,
    CENTIMETRE,
    LIPS,
    RIGID_LANDMARKS,
    Crop,
    matrix_from_quaternion,
    view_size,
)

SIZE, FOV = (640, 480), 47.0
IMAGE = np.zeros((SIZE[1], SIZE[0], 3), dtype=np.uint8)
AWAY = np.array([0.05, -0.02, -0.6])
"""m, camera frame: where the test's heads are."""


def head(scale: float = 1.0) -> NDArray[np.float64]:
    """Landmarks (468, 3) m of a head, its frame: rigid ones in their place, the lips in a ring."""
    points = np.zeros((468, 3))
    angles = np.linspace(0.0, 2 * np.pi, len(LIPS), endpoint=False)
    ring = np.stack([0.02 * np.cos(angles), 0.01 * np.sin(angles), np.zeros(len(LIPS))], axis=1)
    points[list(LIPS)] = CANONICAL_MOUTH + ring
    table = np.array(RIGID_LANDMARKS)
    points[table[:, 0].astype(int)] = table[:, 1:4] * CENTIMETRE
    return points * scale


def pose(turn: float = 0.4, at: NDArray[np.float64] = AWAY) -> NDArray[np.float64]:
    """Pose (4, 4), camera from head: turned by so many rad about the vertical."""
    result = np.eye(4)
    result[:3, :3] = matrix_from_quaternion(np.array([np.cos(turn / 2), 0.0, np.sin(turn / 2), 0]))
    result[:3, 3] = at
    return result


def seen(points: NDArray[np.float64], where: NDArray[np.float64]) -> NDArray[np.float64]:
    """Normalised image coordinates (P, 3) of points (P, 3) m in the head's frame."""
    x, y, z = (points @ where[:3, :3].T + where[:3, 3]).T
    width, height = view_size(SIZE, FOV)
    return np.stack([0.5 - x / z / width, 0.5 + y / z / height, np.zeros_like(x)], axis=1)


def mouth(where: NDArray[np.float64], scale: float = 1.0) -> NDArray[np.float64]:
    """Mouth (3,) m, camera frame."""
    return where[:3, :3] @ CANONICAL_MOUTH * scale + where[:3, 3]


@dataclass
class Faces:
    """Detector that finds the given landmarks, one after another; None: no face."""

    found: list[NDArray[np.float64] | None]
    begun: int = 0

    def follow(self):
        """Begin anew."""
        self.begun += 1
        return lambda image, time: self.found.pop(0)


@dataclass
class Drift:
    """Forecast that all landmarks go on by ``step`` (2,) of the image in each of two frames."""

    step: tuple[float, float] = (0.0, 0.0)
    times: list[float] = field(default_factory=list)

    def reset(self) -> None:
        """Forget everything."""
        self.times.clear()

    def update(self, time, landmarks, image):
        """Forecast two frames."""
        self.times.append(time)
        if landmarks is None:
            return None
        ahead = [landmarks[:, :2] + np.multiply(frame, self.step) for frame in (1, 2)]
        return LiveForecast(np.array(ahead), Crop(0, 0, 1), False, 1)


def track(*found: NDArray[np.float64] | None, step: tuple[float, float] = (0.0, 0.0)):
    faces, drift = Faces(list(found)), Drift(step)
    return MouthTracker(faces.follow, drift, FOV), faces, drift


@pytest.mark.parametrize("turn", [-0.6, 0.0, 0.5])
def test_the_pose_of_exact_pixels_is_exact(turn: float) -> None:
    where = pose(turn)
    found = head_pose_of_points(seen(head(), where), SIZE, FOV)
    np.testing.assert_allclose(found, where, atol=1e-6)  # solver's tolerance


def test_a_wrong_field_of_view_is_a_wrong_distance() -> None:
    """With the field that MediaPipe assumes, 63 degrees, the head would be a third nearer."""
    found = head_pose_of_points(seen(head(), pose()), SIZE, 63.0)
    ratio = np.tan(np.radians(FOV / 2)) / np.tan(np.radians(63.0 / 2))
    assert found[2, 3] / AWAY[2] == pytest.approx(ratio, abs=0.05)


def test_the_mouth_is_lifted_to_where_it_is() -> None:
    where = pose()
    tracker, _, _ = track(seen(head(), where))
    found = tracker.update(IMAGE, 0.0)
    assert found is not None
    assert found.shape == (3, 3)
    # The mean of the lips' pixels is not quite the pixel of their mean: 0.1 mm.
    np.testing.assert_allclose(found, np.tile(mouth(where), (3, 1)), atol=2e-4)


def test_forecasts_move_across_the_view_at_the_same_distance() -> None:
    where, step = pose(), (0.01, -0.02)
    tracker, _, _ = track(seen(head(), where), step=step)
    found = tracker.update(IMAGE, 0.0)
    assert found is not None
    width, height = view_size(SIZE, FOV)
    moved = -mouth(where)[2] * np.array([step[0] * width, -step[1] * height, 0.0])
    np.testing.assert_allclose(np.diff(found, axis=0), [moved, moved], atol=1e-6)


def test_a_larger_head_seems_nearer_and_a_depth_image_tells() -> None:
    """Heads differ in size; a camera without depth cannot know it."""
    scale, where = 1.1, pose()
    points = seen(head(scale), where)
    tracker, _, _ = track(points, points)
    flat = tracker.update(IMAGE, 0.0)
    assert flat is not None
    assert flat[0, 2] / mouth(where, scale)[2] == pytest.approx(1 / scale, abs=0.01)
    depth = np.full(SIZE[::-1], 5.0)  # a wall
    pixels = np.floor(points[:, :2] * SIZE).astype(int)
    depth[pixels[:, 1], pixels[:, 0]] = -(head(scale) @ where[:3, :3].T + where[:3, 3])[:, 2]
    tracker.reset()
    deep = tracker.update(IMAGE, 0.0, depth)
    assert deep is not None
    # Across, the rays are the same; the distance is that of the lips in the image, to 2 mm where
    # landmarks share pixels.
    np.testing.assert_allclose(deep[0], mouth(where, scale), atol=2e-3)


def test_what_hides_the_lips_leaves_the_distance_as_it_was() -> None:
    where = pose()
    points = seen(head(), where)
    tracker, _, _ = track(points, points)
    depth = np.full(SIZE[::-1], 5.0)
    pixels = np.floor(points[:, :2] * SIZE).astype(int)
    depth[pixels[:, 1], pixels[:, 0]] = -(head() @ where[:3, :3].T + where[:3, 3])[:, 2]
    before = tracker.update(IMAGE, 0.0, depth)
    lips = pixels[list(OUTER_LIPS)]
    depth[lips[:, 1], lips[:, 0]] -= 0.1  # a gripper
    after = tracker.update(IMAGE, 1 / 30, depth)
    assert before is not None
    assert after is not None
    np.testing.assert_allclose(after, before, atol=1e-9)


def test_points_that_do_not_agree_are_no_measurement() -> None:
    depth = np.arange(100.0).reshape(10, 10)
    points = np.stack([np.linspace(0.05, 0.95, 10), np.full(10, 0.5)], axis=1)
    assert agreed_excess(points, 0.0, depth, 0.5, 3) is None
    assert agreed_excess(points, depth[5], depth, 0.5, 10) == 0.0
    assert agreed_excess(points + 1.0, depth[5], depth, 0.5, 1) is None  # outside


def test_the_distance_is_an_average_until_the_face_is_lost() -> None:
    near, far = pose(at=AWAY), pose(at=AWAY * 1.1)
    first, second = seen(head(), near), seen(head(), far)
    tracker, _, _ = track(first, second, None, second)
    tracker.update(IMAGE, 0.0)
    found = tracker.update(IMAGE, 1 / 30)
    assert found is not None
    assert mouth(far)[2] < found[0, 2] < mouth(near)[2]
    assert tracker.update(IMAGE, 2 / 30) is None
    again = tracker.update(IMAGE, 1.0)
    assert again is not None
    assert again[0, 2] == pytest.approx(mouth(far)[2], abs=1e-3)


def test_a_reset_begins_with_another_face() -> None:
    tracker, faces, drift = track(seen(head(), pose()))
    tracker.update(IMAGE, 3.0)
    tracker.reset()
    assert faces.begun == 2
    assert drift.times == []


def drawn(points: NDArray[np.float64], across: float, up: float = 0.0) -> NDArray[np.float64]:
    """Landmarks with lips that are elsewhere by so many m."""
    width, height = view_size(SIZE, FOV)
    moved = points.copy()
    moved[list(LIPS), :2] += np.array([across / width, -up / height]) / -mouth(pose())[2]
    return moved


def across(tracker: MouthTracker, images: int, start: int = 0) -> NDArray[np.float64]:
    """Places (T, 2) m of the mouth across the view in so many images, from the true one."""
    found = [tracker.update(IMAGE, number / 30) for number in range(start, start + images)]
    places = np.array([own[0] for own in found if own is not None])
    return (places - mouth(pose()))[:, :2]


@pytest.mark.parametrize("turn", [-0.4, 0.0, 0.4])
def test_lips_that_are_drawn_aside_are_where_they_were(turn: float) -> None:
    where = pose(turn)
    plain = seen(head(), where)
    tracker, _, _ = track(*[plain] * 30, *[drawn(plain, 0.012, 0.008)] * 30)
    found = [tracker.update(IMAGE, number / 30) for number in range(60)]
    wrong = np.array([own[0] for own in found if own is not None]) - mouth(where)
    assert len(wrong) == 60
    assert np.abs(wrong[:30]).max() < 2e-4
    assert np.linalg.norm(wrong[30, :2]) < 3e-4
    assert np.linalg.norm(wrong[-1, :2]) < 3e-3  # a second later


def test_a_head_that_moves_takes_hidden_lips_along() -> None:
    where = pose(at=AWAY + np.array([0.03, 0.0, 0.0]))
    before, after = seen(head(), pose()), seen(head(), where)
    tracker, _, _ = track(*[before] * 30, drawn(after, 0.02))
    for number in range(30):
        tracker.update(IMAGE, number / 30)
    found = tracker.update(IMAGE, 1.0)
    assert found is not None
    np.testing.assert_allclose(found[0, :2], mouth(where)[:2], atol=1e-3)


def test_lips_that_move_a_little_are_believed() -> None:
    plain = seen(head(), pose())
    tracker, _, _ = track(*[plain] * 30, drawn(plain, 0.4 * LIP_SHIFT))
    across(tracker, 30)
    moved = across(tracker, 1, start=30)
    assert moved[0, 0] == pytest.approx(0.4 * LIP_SHIFT, abs=3e-4)


def test_what_lasts_is_believed_in_the_end() -> None:
    plain = seen(head(), pose())
    tracker, _, _ = track(*[plain] * 30, *[drawn(plain, 0.0, -0.01)] * 200)
    places = across(tracker, 230)
    assert abs(places[30, 1]) < 5e-4
    assert places[-1, 1] == pytest.approx(-0.01, abs=1e-3)


def test_a_reset_forgets_where_the_lips_were() -> None:
    plain = seen(head(), pose())
    tracker, _, _ = track(*[plain] * 30, drawn(plain, 0.02))
    across(tracker, 30)
    tracker.reset()
    assert across(tracker, 1)[0, 0] == pytest.approx(0.02, abs=5e-4)
