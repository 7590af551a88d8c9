"""A session: a person steers the arms, episodes are recorded, saved, discarded and done again."""

from __future__ import annotations

import math
from collections.abc import Iterable
from contextlib import closing
from dataclasses import dataclass
from typing import Any, Protocol

import gymnasium
import numpy as np
from numpy.typing import NDArray

from robo_manip_baselines.data.schema import TELEOP
from robo_manip_baselines.envs.mujoco.cell.scene import CONTROL_PERIOD
from robo_manip_baselines.envs.mujoco.tasks.face_env import world_of
from robo_manip_baselines.rollout.demonstrate import Demonstration, EpisodeRecorder
from robo_manip_baselines.teleop.arms import SteeredArms
from robo_manip_baselines.teleop.device import (
    Mode,
    SessionView,
    TeleopDevice,
    TeleopEvent,
    TeleopInput,
)
from robo_manip_baselines.teleop.pace import Pace


class TeleopStore(Protocol):
    """Place for the episodes of a session."""

    def save(self, episode: Demonstration) -> str:
        """Keep an episode; return a line for the person."""
        ...

    def poll(self) -> str:
        """Go on with work in the background; return a line for the person, or ""."""
        ...


class SharedPolicy(Protocol):
    """Policy that acts until a person takes over."""

    attribute: dict[str, str]
    """Value of the episode's attribute ``policy``."""

    def reset(self, seed: int) -> None:
        """Start an episode, or go on after a person has acted."""
        ...

    def act(self) -> NDArray[np.float32]:
        """Return the next action (A,) for the present state of the environment."""
        ...


@dataclass(frozen=True)
class SessionSummary:
    """Summary of a session.

    Attributes:
        saved: episodes that were saved; ``successes`` of them fulfilled the task.
        discarded: episodes that were dropped, those that were done again included.
        steps: control steps of the saved episodes.
        missed: of these, those that ended too late.
        rate: control steps a second while they were recorded, in Hz; NaN without any, and where
            nothing keeps time.
    """

    saved: int = 0
    successes: int = 0
    discarded: int = 0
    steps: int = 0
    missed: int = 0
    rate: float = math.nan


class TeleopSession:
    """Loop of teleoperation: device, end-effector target, inverse kinematics, step, recording.

    Args:
        env: made by `make_env`.
        device: of the person; closed at the end.
        store: for the episodes.
        seeds: of the episodes, one after another.
        steered: arms that the device moves.
        env_kwargs: arguments of the environment, for the files: with the cameras that are to be
            recorded, which ``env`` need not draw.
        operator: name of the person in the files.
        device_name: name of the device, likewise.
        step_limit: control steps after which an episode ends.
        codec, quality: of the images, for the files.
        policy: acts until the person takes over; None leaves all to the person.
        pace: keeps the time; real time if None, for a device that wants it.
    """

    def __init__(
        self,
        env: gymnasium.Env[Any, Any],
        device: TeleopDevice,
        store: TeleopStore,
        seeds: Iterable[int],
        steered: tuple[str, ...],
        *,
        env_kwargs: dict[str, Any],
        operator: str,
        device_name: str,
        step_limit: int,
        codec: str,
        quality: int,
        policy: SharedPolicy | None = None,
        pace: Pace | None = None,
    ) -> None:
        self._env, self._world, self._device, self._store = env, world_of(env), device, store
        self._seeds = list(seeds)
        self._wanted, self._steered, self._step_limit = len(self._seeds), steered, step_limit
        self._facts = {"expert": operator, "device": device_name, "env_kwargs": env_kwargs}
        self._images = {"codec": codec, "quality": quality}
        self._policy = policy
        self._pace = pace or Pace(CONTROL_PERIOD if device.is_paced else None)
        self._arms = SteeredArms(self._world)
        self._active = steered[-1]
        self._recorder: EpisodeRecorder | None = None
        self._message, self._is_over = "", not self._seeds
        self._saved = self._successes = self._discarded = self._steps = self._missed = 0
        self._seconds = 0.0
        self._resets = 0

    def run(self) -> SessionSummary:
        """Run until the person quits, or every seed has been saved or discarded."""
        with closing(self._device):
            if not self._is_over:
                self._begin(Mode.PRACTICE)
            while not self._is_over:
                asked = self._device.update(self.view())
                if not self._has_handled(asked.events) and self._mode is not Mode.REVIEW:
                    self._step(asked)
                self._message = self._store.poll() or self._message
                self._pace.wait()
        rate = self._steps / self._seconds if self._seconds else math.nan
        counts = (self._saved, self._successes, self._discarded, self._steps, self._missed)
        return SessionSummary(*counts, rate)

    def view(self) -> SessionView:
        """Return the present state."""
        return SessionView(
            mode=self._mode,
            seed=self._seeds[0],
            step=self._recorder.steps if self._recorder else 0,
            step_limit=self._step_limit,
            saved=self._saved,
            wanted=self._wanted,
            steered=self._steered,
            active_arm=self._active,
            arms=self._arms.poses,
            is_success=bool(self._info["is_success"]) if self._recorder else False,
            has_policy=self._policy is not None,
            is_policy_acting=self._is_policy_acting,
            rate=self._pace.rate,
            missed=self._episode_missed if self._mode is Mode.REVIEW else self._pace.missed,
            message=self._message,
            world=self._world,
        )

    def _step(self, asked: TeleopInput) -> None:
        """Take one control step: of the person, or of the policy."""
        if self._policy and self._is_policy_acting:
            action = self._policy.act()
            self._arms.take(action)
        else:
            action = self._arms.act(asked.arms, self._steered)
        if self._recorder:
            columns = {"intervention": not self._is_policy_acting} if self._policy else {}
            self._recorder.before(self._observation, action, **columns)
        self._observation, _, is_done, _, self._info = self._env.step(action)
        if self._recorder:
            self._recorder.after(self._info)
            if is_done or self._recorder.steps >= self._step_limit:
                self._end()
        elif is_done:
            self._begin(Mode.PRACTICE)

    # -- events ---------------------------------------------------------------------------------

    def _has_handled(self, events: Iterable[TeleopEvent]) -> bool:
        """Carry out events; return whether one of them put the world elsewhere, or ended it."""
        before = self._resets
        for event in events:
            if not self._is_over:
                self._handle(event)
        return self._is_over or self._resets > before

    def _handle(self, event: TeleopEvent) -> None:
        """Carry out an event; those that the mode does not know do nothing."""
        has_episode = self._recorder is not None and self._recorder.steps > 0
        if event is TeleopEvent.QUIT:
            self._discarded += has_episode
            self._is_over = True
        elif event is TeleopEvent.RECORD and self._mode is Mode.PRACTICE:
            self._begin(Mode.RECORDING)
            self._message = f"recording seed {self._seeds[0]}"
        elif event is TeleopEvent.REDO and self._recorder:
            self._discarded += has_episode
            self._begin(Mode.RECORDING)
            self._message = f"recording seed {self._seeds[0]} again"
        elif event is TeleopEvent.DISCARD and self._recorder:
            self._discarded += has_episode
            self._message = f"seed {self._seeds[0]} was discarded"
            self._go_on()
        elif event is TeleopEvent.SAVE and has_episode:
            if self._mode is Mode.RECORDING:
                self._end()
            self._save()
            self._go_on()
        elif event is TeleopEvent.SWITCH_ARM and len(self._steered) > 1:
            place = self._steered.index(self._active) + 1
            self._active = self._steered[place % len(self._steered)]
        elif event is TeleopEvent.TAKE_OVER and self._is_policy_acting:
            self._is_policy_acting = False
        elif event is TeleopEvent.GIVE_BACK and self._policy and not self._is_policy_acting:
            self._policy.reset(self._seeds[0])
            self._is_policy_acting = True

    def _begin(self, mode: Mode) -> None:
        """Put the world back to the start of the present seed."""
        self._mode, seed = mode, self._seeds[0]
        self._observation, self._info = self._env.reset(seed=seed)
        self._arms.reset()
        self._recorder = None
        if mode is Mode.RECORDING:
            self._recorder = EpisodeRecorder(self._env, seed, **self._images)
        self._is_policy_acting = self._policy is not None and mode is Mode.RECORDING
        if self._policy:
            self._policy.reset(seed)
        self._resets += 1
        self._episode_missed = 0
        self._pace.restart()

    def _end(self) -> None:
        """End the running episode; the world stands still."""
        self._mode = Mode.REVIEW
        self._episode_missed, self._episode_rate = self._pace.missed, self._pace.mean_rate
        result = "success" if self._info["is_success"] else "no success"
        self._message = f"the episode has ended: {result}; save, redo or discard it"

    def _save(self) -> None:
        assert self._recorder is not None
        optional: dict[str, Any] = (
            {} if self._policy is None else {"policy": self._policy.attribute}
        )
        episode = self._recorder.finish(
            **self._facts,
            source=TELEOP,
            loop_rate=self._episode_rate,
            missed_deadlines=self._episode_missed,
            **optional,
        )
        self._message = self._store.save(episode)
        self._saved += 1
        self._successes += bool(self._info["is_success"])
        self._steps += (steps := self._recorder.steps)
        self._missed += self._episode_missed
        self._seconds += 0.0 if math.isnan(self._episode_rate) else steps / self._episode_rate

    def _go_on(self) -> None:
        """Go on with the next seed, if there is one."""
        self._seeds.pop(0)
        if self._seeds:
            self._begin(Mode.PRACTICE)
        else:
            self._is_over = True
