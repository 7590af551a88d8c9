"""Scripted experts that wipe a cheek: strokes over a surface that moves, with a regulated force."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from robo_manip_baselines.envs.mujoco.cell.scene import CONTROL_PERIOD
from robo_manip_baselines.envs.mujoco.expert.phases import (
    Command,
    ExpertPhase,
    ExpertView,
    PhasedExpert,
    Reach,
    level_at,
)
from robo_manip_baselines.envs.mujoco.expert.servo import ARM_LAG
from robo_manip_baselines.envs.mujoco.face.model import rotate
from robo_manip_baselines.envs.mujoco.tasks.wiping.env import FaceWipingEnv
from robo_manip_baselines.envs.mujoco.tasks.wiping.model import (
    HALF_SIDE,
    HANDLE_FINGER,
    PAD_FORWARD,
    PAD_RADIUS,
    PAD_STIFFNESS,
)
from robo_manip_baselines.observation import FRAME_PERIOD

Floats = NDArray[np.float64]

FORCE = 2.0
"""N, aimed at: the middle of the range in which the pad wipes."""

COMPLIANCE = 0.02
"""m/s by which the pad is advanced for every newton that is missing. The foam yields 5 mm/N, so
that an error is halved in 0.17 s: slower than the arm's own lag (0.1 s), or both would swing."""

DEPTH = (-0.015, 0.015)
"""m between which the regulation may advance the pad."""

STANDOFF = 0.10
"""m from the cheek to the pad, along the gripper, from where it comes and to where it goes."""

PRESSED = FORCE / PAD_STIFFNESS
"""m by which the pad is pressed in before its force is regulated."""

TOUCH_SPEED, STROKE_SPEED, RETREAT_SPEED = 0.05, 0.03, 0.15
"""m/s of the pad beside the motion of the face."""

_OUT, _END = 0.5 * HALF_SIDE, 0.75 * HALF_SIDE
STROKES = np.array([(-_OUT, _END), (-_OUT, -_END), (_OUT, -_END), (_OUT, _END)])
"""(N, 2) m across and up from the middle of the residue, corners of the way of the contact: down on
the outer half and up on the inner one. No spot is farther from it than 7.1 mm."""


def reactive(env: FaceWipingEnv) -> WipingExpert:
    """Make the expert that wipes the cheek where it is now."""
    return WipingExpert(env)


def servo(env: FaceWipingEnv) -> WipingExpert:
    """Make the expert that aims ahead of the cheek by the lag of the arm."""
    return WipingExpert(env, lead=ARM_LAG * FRAME_PERIOD)


@dataclass(frozen=True)
class Waypoint:
    """Place of the pad over the cheek.

    Attributes:
        plane: (2,) m across and up from the middle of the residue.
        height: m back from the surface, along the gripper; negative where the pad is pressed.
    """

    plane: Floats
    height: float


class WipingExpert(PhasedExpert):
    """Come from the front, press, wipe along `STROKES` and back, withdraw.

    Args:
        env: the environment, unwrapped.
        lead: s; it aims where the cheek will be this much later.
    """

    def __init__(self, env: FaceWipingEnv, lead: float = 0.0) -> None:
        super().__init__()
        self._env, self._lead = env, lead

    def reset(self) -> None:
        """Begin with the first phase; call it after the environment's reset."""
        self.depth = 0.0
        super().reset()
        self._command = replace(self._command, finger=HANDLE_FINGER)
        self.skip_to(0)

    def view(self) -> ExpertView:
        """Return the present state."""
        return ExpertView(self._env.mouth_track)

    def regulate(self) -> None:
        """Advance the pad where the force is too low, draw it back where it is too high."""
        missing = FORCE - self._env.pad_force
        depth = self.depth + COMPLIANCE * missing * CONTROL_PERIOD
        self.depth = float(np.clip(depth, *DEPTH))

    def over_cheek(self, plane: Floats, height: float) -> Floats:
        """Return where the gripper is with the pad over the cheek, (3,) m, world.

        Args:
            plane: (2,) m across and up from the middle of the residue.
            height: m back from the surface, along the gripper.
        """
        point, normal = self._env.cheek.at(plane)
        head, turn = self._env.head_pose(self._lead)
        touching = head + rotate(turn, point + PAD_RADIUS * normal)
        forward = level_at(touching).as_matrix()[:, 0]
        return touching - (height + PAD_FORWARD) * forward

    def phases(self, home: Command) -> list[ExpertPhase]:
        """Return the phases of one episode, in order."""
        start, turns = STROKES[0], [*STROKES[1:], *STROKES[-2::-1]]

        def standoff(view: ExpertView, last: Command) -> Command:
            place = self.over_cheek(start, STANDOFF)
            return Command(place, level_at(place), HANDLE_FINGER)

        touch = [Waypoint(start, STANDOFF), Waypoint(start, -PRESSED)]
        strokes = [Waypoint(place, -PRESSED) for place in (start, *turns)]
        leave = [Waypoint(start, -PRESSED), Waypoint(start, STANDOFF)]
        return [
            Reach(standoff),
            OverCheek(self, touch, TOUCH_SPEED),
            OverCheek(self, strokes, STROKE_SPEED, is_regulated=True),
            OverCheek(self, leave, RETREAT_SPEED),
            Reach(standoff),
        ]


class OverCheek:
    """Phase that moves the pad along waypoints over the moving cheek.

    Args:
        expert: knows the cheek.
        way: the waypoints, gone along in straight lines.
        speed: m/s.
        is_regulated: keep the force, too.
    """

    def __init__(
        self, expert: WipingExpert, way: list[Waypoint], speed: float, *, is_regulated: bool = False
    ) -> None:
        self._expert, self._is_regulated = expert, is_regulated
        stops = np.array([[*w.plane, w.height] for w in way])
        lengths = np.linalg.norm(np.diff(stops, axis=0), axis=-1)
        self._stops, self._ends = stops, np.append(0.0, np.cumsum(lengths / speed))

    def start(self, view: ExpertView, last: Command) -> None:
        """Start at the first waypoint."""
        self._last, self._time = last, 0.0

    def step(self, view: ExpertView) -> Command:
        """Go on along the way, the force regulated."""
        self._time = min(self._time + CONTROL_PERIOD, self._ends[-1])
        across, up, height = (np.interp(self._time, self._ends, c) for c in self._stops.T)
        expert = self._expert
        if self._is_regulated:
            expert.regulate()
        place = expert.over_cheek(np.array([across, up]), height - expert.depth)
        self._last = replace(self._last, position=place, orientation=level_at(place))
        return self._last

    def is_done(self, view: ExpertView) -> bool:
        """Done at the last waypoint."""
        return bool(self._time >= self._ends[-1] - 1e-9)
