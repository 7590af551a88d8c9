"""Windows on small faces, and the pose under the whole image's camera."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from face_prediction.tracking.detector import FaceDetection
from face_prediction.tracking.extract import (
    FaceFollower,
    ZoomingDetector,
    is_well_inside,
    search_windows,
    whole_image_detection,
    window_around,
)
from face_prediction.tracking.geometry import (
    CanonicalFace,
    Crop,
    head_pose_from_landmarks,
    read_canonical_face,
    rigid_face,
    rigid_head_poses,
)
from robo_manip_baselines.runs.errors import RequestError


def canonical() -> CanonicalFace:
    random = np.random.default_rng(0)
    vertices = random.uniform([-0.07, -0.09, -0.02], [0.07, 0.08, 0.07], (468, 3))
    weights = np.zeros(468)
    weights[random.choice(468, 33, replace=False)] = random.uniform(0.01, 0.1, 33)
    return CanonicalFace(vertices, weights)


def seen(face: CanonicalFace, pose: np.ndarray, image_size: tuple[int, int], project) -> np.ndarray:
    """Landmarks of the face in ``pose``, with depth relative to its mean on the scale of x."""
    points = face.vertices @ pose[:3, :3].T + pose[:3, 3]
    landmarks = project(points, image_size)
    depth = -points[:, 2]
    width, height = image_size
    view_width = 2 * np.tan(np.radians(31.5)) * width / height
    landmarks[:, 2] = (depth / depth.mean() - 1) / view_width
    return landmarks


@pytest.mark.parametrize("image_size", [(640, 480), (1080, 1920), (300, 300)])
@pytest.mark.parametrize("angles", [(0, 0, 0), (20, -30, 10)])
def test_pose_comes_back_from_the_projection(project, image_size, angles) -> None:
    face = canonical()
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_euler("xyz", angles, degrees=True).as_matrix()
    pose[:3, 3] = (0.05, -0.03, -0.6)
    landmarks = seen(face, pose, image_size, project)
    got = head_pose_from_landmarks(landmarks, image_size, face)
    np.testing.assert_allclose(got, pose, atol=1e-9)


def test_the_rigid_landmarks_are_above_the_mouth() -> None:
    face = rigid_face()
    assert np.count_nonzero(face.weights) == 25
    assert face.vertices[face.weights > 0, 1].min() > -0.01  # the mouth is at -0.043
    assert abs(face.weights @ face.vertices[:, 0]) < 1e-9  # as many left as right


def test_an_opening_jaw_does_not_bring_the_face_nearer(make_track) -> None:
    mouth = np.tile([0.0, 0.0, -0.4], (30, 1))
    track = make_track(mouth, jaw=np.linspace(0.0, 0.03, 30))
    track.landmarks[:, [132, 136, 361, 365], 1] += np.linspace(0.0, 0.03, 30)[:, None]
    poses = rigid_head_poses(track.landmarks, track.valid, track.image_size)
    np.testing.assert_allclose(poses, track.head_pose, atol=1e-9)


def test_a_model_that_is_none_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "face_landmarker.task"
    path.write_bytes(b"PK\x03\x04 nothing")
    with pytest.raises(RequestError, match="not a face landmarker model"):
        read_canonical_face(path)


def blob(left: float, top: float, width: float, image_size: tuple[int, int]) -> FaceDetection:
    """A square "face" of ``width`` pixels at (left, top)."""
    grid = np.stack(np.meshgrid(np.linspace(0, 1, 18), np.linspace(0, 1, 26)), -1).reshape(-1, 2)
    points = np.zeros((468, 3))
    points[:, :2] = (grid * width + (left, top)) / image_size
    return FaceDetection(points, np.eye(4))


def test_a_face_in_a_window_is_put_where_it_is_in_the_image() -> None:
    size = (1280, 720)
    window = Crop(left=400, top=100, side=200)
    inside = blob(50, 60, 80, (200, 200))
    inside.landmarks[:, 2] = 0.1  # a tenth of the window's width
    whole = whole_image_detection(inside, window, size, canonical())
    centre, width = whole.box(size)
    np.testing.assert_allclose(centre, (490, 200))
    assert width == pytest.approx(80)
    np.testing.assert_allclose(whole.landmarks[:, 2], 0.1 * 200 / 1280)


@pytest.mark.parametrize(
    ("centre", "width", "expected"),
    [
        ((640, 360), 100, Crop(490, 210, 300)),
        ((640, 360), 256, None),  # a fifth of the longer side: large enough
        ((10, 700), 100, Crop(0, 420, 300)),  # kept inside the image
        ((640, 360), 240, None),  # three faces would be the whole height
    ],
)
def test_window_around(centre, width, expected) -> None:
    assert window_around(np.array(centre), width, (1280, 720)) == expected


@pytest.mark.parametrize(
    ("offset", "width", "fits"),
    [(0, 100, True), (59, 100, True), (61, 100, False), (0, 141, False), (0, 71, False)],
)
def test_a_window_stands_still_until_the_face_has_left_its_middle(offset, width, fits) -> None:
    window = Crop(490, 210, 300)
    assert is_well_inside(window, np.array([640 + offset, 360]), width) == fits
    assert is_well_inside(window, np.array([640, 360 - offset]), width) == fits


@pytest.mark.parametrize("image_size", [(1280, 720), (720, 1280), (90, 90), (3, 2)])
def test_search_windows_cover_the_image(image_size) -> None:
    covered = np.zeros(image_size[::-1], dtype=bool)
    for window in search_windows(image_size):
        assert window.left >= 0
        assert window.top >= 0
        part = window.region(np.ones((*image_size[::-1], 3), dtype=np.uint8))
        assert part.shape == (window.side, window.side, 3)
        covered[window.top : window.top + window.side, window.left : window.left + window.side] = (
            True
        )
    assert covered.all() or min(image_size) < 4


class NearSighted:
    """Finds a bright square, if it is at least a tenth as wide as the picture shown."""

    def __init__(self) -> None:
        self.shown: list[tuple[int, int]] = []

    def __call__(self, image: np.ndarray, time: float) -> list[FaceDetection]:
        height, width = image.shape[:2]
        self.shown.append((width, height))
        rows, columns = np.nonzero(image[..., 0] > 128)
        if len(rows) == 0 or np.ptp(columns) + 1 < 0.1 * width:
            return []
        size = float(np.ptp(columns) + 1)
        return [blob(columns.min(), rows.min(), size, (width, height))]


def picture(left: int, top: int, width: int) -> np.ndarray:
    image = np.zeros((720, 1280, 3), dtype=np.uint8)
    image[top : top + width, left : left + width] = 255
    return image


def test_a_small_face_is_searched_for_then_followed_through_a_window() -> None:
    eye = NearSighted()
    zooming = ZoomingDetector(eye, canonical())
    for index in range(40):
        image = picture(600 + 2 * index, 300, 60)
        faces = zooming.detect(image, index / 30)
        assert len(faces) == 1
        face = zooming.refine(faces[0], image, index / 30)
        centre, width = face.box((1280, 720))
        np.testing.assert_allclose(centre, (630 + 2 * index, 330), atol=1e-6)
        assert width == pytest.approx(60)
    assert zooming.frames == 39  # all but the first, which was searched for
    assert zooming.windows == 3  # 78 pixels, and a window moves every 36
    assert (180, 180) in eye.shown


def test_a_hidden_face_keeps_its_window_for_half_a_second_then_is_searched_for() -> None:
    eye = NearSighted()
    zooming = ZoomingDetector(eye, canonical())
    image, blank = picture(600, 300, 60), picture(0, 0, 0)
    zooming.refine(zooming.detect(image, 0.0)[0], image, 0.0)
    eye.shown.clear()
    assert zooming.detect(blank, 0.1) == []
    assert eye.shown == [(180, 180), (1280, 720)]
    eye.shown.clear()
    assert zooming.detect(blank, 0.6) == []
    assert len(eye.shown) > 10  # the search
    eye.shown.clear()
    assert zooming.detect(blank, 0.7) == []
    assert eye.shown == [(1280, 720)]  # not searched again within half a second


def test_a_large_face_is_looked_at_in_the_whole_frame() -> None:
    eye = NearSighted()
    zooming = ZoomingDetector(eye, canonical())
    image = picture(300, 100, 400)
    face = zooming.detect(image, 0.0)[0]
    assert zooming.refine(face, image, 0.0) is face
    assert eye.shown == [(1280, 720)]


SIZE = (640, 480)
ANN, BOB = blob(100, 100, 120, SIZE), blob(400, 100, 100, SIZE)


def test_the_widest_face_is_followed_and_stays_followed() -> None:
    follower = FaceFollower()
    assert follower.choose([BOB, ANN], 0.0, SIZE) is ANN
    closer_bob = blob(380, 90, 200, SIZE)
    moved_ann = blob(110, 100, 118, SIZE)
    assert follower.choose([closer_bob, moved_ann], 1 / 30, SIZE) is moved_ann


def test_another_person_does_not_stand_in_for_a_lost_face() -> None:
    follower = FaceFollower()
    follower.choose([ANN, BOB], 0.0, SIZE)
    assert follower.choose([BOB], 0.1, SIZE) is None
    assert follower.choose([], 0.2, SIZE) is None
    back = blob(120, 100, 120, SIZE)
    assert follower.choose([BOB, back], 0.3, SIZE) is back
    assert follower.reacquired == 0


def test_after_half_a_second_the_nearest_face_is_followed() -> None:
    follower = FaceFollower()
    follower.choose([ANN], 0.0, SIZE)
    assert follower.choose([BOB], 0.49, SIZE) is None
    assert follower.choose([BOB], 0.51, SIZE) is BOB
    assert follower.reacquired == 1
