"""Options of devices that move a hand, apart from the devices: quick to import."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from annotated_types import Interval


@dataclass(frozen=True)
class SteeringOptions:
    """Speed of the hand; only with --device keyboard.

    Attributes:
        key_step: m that a key moves the gripper by.
        speed: m/s, the largest velocity of the gripper.
    """

    key_step: Annotated[float, Interval(ge=0.0005, le=0.05)] = 0.005
    speed: Annotated[float, Interval(ge=0.01, le=1.0)] = 0.25
