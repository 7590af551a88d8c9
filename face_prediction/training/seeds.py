"""Random numbers as functions of the seed, what they are for, and the step."""

from __future__ import annotations

import numpy as np


def generator(seed: int, name: str, *place: int) -> np.random.Generator:
    """The NumPy generator of the stream ``name`` at ``place`` (a step, an epoch)."""
    return np.random.default_rng([seed, *name.encode(), *place])


def torch_seed(seed: int, name: str, *place: int) -> int:
    """A seed for torch, from the same stream."""
    return int(generator(seed, name, *place).integers(2**63))
