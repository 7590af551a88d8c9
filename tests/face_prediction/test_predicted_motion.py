"""From forecasts in crops to metres, and what each frame of a run is forecast from."""

from __future__ import annotations

import numpy as np
import pytest

from face_prediction.dataset.histories import (
    Origin,
    crop_history,
    errors_across,
    find_origins,
    forecast_metres,
    image_points,
    mouth_ahead,
)
from face_prediction.forecast import mouth_centre
from face_prediction.motion.motion import Quality
from face_prediction.tracking.geometry import Crop, crop_around, mouth_centres

SIZE = (640, 480)


def quality(frames: int, *, lost=(), spike=(), jump=(), turned=()) -> Quality:
    def flags(count: int, places) -> np.ndarray:
        result = np.zeros(count, dtype=bool)
        result[list(places)] = True
        return result

    return Quality(
        ~flags(frames, lost), flags(frames, spike), flags(frames - 1, jump), flags(frames, turned)
    )


@pytest.mark.parametrize("place", [(0.0, 0.0, -0.5), (0.1, -0.08, -0.3), (-0.4, 0.2, -1.5)])
def test_a_face_that_moves_parallel_to_the_image_comes_back_in_metres(project, place) -> None:
    moves = np.array([[0.01, 0.0, 0.0], [0.0, -0.02, 0.0], [0.005, 0.004, 0.0]])
    now = project(np.array([place]), SIZE)[:, :2]
    ahead = project(np.array(place) + moves, SIZE)[None, :, :2]
    got = mouth_ahead(np.array([place]), now, ahead, SIZE)
    assert got.shape == (1, 3, 3)
    np.testing.assert_allclose(got[0], np.array(place) + moves, atol=1e-12)


def test_depth_is_left_as_it_is(project) -> None:
    # the face comes nearer: what is seen of that is a way across the view, at the old depth
    here, there = np.array([[0.1, 0.0, -0.5]]), np.array([[0.1, 0.0, -0.4]])
    now, then = (project(p, SIZE)[:, :2] for p in (here, there))
    got = mouth_ahead(here, now, then[:, None], SIZE)[0, 0]
    np.testing.assert_allclose(got, [0.1 * 0.5 / 0.4, 0.0, -0.5], atol=1e-12)


def test_a_perfect_forecast_is_where_the_mouth_will_be(make_track) -> None:
    time = np.arange(30)[:, None] / 30
    path = np.array([0.02, 0.01, -0.5]) + time * [0.03, -0.02, 0.0]
    track = make_track(path)
    lifted = mouth_centres(track.landmarks, track.head_pose, SIZE)
    origins = find_origins([10, 17], track.landmarks, SIZE, quality(30), 8, 0.1)
    truth = np.stack(
        [o.crop.normalise(track.landmarks[o.frame + 1 : o.frame + 6], SIZE) for o in origins]
    )[..., :2]
    got = forecast_metres(origins, truth, track.landmarks, lifted, SIZE)
    for origin, ahead in zip(origins, got, strict=True):
        np.testing.assert_allclose(ahead, path[origin.frame + 1 : origin.frame + 6], atol=1e-6)


def test_crops_and_images_agree() -> None:
    crop = Crop(-7, 31, 113)
    points = np.random.default_rng(0).uniform(size=(4, 5, 3))
    inside = crop.normalise(points, SIZE)[..., :2]
    np.testing.assert_allclose(image_points(crop, inside, SIZE), points[..., :2], atol=1e-12)


@pytest.mark.parametrize(
    ("verdict", "frame", "history"),
    [
        (quality(20), 12, [8, 9, 10, 11, 12]),
        (quality(20), 4, [0, 1, 2, 3, 4]),
        (quality(20), 2, [0, 0, 0, 1, 2]),
        (quality(20), 0, [0, 0, 0, 0, 0]),
        (quality(20, lost=[10]), 12, [11, 11, 11, 11, 12]),
        (quality(20, lost=[7]), 12, [8, 9, 10, 11, 12]),
        (quality(20, spike=[9]), 12, [10, 10, 10, 11, 12]),
        (quality(20, jump=[9]), 12, [10, 10, 10, 11, 12]),  # between frames 9 and 10
        (quality(20, turned=[10]), 12, [8, 9, 10, 11, 12]),  # turned away, but seen
        (quality(20, lost=[13]), 12, [8, 9, 10, 11, 12]),
    ],
)
def test_a_history_ends_in_its_frame_and_bridges_nothing(
    make_track, verdict: Quality, frame: int, history: list[int]
) -> None:
    path = np.array([0.0, 0.0, -0.5]) + np.arange(20)[:, None] * [0.002, 0.001, 0.0]
    landmarks = make_track(path).landmarks
    (origin,) = find_origins([frame], landmarks, SIZE, verdict, 5, 0.1)
    assert origin.history.tolist() == history
    assert origin.is_short == (history[0] == history[1])
    assert origin.crop == crop_around(landmarks[sorted(set(history))], SIZE, 0.1)


def test_nothing_after_the_frame_is_looked_at(make_track) -> None:
    path = np.array([0.0, 0.0, -0.5]) + np.arange(20)[:, None] * [0.002, 0.001, 0.0]
    whole = make_track(path).landmarks
    cut = whole.copy()
    cut[13:] = np.nan
    for landmarks in (whole, cut):
        (origin,) = find_origins([12], landmarks, SIZE, quality(20), 8, 0.1)
        seen = crop_history(origin, landmarks, SIZE)
        assert seen.shape == (8, 468, 2)
        assert seen.dtype == np.float32
        np.testing.assert_array_equal(
            seen, origin.crop.normalise(whole[5:13], SIZE)[..., :2].astype(np.float32)
        )


def test_the_newest_frame_is_where_it_is_seen(make_track) -> None:
    landmarks = make_track(np.tile([0.05, 0.02, -0.5], (6, 1))).landmarks
    origin = Origin(5, np.arange(6), Crop(200, 150, 128))
    centre = mouth_centre(crop_history(origin, landmarks, SIZE))[-1]
    pixels = mouth_centre(landmarks[5]) * SIZE
    np.testing.assert_allclose(centre, (pixels - [200, 150]) / 128, atol=1e-6)


def test_errors_are_across_the_view_and_end_with_the_run() -> None:
    mouth = np.array([[0.0, 0.0, -0.5], [0.003, 0.004, -0.6], [0.0, 0.0, -0.5]])
    predicted = np.zeros((3, 2, 3))
    got = errors_across(predicted, mouth)
    np.testing.assert_allclose(got, [[0.005, 0.0], [0.0, np.nan], [np.nan, np.nan]], atol=1e-12)
    assert np.isnan(errors_across(np.zeros((2, 5, 3)), mouth[:2])[:, 1:]).all()
