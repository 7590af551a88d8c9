"""Weights of a ResNet-18 from a file."""

from __future__ import annotations

import warnings
from pathlib import Path

import torch
from safetensors import SafetensorError
from safetensors.torch import load_file
from torch import Tensor

from robo_manip_baselines.errors import RequestError
from robo_manip_baselines.policy.act.backbone import ResNet18

SUFFIXES = (".safetensors", ".pth", ".pt")

_IGNORED_PREFIX = "fc."  # the classifier
_IGNORED_SUFFIX = ".num_batches_tracked"  # how long the statistics were gathered


def load_backbone(backbone: ResNet18 | None, path: str | Path) -> None:
    """Load the state dict of a torchvision ResNet-18 into ``backbone``.

    A ``.pth`` file is read by PyTorch's reader of tensors alone, which runs no code of the file.

    Raises:
        RequestError: there is no backbone, no such file, or it holds something else.
    """
    path = Path(path)
    if backbone is None:
        raise RequestError(f"backbone_weights '{path}' without cameras: leave one of the two out")
    found = {
        name: value
        for name, value in _read(path).items()
        if not name.startswith(_IGNORED_PREFIX) and not name.endswith(_IGNORED_SUFFIX)
    }
    wanted = backbone.state_dict()
    for name in sorted(wanted.keys() | found.keys()):
        if name not in found:
            raise _refusal(path, f"'{name}' is not in it")
        if name not in wanted:
            raise _refusal(path, f"it has '{name}' too")
        if found[name].shape != wanted[name].shape:
            shapes = f"{tuple(found[name].shape)}, not {tuple(wanted[name].shape)}"
            raise _refusal(path, f"'{name}' is of shape {shapes}")
    backbone.load_state_dict(found)


def _read(path: Path) -> dict[str, Tensor]:
    if path.suffix not in SUFFIXES:
        raise RequestError(f"backbone_weights '{path}': must be one of {', '.join(SUFFIXES)}")
    if not path.is_file():
        raise RequestError(f"backbone_weights '{path}': there is no such file")
    try:
        if path.suffix == ".safetensors":
            return load_file(path)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # about the age of the file's format
            found = torch.load(path, map_location="cpu", weights_only=True)
    except SafetensorError as error:
        raise _refusal(path, f"it is no safetensors file ({error})") from error
    except Exception as error:  # unpickling fails in every way there is
        raise _refusal(path, "it holds more than tensors, or is damaged") from error
    if not isinstance(found, dict) or not all(isinstance(v, Tensor) for v in found.values()):
        raise _refusal(path, "it is no state dict")
    return found


def _refusal(path: Path, reason: str) -> RequestError:
    return RequestError(
        f"backbone_weights '{path}' is no state dict of torchvision's resnet18: {reason}"
    )
