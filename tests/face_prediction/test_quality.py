"""Thresholds of jumps, spikes, lost faces and turned heads: tables at the limits."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from face_prediction.motion.motion import QualityLimits, assess, stretches, tremor
from robo_manip_baselines.runs.errors import RequestError

FPS = 30.0
LIMITS = QualityLimits()


def still(frames: int = 20) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    mouth = np.tile([0.0, 0.0, -0.5], (frames, 1))
    return mouth, np.tile([1.0, 0.0, 0.0, 0.0], (frames, 1)), np.full(frames, 0.01)


@pytest.mark.parametrize(
    ("axis", "speed", "jumps"),
    [
        (0, 0.59, False),
        (0, 0.61, True),
        (1, -0.59, False),
        (1, -0.61, True),
        (2, 0.59, False),  # the noiseless depth has no tremor to allow for
        (2, 0.61, True),
    ],
)
def test_a_step_of_the_mouth(axis: int, speed: float, jumps: bool) -> None:
    mouth, orientation, jaw = still()
    mouth[10:, axis] += speed / FPS
    limits = QualityLimits(max_acceleration=1000.0)
    quality = assess(mouth, orientation, jaw, FPS, limits)
    assert quality.jump.tolist() == [jumps and step == 9 for step in range(19)]
    assert quality.segments() == ([(0, 10), (10, 20)] if jumps else [(0, 20)])


def test_depth_is_allowed_its_own_tremor_and_no_more() -> None:
    mouth, orientation, jaw = still(2000)
    noise = 0.003
    mouth[:, 2] += np.random.default_rng(0).normal(0, noise, 2000)
    assert not assess(mouth, orientation, jaw, FPS, LIMITS).jump.any()
    # 0.6 m/s + 4 sigma of a step = 1.11 m/s; this step is 1.5 m/s before its own noise
    mouth[1000:, 2] += 0.05
    assert np.flatnonzero(assess(mouth, orientation, jaw, FPS, LIMITS).jump).tolist() == [999]


@pytest.mark.parametrize(("acceleration", "found"), [(14.9, False), (15.1, True)])
def test_a_spike_across_the_view(acceleration: float, found: bool) -> None:
    mouth, orientation, jaw = still()
    mouth[10, 0] += acceleration / FPS**2 / 2  # out and back: twice the height
    quality = assess(mouth, orientation, jaw, FPS, LIMITS)
    assert np.flatnonzero(quality.spike).tolist() == ([10] if found else [])
    assert not quality.jump.any()
    assert quality.segments() == ([(0, 10), (11, 20)] if found else [(0, 20)])


@pytest.mark.parametrize(("rate", "jumps"), [(395.0, False), (405.0, True)])
def test_a_turn_of_the_head(rate: float, jumps: bool) -> None:
    mouth, orientation, jaw = still()
    turned = Rotation.from_euler("y", rate / FPS, degrees=True).as_quat(scalar_first=True)
    orientation[10:] = -turned  # a sign is no turn
    assert assess(mouth, orientation, jaw, FPS, LIMITS).jump.any() == jumps


@pytest.mark.parametrize(("speed", "jumps"), [(0.59, False), (-0.61, True)])
def test_a_step_of_the_jaw(speed: float, jumps: bool) -> None:
    mouth, orientation, jaw = still()
    jaw[:] = 0.03
    jaw[10:] += speed / FPS
    assert assess(mouth, orientation, jaw, FPS, LIMITS).jump.any() == jumps


@pytest.mark.parametrize("axis", ["x", "y", "z"])
@pytest.mark.parametrize(("angle", "away"), [(34.5, False), (-34.5, False), (35.5, True)])
def test_a_head_turned_away(axis: str, angle: float, away: bool) -> None:
    mouth, orientation, jaw = still()
    orientation[5:8] = Rotation.from_euler(axis, angle, degrees=True).as_quat(scalar_first=True)
    quality = assess(mouth, orientation, jaw, FPS, QualityLimits(max_turn_rate=2000.0))
    assert np.flatnonzero(quality.turned_away).tolist() == ([5, 6, 7] if away else [])
    assert quality.facing_segments() == ([(0, 5), (8, 20)] if away else [(0, 20)])
    assert quality.segments() == [(0, 20)]


@pytest.mark.parametrize("what", ["mouth", "orientation", "jaw"])
def test_a_lost_face_is_lost_whichever_number_is_missing(what: str) -> None:
    arrays = dict(zip(("mouth", "orientation", "jaw"), still(), strict=True))
    arrays[what][7] = np.nan
    quality = assess(**arrays, fps=FPS, limits=LIMITS)
    assert np.flatnonzero(~quality.found).tolist() == [7]
    assert not quality.jump.any()
    assert quality.segments() == [(0, 7), (8, 20)]


def test_tremor_is_the_noise_and_not_the_motion() -> None:
    time = np.arange(3000) / FPS
    motion = 0.03 * np.sin(2 * np.pi * 0.5 * time)
    noise = np.random.default_rng(1).normal(0, 0.001, 3000)
    # a median of 3000 values: 3 %; the motion's own second difference adds 0.3 mm at most
    assert tremor(motion + noise) == pytest.approx(0.001, rel=0.08)
    assert tremor(motion) < 0.0002
    assert tremor(np.array([0.1, np.nan])) == 0.0


@pytest.mark.parametrize(
    ("good", "broken", "expected"),
    [
        ("1111", "000", [(0, 4)]),
        ("1111", "010", [(0, 2), (2, 4)]),
        ("0110", "000", [(1, 3)]),
        ("1011", "000", [(0, 1), (2, 4)]),
        ("1011", "001", [(0, 1), (2, 3), (3, 4)]),
        ("0000", "000", []),
        ("1", "", [(0, 1)]),
    ],
)
def test_stretches(good: str, broken: str, expected: list[tuple[int, int]]) -> None:
    flags = (np.array([c == "1" for c in text], dtype=bool) for text in (good, broken))
    assert stretches(*flags) == expected


@pytest.mark.parametrize("value", [0.0, -1.0, np.nan, np.inf])
def test_limits_must_be_positive(value: float) -> None:
    with pytest.raises(RequestError, match="--max_speed"):
        QualityLimits(max_speed=value)
