"""The landmarks seen so far at 30 a second, whatever the camera's rate."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from face_prediction.live.streaming import landmarks_at, nearest, times_back
from face_prediction.tracking.extract import Samples, resample

steps = st.lists(st.floats(0.002, 0.1), min_size=1, max_size=40)


def walk(count: int, seed: int = 0) -> np.ndarray:
    return np.cumsum(np.random.default_rng(seed).normal(size=(count, 4, 2)), axis=0)


def test_times_go_back_from_the_newest() -> None:
    np.testing.assert_allclose(times_back(2.0, 4, 30.0), [1.9, 2 - 2 / 30, 2 - 1 / 30, 2.0])


def test_a_camera_at_the_rate_is_taken_as_it_is() -> None:
    times, points = np.arange(50) / 30, walk(50)
    got = landmarks_at(times_back(times[49], 20, 30.0), times, points)
    np.testing.assert_array_equal(got, points[30:])  # to the last bit


def test_ticks_of_a_container_count_as_the_same_time() -> None:
    times = np.round(np.arange(50) / 30, 3)  # milliseconds, as Matroska has them
    got = landmarks_at(times_back(times[49], 20, 30.0), times, walk(50))
    np.testing.assert_array_equal(got, walk(50)[30:])


@given(steps=steps, count=st.integers(1, 30), fps=st.sampled_from([15.0, 30.0, 50.0]))
def test_between_frames_on_the_straight_line(steps: list[float], count: int, fps: float) -> None:
    times = np.cumsum([0.0, *steps])
    points = walk(len(times))
    wanted = times_back(times[-1], count, fps)
    got = landmarks_at(wanted, times, points)
    oracle = np.stack(
        [np.interp(wanted, times, column) for column in points.reshape(len(times), -1).T], axis=-1
    ).reshape(count, 4, 2)
    # a frame less than a millisecond away stands for the time itself
    slope = np.abs(np.diff(points, axis=0)).max() / np.diff(times).min()
    np.testing.assert_allclose(got, oracle, atol=1.001e-3 * slope)
    np.testing.assert_array_equal(got[-1], points[-1])
    assert got.min() >= points.min()
    assert got.max() <= points.max()


@given(steps=steps, count=st.integers(1, 30))
def test_it_is_what_a_track_would_hold(steps: list[float], count: int) -> None:
    # the same rule as `extract --fps 30`, on a clock that is counted from the newest frame
    times = np.cumsum([0.0, *steps])
    points = walk(len(times))
    flipped = times[-1] - times[::-1]
    pose = np.tile(np.eye(4), (len(times), 1, 1))
    ones = np.ones(len(times), dtype=bool)
    track, _ = resample(Samples(flipped, points[::-1], pose, ones), 30.0, max_gap=1.0)
    known = min(count, len(track.landmarks))
    got = landmarks_at(times_back(times[-1], known, 30.0), times, points)
    np.testing.assert_allclose(got, track.landmarks[:known][::-1], atol=1e-9)


def test_before_the_first_frame_the_face_was_at_rest() -> None:
    times, points = np.array([0.0, 1 / 30, 2 / 30]), walk(3)
    got = landmarks_at(times_back(times[2], 6, 30.0), times, points)
    np.testing.assert_array_equal(got, points[[0, 0, 0, 0, 1, 2]])
    alone = landmarks_at(times_back(0.0, 3, 30.0), times[:1], points[:1])
    np.testing.assert_array_equal(alone, points[[0, 0, 0]])


@pytest.mark.parametrize(
    ("wanted", "index"),
    [(-1.0, 0), (0.0, 0), (0.019, 0), (0.02, 0), (0.022, 1), (0.04, 1), (0.05, 1), (0.1, 2)],
)
def test_the_nearest_picture(wanted: float, index: int) -> None:
    times = np.array([0.0, 0.04, 0.08])  # of two as near, the earlier
    assert nearest(np.array([wanted]), times).tolist() == [index]
