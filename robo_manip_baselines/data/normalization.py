"""Normalisation of states and actions, measured on the training episodes only.

A normalisation is an offset and a scale for each element: x -> (x - offset) / scale. A policy names
the function that measures them in its registry entry, one of ``METHODS`` or a ``module:function``
of its own with the same signature.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from typing import Annotated, Any

import numpy as np
from annotated_types import Interval
from numpy.typing import NDArray

from robo_manip_baselines.runs.documents import convert
from robo_manip_baselines.runs.errors import RequestError

Vector = NDArray[np.float32]

SMALLEST_STD = 1e-3
"""Smallest divisor, in the unit of the element: a nearly constant element stays nearly constant
instead of being blown up to unit variance. 1 mm, 1 mrad; below what the task can tell apart."""


@dataclass(frozen=True)
class Normalization:
    """Offsets and scales for the S elements of a state and the A elements of an action.

    The names are those of ``stats.json``; only `mean_std` makes them means and deviations.

    Attributes:
        state_mean, state_std: (S,) float32, offset and scale of states.
        action_mean, action_std: (A,) float32, offset and scale of actions.
    """

    state_mean: Vector
    state_std: Vector
    action_mean: Vector
    action_std: Vector

    def normalize_state(self, state: Vector) -> Vector:
        """Scale (..., S) states."""
        return (state - self.state_mean) / self.state_std

    def normalize_action(self, action: Vector) -> Vector:
        """Scale (..., A) actions."""
        return (action - self.action_mean) / self.action_std

    def unnormalize_action(self, normalized: Vector) -> Vector:
        """Scale (..., A) normalised actions back."""
        return normalized * self.action_std + self.action_mean

    def to_json(self) -> dict[str, list[float]]:
        """Return the vectors as plain lists, exactly."""
        return {field.name: getattr(self, field.name).tolist() for field in fields(self)}

    @classmethod
    def from_json(cls, data: Any, source: str = "statistics") -> Normalization:
        """Undo `to_json`; ``source`` begins messages.

        Raises:
            RequestError: ``data`` is no normalisation: something is missing, not finite, of
                another length, or a divisor is 0 or less.
        """
        stored = convert(data, StoredNormalization, source)
        return cls(**{name: np.array(value, np.float32) for name, value in vars(stored).items()})


_LARGEST = float(np.finfo(np.float32).max)
_Offset = Annotated[float, Interval(ge=-_LARGEST, le=_LARGEST)]
_Scale = Annotated[float, Interval(ge=1e-38, le=_LARGEST)]


@dataclass(frozen=True)
class StoredNormalization:
    """Content of ``stats.json``: the vectors of `Normalization`, within the range of float32."""

    state_mean: tuple[_Offset, ...]
    state_std: tuple[_Scale, ...]
    action_mean: tuple[_Offset, ...]
    action_std: tuple[_Scale, ...]

    def __post_init__(self) -> None:
        for kind in ("state", "action"):
            mean, std = getattr(self, f"{kind}_mean"), getattr(self, f"{kind}_std")
            if len(mean) != len(std):
                raise RequestError(f"{len(mean)} of '{kind}_mean', {len(std)} of its std")


def mean_std(state: Vector, action: Vector) -> Normalization:
    """Normalise (n, S) states and (n, A) actions to mean 0 and standard deviation 1."""

    def measure(values: Vector) -> tuple[Vector, Vector]:
        wide = values.astype(np.float64)
        std = np.maximum(wide.std(axis=0), SMALLEST_STD)
        return wide.mean(axis=0).astype(np.float32), std.astype(np.float32)

    return Normalization(*measure(state), *measure(action))


def min_max(state: Vector, action: Vector) -> Normalization:
    """Normalise (n, S) states and (n, A) actions to the range [-1, 1]."""

    def measure(values: Vector) -> tuple[Vector, Vector]:
        low, high = values.min(axis=0), values.max(axis=0)
        return (low + high) / 2, np.maximum((high - low) / 2, np.float32(SMALLEST_STD))

    return Normalization(*measure(state), *measure(action))


def action_min_max(state: Vector, action: Vector) -> Normalization:
    """Normalise (n, A) actions to the range [-1, 1], and (n, S) states as `mean_std` does."""
    states, actions = mean_std(state, action), min_max(state, action)
    return replace(states, action_mean=actions.action_mean, action_std=actions.action_std)


def no_normalization(state: Vector, action: Vector) -> Normalization:
    """Leave (n, S) states and (n, A) actions in their own units."""
    s, a = state.shape[1], action.shape[1]
    zeros, ones = np.zeros(max(s, a), np.float32), np.ones(max(s, a), np.float32)
    return Normalization(zeros[:s], ones[:s], zeros[:a], ones[:a])


METHODS: dict[str, Callable[[Vector, Vector], Normalization]] = {
    "mean_std": mean_std,
    "min_max": min_max,
    "action_min_max": action_min_max,
    "none": no_normalization,
}
