"""Phases of scripted experts, and the expert that runs them one after another.

A phase is started with the last command, gives a command every control step, and reports when it
is done. It knows the world only through an `ExpertView`, so that a new task can string the same
phases together.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import ClassVar, Protocol

import mink
import numpy as np
from numpy.typing import NDArray

from robo_manip_baselines.envs.mujoco.cell.scene import ARM_BASES, CONTROL_PERIOD
from robo_manip_baselines.envs.mujoco.cell.vx300s import FINGER_OPEN, HOME_QPOS
from robo_manip_baselines.envs.mujoco.expert.kinematics import ArmKinematics
from robo_manip_baselines.observation import FRAME_PERIOD

DOWN = mink.SO3.from_z_radians(np.pi) @ mink.SO3.from_y_radians(np.pi / 2)
"""Gripper pointing straight down, its fingers closing along world y."""


def level_at(position: NDArray[np.float64], arm: str = "right") -> mink.SO3:
    """Orientation of a level gripper at ``position`` (3,) m, world, pointing away from its base.

    Straight in front of the base this is along world -x, into the mouth of a face that looks along
    +x. Elsewhere it turns with the arm: to keep pointing along -x there, the wrist would have to
    work around its singularity, where forearm and gripper are in line.
    """
    away = position - np.array(ARM_BASES[arm][0])
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
        target_track: (K, 3) m, world: the target now and 1 ... 24 frames of 1/30 s ahead.
        object_position: (3,) m, world: the object that the gripper takes, if there is one.
        elapsed: s since the approach to the target may begin; None before.
        is_at_target: the task's condition for the end of the approach holds now.
        time: s since the start of the episode.
        gripper_position: (3,) m, world: where the gripper is.
    """

    target_track: NDArray[np.float64]
    object_position: NDArray[np.float64] = field(default_factory=lambda: np.zeros(3))
    elapsed: float | None = None
    is_at_target: bool = False
    time: float = 0.0
    gripper_position: NDArray[np.float64] = field(default_factory=lambda: np.zeros(3))

    def target(self, lead: float = 0.0) -> NDArray[np.float64]:
        """Return the target ``lead`` s ahead, interpolated; (3,) m. At most 24 frames ahead."""
        ahead = np.arange(len(self.target_track)) * FRAME_PERIOD
        return np.array([np.interp(lead, ahead, axis) for axis in self.target_track.T])


class ExpertPhase(Protocol):
    """A stretch of an expert's work."""

    def start(self, view: ExpertView, last: Command) -> None:
        """Begin, the gripper having been commanded to ``last``."""
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
        target: gives the pose to go to when the phase starts.
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


class Wait:
    """Hold still until something has happened.

    Args:
        until: tells whether it has.
    """

    def __init__(self, until: Callable[[], bool]) -> None:
        self._until = until

    def start(self, view: ExpertView, last: Command) -> None:
        """Keep the last command."""
        self._command = last

    def step(self, view: ExpertView) -> Command:
        """Hold."""
        return self._command

    def is_done(self, view: ExpertView) -> bool:
        """Done when it has happened."""
        return self._until()


class Approach:
    """Move, level, towards the target so as to be there when the time is up.

    That is lines 9 to 15 of the paper's Algorithm 1.

    The velocity is (target - gripper) / (limit - t), with t the elapsed time and the gripper where
    it was last commanded.

    Args:
        limit: s.
        lead: s; aim where the target will be this much later.
    """

    def __init__(self, *, limit: float = 6.0, lead: float = 0.0) -> None:
        self._limit, self._lead = limit, lead

    def start(self, view: ExpertView, last: Command) -> None:
        """Start from the last command."""
        self._command = last

    def step(self, view: ExpertView) -> Command:
        """Move by velocity times control period."""
        # Below one control period, the step would go past the target.
        left = max(self._limit - (view.elapsed or 0.0), CONTROL_PERIOD)
        velocity = (view.target(self._lead) - self._command.position) / left
        position = self._command.position + velocity * CONTROL_PERIOD
        self._command = replace(self._command, position=position, orientation=level_at(position))
        return self._command

    def is_done(self, view: ExpertView) -> bool:
        """Done at the target, when the time is up, or at once if it may not begin."""
        elapsed = view.elapsed
        return view.is_at_target or elapsed is None or elapsed > self._limit


class Follow:
    """Keep a place relative to the target, level, getting there gently.

    Args:
        offset: (3,) m, world, from the target.
        duration: s.
        finger: m; None to keep the fingers as they are.
        lead: s; follow where the target will be this much later.
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
        self._gap = last.position - view.target(self._lead) - self._offset

    def step(self, view: ExpertView) -> Command:
        """Move with the target and close the gap to the wanted place."""
        self._step += 1
        distance = float(np.linalg.norm(self._gap))
        reach = self._speed * CONTROL_PERIOD
        self._gap = self._gap * (0.0 if distance <= reach else 1.0 - reach / distance)
        position = view.target(self._lead) + self._offset + self._gap
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


class PhasedExpert:
    """Scripted expert that runs phases with one arm, by inverse kinematics.

    The expert of a task derives from it and implements ``view`` and ``phases``.

    Args:
        arm: ``left`` or ``right``.
        home: (6,) rad, joints with which an episode starts.
        finger: m, position of a finger then.
        tool: frame that commands place, in that of the gripper, such as a spoon's; None for the
            gripper itself.

    Attributes:
        goes_by_observation: whether it sees the mouth as the environment observes it; others know
            the truth.
    """

    goes_by_observation: ClassVar[bool] = False

    def __init__(
        self,
        arm: str = "right",
        home: Sequence[float] = HOME_QPOS,
        *,
        finger: float = FINGER_OPEN,
        tool: mink.SE3 | None = None,
    ) -> None:
        self._kinematics, self._start, self._finger = ArmKinematics(arm), home, finger
        self._tool = tool

    def view(self) -> ExpertView:
        """Return the present state."""
        raise NotImplementedError

    def phases(self, home: Command) -> list[ExpertPhase]:
        """Return the phases of one episode, in order, given the pose that it starts from."""
        raise NotImplementedError

    def reset(self) -> None:
        """Begin with the first phase; call it after the environment's reset."""
        self._joints = np.array(self._start)
        home = self._kinematics.forward(self._joints)
        if self._tool is not None:
            home = home @ self._tool
        self._home = self._command = Command(home.translation(), home.rotation(), self._finger)
        self.skip_to(0)

    def skip_to(self, number: int) -> None:
        """Go on with the phase of a number, counted from 0, from the last command."""
        phases = self.phases(self._home)
        self._count, self._phases = len(phases), phases[number + 1 :]
        self._phase = phases[number]
        self._phase.start(self.view(), self._command)

    @property
    def phases_done(self) -> int:
        """Number of phases that are done."""
        is_done = self._phase.is_done(self.view())
        return self._count - len(self._phases) - (0 if is_done else 1)

    def act(self) -> NDArray[np.float32]:
        """Return the next action, (7,): joint targets in rad and the finger in m."""
        view = self.view()
        while self._phases and self._phase.is_done(view):
            self._phase = self._phases.pop(0)
            self._phase.start(view, self._command)
        self._command = self._phase.step(view)
        pose = (self._command.orientation, self._command.position)
        target = mink.SE3.from_rotation_and_translation(*pose)
        if self._tool is not None:
            target = target @ self._tool.inverse()
        self._joints = self._kinematics.inverse(target, self._joints)
        return np.append(self._joints, self._command.finger).astype(np.float32)
