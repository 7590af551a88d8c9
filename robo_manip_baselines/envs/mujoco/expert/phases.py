"""Phases of scripted experts: each commands the gripper until it is done.

A phase is started with the last command, gives a command every control step, and reports when it
is done. It knows the world only through an `ExpertView`, so that a new task can string the same
phases together.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Protocol

import mink
import numpy as np
from numpy.typing import NDArray

from robo_manip_baselines.envs.mujoco.cell.scene import ARM_BASES, CONTROL_PERIOD
from robo_manip_baselines.observation import FRAME_PERIOD

RIGHT_BASE = np.array(ARM_BASES["right"][0])
"""m, world: the base of the arm that feeds."""

DOWN = mink.SO3.from_z_radians(np.pi) @ mink.SO3.from_y_radians(np.pi / 2)
"""Gripper pointing straight down, its fingers closing along world y."""


def level_at(position: NDArray[np.float64]) -> mink.SO3:
    """Return the orientation of a level gripper at ``position``, pointing away from the arm's base.

    Straight in front of the base this is along world -x, into the mouth of a face that looks along
    +x. Elsewhere it turns with the arm: to keep pointing along -x there, the wrist would have to
    work around its singularity, where forearm and gripper are in line.

    Args:
        position: (3,) m, world.
    """
    away = position - RIGHT_BASE
    return mink.SO3.from_z_radians(float(np.arctan2(away[1], away[0])))


@dataclass(frozen=True)
class Command:
    """Commanded pose of the gripper.

    Attributes:
        position: (3,) m, world.
        orientation: world from gripper.
        finger: m, position of a finger.
    """

    position: NDArray[np.float64]
    orientation: mink.SO3
    finger: float


@dataclass(frozen=True)
class ExpertView:
    """State that an expert acts on: the present, and the recorded future.

    Attributes:
        object_position: (3,) m, world.
        mouth_track: (K, 3) m, world: the mouth now and 1 ... 5 frames of 1/30 s ahead.
        time_since_lift: s; None before.
        is_at_mouth: Algorithm 1's spatial condition holds now.
    """

    object_position: NDArray[np.float64]
    mouth_track: NDArray[np.float64]
    time_since_lift: float | None
    is_at_mouth: bool

    def mouth(self, lead: float = 0.0) -> NDArray[np.float64]:
        """Return the mouth ``lead`` s ahead, interpolated; (3,) m. At most 5 frames ahead."""
        ahead = np.arange(len(self.mouth_track)) * FRAME_PERIOD
        return np.array([np.interp(lead, ahead, axis) for axis in self.mouth_track.T])


class ExpertPhase(Protocol):
    """A stretch of an expert's work."""

    def start(self, view: ExpertView, last: Command) -> None:
        """Begin, ``last`` being the last command."""
        ...

    def step(self, view: ExpertView) -> Command:
        """Return the command of the next control step."""
        ...

    def is_done(self, view: ExpertView) -> bool:
        """Return whether the next phase may begin."""
        ...


class Reach:
    """Go to a pose on a straight line, with the speed profile of least jerk.

    Args:
        target: the pose to go to, given what there is to see when the phase starts.
        speed: m/s, the mean along the line.
        least_duration: s, however short the line is.
    """

    def __init__(
        self,
        target: Callable[[ExpertView, Command], Command],
        *,
        speed: float = 0.25,
        least_duration: float = 0.3,
    ) -> None:
        self._target_of, self._speed, self._least = target, speed, least_duration

    def start(self, view: ExpertView, last: Command) -> None:
        """Fix the line and its duration."""
        self._from, self._to = last, self._target_of(view, last)
        length = float(np.linalg.norm(self._to.position - last.position))
        self._steps = max(1, round(max(length / self._speed, self._least) / CONTROL_PERIOD))
        self._step = 0

    def step(self, view: ExpertView) -> Command:
        """Advance along the line."""
        self._step += 1
        share = least_jerk(self._step / self._steps)
        return Command(
            position=self._from.position + share * (self._to.position - self._from.position),
            orientation=self._from.orientation.interpolate(self._to.orientation, share),
            finger=self._from.finger + share * (self._to.finger - self._from.finger),
        )

    def is_done(self, view: ExpertView) -> bool:
        """Done at the end of the line."""
        return self._step >= self._steps


class Grip:
    """Stand still and move the fingers.

    Args:
        finger: m, where they should go.
        duration: s.
    """

    def __init__(self, finger: float, duration: float) -> None:
        self._finger, self._steps = finger, round(duration / CONTROL_PERIOD)

    def start(self, view: ExpertView, last: Command) -> None:
        """Keep the pose of the last command."""
        self._command, self._step = replace(last, finger=self._finger), 0

    def step(self, view: ExpertView) -> Command:
        """Hold."""
        self._step += 1
        return self._command

    def is_done(self, view: ExpertView) -> bool:
        """Done when the time is over."""
        return self._step >= self._steps


class Approach:
    """Move, level, towards the mouth so as to be there when the time is up.

    That is lines 9 to 15 of the paper's Algorithm 1.

    The velocity is (mouth - gripper) / (limit - t), with t since the lift and the gripper where it
    was last commanded.

    Args:
        limit: s since the lift.
        lead: s; aim where the mouth will be this much later.
    """

    def __init__(self, *, limit: float = 6.0, lead: float = 0.0) -> None:
        self._limit, self._lead = limit, lead

    def start(self, view: ExpertView, last: Command) -> None:
        """Start from the last command."""
        self._command = last

    def step(self, view: ExpertView) -> Command:
        """Move by velocity times control period."""
        # Below one control period, the step would go past the mouth.
        elapsed = view.time_since_lift or 0.0
        left = max(self._limit - elapsed, CONTROL_PERIOD)
        velocity = (view.mouth(self._lead) - self._command.position) / left
        position = self._command.position + velocity * CONTROL_PERIOD
        self._command = replace(self._command, position=position, orientation=level_at(position))
        return self._command

    def is_done(self, view: ExpertView) -> bool:
        """Done at the mouth, when the time is up, or at once if nothing was lifted."""
        elapsed = view.time_since_lift
        return view.is_at_mouth or elapsed is None or elapsed > self._limit


class Follow:
    """Keep a place relative to the mouth, level, getting there gently.

    Args:
        offset: (3,) m, world, from the mouth.
        duration: s.
        finger: m; None to keep the fingers as they are.
        lead: s; follow where the mouth will be this much later.
        speed: m/s, the largest at which the gap is closed.
    """

    def __init__(
        self,
        offset: NDArray[np.float64],
        duration: float,
        *,
        finger: float | None = None,
        lead: float = 0.0,
        speed: float = 0.15,
    ) -> None:
        self._offset, self._steps = offset, round(duration / CONTROL_PERIOD)
        self._finger, self._lead, self._speed = finger, lead, speed

    def start(self, view: ExpertView, last: Command) -> None:
        """Note how far from the wanted place it starts."""
        finger = last.finger if self._finger is None else self._finger
        self._last, self._step = replace(last, finger=finger), 0
        self._gap = last.position - view.mouth(self._lead) - self._offset

    def step(self, view: ExpertView) -> Command:
        """Move with the mouth and close the gap to the wanted place."""
        self._step += 1
        distance = float(np.linalg.norm(self._gap))
        reach = self._speed * CONTROL_PERIOD
        self._gap = self._gap * (0.0 if distance <= reach else 1.0 - reach / distance)
        position = view.mouth(self._lead) + self._offset + self._gap
        self._last = replace(self._last, position=position, orientation=level_at(position))
        return self._last

    def is_done(self, view: ExpertView) -> bool:
        """Done when the time is over."""
        return self._step >= self._steps


def least_jerk(share: float) -> float:
    """Map elapsed time in [0, 1] to distance in [0, 1] on a minimum-jerk path (Flash, Hogan 1985).

    Times outside the interval are held at its ends.
    """
    s = min(max(share, 0.0), 1.0)
    return s**3 * (10.0 - 15.0 * s + 6.0 * s**2)
