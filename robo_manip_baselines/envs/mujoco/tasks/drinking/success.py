"""Success of drinking: where liquid counts as drunk, and the progress of an episode."""

from __future__ import annotations

import enum
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from robo_manip_baselines.envs.mujoco.tasks.drinking.liquid import Liquid, jet_at
from robo_manip_baselines.envs.mujoco.tasks.lift import LiftProgress
from robo_manip_baselines.envs.mujoco.tasks.mouth import LIP_DEPTH, from_mouth, is_inside_mouth
from robo_manip_baselines.envs.mujoco.tasks.registry import FORCE_LIMITS

DELIVERY_DISTANCE = 0.03
"""m from the mouth's centre within which liquid is delivered (Assistive Gym, ``DrinkingEnv``)."""

DELIVERED_SHARE = 0.75
"""Part of the liquid that has to be delivered (Assistive Gym, ``task_success_threshold``)."""

SPILLED_SHARE = 0.05
"""Part of the liquid that may be spilled under the strict condition: 2 ml, which a napkin takes;
more wets the clothes."""

GENTLE_FORCE = float(FORCE_LIMITS[1])
"""N that the spout may press with under the strict condition. A spout rests on the lower lip, so
that touching is part of drinking. Assistive Gym penalises a tool that presses with 10 N or more."""

LIFT_HEIGHT = 0.10
"""m above where it stood from which the cup counts as lifted, as the cube of `FeedingEnv`."""

CLEAR_DISTANCE = 0.12
"""m between spout and mouth from which the cup has been taken away."""

UPRIGHT = np.cos(np.radians(15.0))
"""Cosine of the tilt below which the cup is upright again: a full cup pours from 19 degrees on."""


class Phase(enum.IntEnum):
    """Phase of the task. Only ever advances, except back to REACH before the lift."""

    REACH = 0
    GRASP = 1
    CARRY = 2
    POUR = 3
    WITHDRAW = 4


@dataclass(frozen=True)
class Mouth:
    """An open mouth.

    Attributes:
        centre: (3,) m, world.
        axes: (3, 3) columns: out, across, up; world, see `from_mouth`.
        half_width, half_height: m, of the ellipse that the inner lips span.
    """

    centre: NDArray[np.float64]
    axes: NDArray[np.float64]
    half_width: float
    half_height: float

    def holds(self, point: NDArray[np.float64]) -> bool:
        """Return whether a point (3,) m, world, is in the opening, past the front of the lips."""
        offset = from_mouth(point, self.centre, self.axes)
        return is_inside_mouth(offset, self.half_width, self.half_height)


def is_drunk(tip: NDArray[np.float64], velocity: NDArray[np.float64], mouth: Mouth) -> bool:
    """Return whether what leaves the spout goes into the mouth.

    The tip is less than `DELIVERY_DISTANCE` from the mouth's centre, and it is in the opening, or
    the jet, flying freely, enters that through the plane of the front of the lips.

    Args:
        tip: (3,) m, world, of the spout.
        velocity: (3,) m/s, world, with which liquid leaves it.
        mouth: at that moment.
    """
    if np.linalg.norm(tip - mouth.centre) >= DELIVERY_DISTANCE:
        return False
    if mouth.holds(tip):
        return True
    flight = time_to_lips(tip, velocity, mouth)
    return flight is not None and mouth.holds(jet_at(flight, tip, velocity))


def time_to_lips(
    tip: NDArray[np.float64], velocity: NDArray[np.float64], mouth: Mouth
) -> float | None:
    """Return s after which a jet comes from before the lips to the plane of their front.

    None if it starts behind it, or never comes there. In this time of some hundredths of a second
    the fall along a face's normal is neglected: normals of upright faces are level.
    """
    out = float(from_mouth(tip, mouth.centre, mouth.axes)[0]) - LIP_DEPTH
    inward = -float(velocity @ mouth.axes[:, 0])
    # A thousandth of a millimetre further, so that rounding does not leave it before the plane.
    return (out + 1e-6) / inward if out > 0.0 and inward > 0.0 else None


@dataclass(frozen=True)
class StepMeasurements:
    """Measurements of one control step.

    Attributes:
        time: s since the start of the episode.
        is_held: both fingers touch the cup.
        lift: m by which the cup is above where it stood.
        liquid: where it is.
        face_force: N, the largest normal force on the face in the step.
        spout_distance: m between the tip of the spout and the mouth.
        is_upright: the cup is, see `UPRIGHT`.
    """

    time: float
    is_held: bool
    lift: float
    liquid: Liquid
    face_force: float
    spout_distance: float
    is_upright: bool


@dataclass(frozen=True)
class DrinkingProgress(LiftProgress):
    """Events of an episode so far; ``advance`` returns the next.

    Attributes:
        phase: see ``Phase``.
        lift_time: s at which the cup was lifted.
        success_time: s at which enough was delivered.
        liquid: where it is.
        largest_force: N, on the face.
        is_clear: after the success, the cup has been taken away, upright.
    """

    phase: Phase = Phase.REACH
    liquid: Liquid = field(default_factory=Liquid)
    largest_force: float = 0.0
    is_clear: bool = False

    @property
    def is_success_strict(self) -> bool:
        """As well, little was spilled, and the face never pressed harder than gently."""
        spilled, force = self.liquid.spilled_share, self.largest_force
        return self.is_success and spilled <= SPILLED_SHARE and force <= GENTLE_FORCE

    def advance(self, step: StepMeasurements) -> DrinkingProgress:
        """Take in the measurements of one control step."""
        lift_time, success_time = self.lift_time, self.success_time
        if lift_time is None and step.is_held and step.lift >= LIFT_HEIGHT:
            lift_time = step.time
        # A nanolitre less, so that rounding does not take a drop from exactly three quarters.
        is_enough = step.liquid.delivered_share >= DELIVERED_SHARE - 1e-9
        if success_time is None and lift_time is not None and is_enough:
            success_time = step.time
        if lift_time is None:
            phase = Phase.GRASP if step.is_held else Phase.REACH
        elif success_time is not None and step.spout_distance >= DELIVERY_DISTANCE:
            phase = Phase.WITHDRAW
        else:
            phase = Phase.POUR if step.liquid.delivered > 0.0 else Phase.CARRY
            phase = max(phase, self.phase)
        is_away = step.spout_distance >= CLEAR_DISTANCE and step.is_upright
        return replace(
            self,
            phase=phase,
            lift_time=lift_time,
            success_time=success_time,
            liquid=step.liquid,
            largest_force=max(self.largest_force, step.face_force),
            is_clear=self.is_clear or (success_time is not None and is_away),
        )
