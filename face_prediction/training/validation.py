"""Losses and errors on the held-out people, beside those of predicting no motion."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
import torch
from numpy.typing import NDArray

from face_prediction.dataset.reader import FaceDataset
from face_prediction.models.interface import PredictorModel
from face_prediction.models.settings import PredictorTrainSettings
from face_prediction.prediction.errors import mouth_distances, mouth_residuals
from face_prediction.training.windows import SequenceWindows, WindowBatch


class HeldOutLoss:
    """Losses and errors on sequences of the held-out fold, always at the same frame.

    Args:
        dataset: open for reading; used by one thread.
        indices: (N,) sequences of the fold, one or more.
        model: decides which frames and images are needed.
        settings: of training.
        memory: bytes for decoded images.
    """

    def __init__(
        self,
        dataset: FaceDataset,
        indices: NDArray[np.int64],
        model: PredictorModel,
        settings: PredictorTrainSettings,
        memory: float,
    ) -> None:
        count = min(settings.validation_sequences or len(indices), len(indices))
        spread = np.linspace(0, len(indices) - 1, count).astype(int)
        self._windows = SequenceWindows(dataset, indices[spread], model, memory)
        self._start = dataset.manifest.settings.history - model.history
        self._batch_size = settings.batch_size

    def __call__(self, model: PredictorModel, autocast: torch.autocast) -> dict[str, float]:
        """Evaluate a network and return means over the sequences.

        ``loss`` and its terms; ``mouth_error``, the distance of the mouth centre in crops over all
        predicted frames (of a network that predicts landmarks), and beside it
        ``persistence_mouth_error``, that of predicting no motion; ``copy_image``, the squared error
        of the last image as a prediction.
        """
        model.eval()
        sums: dict[str, list[float]] = {}
        for batch in self._batches():
            with torch.inference_mode(), autocast:
                numbers = _errors(model, batch)
            for name, value in numbers.items():
                sums.setdefault(name, []).append(len(batch.history.landmarks) * value)
        return {name: math.fsum(values) / len(self._windows) for name, values in sums.items()}

    def _batches(self) -> Iterator[WindowBatch]:
        for first in range(0, len(self._windows), self._batch_size):
            rows = np.arange(first, min(first + self._batch_size, len(self._windows)))
            yield self._windows.batch(rows, np.full(len(rows), self._start))


def selection_error(numbers: dict[str, float]) -> float:
    """Return the number by which the best weights are chosen: mouth error, or else loss."""
    return numbers.get("mouth_error", numbers["loss"])


def _errors(model: PredictorModel, batch: WindowBatch) -> dict[str, float]:
    moved = batch.to(next(model.parameters()).device)
    losses = model.loss(*moved)
    numbers = {name: float(value) for name, value in {"loss": losses.total, **losses.terms}.items()}
    history, future = batch
    still = history.landmarks[:, -1:].expand_as(future.landmarks)
    predictions = {"mouth_error": model(moved.history).landmarks, "persistence_mouth_error": still}
    for name, landmarks in predictions.items():
        if landmarks is not None:
            forecast, truth = landmarks.float().cpu().numpy(), future.landmarks.numpy()
            numbers[name] = float(mouth_distances(mouth_residuals(forecast, truth)).mean())
    if future.images.shape[1] and history.images.shape[1]:
        change = (future.images.float() - history.images[:, -1:].float()) / 255
        numbers["copy_image"] = float(change.square().mean())
    return numbers
