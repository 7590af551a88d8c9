"""The forecast that nothing moves."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from face_prediction.forecast.interface import Array, Forecaster, LandmarkSequences

if TYPE_CHECKING:
    from typing_extensions import Self


@dataclass(frozen=True)
class Persistence(Forecaster):
    """Every future frame is the last one seen."""

    name = "persistence"

    @classmethod
    def fit(cls, sequences: LandmarkSequences) -> Self:
        """Nothing is fitted."""
        return cls()

    @property
    def memory(self) -> int:
        """The last frame."""
        return 1

    def _forecast(self, history: Array, horizon: int) -> NDArray[np.float64]:
        return np.repeat(history[:, -1:].astype(np.float64), horizon, axis=1)
