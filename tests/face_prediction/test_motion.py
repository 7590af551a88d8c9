"""Tracks to runs: what is kept is what was measured, what is cut is counted."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from face_prediction.motion.motion import (
    MotionSettings,
    QualityLimits,
    lift,
    smooth_depth,
    step_tremor,
)
from robo_manip_baselines.runs.errors import RequestError

FPS = 30.0
SHORT = MotionSettings(min_run=1.0)  # windows of 31 frames


def sway(frames: int, amplitude: float = 0.02) -> np.ndarray:
    time = np.arange(frames)[:, None] / FPS
    return np.array([0.0, 0.0, -0.5]) + amplitude * np.sin(2 * np.pi * time * [0.5, 0.3, 0.2])


def test_a_good_track_is_kept_whole_and_unchanged(make_track) -> None:
    mouth = sway(200)
    motion = lift(make_track(mouth), SHORT)
    assert motion.runs == [(0, 200)]
    assert not motion.depth_smoothed
    np.testing.assert_allclose(motion.mouth, mouth, atol=1e-9)
    np.testing.assert_allclose(motion.jaw, 0.01, atol=1e-9)
    np.testing.assert_allclose(motion.orientation, np.tile([1.0, 0, 0, 0], (200, 1)), atol=1e-9)
    assert motion.counts() == {
        "frames": 200, "kept": 200, "no_face": 0, "spike": 0, "turned_away": 0, "too_short": 0,
        "out_of_reach": 0, "jumps": 0, "runs": 1,
    }  # fmt: skip


def test_a_lost_face_splits_and_is_not_bridged(make_track) -> None:
    valid = np.ones(200, dtype=bool)
    valid[90] = False
    motion = lift(make_track(sway(200), valid=valid), SHORT)
    assert motion.runs == [(0, 90), (91, 200)]
    assert motion.counts()["no_face"] == 1


def test_a_jump_splits_and_neither_side_is_smoothed(make_track) -> None:
    mouth = sway(200)
    mouth[120:, 0] += 0.05
    motion = lift(make_track(mouth), SHORT)
    # the acceleration into and out of the step marks the two frames beside it
    assert motion.runs == [(0, 119), (121, 200)]
    assert motion.counts()["jumps"] == 1
    assert motion.counts()["spike"] == 2
    np.testing.assert_allclose(motion.mouth, mouth, atol=1e-9)


def test_what_is_left_over_is_too_short(make_track) -> None:
    valid = np.ones(200, dtype=bool)
    valid[170] = False
    motion = lift(make_track(sway(200), valid=valid), SHORT)
    assert motion.runs == [(0, 170)]
    assert motion.counts()["too_short"] == 29


def test_out_of_reach_is_cut_and_counted(make_track) -> None:
    mouth = sway(300, 0.0)
    mouth[130:170, 2] -= 0.2 * np.sin(np.pi * np.arange(40) / 40)  # away by 20 cm and back
    motion = lift(make_track(mouth), SHORT)
    kept = sum(stop - start for start, stop in motion.runs)
    assert 0 < motion.counts()["out_of_reach"] == 300 - kept
    for start, stop in motion.runs:
        for first in range(start, stop - 30):
            assert np.abs(mouth[first : first + 31] - mouth[first]).max() <= 0.08 + 1e-9


@pytest.mark.long
@given(seed=st.integers(0, 10_000))
def test_counts_add_up_and_runs_hold_only_good_frames(make_track, seed: int) -> None:
    random = np.random.default_rng(seed)
    frames = int(random.integers(1, 200))
    mouth = np.array([0.0, 0.0, -0.5]) + np.cumsum(random.normal(0, 0.004, (frames, 3)), axis=0)
    mouth[:, 2] = np.minimum(mouth[:, 2], -0.1)
    valid = random.random(frames) > random.choice([0.0, 0.02])
    motion = lift(make_track(mouth, valid=valid), SHORT)
    counts = motion.counts()
    causes = ("kept", "no_face", "spike", "turned_away", "too_short", "out_of_reach")
    assert sum(counts[cause] for cause in causes) == counts["frames"] == frames
    good = motion.quality.found & ~motion.quality.spike & ~motion.quality.turned_away
    for start, stop in motion.runs:
        assert good[start:stop].all()
        assert not motion.quality.jump[start : stop - 1].any()
        assert stop - start >= 31


def test_a_trembling_depth_is_smoothed_and_recorded(make_track) -> None:
    mouth = sway(600)
    noisy = mouth.copy()
    noisy[:, 2] += np.random.default_rng(0).normal(0, 0.0015, 600)
    motion = lift(make_track(noisy), SHORT)
    assert motion.depth_smoothed
    np.testing.assert_allclose(motion.raw_depth, noisy[:, 2], atol=1e-9)
    assert step_tremor(motion.mouth[:, 2]) < 0.5 * step_tremor(noisy[:, 2])
    # 0.7 mm: what the low-pass leaves of 1.5 mm of white noise (0.47), and 3 sigma
    assert np.sqrt(np.mean((motion.mouth[:, 2] - mouth[:, 2]) ** 2)) < 0.0009
    raw = lift(make_track(noisy), MotionSettings(min_run=1.0, depth_cutoff=None))
    np.testing.assert_allclose(raw.mouth, noisy, atol=1e-9)


def test_smoothing_keeps_the_image_and_steady_approach() -> None:
    time = np.arange(100) / FPS
    mouth = np.stack([0.1 + 0 * time, -0.05 + 0.01 * time, -0.5 + 0.1 * time], axis=1)
    smooth = smooth_depth(mouth, 3.0 / FPS)
    np.testing.assert_allclose(smooth, mouth, atol=1e-12)
    rough = mouth + np.random.default_rng(0).normal(0, 0.002, (100, 3))
    smooth = smooth_depth(rough, 3.0 / FPS)
    np.testing.assert_allclose(smooth[:, :2] / smooth[:, 2:], rough[:, :2] / rough[:, 2:])


def test_the_cutoff_is_where_the_low_pass_halves_the_power() -> None:
    time = np.arange(600) / FPS
    wave = 0.01 * np.sin(2 * np.pi * 3.0 * time)
    mouth = np.stack([0 * time, 0 * time, -0.5 + wave], axis=1)
    smooth = smooth_depth(mouth, 3.0 / FPS)[:, 2] + 0.5
    ratio = np.std(smooth[60:-60]) / np.std(wave[60:-60])
    assert ratio == pytest.approx(np.sqrt(0.5), rel=0.01)  # the kernel ends at four sigma
    assert np.corrcoef(smooth[60:-60], wave[60:-60])[0, 1] > 0.9999  # zero phase


def test_smoothing_never_crosses_a_gap(make_track) -> None:
    mouth = sway(400, 0.0)
    mouth[:, 2] += np.random.default_rng(0).normal(0, 0.0015, 400)
    valid = np.ones(400, dtype=bool)
    valid[200] = False
    whole = lift(make_track(mouth, valid=valid), SHORT)
    second = mouth.copy()
    second[201:, 2] -= 0.05
    moved = lift(make_track(second, valid=valid), SHORT)
    assert whole.depth_smoothed
    np.testing.assert_array_equal(whole.mouth[:200], moved.mouth[:200])


def test_a_variable_rate_is_refused(make_track) -> None:
    track = make_track(sway(100))
    track.timestamps[50:] += 0.01
    with pytest.raises(RequestError, match=r"synthetic\.mp4.*constant rate.*--fps 30"):
        lift(track, SHORT)


@pytest.mark.parametrize("name", ["min_run", "max_displacement", "depth_cutoff"])
def test_settings_must_be_positive(name: str) -> None:
    with pytest.raises(RequestError, match=f"--{name}"):
        MotionSettings(limits=QualityLimits(), **{name: -1.0})
