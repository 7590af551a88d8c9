"""Trained networks: checkpoints, and the `Predictor` that runs one: arrays in, a forecast out.

A checkpoint is a folder with ``model.safetensors`` and ``config.json``. Each file is complete or
absent, and damage is detected: both hold the SHA-256 of the tensors.

Shapes: B histories, T frames of history, H horizon, L = 468 landmarks, S side of the images,
P images at the end of the history.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from typing_extensions import TypedDict

from face_prediction.dataset.split import SplitName
from face_prediction.models.interface import History, Output, PredictorModel
from face_prediction.models.settings import make_predictor_model, settings_class
from face_prediction.prediction.interface import Forecast
from face_prediction.tracking.tracks import NUM_LANDMARKS
from robo_manip_baselines.runs import tensors as tensor_files
from robo_manip_baselines.runs.documents import Schema, convert, parse_json, read_json
from robo_manip_baselines.runs.errors import RequestError
from robo_manip_baselines.runs.extras import install_command
from robo_manip_baselines.runs.files import atomic_file, write_json
from robo_manip_baselines.runs.ranges import NonNegativeInt, Seed
from robo_manip_baselines.runs.tensors import require_alike, require_finite

try:
    import safetensors.torch
except ModuleNotFoundError:
    raise RequestError(
        f"networks need safetensors; run: {install_command('face-prediction')}"
    ) from None

SCHEMA = Schema("face_predictor", 1)
MODEL_FILE = "model.safetensors"
CONFIG_FILE = "config.json"


class LearnedPredictor:
    """`Predictor` that runs a network, on its device, on batches of histories.

    Args:
        model: put into eval mode.
        record: its provenance.
        batch_size: histories that go through the network at once.

    Attributes:
        name: of the network, in the registry; with a residual connection that says so.
        memory: frames of landmarks that it sees; a history must have as many or more.
        horizon: most frames that it predicts.
    """

    def __init__(
        self, model: PredictorModel, record: CheckpointRecord, batch_size: int = 16
    ) -> None:
        self.model = model.eval()
        self.record = record
        self.name = record.model + "_residual" * bool(record.settings.get("residual"))
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
    if output.landmarks is not None:
        arrays["landmarks"] = output.landmarks[:, :horizon].float().cpu().numpy()
    if output.images is not None:
        images = (255 * output.images[:, :horizon].float()).round().clamp(0, 255).to(torch.uint8)
        arrays["images"] = images.permute(0, 1, 3, 4, 2).contiguous().cpu().numpy()
    return arrays


class FoldUses(TypedDict):
    """Folds, or parts of a split by sequence, by their use."""

    train: list[NonNegativeInt]
    validation: list[NonNegativeInt]
    test: list[NonNegativeInt]


@dataclass(frozen=True)
class CheckpointRecord:
    """Provenance of a trained network.

    Attributes:
        model: name in the registry.
        settings: JSON of its settings, which started from ``preset``.
        training: JSON of the `PredictorTrainSettings`.
        dataset: JSON of the dataset's `SequenceSettings`.
        dataset_sha256: of its ``dataset.json``.
        folds: folds by use: ``train``, ``validation``, ``test``.
        train_subjects: people trained on, on whom the network must not be evaluated (by person).
        step: optimizer steps that made these weights.
        validation: losses and errors (crops) on the held-out fold, if there is one.
        versions: of the software, by package.
        split: person: ``folds`` are those of the dataset. sequence: they are parts of its split by
            sequence, and ``train_subjects`` may be in all of them.
        windows_sha256: of the windows of such parts.
    """

    model: str
    settings: dict[str, Any]
    preset: str
    training: dict[str, Any]
    seed: Seed
    dataset: dict[str, Any]
    dataset_sha256: str
    folds: FoldUses
    train_subjects: list[str]
    step: NonNegativeInt
    validation: dict[str, float]
    versions: dict[str, str]
    split: SplitName = "person"
    windows_sha256: str = ""


def save_predictor_checkpoint(
    folder: Path, record: CheckpointRecord, state: Mapping[str, Tensor]
) -> None:
    """Write both files of a checkpoint.

    Raises:
        RequestError: the folder cannot be written to.
    """
    digest = write_tensors(folder / MODEL_FILE, state, SCHEMA.to_json())
    write_json(folder / CONFIG_FILE, {**SCHEMA.to_json(), **asdict(record), "model_sha256": digest})


def read_predictor_checkpoint(folder: Path) -> tuple[CheckpointRecord, dict[str, Tensor]]:
    """Read and check both files of a checkpoint.

    Raises:
        RequestError: a file is absent, damaged or of another schema, or they do not belong
            together.
    """
    path = folder / CONFIG_FILE
    _require_file(path)
    data = read_json(path, schema=SCHEMA)
    expected = data.pop("model_sha256", None)
    try:
        record = convert(data, CheckpointRecord, f"'{path}'")
    except RequestError as error:
        raise RequestError(f"{error}; train the network again") from None
    tensors, _, digest = read_tensors(folder / MODEL_FILE)
    if digest != expected:
        raise RequestError(
            f"{folder}: {MODEL_FILE} and {CONFIG_FILE} are of different steps; "
            "give the training command again, which puts that right"
        )
    return record, tensors


def load_tensors(model: PredictorModel, tensors: Mapping[str, Tensor], source: Path) -> None:
    """Load the tensors that were read from ``source`` into a network.

    Raises:
        RequestError: they do not fit; the first that differs is named.
    """
    require_alike(tensors, model.state_dict(), source)
    require_finite(tensors, source)
    model.load_state_dict(tensors)


def write_tensors(path: Path, tensors: Mapping[str, Tensor], record: Mapping[str, Any]) -> str:
    """Write a safetensors file with a JSON record in it, and return `tensor_hash`.

    Raises:
        RequestError: the folder cannot be written to.
    """
    plain = {name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()}
    digest = tensor_hash(plain)
    # one entry: safetensors writes several in any order, and equal networks shall be equal files
    metadata = {"record": json.dumps({**record, "sha256": digest})}
    with atomic_file(path) as temporary:
        temporary.write_bytes(safetensors.torch.save(plain, metadata))
    return digest


def read_tensors(path: Path) -> tuple[dict[str, Tensor], dict[str, Any], str]:
    """Read tensors, record and hash, as `write_tensors` wrote them.

    Raises:
        RequestError: the file is absent, damaged or of another kind.
    """
    _require_file(path)
    tensors, metadata = tensor_files.read_tensors(path)
    try:
        record = convert(parse_json(metadata["record"], f"'{path}'"), dict, f"'{path}'")
        digest = record.pop("sha256")
    except (LookupError, TypeError, ValueError, AttributeError) as error:
        raise RequestError(
            f"{path}: damaged, or not written by this program ({type(error).__name__}: {error})"
        ) from None
    if tensor_hash(tensors) != digest:
        raise RequestError(f"{path}: damaged (its tensors are not those that were written)")
    return tensors, record, digest


def tensor_hash(tensors: Mapping[str, Tensor]) -> str:
    """Return the SHA-256 of names, types, shapes and numbers, in the order of the names."""
    digest = hashlib.sha256()
    for name, tensor in sorted(tensors.items()):
        digest.update(f"{name} {tensor.dtype} {tuple(tensor.shape)}\n".encode())
        plain = tensor.detach().cpu().contiguous().reshape(-1)
        digest.update(plain.view(torch.uint8).numpy().data)
    return digest.hexdigest()


def _require_file(path: Path) -> None:
    if not path.is_file():
        raise RequestError(f"{path}: no such file; name a folder written by face-prediction train")
