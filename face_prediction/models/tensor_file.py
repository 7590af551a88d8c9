"""Files of named tensors with a record beside them in one piece: whole, or refused by name."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from face_prediction.errors import RequestError
from face_prediction.whole_file import whole_file


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
    with whole_file(path) as temporary:
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
