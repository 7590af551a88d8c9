"""The visual servo: its phases on their own, and feeding a face that moves."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from robo_manip_baselines.envs.mujoco.cell.vx300s import FINGER_OPEN
from robo_manip_baselines.envs.mujoco.expert.phases import DOWN, Command, ExpertView
from robo_manip_baselines.envs.mujoco.expert.servo import (
    ARM_LAG,
    Forecast,
    Hold,
    Insert,
    ServoConfig,
)
from robo_manip_baselines.envs.mujoco.tasks.feeding.env import FeedingEnv
from robo_manip_baselines.envs.mujoco.tasks.feeding.expert import FeedingServo
from robo_manip_baselines.envs.mujoco.tasks.registry import make_env
from robo_manip_baselines.runs.errors import RequestError

MOUTH = np.array([0.0, 0.5, 0.35])
BEFORE = Command(MOUTH + np.array([0.2, 0.0, 0.0]), DOWN, 0.021)
STEP = 0.02


def still(seen: float, ahead: float) -> np.ndarray:
    return MOUTH


def drifting(seen: float, ahead: float) -> np.ndarray:
    """A target at 0.1 m/s along y, of which everything is known."""
    return MOUTH + np.array([0.0, 0.1 * (seen + ahead), 0.0])


def follow(phase: Insert | Hold, steps: int) -> list[np.ndarray]:
    """Run a phase whose gripper is where it was last commanded to be."""
    phase.start(ExpertView(MOUTH[None]), BEFORE)
    commands = [BEFORE.position]
    for step in range(steps):
        view = ExpertView(MOUTH[None], time=step * STEP, gripper_position=commands[-1])
        commands.append(phase.step(view).position)
        if phase.is_done(view):
            break
    return commands


@pytest.mark.parametrize(("lead", "delay"), [(0, 0), (3, 0), (0, 6), (9, 6)])
def test_it_aims_a_lead_ahead_of_a_late_target(lead: float, delay: float) -> None:
    config = ServoConfig(lead=lead, delay=delay, speed=2.0)
    phase = Hold(drifting, config, goal=0.1, rate=0.3, duration=1.0)
    commands = follow(phase, 50)
    assert len(commands) == 51  # 1 s
    time = 49 * STEP  # of the last view
    expected = MOUTH + np.array([0.1, 0.1 * (time + (lead - delay) / 30), 0.0])
    np.testing.assert_allclose(commands[-1], expected, atol=1e-9)


def test_commands_keep_to_the_limit_of_speed() -> None:
    def jumping(seen: float, ahead: float) -> np.ndarray:
        return MOUTH + np.array([0.0, 0.1 * (seen > 0.2), 0.0])

    phase = Hold(jumping, ServoConfig(speed=0.2), goal=0.1, rate=1.0, duration=2.0)
    ways = np.linalg.norm(np.diff(follow(phase, 100), axis=0), axis=1)
    assert ways.max() == pytest.approx(0.2 * STEP)


def plans_of(config: ServoConfig, forecast: Forecast, steps: int) -> tuple[list, list]:
    """Run a phase whose plans are executed at their first step; return plans and commands."""
    plans: list[np.ndarray] = []

    def execution(plan: np.ndarray) -> np.ndarray:
        plans.append(plan.copy())
        return plan[0]

    phase = Hold(forecast, config, goal=0.1, rate=0.3, duration=9.0, execution=execution)
    return plans, follow(phase, steps)


def test_plans_take_the_target_to_stay() -> None:
    config = ServoConfig(lead=0, plan_steps=30)
    plans, _ = plans_of(config, drifting, 60)
    last, wanted = plans[-1], MOUTH + np.array([0.1, 0.1 * 59 * STEP, 0.0])
    np.testing.assert_allclose(last, np.tile(wanted, (30, 1)), atol=1e-9)


def test_plans_come_nearer_at_the_rate_and_keep_to_the_speed() -> None:
    """From 0.2 m to 0.1 m at 0.3 m/s, and to a target 40 mm aside at 0.5 m/s, at the first step."""

    def aside(seen: float, ahead: float) -> np.ndarray:
        return MOUTH + np.array([0.0, 0.04 * (seen >= 0.0), 0.0])

    phase_plans, commands = plans_of(ServoConfig(lead=0, plan_steps=30), aside, 1)
    (plan,) = phase_plans
    np.testing.assert_array_equal(commands[1], plan[0])
    ways = np.linalg.norm(np.diff([commands[0], *plan], axis=0), axis=1)
    assert ways.max() <= 0.5 * STEP + 1e-12
    assert ways[0] == pytest.approx(0.5 * STEP)
    expected = np.maximum(0.2 - 0.3 * STEP * np.arange(1, 31), 0.1)
    np.testing.assert_allclose(plan[10:, 0] - MOUTH[0], expected[10:], atol=1e-9)
    np.testing.assert_allclose(plan[10:, 1] - MOUTH[1], 0.04, atol=1e-9)


def test_the_first_step_of_a_plan_is_the_plan_of_one_step() -> None:
    """Whatever the number of steps, as long as the first one is executed."""
    _, one = plans_of(ServoConfig(lead=2, speed=0.12), drifting, 80)
    _, many = plans_of(ServoConfig(lead=2, speed=0.12, plan_steps=30), drifting, 80)
    np.testing.assert_array_equal(one, many)


def test_it_goes_in_at_its_rate_and_lets_go_after_the_dwell() -> None:
    config = ServoConfig(lead=0, dwell=0.1)
    phase = Insert(still, config, goal=0.028, rate=0.1, waiting=0.08)
    commands = follow(phase, 200)
    ways = np.diff([position[0] for position in commands])
    assert ways.min() == pytest.approx(-0.1 * STEP)
    assert commands[-1][0] == pytest.approx(0.028)
    # 86 steps down to 0.028 m; inside, below 0.030 m, from the last of them; then more than 5.
    assert len(commands) == pytest.approx(1 + 86 + 6, abs=2)


def test_it_waits_before_a_target_that_it_misses() -> None:
    """A gripper 9 mm aside never goes in, one that is hit aside goes back to wait."""
    config = ServoConfig(lead=0, limit=2.0)
    phase = Insert(still, config, goal=0.028, rate=0.1, waiting=0.08)
    phase.start(
        ExpertView(MOUTH[None]), replace(BEFORE, position=MOUTH + np.array([0.05, 0.0, 0.0]))
    )
    aside = ExpertView(MOUTH[None], gripper_position=MOUTH + np.array([0.05, 0.009, 0.0]))
    commands = []
    while not phase.is_done(aside):
        commands.append(phase.step(aside).position)
    assert len(commands) == 100  # 2 s are over
    assert commands[-1][0] == pytest.approx(0.08)


@pytest.mark.parametrize(
    ("delay", "lead", "believed"),
    [(0, 0, 0), (6, 0, -6), (6, 4, -2), (6, 9, 0), (0, 3, 0)],
)
def test_it_judges_by_the_present_as_far_as_it_knows_it(
    delay: int, lead: int, believed: int
) -> None:
    """The forecast of now where the lead reaches it, else the last that is known."""
    asked: list[float] = []

    def forecast(seen: float, ahead: float) -> np.ndarray:
        asked.append(seen + ahead)
        return MOUTH

    config = ServoConfig(lead=lead, delay=delay)
    phase = Insert(forecast, config, goal=0.028, rate=0.1, waiting=0.08)
    phase.start(ExpertView(MOUTH[None]), BEFORE)
    asked.clear()
    phase.step(ExpertView(MOUTH[None], time=1.0))
    np.testing.assert_allclose(asked, [1.0 + believed / 30, 1.0 + (lead - delay) / 30])


def test_plans_have_a_step_or_more() -> None:
    with pytest.raises(RequestError, match="plan_steps 0: must be 1 or more"):
        ServoConfig(plan_steps=0)


@pytest.mark.parametrize("name", ["lead", "delay", "speed", "dwell", "limit", "gate"])
def test_settings_below_zero_are_refused(name: str) -> None:
    with pytest.raises(RequestError, match=f"{name} -1.0: must be 0 or more"):
        replace(ServoConfig(), **{name: -1.0})


@pytest.fixture(scope="module")
def moving() -> FeedingEnv:
    world = make_env("FeedingEnv", cameras=(), motion="dyskinetic").unwrapped
    assert isinstance(world, FeedingEnv)
    return world


def feed(world: FeedingEnv, config: ServoConfig, seed: int) -> bool:
    actor = FeedingServo(world, config)
    world.reset(seed=seed)
    actor.reset()
    for _ in range(600):
        if world.step(actor.act())[2]:
            break
    return world.progress.is_success_strict


@pytest.mark.long
def test_it_feeds_a_dyskinetic_person_without_touching_the_face(moving: FeedingEnv) -> None:
    assert [feed(moving, ServoConfig(), seed) for seed in range(4)] == [True] * 4


@pytest.mark.long
def test_with_a_delay_the_lead_decides(moving: FeedingEnv) -> None:
    late = [feed(moving, ServoConfig(lead=0, delay=8), seed) for seed in range(3)]
    led = [feed(moving, ServoConfig(lead=8 + ARM_LAG, delay=8), seed) for seed in range(3)]
    assert sum(led) == 3
    assert sum(late) <= 1


def test_the_fingers_open_when_it_lets_go() -> None:
    phase = Hold(still, ServoConfig(), goal=0.028, rate=0.1, duration=0.1, finger=FINGER_OPEN)
    phase.start(ExpertView(MOUTH[None]), BEFORE)
    assert phase.step(ExpertView(MOUTH[None])).finger == FINGER_OPEN
