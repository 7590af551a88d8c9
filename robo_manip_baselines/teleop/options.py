"""Options of devices that move a hand, apart from the devices: quick to import."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from annotated_types import Interval


@dataclass(frozen=True)
class SteeringOptions:
    """Speed of the hand; only with --device keyboard or spacemouse.

    Attributes:
        key_step: m that a key moves the gripper by.
        speed: m/s, the largest velocity of the gripper.
        turn_speed: rad/s at the full deflection of a SpaceMouse.
        dead_zone: Proportion of a SpaceMouse's deflection that counts as none.
        mice: SpaceMice, the left arm's first, for example /dev/hidraw3 /dev/hidraw5; those that
            are connected, if not given.
    """

    key_step: Annotated[float, Interval(ge=0.0005, le=0.05)] = 0.005
    speed: Annotated[float, Interval(ge=0.01, le=1.0)] = 0.25
    turn_speed: Annotated[float, Interval(ge=0.05, le=6.0)] = 1.0
    dead_zone: Annotated[float, Interval(ge=0.0, lt=0.9)] = 0.1
    mice: tuple[Path, ...] = ()
