"""Image landmarks to metres, against a camera written down independently (conftest.py)."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from face_prediction.tracking.geometry import (
    CANONICAL_MOUTH,
    LIPS,
    image_rays,
    jaw_openings,
    mouth_centres,
)


def test_lips_are_mediapipes_forty() -> None:
    assert len(LIPS) == len(set(LIPS)) == 40
    assert {13, 14, 61, 291, 0, 17} <= set(LIPS)


@pytest.mark.parametrize("image_size", [(640, 480), (1080, 1920), (256, 256)])
def test_rays_go_through_the_points_they_are_seen_at(project, image_size) -> None:
    points = np.random.default_rng(1).uniform([-0.3, -0.3, -2.0], [0.3, 0.3, -0.3], (50, 3))
    rays = image_rays(project(points, image_size), image_size)
    np.testing.assert_allclose(rays * -points[:, 2:], points, atol=1e-12)


def test_the_top_of_the_image_is_half_the_field_of_view_up() -> None:
    ray = image_rays(np.array([0.5, 0.0]), (640, 480))
    assert np.degrees(np.arctan2(ray[1], -ray[2])) == pytest.approx(31.5)


@pytest.mark.parametrize("image_size", [(640, 480), (1080, 1920), (256, 256)])
@pytest.mark.parametrize("angles", [(0, 0, 0), (20, 0, 0), (0, -30, 0), (-15, 25, 40)])
def test_mouth_and_jaw_come_back_from_their_projection(make_track, image_size, angles) -> None:
    mouth = np.random.default_rng(2).uniform([-0.1, -0.1, -1.2], [0.1, 0.1, -0.25], (20, 3))
    rotation = np.tile(Rotation.from_euler("xyz", angles, degrees=True).as_matrix(), (20, 1, 1))
    jaw = np.linspace(0.0, 0.03, 20)
    track = make_track(mouth, rotation=rotation, jaw=jaw, image_size=image_size)
    lifted = mouth_centres(track.landmarks, track.head_pose, image_size)
    np.testing.assert_allclose(lifted, mouth, atol=1e-9)
    # an opening seen from above or below keeps its length: the plane turns with the head
    opening = jaw_openings(track.landmarks, track.head_pose, image_size)
    np.testing.assert_allclose(opening, jaw, atol=1e-9)


def test_lips_that_move_on_the_face_move_the_mouth() -> None:
    """Not only the head carries the mouth: the same pose with lower lips gives a lower mouth."""
    size = (640, 480)
    pose = np.eye(4)[None].copy()
    pose[0, :3, 3] = np.array([0.0, 0.0, -0.5]) - CANONICAL_MOUTH
    landmarks = np.full((1, 468, 3), 0.5)
    at_rest = mouth_centres(landmarks, pose, size)
    landmarks[:, list(LIPS), 1] += 0.01
    lowered = mouth_centres(landmarks, pose, size)
    pixels_per_metre = 480 / 2 / np.tan(np.radians(31.5)) / 0.5
    assert at_rest[0, 1] - lowered[0, 1] == pytest.approx(0.01 * 480 / pixels_per_metre)


def test_a_mouth_seen_edge_on_is_not_lifted(make_track) -> None:
    rotation = np.tile(Rotation.from_euler("y", 88, degrees=True).as_matrix(), (3, 1, 1))
    track = make_track(np.tile([0.0, 0.0, -0.5], (3, 1)), rotation=rotation)
    assert np.isnan(mouth_centres(track.landmarks, track.head_pose, track.image_size)).all()
    assert np.isnan(jaw_openings(track.landmarks, track.head_pose, track.image_size)).all()
