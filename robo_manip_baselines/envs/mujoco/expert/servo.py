"""Visual servo: phases that follow a moving target as it is seen, late and with a lead.

The servo sees the target some frames late, and aims where a forecast says that it will be some
frames after the newest one seen. With the true future, the best lead is the delay plus the lag of
the arm itself.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from robo_manip_baselines.envs.mujoco.cell.scene import CONTROL_PERIOD
from robo_manip_baselines.envs.mujoco.expert.phases import Command, ExpertView, level_at
from robo_manip_baselines.observation import FRAME_PERIOD
from robo_manip_baselines.runs.errors import RequestError

ARM_LAG = 3
"""Frames of 1/30 s by which the gripper is behind its commands: the lead with which a servo that
sees the target without delay follows it best (``bin/Benchmark.py foresight``)."""


class Forecast(Protocol):
    """Source of the target: the truth, or any forecast of it."""

    def __call__(self, seen: float, ahead: float) -> NDArray[np.float64]:
        """Return the target (3,) m, world, at ``seen + ahead`` s of the episode.

        It may use what happened until ``seen`` s, and ``ahead`` is 0 s or more.
        """
        ...


@dataclass(frozen=True)
class ServoConfig:
    """Settings of a visual servo.

    Attributes:
        lead: frames of 1/30 s, from the newest one seen, ahead of which it aims.
        delay: frames of 1/30 s, age of the newest one seen.
        speed: m/s, limit of the gripper's commanded speed.
        gate, gate_along: m, largest errors across and along the approach at which it goes on.
        tolerance: (3,) m, largest error at which it counts as inside.
        dwell: s, inside, after which it lets go.
        limit: s after which it gives up.
        plan_steps: control steps of a plan, see `Servo`.

    Raises:
        RequestError: a value is not valid.
    """

    lead: float = ARM_LAG
    delay: float = 0.0
    speed: float = 0.5
    gate: float = 0.008
    gate_along: float = 0.02
    tolerance: tuple[float, float, float] = (0.030, 0.008, 0.008)
    dwell: float = 0.06
    limit: float = 5.0
    plan_steps: int = 1

    def __post_init__(self) -> None:
        for name in ("lead", "delay", "speed", "gate", "gate_along", "dwell", "limit"):
            value = getattr(self, name)
            if not 0.0 <= value < np.inf:
                raise RequestError(f"{name} {value}: must be 0 or more")
        if self.plan_steps < 1:
            raise RequestError(f"plan_steps {self.plan_steps}: must be 1 or more")


class Execution(Protocol):
    """Execution of plans: what a policy's action buffer makes of its chunks."""

    def __call__(self, plan: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the position to command now, (3,) m, world.

        ``plan`` (K, 3) has the positions of this control step and of the next ones, as planned
        now. It is called once in each control step of a servo's phases.
        """
        ...


def first_of(plan: NDArray[np.float64]) -> NDArray[np.float64]:
    """Execute the first step of each plan, so that every step has a plan of its own."""
    return plan[0]


class Servo:
    """Base of the phases of a servo: the gripper level, at a changing distance before the target.

    The distance is along world x, the normal of a face that looks straight ahead. In every control
    step it plans the positions of the gripper for ``plan_steps``, from the last one commanded: at
    one target, the forecast with the lead, which the plan takes to stay where it is, and within
    the limit of speed. The distance changes in the plan as it does in the phase.

    Args:
        forecast: source of the target.
        config: settings.
        goal: m before the target.
        rate: m/s at which the distance changes.
        execution: of the plans.
    """

    def __init__(
        self,
        forecast: Forecast,
        config: ServoConfig,
        *,
        goal: float,
        rate: float,
        execution: Execution = first_of,
    ) -> None:
        self._forecast, self._config, self._execution = forecast, config, execution
        self._goal, self._way = goal, rate * CONTROL_PERIOD

    def start(self, view: ExpertView, last: Command) -> None:
        """Start from the last command, at its distance."""
        self._command, self._step = last, 0
        self._distance = float(last.position[0] - self._aim(view)[0])

    def step(self, view: ExpertView) -> Command:
        """Follow the target, within the limit of speed, and come nearer to the goal."""
        self._step += 1
        goal, aim = self._next(view), self._aim(view)
        way = self._way * np.arange(1, self._config.plan_steps + 1)
        distance = self._distance + np.clip(goal - self._distance, -way, way)
        self._distance = float(distance[0])
        plan = aim + np.multiply.outer(distance, [1.0, 0.0, 0.0])
        self._keep_to_speed(plan)
        position = self._execution(plan)
        self._command = replace(self._command, position=position, orientation=level_at(position))
        return self._command

    def _keep_to_speed(self, plan: NDArray[np.float64]) -> None:
        """Let wanted positions (K, 3) m be reached within the limit of speed, in place."""
        position, longest = self._command.position, self._config.speed * CONTROL_PERIOD
        for row in plan:
            way = row - position
            length = math.sqrt(way @ way)
            row[:] = position = position + way * min(1.0, longest / max(length, longest))
            if length <= longest and self._way <= longest:
                break  # it stays with the plan from here on

    def _next(self, view: ExpertView) -> float:
        """Return the distance to go to."""
        return self._goal

    def _aim(self, view: ExpertView) -> NDArray[np.float64]:
        """Return the target at which to aim, (3,) m."""
        config = self._config
        seen = view.time - config.delay * FRAME_PERIOD
        return self._forecast(seen, config.lead * FRAME_PERIOD)

    def _error(self, view: ExpertView) -> NDArray[np.float64]:
        """Return the gripper minus the present target as far as the forecast reaches, (3,) m."""
        config = self._config
        seen = view.time - config.delay * FRAME_PERIOD
        ahead = min(config.delay, config.lead) * FRAME_PERIOD
        return view.gripper_position - self._forecast(seen, ahead)


class Insert(Servo):
    """Come to the goal while in line with the target, go back to wait while not.

    Args:
        forecast, config, goal, rate, execution: see `Servo`.
        waiting: m before the target, to which it goes back.
    """

    def __init__(
        self,
        forecast: Forecast,
        config: ServoConfig,
        *,
        goal: float,
        rate: float,
        waiting: float,
        execution: Execution = first_of,
    ) -> None:
        super().__init__(forecast, config, goal=goal, rate=rate, execution=execution)
        self._waiting = waiting

    def start(self, view: ExpertView, last: Command) -> None:
        """Start from the last command, at its distance."""
        super().start(view, last)
        self._inside = 0

    def is_done(self, view: ExpertView) -> bool:
        """Done after the dwell inside, or when the time is up."""
        inside, passed = self._inside * CONTROL_PERIOD, self._step * CONTROL_PERIOD
        return inside > self._config.dwell or passed >= self._config.limit

    def _next(self, view: ExpertView) -> float:
        error, config = self._error(view), self._config
        self._inside = self._inside + 1 if (np.abs(error) < config.tolerance).all() else 0
        across, along = float(np.hypot(*error[1:])), abs(float(error[0]) - self._distance)
        if across < config.gate and along < config.gate_along:
            return self._goal
        return max(self._waiting, self._distance)


class Hold(Servo):
    """Follow the target for a time.

    Args:
        forecast, config, goal, rate, execution: see `Servo`.
        duration: s.
        finger: m; None to keep the fingers as they are.
    """

    def __init__(
        self,
        forecast: Forecast,
        config: ServoConfig,
        *,
        goal: float,
        rate: float,
        duration: float,
        finger: float | None = None,
        execution: Execution = first_of,
    ) -> None:
        super().__init__(forecast, config, goal=goal, rate=rate, execution=execution)
        self._steps, self._finger = round(duration / CONTROL_PERIOD), finger

    def start(self, view: ExpertView, last: Command) -> None:
        """Start from the last command, with other fingers if wanted."""
        super().start(view, last if self._finger is None else replace(last, finger=self._finger))

    def is_done(self, view: ExpertView) -> bool:
        """Done when the time is over."""
        return self._step >= self._steps
