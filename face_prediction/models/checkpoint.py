"""Checkpoints of trained networks: a folder with ``model.safetensors`` and ``config.json``.

Each file is complete or absent, and damage is detected: both hold the SHA-256 of the tensors.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from face_prediction.models.interface import PredictorModel
from robo_manip_baselines.runs.errors import RequestError
from robo_manip_baselines.runs.files import atomic_file, read_json, write_json

try:
    import safetensors
    import safetensors.torch
except ModuleNotFoundError:
    raise RequestError(
        "networks need safetensors; pip install 'robo_manip_baselines[face-prediction]'"
    ) from None

KIND = {"schema": "face_predictor", "version": 1}
MODEL_FILE = "model.safetensors"
CONFIG_FILE = "config.json"


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
        train_subjects: people trained on, on whom the network must not be evaluated.
        step: optimizer steps that made these weights.
        validation: losses and errors (crops) on the held-out fold, if there is one.
        versions: of the software, by package.
    """

    model: str
    settings: dict[str, Any]
    preset: str
    training: dict[str, Any]
    seed: int
    dataset: dict[str, Any]
    dataset_sha256: str
    folds: dict[str, list[int]]
    train_subjects: list[str]
    step: int
    validation: dict[str, float]
    versions: dict[str, str]


def save_predictor_checkpoint(
    folder: Path, record: CheckpointRecord, state: Mapping[str, Tensor]
) -> None:
    """Write both files of a checkpoint.

    Raises:
        RequestError: the folder cannot be written to.
    """
    digest = write_tensors(folder / MODEL_FILE, state, KIND)
    write_json(folder / CONFIG_FILE, {**KIND, **asdict(record), "model_sha256": digest})


def read_predictor_checkpoint(folder: Path) -> tuple[CheckpointRecord, dict[str, Tensor]]:
    """Read and check both files of a checkpoint.

    Raises:
        RequestError: a file is absent, damaged or of another schema, or they do not belong
            together.
    """
    path = folder / CONFIG_FILE
    _require_file(path)
    data = read_json(path)
    require_kind(path, data, KIND)
    try:
        record = CheckpointRecord(**{x.name: data[x.name] for x in fields(CheckpointRecord)})
        expected = data["model_sha256"]
    except KeyError as error:
        raise RequestError(f"{path}: key {error} is missing; train the network again") from None
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
    wanted = model.state_dict()
    for name in sorted({*wanted, *tensors}):
        if name not in tensors:
            raise RequestError(f"{source}: tensor '{name}' is missing")
        if name not in wanted:
            raise RequestError(f"{source}: tensor '{name}' is none of this network")
        found, expected = (f"{x.dtype} {tuple(x.shape)}" for x in (tensors[name], wanted[name]))
        if found != expected:
            raise RequestError(f"{source}: tensor '{name}' is {found}, expected {expected}")
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
    try:
        with safetensors.safe_open(path, framework="pt", device="cpu") as file:
            # cloned: tensors must not change when the file is replaced
            tensors = {name: file.get_tensor(name).clone() for name in file.keys()}  # noqa: SIM118
            record = json.loads(file.metadata()["record"])
        digest = record.pop("sha256")
    except (OSError, LookupError, TypeError, ValueError, safetensors.SafetensorError) as error:
        raise RequestError(
            f"{path}: damaged, or not written by this program ({type(error).__name__}: {error})"
        ) from None
    if tensor_hash(tensors) != digest:
        raise RequestError(f"{path}: damaged (its tensors are not those that were written)")
    return tensors, record, digest


def require_kind(path: Path, record: Mapping[str, Any], kind: Mapping[str, Any]) -> None:
    """Check the schema and version in a file's record.

    Raises:
        RequestError: it is of another schema or version.
    """
    if any(record.get(key) != value for key, value in kind.items()):
        raise RequestError(
            f"{path}: schema '{record.get('schema')}' version {record.get('version')}, expected "
            f"'{kind['schema']}' {kind['version']}"
        )


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
