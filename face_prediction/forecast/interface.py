"""Interface of forecasters, the sequences they are fitted to, and the mouth centre.

Legend: N sequences, T frames, H horizon, L = 468 landmarks.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from face_prediction.tracking.geometry import LIPS
from face_prediction.tracking.tracks import NUM_LANDMARKS
from robo_manip_baselines.runs.errors import RequestError

if TYPE_CHECKING:
    from typing_extensions import Self


Array = NDArray[np.floating]

_LIPS = list(LIPS)


def mouth_centre(landmarks: NDArray[np.floating]) -> NDArray[np.float64]:
    """Mean (..., 2) of the 40 lip landmarks of (..., L, 2 or 3), in the landmarks' own unit.

    The paper's mouth centre: "the average of the U and V coordinates of all mouth-related
    landmarks" (section IV.B).
    """
    return np.asarray(landmarks)[..., _LIPS, :2].mean(axis=-2, dtype=np.float64)


def subject_folds(subjects: Sequence[str], folds: int) -> NDArray[np.int64]:
    """Fold (N,) of each sequence: all of one subject in one fold, the folds about equally large.

    The subject with most sequences goes first, each into the smallest fold; equal ones by name,
    so that the same subjects give the same folds. There are never more folds than subjects.
    """
    amounts = sorted(Counter(subjects).items(), key=lambda item: (-item[1], item[0]))
    sizes = [0] * min(folds, len(amounts))
    fold_of: dict[str, int] = {}
    for subject, amount in amounts:
        fold_of[subject] = sizes.index(min(sizes))
        sizes[fold_of[subject]] += amount
    return np.array([fold_of[subject] for subject in subjects], dtype=np.int64)


@dataclass(frozen=True)
class LandmarkSequences:
    """Sequences to fit a forecaster to, and their subjects.

    Attributes:
        landmarks: (N, T, L, 2), normalised to the crop of their sequence.
        subjects: N names: the person of each sequence.

    Raises:
        RequestError: an array has another shape, or holds NaN or infinity.
    """

    landmarks: Array
    subjects: tuple[str, ...]

    def __post_init__(self) -> None:
        shape = self.landmarks.shape
        if len(shape) != 4 or shape[2:] != (NUM_LANDMARKS, 2) or 0 in shape:
            expected = f"(sequences, frames, {NUM_LANDMARKS}, 2)"
            raise RequestError(f"sequences of shape {shape}; expected {expected}")
        if len(self.subjects) != shape[0]:
            raise RequestError(f"{len(self.subjects)} subjects for {shape[0]} sequences")
        _require_finite("sequences", self.landmarks)


class Forecaster(ABC):
    """A forecaster with its fitted parameters; subclasses are frozen dataclasses of them.

    Contract, tested for each registered forecaster: nothing after the history is read; rows of a
    batch are independent; the forecast of a shifted face is shifted by as much; a shorter horizon
    gives the first frames of a longer one; any history of one frame or more is enough, the face
    being taken to have been at rest before it.
    """

    name: ClassVar[str]

    @classmethod
    @abstractmethod
    def fit(cls, sequences: LandmarkSequences) -> Self:
        """Fit to ``sequences`` of people other than those to be forecast."""

    @property
    @abstractmethod
    def memory(self) -> int | None:
        """Frames at the end of the history that count; None: all of them."""

    @abstractmethod
    def _forecast(self, history: Array, horizon: int) -> NDArray[np.float64]:
        """Forecast (B, H, L, 2) from a checked history (B, T, L, 2) of at most ``memory``."""

    def predict(self, history: Array, horizon: int) -> Array:
        """Forecast the landmarks (..., H, L, 2) of the frames after ``history`` (..., T, L, 2).

        Args:
            history: the frames up to now, the newest last, at the rate fitted (30 a second).
            horizon: frames to forecast, 1 or more.

        Returns:
            A new array of the dtype of ``history`` (float64 for integers).

        Raises:
            RequestError: a shape is another one, or a frame that counts holds NaN or infinity.
        """
        history = np.asarray(history)
        if history.ndim < 3 or history.shape[-2:] != (NUM_LANDMARKS, 2):
            expected = f"(..., frames, {NUM_LANDMARKS}, 2)"
            raise RequestError(f"history of shape {history.shape}; expected {expected}")
        if history.shape[-3] < 1:
            raise RequestError("history of 0 frames; 1 or more are needed")
        if horizon < 1:
            raise RequestError(f"horizon {horizon}; must be 1 or more frames")
        if self.memory is not None:
            history = history[..., -self.memory :, :, :]
        _require_finite("history", history)
        rows = history.reshape(-1, *history.shape[-3:])
        forecast = self._forecast(rows, horizon)
        dtype = history.dtype if history.dtype.kind == "f" else np.float64
        shape = (*history.shape[:-3], horizon, *history.shape[-2:])
        return forecast.reshape(shape).astype(dtype, copy=False)

    def arrays(self) -> dict[str, NDArray[Any]]:
        """The fitted parameters as arrays, for a safetensors or ``.npz`` file."""
        return {field.name: np.asarray(getattr(self, field.name)) for field in fields(self)}  # pyright: ignore[reportArgumentType]

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, NDArray[Any]]) -> Self:
        """The forecaster whose ``arrays()`` these are.

        Raises:
            RequestError: a parameter is missing or is not one of this forecaster.
        """
        wanted = {field.name for field in fields(cls)}  # pyright: ignore[reportArgumentType]
        if set(arrays) != wanted:
            stored = f"parameters {sorted(arrays)} stored"
            raise RequestError(f"{cls.name}: {stored}, expected {sorted(wanted)}")
        values = {name: np.asarray(array) for name, array in arrays.items()}
        return cls(**{name: v if v.ndim else v.item() for name, v in values.items()})


def _require_finite(what: str, values: Array) -> None:
    # a sum is NaN or infinite if any term is: no array of booleans as large as the data
    with np.errstate(invalid="ignore"):  # infinity less infinity
        total = values.sum(dtype=np.float64)
    if not np.isfinite(total):
        raise RequestError(f"{what}: NaN or infinity in it; leave out frames without a face")
