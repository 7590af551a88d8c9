"""The observation space that belongs to an observation spec."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np

from robo_manip_baselines.observation import ObservationSpec

# Wide enough for whatever physics may do; observations are not clipped to them.
_BOUNDS = {" position": 2.0 * np.pi, " velocity": 100.0, "t_": 60.0}
"""rad, m; rad/s, m/s; s."""

_LENGTH_BOUND = 5.0
"""m, of everything else."""


def observation_space(spec: ObservationSpec) -> gymnasium.spaces.Dict:
    """Return a ``Dict`` of float32 vectors, and of uint8 images of shape (height, width, 3)."""
    spaces: dict[str, gymnasium.Space[Any]] = {}
    for key, names in spec.components().items():
        high = np.array([_bound(name) for name in names], dtype=np.float32)
        spaces[key] = gymnasium.spaces.Box(-high, high)
    for key in spec.image_keys():
        spaces[key] = gymnasium.spaces.Box(0, 255, (*spec.image_size, 3), np.uint8)
    return gymnasium.spaces.Dict(spaces)


def _bound(name: str) -> float:
    """Return a generous bound of an observed quantity, in its unit."""
    matches = [bound for part, bound in _BOUNDS.items() if part in name]
    return matches[0] if matches else _LENGTH_BOUND
