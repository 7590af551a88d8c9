"""Phases of scripted experts, each on its own."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from robo_manip_baselines.envs.mujoco.expert.phases import (
    DOWN,
    Approach,
    Command,
    ExpertView,
    Follow,
    Grip,
    Reach,
    least_jerk,
    level_at,
)

STILL = ExpertView(
    object_position=np.array([0.15, 0.5, 0.02]),
    target_track=np.tile([0.0, 0.5, 0.35], (6, 1)),
    elapsed=0.0,
    is_at_target=False,
)
START = Command(np.array([0.2, 0.45, 0.3]), DOWN, 0.021)


def test_down_points_down_and_closes_along_y() -> None:
    np.testing.assert_allclose(DOWN.apply(np.array([1.0, 0, 0])), [0, 0, -1], atol=1e-12)
    np.testing.assert_allclose(np.abs(DOWN.apply(np.array([0, 1.0, 0]))), [0, 1, 0], atol=1e-12)


@given(st.floats(-0.2, 0.3), st.floats(0.3, 0.7))
def test_level_points_away_from_the_base(x: float, y: float) -> None:
    orientation = level_at(np.array([x, y, 0.35]))
    out, up = (orientation.apply(axis) for axis in np.eye(3)[[0, 2]])
    away = np.array([x - 0.469, y - 0.5, 0.0])
    np.testing.assert_allclose(out, away / np.linalg.norm(away), atol=1e-9)
    np.testing.assert_allclose(up, [0, 0, 1], atol=1e-9)


def test_least_jerk_starts_and_ends_at_rest() -> None:
    s = np.linspace(0, 1, 1001)
    path = np.array([least_jerk(x) for x in s])
    assert path[0] == 0.0
    assert path[-1] == pytest.approx(1.0)
    assert (np.diff(path) >= 0).all()
    for derivative in (1, 2):  # velocity and acceleration vanish at both ends
        rate = np.diff(path, derivative) * 1000**derivative
        assert abs(rate[0]) < 0.1
        assert abs(rate[-1]) < 0.1
    assert least_jerk(-1.0) == 0.0
    assert least_jerk(2.0) == 1.0


def test_reach_ends_at_its_target() -> None:
    target = Command(np.array([0.0, 0.5, 0.2]), DOWN, 0.057)
    phase = Reach(lambda view, last: target, speed=0.25)
    phase.start(STILL, START)
    positions = [START.position]
    while not phase.is_done(STILL):
        command = phase.step(STILL)
        positions.append(command.position)
    np.testing.assert_allclose(command.position, target.position, atol=1e-12)
    assert np.linalg.norm(command.orientation.inverse().multiply(DOWN).log()) < 1e-9
    assert command.finger == pytest.approx(0.057)
    length = np.linalg.norm(target.position - START.position)
    assert len(positions) - 1 == round(length / 0.25 / 0.02)
    # Minimum jerk peaks at 15/8 of the mean speed.
    assert np.linalg.norm(np.diff(positions, axis=0), axis=1).max() / 0.02 < 0.25 * 1.9


def test_approach_is_algorithm_1() -> None:
    """v = (mouth - gripper) / (6 - t), step by step, in the obvious way."""
    rng = np.random.default_rng(0)
    phase = Approach(limit=6.0)
    phase.start(STILL, START)
    gripper = START.position.copy()
    for step in range(290):
        t = 0.5 + 0.02 * step if step < 270 else 5.9
        mouth = np.array([0.0, 0.5, 0.35]) + 0.02 * rng.standard_normal(3)
        view = replace(STILL, target_track=np.tile(mouth, (6, 1)), elapsed=t)
        gripper = gripper + (mouth - gripper) / (6.0 - t) * 0.02
        np.testing.assert_allclose(phase.step(view).position, gripper, atol=1e-12)


def test_approach_arrives_exactly_when_the_time_is_up() -> None:
    phase = Approach(limit=6.0)
    phase.start(STILL, START)
    for step in range(300):
        command = phase.step(replace(STILL, elapsed=0.02 * step))
    np.testing.assert_allclose(command.position, [0.0, 0.5, 0.35], atol=1e-9)


@pytest.mark.parametrize(
    ("elapsed", "is_at_target", "done"),
    [(0.0, False, False), (6.0, False, False), (6.02, False, True), (1.0, True, True),
     (None, False, True)],
)  # fmt: skip
def test_approach_ends(elapsed: float | None, is_at_target: bool, done: bool) -> None:
    phase = Approach(limit=6.0)
    view = replace(STILL, elapsed=elapsed, is_at_target=is_at_target)
    assert phase.is_done(view) is done


@given(st.floats(0.0, 5 / 30))
def test_the_target_ahead_is_interpolated(lead: float) -> None:
    track = np.random.default_rng(0).random((6, 3))
    low = min(int(lead * 30), 4)
    share = lead * 30 - low
    expected = (1 - share) * track[low] + share * track[low + 1]
    np.testing.assert_allclose(replace(STILL, target_track=track).target(lead), expected, atol=1e-9)


def test_lead_aims_at_the_future() -> None:
    track = np.linspace([0.0, 0.5, 0.35], [0.0, 0.55, 0.35], 6)  # 0.3 m/s along y
    view = replace(STILL, target_track=track, elapsed=5.9)
    now, later = Approach(), Approach(lead=0.1)
    for phase in (now, later):
        phase.start(view, START)
    ahead = later.step(view).position - now.step(view).position
    np.testing.assert_allclose(ahead, [0.0, 0.03 / 0.1 * 0.02, 0.0], atol=1e-12)


def test_grip_stands_still() -> None:
    phase = Grip(0.05, 0.4)
    phase.start(STILL, START)
    for _ in range(20):
        assert not phase.is_done(STILL)
        command = phase.step(STILL)
        np.testing.assert_array_equal(command.position, START.position)
        assert command.finger == 0.05
    assert phase.is_done(STILL)


def test_follow_closes_the_gap_no_faster_than_it_may() -> None:
    offset = np.array([0.03, 0.0, 0.0])
    phase = Follow(offset, 2.0, speed=0.15)
    phase.start(STILL, START)
    last = START.position
    while not phase.is_done(STILL):
        command = phase.step(STILL)
        assert np.linalg.norm(command.position - last) <= 0.15 * 0.02 + 1e-12
        last = command.position
    np.testing.assert_allclose(last, [0.03, 0.5, 0.35], atol=1e-12)


def test_near_the_target_the_gripper_is_level() -> None:
    for phase in (Approach(), Follow(np.zeros(3), 1.0)):
        phase.start(STILL, START)
        command = phase.step(STILL)
        turned = command.orientation.inverse().multiply(level_at(command.position)).log()
        assert np.linalg.norm(turned) < 1e-9
