"""Success predicates at their boundaries, and the order in which things may happen."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from robo_manip_baselines.envs.mujoco.tasks.feeding.success import (
    CLEAR_DISTANCE,
    LIFT_HEIGHT,
    FeedingProgress,
    Phase,
    StepMeasurements,
    is_at_mouth,
)
from robo_manip_baselines.envs.mujoco.tasks.mouth import (
    CAVITY_DEPTH,
    LIP_DEPTH,
    from_mouth,
    is_inside_mouth,
)

MOUTH = np.array([0.02, 0.48, 0.36])
EPSILON = 1e-6
"""m, far above rounding and far below any tolerance."""


@pytest.mark.parametrize(
    ("offset", "expected"),
    [
        ((0.0, 0.0, 0.0), True),
        ((0.03 - EPSILON, 0.0, 0.0), True),
        ((0.03 + EPSILON, 0.0, 0.0), False),
        ((-0.03 + EPSILON, 0.0, 0.0), True),
        ((-0.03 - EPSILON, 0.0, 0.0), False),
        ((0.0, 0.01 - EPSILON, 0.0), True),
        ((0.0, 0.01 + EPSILON, 0.0), False),
        ((0.0, -0.01 - EPSILON, 0.0), False),
        ((0.0, 0.0, 0.01 - EPSILON), True),
        ((0.0, 0.0, 0.01 + EPSILON), False),
        ((0.0, 0.0, -0.01 - EPSILON), False),
        ((0.03 - EPSILON, 0.01 - EPSILON, -0.01 + EPSILON), True),
        ((0.03 - EPSILON, 0.01 + EPSILON, 0.0), False),
    ],
)
def test_spatial_condition(offset: tuple[float, float, float], expected: bool) -> None:
    assert is_at_mouth(MOUTH + np.array(offset), MOUTH) is expected


def test_spatial_condition_excludes_its_bounds() -> None:
    for axis, bound in enumerate((0.03, 0.01, 0.01)):
        gripper = np.zeros(3)
        gripper[axis] = bound
        assert not is_at_mouth(gripper, np.zeros(3))


TURNED = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
"""A face that looks along world y: its columns are out, across and up."""


@pytest.mark.parametrize(
    ("out", "across", "up", "expected"),
    [
        (0.0, 0.0, 0.0, True),
        (LIP_DEPTH - EPSILON, 0.0, 0.0, True),
        (LIP_DEPTH + EPSILON, 0.0, 0.0, False),
        (-CAVITY_DEPTH + EPSILON, 0.0, 0.0, True),
        (-CAVITY_DEPTH - EPSILON, 0.0, 0.0, False),
        (-0.01, 0.025 - EPSILON, 0.0, True),
        (-0.01, 0.025 + EPSILON, 0.0, False),
        (-0.01, 0.0, 0.015 - EPSILON, True),
        (-0.01, 0.0, -0.015 - EPSILON, False),
        (-0.01, 0.024, 0.014, False),  # in the rectangle, outside the ellipse
    ],
)
@pytest.mark.parametrize("axes", [np.eye(3), TURNED])
def test_inside_the_opening(
    axes: np.ndarray, out: float, across: float, up: float, expected: bool
) -> None:
    offset = np.array([out, across, up])
    found = from_mouth(MOUTH + axes @ offset, MOUTH, axes)
    np.testing.assert_allclose(found, offset, atol=1e-12)
    assert is_inside_mouth(found, 0.025, 0.015) is expected


NOTHING = StepMeasurements(
    time=0.0,
    is_held=False,
    is_touched=False,
    cube_height=0.02,
    is_at_mouth=False,
    is_inside_mouth=False,
    touches_face=False,
    gripper_distance=0.3,
)
HELD = replace(NOTHING, is_held=True, is_touched=True)
LIFTED = replace(HELD, cube_height=LIFT_HEIGHT)
AT_MOUTH = replace(LIFTED, is_at_mouth=True, gripper_distance=0.02)
LET_GO = replace(AT_MOUTH, is_held=False, is_touched=False, is_inside_mouth=True)
FINGER_STAYS = replace(LET_GO, is_touched=True)
CLEAR = replace(LET_GO, is_at_mouth=False, gripper_distance=CLEAR_DISTANCE)


def touching(fact: StepMeasurements) -> StepMeasurements:
    return replace(fact, touches_face=True)


def play(*facts: StepMeasurements) -> FeedingProgress:
    """Advance through facts, one control step each."""
    progress = FeedingProgress()
    for step, fact in enumerate(facts):
        progress = progress.advance(replace(fact, time=0.02 * (step + 1)))
    return progress


def test_a_perfect_episode() -> None:
    progress = play(NOTHING, HELD, LIFTED, LIFTED, AT_MOUTH, LET_GO, CLEAR)
    assert progress.is_success
    assert progress.is_success_strict
    assert progress.is_clear
    assert progress.phase is Phase.RELEASE
    assert progress.lift_time == pytest.approx(0.06)
    assert progress.completion_time == pytest.approx(0.04)
    assert progress.time_since_lift(0.14) == pytest.approx(0.08)


@pytest.mark.parametrize(
    ("facts", "phase"),
    [
        ((NOTHING,), Phase.REACH),
        ((HELD,), Phase.GRASP),
        ((HELD, NOTHING), Phase.REACH),
        ((replace(LIFTED, is_held=False),), Phase.REACH),  # tossed up, not lifted
        ((HELD, LIFTED), Phase.CARRY),
        ((HELD, LIFTED, HELD), Phase.CARRY),
        ((HELD, LIFTED, AT_MOUTH), Phase.DELIVER),
        ((HELD, LIFTED, AT_MOUTH, LIFTED), Phase.DELIVER),
        ((HELD, LIFTED, LET_GO), Phase.RELEASE),
        ((HELD, LIFTED, LET_GO, HELD), Phase.RELEASE),
    ],
)
def test_phases(facts: tuple[StepMeasurements, ...], phase: Phase) -> None:
    assert play(*facts).phase is phase


@pytest.mark.parametrize(
    ("name", "facts", "success", "strict"),
    [
        ("an empty gripper at the mouth", (replace(AT_MOUTH, is_held=False),), False, False),
        ("the cube pushed, not lifted", (HELD, replace(AT_MOUTH, cube_height=0.02)), False, False),
        ("lifted a hair too little", (replace(LIFTED, cube_height=0.0999),), False, False),
        ("held by one finger", (LIFTED, replace(AT_MOUTH, is_held=False)), False, False),
        ("at the mouth, still held", (LIFTED, AT_MOUTH), True, False),
        ("let go outside", (LIFTED, AT_MOUTH, replace(LET_GO, is_inside_mouth=False)), True, False),
        ("let go inside", (LIFTED, AT_MOUTH, LET_GO), True, True),
        ("let go inside, never in the box", (LIFTED, LET_GO), False, False),
        ("one finger still touches", (LIFTED, AT_MOUTH, FINGER_STAYS), True, False),
        ("lips touched on the way in", (LIFTED, touching(AT_MOUTH), LET_GO), True, False),
        ("lips touched on the way out", (LIFTED, AT_MOUTH, LET_GO, touching(CLEAR)), True, False),
        ("touched before the lift only", (touching(HELD), LIFTED, AT_MOUTH, LET_GO), True, True),
        ("it rolls out after the release", (LIFTED, AT_MOUTH, LET_GO, NOTHING), True, True),
    ],
)
def test_outcomes(
    name: str, facts: tuple[StepMeasurements, ...], success: bool, strict: bool
) -> None:
    progress = play(*facts)
    assert progress.is_success is success, name
    assert progress.is_success_strict is strict, name


def test_there_are_no_times_before_the_events() -> None:
    assert FeedingProgress().completion_time is None
    assert FeedingProgress().time_since_lift(3.0) is None
    assert play(LIFTED).completion_time is None


def test_clear_needs_the_release_first() -> None:
    assert not play(LIFTED, replace(LIFTED, gripper_distance=1.0)).is_clear
    assert not play(LIFTED, LET_GO, replace(CLEAR, gripper_distance=0.1199)).is_clear
    assert play(LIFTED, LET_GO, CLEAR, LET_GO).is_clear
