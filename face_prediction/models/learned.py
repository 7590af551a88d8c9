"""Trained networks behind the `Predictor` interface: arrays in, a forecast out.

Shapes: B histories, T frames of history, H horizon, L = 468 landmarks, S side of the images,
P images at the end of the history.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from face_prediction.models.checkpoint import (
    CONFIG_FILE,
    MODEL_FILE,
    CheckpointRecord,
    load_tensors,
    read_predictor_checkpoint,
)
from face_prediction.models.interface import History, Output, PredictorModel
from face_prediction.models.settings import make_predictor_model, settings_class
from face_prediction.prediction.interface import Forecast
from face_prediction.tracking.tracks import NUM_LANDMARKS
from robo_manip_baselines.runs.errors import RequestError


class LearnedPredictor:
    """`Predictor` that runs a network on batches of histories.

    Args:
        model: on its device; put into eval mode.
        record: its provenance.
        batch_size: histories that go through the network at once.

    Attributes:
        name: of the network, in the registry.
        memory: frames of landmarks that it sees; a history must have as many or more.
        needs: images that it sees.
        horizon: most frames that it predicts.
    """

    def __init__(
        self, model: PredictorModel, record: CheckpointRecord, batch_size: int = 16
    ) -> None:
        self.model = model.eval()
        self.record = record
        self.name = record.model
        self.memory, self.needs, self.horizon = model.history, model.needs, model.horizon
        self._batch_size = batch_size

    @classmethod
    def load(
        cls, folder: str | Path, device: str = "cpu", batch_size: int = 16
    ) -> LearnedPredictor:
        """Load the network that ``face-prediction train`` wrote to ``folder``.

        Raises:
            RequestError: it is absent, damaged or of another schema.
        """
        folder = Path(folder)
        record, tensors = read_predictor_checkpoint(folder)
        try:
            settings = settings_class(record.model).from_json(record.settings)
        except RequestError as error:
            raise RequestError(f"{folder / CONFIG_FILE}: {error}") from None
        model = make_predictor_model(record.model, settings)
        load_tensors(model, tensors, folder / MODEL_FILE)
        return cls(model.to(device), record, batch_size)

    @property
    def test_fold(self) -> int:
        """Fold of people that the network may be evaluated on.

        Raises:
            RequestError: there is none: it was trained on everybody.
        """
        if not self.record.folds["test"]:
            raise RequestError(
                f"this {self.name} was trained on the people of all folds and can be judged on "
                "none of them; train one with --test_fold"
            )
        return self.record.folds["test"][0]

    def predict(
        self, landmarks: NDArray[np.floating], images: NDArray[np.uint8] | None, horizon: int
    ) -> Forecast:
        """Predict the next ``horizon`` frames; see `Predictor.predict`.

        Landmarks are NaN from a network that predicts images only.

        Raises:
            RequestError: a shape does not fit `needs` and `memory`, the landmarks hold NaN or
                infinity, or the horizon is longer than the network's.
        """
        if not 1 <= horizon <= self.horizon:
            raise RequestError(f"horizon {horizon}: {self.name} forecasts 1 to {self.horizon}")
        landmarks = self._checked_landmarks(np.asarray(landmarks))
        images = self._checked_images(images, len(landmarks))
        device = next(self.model.parameters()).device
        batches: list[dict[str, NDArray[Any]]] = []
        for first in range(0, len(landmarks), self._batch_size):
            rows = slice(first, first + self._batch_size)
            seen = torch.tensor(landmarks[rows], dtype=torch.float32, device=device)
            with torch.inference_mode():
                output = self.model(History(seen, torch.tensor(images[rows], device=device)))
            batches.append(_arrays(output, horizon))
        joined = {name: np.concatenate([batch[name] for batch in batches]) for name in batches[0]}
        if "landmarks" not in joined:
            shape = (len(landmarks), horizon, NUM_LANDMARKS, 2)
            joined["landmarks"] = np.full(shape, np.nan, dtype=np.float32)
        freedom = output.degrees_of_freedom
        if freedom is not None:
            joined["degrees_of_freedom"] = freedom[:horizon].double().cpu().numpy()
        return Forecast(**joined)

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
            raise RequestError("landmarks: NaN or infinity; leave out frames without a face")
        return landmarks

    def _checked_images(self, images: NDArray[np.uint8] | None, rows: int) -> NDArray[np.uint8]:
        wanted = (rows, self.needs.frames, self.needs.size, self.needs.size, 3)
        if images is None and not self.needs.frames:
            return np.empty(wanted, dtype=np.uint8)
        if images is None or images.shape != wanted or images.dtype != np.uint8:
            found = "none" if images is None else f"{images.dtype} of shape {images.shape}"
            raise RequestError(f"images: {found}; {self.name} needs uint8 of shape {wanted}")
        return images


def _arrays(output: Output, horizon: int) -> dict[str, NDArray[Any]]:
    """Return the outputs that there are, by name, for the first ``horizon`` frames."""
    arrays = {}
    for name in ("landmarks", "mouth_scale"):
        if (values := getattr(output, name)) is not None:
            arrays[name] = values[:, :horizon].float().cpu().numpy()
    if output.images is not None:
        images = (255 * output.images[:, :horizon].float()).round().clamp(0, 255).to(torch.uint8)
        arrays["images"] = images.permute(0, 1, 3, 4, 2).contiguous().cpu().numpy()
    return arrays
