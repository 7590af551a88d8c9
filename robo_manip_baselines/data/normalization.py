"""Mean and standard deviation of what a policy sees and does, from its training episodes only."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robo_manip_baselines.runs.errors import RequestError

Vector = NDArray[np.float32]

SMALLEST_STD = 1e-3
"""Smallest divisor, in the unit of the element: a nearly constant element stays nearly constant
instead of being blown up to unit variance. 1 mm, 1 mrad; below what the task can tell apart."""


@dataclass(frozen=True)
class Normalization:
    """How vectors are scaled, for the S elements of a state and the A of an action.

    Attributes:
        state_mean, state_std: (S,) float32.
        action_mean, action_std: (A,) float32.
    """

    state_mean: Vector
    state_std: Vector
    action_mean: Vector
    action_std: Vector

    @classmethod
    def of(cls, state: NDArray[np.float32], action: NDArray[np.float32]) -> Normalization:
        """Measure (n, S) states and (n, A) actions, the rows of the training episodes."""
        return cls(*_mean_std(state), *_mean_std(action))

    def normalized_state(self, state: Vector) -> Vector:
        """Scale (..., S) states."""
        return (state - self.state_mean) / self.state_std

    def normalized_action(self, action: Vector) -> Vector:
        """Scale (..., A) actions."""
        return (action - self.action_mean) / self.action_std

    def action(self, normalized: Vector) -> Vector:
        """Scale (..., A) normalised actions back."""
        return normalized * self.action_std + self.action_mean

    def to_json(self) -> dict[str, list[float]]:
        """Return what `from_json` takes, bit for bit, made of plain lists."""
        return {field.name: getattr(self, field.name).tolist() for field in fields(self)}

    @classmethod
    def from_json(cls, data: Any) -> Normalization:
        """Undo `to_json`.

        Raises:
            RequestError: ``data`` is no normalisation: something is missing, not finite, of
                another length, or a divisor is 0 or less.
        """
        vectors = {field.name: _vector(data, field.name) for field in fields(cls)}
        for of in ("state", "action"):
            mean, std = vectors[f"{of}_mean"], vectors[f"{of}_std"]
            if len(mean) != len(std):
                raise RequestError(f"statistics: {len(mean)} of '{of}_mean', {len(std)} of its std")
            if not (std > 0.0).all():
                raise RequestError(f"statistics: '{of}_std' must be more than 0 everywhere")
        return cls(**vectors)


def _mean_std(values: NDArray[np.float32]) -> tuple[Vector, Vector]:
    wide = values.astype(np.float64)
    std = np.maximum(wide.std(axis=0), SMALLEST_STD)
    return wide.mean(axis=0).astype(np.float32), std.astype(np.float32)


def _vector(data: Any, name: str) -> Vector:
    numbers = data.get(name) if isinstance(data, dict) else None
    # A bool is an int to Python, but no statistic.
    if not isinstance(numbers, list) or not all(type(x) in (int, float) for x in numbers):
        raise RequestError(f"statistics: '{name}' is missing, or no list of numbers")
    vector = np.array(numbers, dtype=np.float32)
    if not np.isfinite(vector).all():
        raise RequestError(f"statistics: '{name}' is not finite everywhere")
    return vector
