"""Events, modes and recording of a session, and the motion of its arms."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium
import mink
import numpy as np
import pytest

from robo_manip_baselines.data import EpisodeReader, list_episodes
from robo_manip_baselines.envs.mujoco.cell.vx300s import FINGER_CLOSED, FINGER_OPEN
from robo_manip_baselines.envs.mujoco.tasks.face_env import world_of
from robo_manip_baselines.envs.mujoco.tasks.registry import make_env
from robo_manip_baselines.teleop.arms import FLOOR, MAX_LINEAR, STRAIN, SteeredArms
from robo_manip_baselines.teleop.device import (
    Mode,
    SessionView,
    TeleopCommand,
    TeleopEvent,
    TeleopInput,
)
from robo_manip_baselines.teleop.pace import Pace
from robo_manip_baselines.teleop.replay import ReplayDevice

Env = gymnasium.Env[Any, Any]
MakeSession = Callable[..., Any]


class Script:
    """Device that answers by a function of the view; the views are kept."""

    is_paced = False

    def __init__(self, answer: Callable[[SessionView], TeleopInput]) -> None:
        self.answer = answer
        self.views: list[SessionView] = []
        self.is_closed = False

    def update(self, view: SessionView) -> TeleopInput:
        self.views.append(view)
        assert len(self.views) < 3000, "the session does not end"
        return self.answer(view)

    def close(self) -> None:
        self.is_closed = True


def script(*answers: TeleopInput | TeleopEvent | None) -> Script:
    """Return a device that gives these answers one after another, and then quits."""
    waiting = list(answers)

    def answer(_: SessionView) -> TeleopInput:
        given = waiting.pop(0) if waiting else TeleopEvent.QUIT
        if isinstance(given, TeleopEvent):
            return TeleopInput(events=(given,))
        return given or TeleopInput()

    return Script(answer)


RECORD, SAVE, DISCARD, REDO = (
    TeleopEvent.RECORD,
    TeleopEvent.SAVE,
    TeleopEvent.DISCARD,
    TeleopEvent.REDO,
)


def test_events_lead_through_the_modes(make_session: MakeSession, feeding_env: Env) -> None:
    device = script(SAVE, None, RECORD, None, None, REDO, None, SAVE, RECORD, None, DISCARD, None)
    session, store = make_session(feeding_env, device, seeds=(4, 5, 6))
    summary = session.run()
    assert [view.mode for view in device.views] == [
        *[Mode.PRACTICE] * 3,
        *[Mode.RECORDING] * 5,
        Mode.PRACTICE,
        *[Mode.RECORDING] * 2,
        *[Mode.PRACTICE] * 2,
    ]
    assert [view.seed for view in device.views] == [4] * 8 + [5] * 3 + [6] * 2
    assert [view.step for view in device.views] == [0, 0, 0, 0, 1, 2, 0, 1, 0, 0, 1, 0, 0]
    assert (summary.saved, summary.discarded, summary.steps) == (1, 2, 1)
    assert math.isnan(summary.rate)
    assert device.is_closed
    (episode,) = store.episodes
    assert len(episode.arrays["time"]) == 1
    known = episode.attributes
    assert (known["seed"], known["source"], known["device"]) == (4, "teleop", "script")
    assert (known["expert"], known["missed_deadlines"]) == ("somebody", 0)
    assert "intervention" not in episode.arrays
    assert "policy" not in known


def test_a_session_ends_after_the_last_seed(make_session: MakeSession, feeding_env: Env) -> None:
    device = script(RECORD, None, SAVE)
    session, store = make_session(feeding_env, device, seeds=(4,))
    assert session.run().saved == len(store.episodes) == 1
    assert len(device.views) == 3


def test_an_episode_ends_at_its_limit_and_waits(
    make_session: MakeSession, feeding_env: Env
) -> None:
    device = script(RECORD, *[None] * 5, SAVE)
    session, store = make_session(feeding_env, device, step_limit=3)
    session.run()
    assert [view.mode for view in device.views[4:]] == [Mode.REVIEW] * 3
    assert {view.step for view in device.views[4:]} == {3}
    times = [view.world.time for view in device.views[4:]]
    assert len(set(times)) == 1
    assert len(store.episodes[0].arrays["time"]) == 3


def test_an_episode_starts_as_the_seed_says_whatever_was_practised(
    make_session: MakeSession, feeding_env: Env
) -> None:
    right = TeleopInput({"right": TeleopCommand(np.array([0.2, 0.1, 0.3]), opening=0.0)})
    session, store = make_session(feeding_env, script(*[right] * 20, RECORD, None, SAVE), (7,))
    session.run()
    feeding_env.reset(seed=7)
    world = world_of(feeding_env)
    np.testing.assert_array_equal(store.episodes[0].arrays["qpos"][0], world.data.qpos)


def test_a_velocity_moves_the_gripper_along_the_axes_of_the_world(
    make_session: MakeSession, feeding_env: Env
) -> None:
    velocity, turn, steps = np.array([-0.1, 0.06, 0.05]), np.array([0.0, 0.2, 0.3]), 50
    command = TeleopCommand(velocity, turn, 0.25)
    device = script(RECORD, *[TeleopInput({"right": command})] * steps, *[None] * 25, SAVE)
    session, store = make_session(feeding_env, device)
    session.run()
    arrays, first, last = store.episodes[0].arrays, device.views[1], device.views[-1]
    moved = last.arms["right"].position - first.arms["right"].position
    np.testing.assert_allclose(moved, velocity * steps * 0.02, atol=1e-9)
    turned = (
        mink.SO3(last.arms["right"].orientation)
        @ mink.SO3(first.arms["right"].orientation).inverse()
    )
    np.testing.assert_allclose(turned.log(), turn * steps * 0.02, atol=1e-6)
    # The servos hold the arm within millimetres of its target.
    reached = arrays["end_effector_position"][-1]
    np.testing.assert_allclose(reached, last.arms["right"].position, atol=5e-3)
    finger = FINGER_CLOSED + 0.25 * (FINGER_OPEN - FINGER_CLOSED)
    np.testing.assert_allclose(arrays["action"][-1, -1], finger, rtol=1e-6)


def move(env: Env, command: TeleopCommand, steps: int) -> SteeredArms:
    """Follow a command with the right arm from the start of seed 0; return the arms."""
    env.reset(seed=0)
    arms = SteeredArms(world_of(env))
    arms.reset()
    for _ in range(steps):
        env.step(arms.act({"right": command}, ("right",)))
    return arms


def test_the_gripper_stays_above_the_table(feeding_env: Env) -> None:
    arms = move(feeding_env, TeleopCommand(np.array([0.0, 0.0, -0.5])), 60)
    assert arms.poses["right"].position[2] >= FLOOR - 1e-9


def test_a_target_out_of_reach_does_not_run_away(feeding_env: Env) -> None:
    out = TeleopCommand(np.array([-0.5, 0.0, 0.5]))
    arms = move(feeding_env, out, 150)
    far = arms.poses["right"].position
    back = TeleopCommand(np.array([0.25, 0.0, -0.25]))
    for _ in range(5):
        feeding_env.step(arms.act({"right": back}, ("right",)))
    # 5 steps at 0.35 m/s: it comes back at once.
    assert np.linalg.norm(arms.poses["right"].position - far) > 0.02
    away = arms.poses["right"].position - world_of(feeding_env).gripper_position
    assert np.linalg.norm(away) < STRAIN + MAX_LINEAR * 0.02


@pytest.mark.parametrize("bad", [np.full(3, np.nan), np.full(3, np.inf), np.zeros(2)])
def test_numbers_that_are_none_move_nothing(feeding_env: Env, bad: Any) -> None:
    arms = move(feeding_env, TeleopCommand(bad, bad, math.nan), 3)
    world_of(feeding_env).reset(seed=0)
    start = world_of(feeding_env).gripper_position
    np.testing.assert_allclose(arms.poses["right"].position, start, atol=1e-9)


def test_the_other_arm_holds_still_and_hands_are_switched(make_session: MakeSession) -> None:
    env = make_env("BimanualFeedingEnv", cameras=())
    lift = TeleopCommand(np.array([0.0, 0.0, 0.2]))

    def answer(view: SessionView) -> TeleopInput:
        if view.mode is Mode.PRACTICE:
            return TeleopInput(events=(RECORD,))
        events = {10: (TeleopEvent.SWITCH_ARM,), 20: (SAVE,)}.get(view.step, ())
        return TeleopInput({view.active_arm: lift}, events)

    device = Script(answer)
    session, store = make_session(env, device)
    session.run()
    env.close()
    heights = [{name: pose.position[2] for name, pose in v.arms.items()} for v in device.views]
    begin, half, end = heights[1], heights[10], heights[-1]
    assert half["right"] > begin["right"] + 0.03
    assert half["left"] == begin["left"]
    assert end["left"] > half["left"] + 0.03
    assert store.episodes[0].arrays["action"].shape == (20, 14)


@pytest.mark.long
@pytest.mark.parametrize("env_name", ["FeedingEnv", "BimanualFeedingEnv", "FaceWipingEnv"])
def test_the_motion_of_an_episode_does_the_task_again(
    make_session: MakeSession, env_name: str, recorded: Callable[..., Path]
) -> None:
    paths = list_episodes(recorded(env_name))
    env = make_env(env_name, cameras=())
    device = ReplayDevice(paths, world_of(env).observation_spec.arm_names)
    session, store = make_session(env, device, device.seeds)
    assert session.run().successes == 1
    env.close()
    with EpisodeReader(paths[0]) as episode:
        wanted = episode.array("end_effector_position")
    reached = store.episodes[0].arrays["end_effector_position"]
    steps = min(len(wanted), len(reached))
    assert abs(len(wanted) - len(reached)) < 5
    # Inverse kinematics is exact to 0.2 mm; contacts and the servos add a little.
    assert np.abs(wanted[:steps] - reached[:steps]).max() < 5e-3


class Clock:
    """Time that passes when it is told to."""

    def __init__(self) -> None:
        self.now = 100.0

    def __call__(self) -> float:
        return self.now

    def sleep(self, seconds: float) -> None:
        self.now += seconds


@pytest.mark.parametrize(
    ("work", "missed", "elapsed"),
    [
        ([0.005] * 50, 0, 1.0),
        ([0.005] * 10 + [0.028] + [0.005] * 39, 0, 1.0),  # late, but made up for
        ([0.005] * 10 + [0.035] + [0.005] * 39, 1, 1.0),  # late by less than a period: likewise
        ([0.005] * 10 + [0.125] + [0.005] * 39, 1, 1.105),  # lost, and not hurried after
        ([0.04] * 50, 50, 2.0),
    ],
)
def test_deadlines_are_kept_or_counted(work: list[float], missed: int, elapsed: float) -> None:
    clock = Clock()
    pace = Pace(0.02, clock, clock.sleep)
    for seconds in work:
        clock.now += seconds
        pace.wait()
    assert pace.missed == missed
    assert clock.now - 100.0 == pytest.approx(elapsed)
    assert pace.mean_rate == pytest.approx(len(work) / elapsed)
    assert pace.rate == pytest.approx(50.0 if missed < 50 else 25.0, rel=0.12)


def test_missed_deadlines_are_in_the_episode(make_session: MakeSession, feeding_env: Env) -> None:
    clock = Clock()

    def answer(view: SessionView) -> TeleopInput:
        clock.now += 0.05 if view.step in (3, 4) else 0.004
        if view.mode is Mode.PRACTICE:
            return TeleopInput(events=(RECORD,))
        return TeleopInput(events=(SAVE,) if view.step == 10 else ())

    session, store = make_session(feeding_env, Script(answer), pace=Pace(0.02, clock, clock.sleep))
    summary = session.run()
    assert store.episodes[0].attributes["missed_deadlines"] == summary.missed == 2
    rate = store.episodes[0].attributes["loop_rate"]
    assert rate == pytest.approx(summary.rate)
    assert 30.0 < rate < 50.0
