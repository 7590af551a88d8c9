"""A trained network as a `Predictor`: arrays in, a forecast out.

Legend: B histories, T frames of history, H horizon, L = 468 landmarks, S side of the pictures,
P pictures at the end of the history.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from face_prediction.models.checkpoint import CheckpointRecord, load_model
from face_prediction.models.interface import History, Output, PredictorModel
from face_prediction.prediction.interface import Forecast, PictureNeeds
from face_prediction.tracking.tracks import NUM_LANDMARKS
from robo_manip_baselines.runs.errors import RequestError


class LearnedPredictor:
    """Runs a network on batches of histories; see `face_prediction.prediction.interface.Predictor`.

    Args:
        model: on its device; put into eval mode.
        record: what it is.
        batch_size: histories that go through the network at once.

    Attributes:
        model: the network.
        record: what it was trained on, and how.
    """

    def __init__(
        self, model: PredictorModel, record: CheckpointRecord, batch_size: int = 16
    ) -> None:
        self.model = model.eval()
        self.record = record
        self._batch_size = batch_size

    @classmethod
    def load(
        cls, folder: str | Path, device: str = "cpu", batch_size: int = 16
    ) -> LearnedPredictor:
        """The network that ``face-prediction train`` left in ``folder``.

        Raises:
            RequestError: it is absent, damaged, or not what this program writes.
        """
        model, record = load_model(Path(folder), device)
        return cls(model, record, batch_size)

    @property
    def name(self) -> str:
        """Of the network, in the registry."""
        return self.record.model

    @property
    def memory(self) -> int:
        """Frames of landmarks it is shown; a history must have so many or more."""
        return self.model.history

    @property
    def needs(self) -> PictureNeeds:
        """Pictures it is shown."""
        return self.model.needs

    @property
    def preset(self) -> str:
        """Its size, by name."""
        return self.record.preset

    @property
    def test_fold(self) -> int:
        """The fold of people that it may be judged on.

        Raises:
            RequestError: there is none: it was trained on everybody.
        """
        if not self.record.folds["test"]:
            raise RequestError(
                f"this {self.name} was trained on the people of all folds and can be judged on "
                "none of them; train one with --test_fold"
            )
        return self.record.folds["test"][0]

    @property
    def train_subjects(self) -> tuple[str, ...]:
        """Whom it was trained on; it must not be judged on them."""
        return tuple(self.record.train_subjects)

    @property
    def horizon(self) -> int:
        """Most frames it forecasts."""
        return self.model.horizon

    def predict(
        self,
        landmarks: NDArray[np.floating],
        pictures: NDArray[np.uint8] | None,
        horizon: int,
    ) -> Forecast:
        """Forecast the next ``horizon`` frames; see `Predictor.predict`.

        A network that makes pictures only gives landmarks of NaN.

        Raises:
            RequestError: a shape is another one than `needs` and `memory` say, the landmarks hold
                NaN or infinity, or the horizon is longer than the network's.
        """
        if not 1 <= horizon <= self.horizon:
            raise RequestError(f"horizon {horizon}: {self.name} forecasts 1 to {self.horizon}")
        landmarks = self._checked_landmarks(np.asarray(landmarks))
        pictures = self._checked_pictures(pictures, len(landmarks))
        device = next(self.model.parameters()).device
        parts: list[Forecast] = []
        for first in range(0, len(landmarks), self._batch_size):
            rows = slice(first, first + self._batch_size)
            history = History(
                torch.tensor(landmarks[rows], dtype=torch.float32, device=device),
                torch.tensor(pictures[rows], device=device),
            )
            with torch.inference_mode():
                parts.append(_forecast(self.model(history), horizon, len(history.landmarks)))
        return _joined(parts)

    def _checked_landmarks(self, landmarks: NDArray[np.floating]) -> NDArray[np.floating]:
        shape = landmarks.shape
        if len(shape) != 4 or shape[2:] != (NUM_LANDMARKS, 2) or shape[0] == 0:
            raise RequestError(
                f"landmarks of shape {shape}; expected (histories, frames, {NUM_LANDMARKS}, 2)"
            )
        if shape[1] < self.memory:
            raise RequestError(f"a history of {shape[1]} frames; {self.name} needs {self.memory}")
        landmarks = landmarks[:, -self.memory :]
        if not np.all(np.isfinite(landmarks)):
            raise RequestError(
                "landmarks: NaN or infinity in them; leave out frames without a face"
            )
        return landmarks

    def _checked_pictures(self, pictures: NDArray[np.uint8] | None, rows: int) -> NDArray[np.uint8]:
        needs = self.needs
        wanted = (rows, needs.frames, needs.size, needs.size, 3)
        if pictures is None and not needs.frames:
            return np.empty(wanted, dtype=np.uint8)
        if pictures is None or pictures.shape != wanted or pictures.dtype != np.uint8:
            found = "none" if pictures is None else f"{pictures.dtype} of shape {pictures.shape}"
            raise RequestError(f"pictures: {found}; {self.name} needs uint8 of shape {wanted}")
        return pictures


def _forecast(output: Output, horizon: int, rows: int) -> Forecast:
    landmarks = np.full((rows, horizon, NUM_LANDMARKS, 2), np.nan, dtype=np.float32)
    if output.landmarks is not None:
        landmarks = _numbers(output.landmarks[:, :horizon])
    pictures = None
    if output.pictures is not None:
        bytes_ = (255 * output.pictures[:, :horizon].float()).round().clamp(0, 255)
        pictures = bytes_.to(torch.uint8).permute(0, 1, 3, 4, 2).contiguous().cpu().numpy()
    scale = None if output.mouth_scale is None else _numbers(output.mouth_scale[:, :horizon])
    freedom = output.degrees_of_freedom
    return Forecast(
        landmarks=landmarks,
        pictures=pictures,
        mouth_scale=scale,
        degrees_of_freedom=None
        if freedom is None
        else _numbers(freedom[:horizon]).astype(np.float64),
    )


def _numbers(values: Tensor) -> NDArray[np.float32]:
    return values.float().cpu().numpy()


def _joined(parts: list[Forecast]) -> Forecast:
    if len(parts) == 1:
        return parts[0]
    first = parts[0]
    pictures = [part.pictures for part in parts if part.pictures is not None]
    scales = [part.mouth_scale for part in parts if part.mouth_scale is not None]
    return Forecast(
        landmarks=np.concatenate([part.landmarks for part in parts]),
        pictures=np.concatenate(pictures) if pictures else None,
        mouth_scale=np.concatenate(scales) if scales else None,
        degrees_of_freedom=first.degrees_of_freedom,
    )
