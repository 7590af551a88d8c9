"""What a network must fit. Nothing heavy is imported here."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Sizes:
    """What a network must fit.

    Attributes:
        state: S, elements of all observed vectors together.
        action: A, elements of an action.
        cameras: N, perhaps 0.
        image: (H, W) in pixels.
    """

    state: int
    action: int
    cameras: int
    image: tuple[int, int]
