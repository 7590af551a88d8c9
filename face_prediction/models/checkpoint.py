"""Files of named tensors with a record beside them in one piece: whole, or refused by name."""

from __future__ import annotations

import hashlib
import json
import platform
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from face_prediction.models.interface import PredictorModel
from face_prediction.models.settings import make_model, settings_class
from robo_manip_baselines.runs.errors import RequestError
from robo_manip_baselines.runs.files import atomic_file


def write_tensors(path: Path, tensors: Mapping[str, Tensor], record: Mapping[str, Any]) -> str:
    """Write a safetensors file, whole or not at all; ``record`` is JSON.

    Returns:
        The SHA-256 of names, types, shapes and numbers of the tensors.

    Raises:
        RequestError: the folder cannot be written to, or safetensors is not installed.
    """
    safetensors = _safetensors()
    plain = {name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()}
    digest = tensor_hash(plain)
    # one entry: safetensors writes several in any order, and equal networks shall be equal files
    metadata = {"record": json.dumps({**record, "sha256": digest})}
    with atomic_file(path) as temporary:
        temporary.write_bytes(safetensors.save(plain, metadata))
    return digest


def read_tensors(path: Path) -> tuple[dict[str, Tensor], dict[str, Any], str]:
    """Read what `write_tensors` wrote: tensors, record and hash.

    Raises:
        RequestError: the file is absent, damaged or of another kind, or safetensors is not
            installed.
    """
    if not path.is_file():
        raise RequestError(f"{path}: no such file; name a folder written by face-prediction train")
    safetensors = _safetensors()
    try:
        with safetensors.safe_open(path, framework="pt", device="cpu") as file:
            metadata = file.metadata() or {}
            # cloned: what is read stays as it is when the file is replaced
            tensors = {name: file.get_tensor(name).clone() for name in file.keys()}  # noqa: SIM118
        record = json.loads(metadata["record"])
        digest = record.pop("sha256")
    except (OSError, KeyError, ValueError, AttributeError, safetensors.SafetensorError) as error:
        raise RequestError(
            f"{path}: damaged, or not written by this program ({type(error).__name__}: {error})"
        ) from None
    if tensor_hash(tensors) != digest:
        raise RequestError(f"{path}: damaged (its numbers are not those that were written)")
    return tensors, record, digest


def tensor_hash(tensors: Mapping[str, Tensor]) -> str:
    """SHA-256 of names, types, shapes and numbers, in the order of the names."""
    digest = hashlib.sha256()
    for name, tensor in sorted(tensors.items()):
        digest.update(f"{name} {tensor.dtype} {tuple(tensor.shape)}\n".encode())
        plain = tensor.detach().cpu().contiguous().reshape(-1)
        digest.update(plain.view(torch.uint8).numpy().data)
    return digest.hexdigest()


class _Safetensors:
    """The names of safetensors that are used, so that its absence is one line."""

    def __init__(self) -> None:
        from safetensors import SafetensorError, safe_open
        from safetensors.torch import save

        self.SafetensorError = SafetensorError
        self.safe_open = safe_open
        self.save = save


def _safetensors() -> _Safetensors:
    try:
        return _Safetensors()
    except ImportError:
        raise RequestError(
            "networks need safetensors; pip install 'robo_manip_baselines[face-prediction]'"
        ) from None


SCHEMA = "face_predictor"
VERSION = 1
MODEL_FILE = "model.safetensors"
CONFIG_FILE = "config.json"


@dataclass(frozen=True)
class CheckpointRecord:
    """What a trained network is, and what it was trained on and how."""

    #: name in the registry
    model: str
    #: JSON of its settings
    settings: dict[str, Any]
    preset: str
    #: JSON of the `TrainSettings`
    training: dict[str, Any]
    seed: int
    #: JSON of the dataset's `SequenceSettings`, and the SHA-256 of its ``dataset.json``
    dataset: dict[str, Any]
    dataset_sha256: str
    #: folds by use: train, validation, test
    folds: dict[str, list[int]]
    #: the people it was trained on; it must not be judged on them
    train_subjects: list[str]
    #: steps that made these weights
    step: int
    #: what it got on the fold that was held out, if any; crops and losses
    validation: dict[str, float]
    versions: dict[str, str]


def library_versions() -> dict[str, str]:
    """Versions that a network's numbers may depend on."""
    return {"python": platform.python_version(), "torch": torch.__version__}


def save_checkpoint(folder: Path, record: CheckpointRecord, state: Mapping[str, Tensor]) -> None:
    """Write both files, each whole or not at all.

    Raises:
        RequestError: the folder cannot be written to.
    """
    kind = {"schema": SCHEMA, "version": VERSION}
    digest = write_tensors(folder / MODEL_FILE, state, kind)
    data = {**kind, **asdict(record), "model_sha256": digest}
    with atomic_file(folder / CONFIG_FILE) as temporary:
        text = json.dumps(data, indent=1, ensure_ascii=False)
        temporary.write_text(text + "\n", encoding="utf-8")


def read_checkpoint(folder: Path) -> tuple[CheckpointRecord, dict[str, Tensor]]:
    """Read and check both files.

    Raises:
        RequestError: one is absent, damaged or of another schema, or they do not belong together.
    """
    path = folder / CONFIG_FILE
    data = _read_config(path)
    try:
        names = {item.name for item in fields(CheckpointRecord)}
        record = CheckpointRecord(**{name: data[name] for name in names})
        expected = data["model_sha256"]
    except KeyError as error:
        raise RequestError(f"{path}: key {error} is missing; train the network again") from None
    tensors, _, digest = read_tensors(folder / MODEL_FILE)
    if digest != expected:
        raise RequestError(
            f"{folder}: {MODEL_FILE} and {CONFIG_FILE} are not of the same moment; "
            "give the training command again, which puts that right"
        )
    return record, tensors


def load_model(folder: Path, device: str = "cpu") -> tuple[PredictorModel, CheckpointRecord]:
    """The network of a checkpoint, on ``device`` and ready to predict (eval mode).

    Raises:
        RequestError: as `read_checkpoint`, or the tensors are not those of the network.
    """
    record, tensors = read_checkpoint(folder)
    try:
        settings = settings_class(record.model).from_json(record.settings)
    except RequestError as error:
        raise RequestError(f"{folder / CONFIG_FILE}: {error}") from None
    model = make_model(record.model, settings)
    fill(model, tensors, folder / MODEL_FILE)
    return model.to(device).eval(), record


def fill(model: PredictorModel, tensors: Mapping[str, Tensor], source: Path) -> None:
    """Give a network the tensors that ``source`` holds.

    Raises:
        RequestError: they are not its own; the first that differs is named.
    """
    wanted = model.state_dict()
    for name in sorted({*wanted, *tensors}):
        if name not in tensors:
            raise RequestError(f"{source}: tensor '{name}' is missing")
        if name not in wanted:
            raise RequestError(f"{source}: tensor '{name}' is none of this network")
        if tensors[name].shape != wanted[name].shape or tensors[name].dtype != wanted[name].dtype:
            raise RequestError(
                f"{source}: tensor '{name}' is {tensors[name].dtype} {tuple(tensors[name].shape)}, "
                f"expected {wanted[name].dtype} {tuple(wanted[name].shape)}"
            )
    model.load_state_dict(tensors)


def _read_config(path: Path) -> dict[str, Any]:
    if not path.is_file():
        raise RequestError(f"{path}: no such file; name a folder written by face-prediction train")
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise RequestError(f"{path}: damaged ({error}); train the network again") from None
    schema = data.get("schema") if isinstance(data, dict) else None
    version = data.get("version") if isinstance(data, dict) else None
    if (schema, version) != (SCHEMA, VERSION):
        raise RequestError(
            f"{path}: schema '{schema}' version {version}, expected '{SCHEMA}' {VERSION}"
        )
    return data
