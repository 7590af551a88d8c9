"""Resampling: values between neighbours, and never across a gap."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from face_prediction.tracking.detector import FaceDetection
from face_prediction.tracking.extract import (
    CHUNK,
    MAX_GAP,
    Resampler,
    Samples,
    TrackBuilder,
    resample,
)
from face_prediction.tracking.tracks import NUM_LANDMARKS


def moving(times: np.ndarray, valid: np.ndarray | None = None) -> Samples:
    """A face that goes 0.1 m/s and turns 20 degrees/s, at ``times``."""
    times = np.asarray(times, dtype=float)
    valid = np.ones(len(times), dtype=bool) if valid is None else valid
    landmarks = np.tile(times[:, None, None], (1, 2, 3)) * 0.1
    pose = np.tile(np.eye(4), (len(times), 1, 1))
    pose[:, :3, :3] = Rotation.from_euler("y", 20 * times[:, None], degrees=True).as_matrix()
    pose[:, 0, 3] = 0.1 * times
    landmarks[~valid] = np.nan
    pose[~valid] = np.nan
    return Samples(times, landmarks, pose, valid)


@pytest.mark.parametrize(
    "times",
    [
        pytest.param(np.arange(50) / 25, id="25 fps"),
        pytest.param(np.arange(50) / 23.976, id="23.976 fps"),
        pytest.param(np.arange(120) / 60 + 7.0, id="60 fps, clock from 7 s"),
        pytest.param(
            np.cumsum(np.random.default_rng(0).uniform(0.01, 0.09, 60)), id="variable rate"
        ),
    ],
)
def test_steady_motion_is_kept(times: np.ndarray) -> None:
    got, _ = resample(moving(times), 30.0)
    expected = moving(got.timestamps)
    assert got.valid.all()
    np.testing.assert_allclose(np.diff(got.timestamps), 1 / 30)
    assert got.timestamps[0] == times[0]
    assert times[-1] - 1 / 30 < got.timestamps[-1] <= times[-1] + 1e-6
    # a time within 1 ms of a decoded frame is that frame: 0.1 mm and 0.02 degrees here
    np.testing.assert_allclose(got.landmarks, expected.landmarks, atol=1.1e-4)
    np.testing.assert_allclose(got.head_pose, expected.head_pose, atol=4e-4)


def test_frames_at_their_own_times_stay_as_they_are() -> None:
    source = moving(np.arange(30) / 30)
    got, interpolated = resample(source, 30.0)
    np.testing.assert_array_equal(got.landmarks, source.landmarks)
    np.testing.assert_allclose(got.head_pose, source.head_pose, atol=1e-12)
    assert not interpolated.any()


def test_25_to_30_interpolates_all_but_every_sixth() -> None:
    _, interpolated = resample(moving(np.arange(26) / 25), 30.0)
    np.testing.assert_array_equal(~interpolated, np.arange(len(interpolated)) % 6 == 0)


def test_a_lost_frame_takes_its_neighbourhood_with_it() -> None:
    times = np.arange(26) / 25
    valid = np.ones(26, dtype=bool)
    valid[10] = False  # 0.40 s
    got, _ = resample(moving(times, valid), 30.0)
    lost = (got.timestamps > 0.36 + 1e-3) & (got.timestamps < 0.44 - 1e-3)
    np.testing.assert_array_equal(got.valid, ~lost)
    assert np.isnan(got.landmarks[lost]).all()
    assert np.isnan(got.head_pose[lost]).all()


@pytest.mark.parametrize(("gap", "bridged"), [(MAX_GAP, True), (MAX_GAP + 0.001, False)])
def test_the_longest_gap(gap: float, bridged: bool) -> None:
    times = np.concatenate([np.arange(10) / 30, 9 / 30 + gap + np.arange(10) / 30])
    got, interpolated = resample(moving(times), 30.0)
    inside = (got.timestamps > 9 / 30 + 0.002) & (got.timestamps < 9 / 30 + gap - 0.002)
    assert inside.any()
    assert np.all(got.valid[inside] == bridged)
    assert np.all(interpolated[inside] == bridged)


def test_one_frame() -> None:
    got, interpolated = resample(moving(np.array([3.0])), 30.0)
    assert got.valid.tolist() == [True]
    assert interpolated.tolist() == [False]


@given(
    steps=st.lists(st.floats(0.005, 0.3), min_size=1, max_size=25),
    lost=st.sets(st.integers(0, 25)),
    fps=st.sampled_from([10.0, 30.0, 50.0]),
)
def test_against_a_slow_oracle(steps: list[float], lost: set[int], fps: float) -> None:
    times = np.concatenate([[0.0], np.cumsum(steps)])
    valid = np.array([index not in lost for index in range(len(times))])
    got, _ = resample(moving(times, valid), fps)
    for time, frame_valid, pose in zip(got.timestamps, got.valid, got.head_pose, strict=True):
        nearest = int(np.argmin(np.abs(times - time)))
        if abs(times[nearest] - time) < 1e-3:
            expected = valid[nearest]
        else:
            before = int(np.flatnonzero(times < time)[-1])
            close = times[before + 1] - times[before] <= MAX_GAP + 1e-6
            expected = valid[before] and valid[before + 1] and close
        assert frame_valid == expected
        assert np.isfinite(pose).all() == expected
        if expected:
            assert pose[0, 3] == pytest.approx(0.1 * time, abs=1.1e-4)


@pytest.mark.parametrize("count", [1, 2, 3, 7, 8, 9, 40])
@pytest.mark.parametrize("chunk", [1, 2, 4, 8])
def test_chunks_give_the_same_bit_for_bit(count: int, chunk: int) -> None:
    random = np.random.default_rng(count)
    times = np.cumsum(random.uniform(0.001, 0.09, count)) + random.uniform(-1, 9)
    source = moving(times, random.random(count) > 0.2)
    whole, interpolated = resample(source, 30.0)
    resampler = Resampler(30.0)
    parts = []
    for begin in range(0, count, chunk):
        part = Samples(*(array[begin : begin + chunk] for array in vars(source).values()))
        parts.append(resampler.add(part, is_last=begin + chunk >= count))
    for name, expected in vars(whole).items():
        got = np.concatenate([getattr(samples, name) for samples, _ in parts])
        np.testing.assert_array_equal(got, expected)
    np.testing.assert_array_equal(np.concatenate([made for _, made in parts]), interpolated)


def test_a_chunk_may_hold_no_frame_of_a_slow_track() -> None:
    """At a frame in ten seconds, 256 frames of a video hold none at times."""
    face = FaceDetection(np.zeros((NUM_LANDMARKS, 3)), np.eye(4))
    builder = TrackBuilder(0.1, MAX_GAP)
    for number in range(3 * CHUNK):
        builder.add(number / 30, face, (640, 480))
    track = builder.finish({}, {})
    assert track.timestamps.tolist() == [0.0, 10.0, 20.0]
    assert track.valid.all()
    assert len(track.source_timestamps) == 3 * CHUNK
