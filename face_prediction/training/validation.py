"""How a network does on people it is not trained on, and how well one would do by doing nothing."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
import torch

from face_prediction.models.interface import PredictorModel
from face_prediction.prediction.errors import mouth_distances, mouth_residuals
from face_prediction.training.step import TrainStep
from face_prediction.training.windows import Batch, Windows


class Validation:
    """Losses and errors on the sequences of ``windows``, always at the same frame.

    Args:
        windows: of the fold that is held out.
        start: first frame of the windows.
        batch_size: sequences at once.
    """

    def __init__(self, windows: Windows, start: int, batch_size: int) -> None:
        self._windows = windows
        self._start = start
        self._batch_size = batch_size

    def __call__(self, train_step: TrainStep) -> dict[str, float]:
        """Means over the sequences.

        ``loss`` and its terms; ``mouth_error``, the distance of the mouth centre in crops over all
        frames forecast (of a network that forecasts landmarks), and beside it
        ``persistence_mouth_error``, that of the forecast that nothing moves; ``copy_image``, the
        squared error of the last picture as a forecast.
        """
        model = train_step.result.eval()
        sums: dict[str, list[float]] = {}
        for batch in self._batches():
            rows = len(batch.history.landmarks)
            with torch.inference_mode(), train_step.autocast():
                numbers = _numbers(model, batch.to(train_step.device))
            for name, value in {**numbers, **_of_copying(batch)}.items():
                sums.setdefault(name, []).append(rows * value)
        return {name: math.fsum(values) / len(self._windows) for name, values in sums.items()}

    def _batches(self) -> Iterator[Batch]:
        for first in range(0, len(self._windows), self._batch_size):
            rows = np.arange(first, min(first + self._batch_size, len(self._windows)))
            yield self._windows.batch(rows, np.full(len(rows), self._start))


def selection_error(numbers: dict[str, float]) -> float:
    """What the best weights have least of: the mouth's error, or the loss where there is none."""
    return numbers.get("mouth_error", numbers["loss"])


def _numbers(model: PredictorModel, batch: Batch) -> dict[str, float]:
    losses = model.loss(*batch)
    landmarks = model(batch.history).landmarks
    numbers = {"loss": losses.total, **losses.terms}
    result = {name: float(value) for name, value in numbers.items()}
    if landmarks is not None:
        truth = batch.future.landmarks.cpu().numpy()
        result["mouth_error"] = _mouth_error(landmarks.float().cpu().numpy(), truth)
    return result


def _of_copying(batch: Batch) -> dict[str, float]:
    history, future = batch
    still = history.landmarks[:, -1:].expand_as(future.landmarks)
    result = {"persistence_mouth_error": _mouth_error(still.numpy(), future.landmarks.numpy())}
    if future.pictures.shape[1] and history.pictures.shape[1]:
        change = (future.pictures.float() - history.pictures[:, -1:].float()) / 255
        result["copy_image"] = float(change.square().mean())
    return result


def _mouth_error(forecast: np.ndarray, truth: np.ndarray) -> float:
    return float(mouth_distances(mouth_residuals(forecast, truth)).mean())
