"""Checkpoints: a trained network with everything that acting with it needs.

A folder of safetensors and JSON, described in ``docs/training.md``; never pickle. PyTorch is
imported only by the functions that touch weights.
"""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from robo_manip_baselines.data.demonstrations import Split
from robo_manip_baselines.data.normalization import Normalization
from robo_manip_baselines.observation import ObservationSpec
from robo_manip_baselines.policy.presets import Acting, Sizes, TrainSettings
from robo_manip_baselines.policy.registry import load_part, make_model, policy_entry
from robo_manip_baselines.runs.checkpoints import (
    checkpoint_folder,
    find_checkpoint,
    read_json,
    read_manifest,
    verify,
    write_json,
)
from robo_manip_baselines.runs.errors import RequestError

if TYPE_CHECKING:
    import torch
    from torch import Tensor

    from robo_manip_baselines.policy.interface import PolicyModel


MODEL = "model.safetensors"
CONFIG = "config.json"
STATS = "stats.json"
TRAINER_TENSORS = "trainer.safetensors"
TRAINER = "trainer.json"

INITIAL_WEIGHTS = "backbone_weights"
"""Setting of a policy that names a file of weights to start from, where it has one."""


@dataclass(frozen=True)
class Checkpoint:
    """A trained policy, without its weights.

    Attributes:
        folder: where it is.
        policy: name in ``POLICIES``.
        config: the policy's own frozen dataclass.
        sizes: what the network was made for.
        spec: what the policy was shown.
        env: name of the environment in ``ENVS``.
        acting: how it was meant to act.
        normalization: of states and actions, from the training episodes.
        action_names: (A,) elements of an action.
        control_period: seconds between actions.
        xml_hash: of the simulated model that the demonstrations were made in.
        step: optimiser steps that made it.
        train_seed: seed of the training run.
        settings: how it was trained.
        split: which episodes it was trained on, and which were held out.
        dataset: facts of the demonstrations: ``folder``, ``episodes`` (how many), ``content_hash``
            and ``env_kwargs``, what their environment was made with beside ``spec``.
        versions: of the libraries that wrote it.
        content_hash: SHA-256 over weights, configuration and statistics; 64 hexadecimal digits.
    """

    folder: Path
    policy: str
    config: Any
    sizes: Sizes
    spec: ObservationSpec
    env: str
    acting: Acting
    normalization: Normalization
    action_names: tuple[str, ...]
    control_period: float
    xml_hash: str
    step: int
    train_seed: int
    settings: TrainSettings
    split: Split
    dataset: dict[str, Any]
    versions: dict[str, str]
    content_hash: str = ""


def read_checkpoint(path: str | Path) -> Checkpoint:
    """Read a checkpoint folder, or the newest checkpoint of a run folder.

    Weights, configuration and statistics are verified against their digests.

    Raises:
        RequestError: it is missing, damaged, of another kind, or of a newer schema.
    """
    folder = find_checkpoint(Path(path))
    digests = read_manifest(folder)
    verify(folder, digests, MODEL)
    config = read_json(verify(folder, digests, CONFIG))
    stats = read_json(verify(folder, digests, STATS))
    try:
        return Checkpoint(folder=folder, **_decode(config, stats), content_hash=_hash(digests))
    except RequestError as error:
        raise RequestError(f"checkpoint '{folder}' does not fit this package: {error}") from error
    except (KeyError, TypeError, AttributeError) as error:
        raise RequestError(
            f"checkpoint '{folder}' does not fit this package ({type(error).__name__}: {error} in "
            f"{CONFIG}); use the package that wrote it"
        ) from error


def load_model(checkpoint: Checkpoint, device: torch.device | str = "cpu") -> PolicyModel:
    """Build the network with the checkpoint's weights, for evaluation.

    The weights are the moving average where training kept one.

    Raises:
        RequestError: the weights do not fit the network.
    """
    import safetensors.torch

    config = without_initial_weights(checkpoint.config)
    model = make_model(checkpoint.policy, config, checkpoint.sizes)
    state = safetensors.torch.load_file(checkpoint.folder / MODEL)
    try:
        model.load_state_dict(state)
    except RuntimeError as error:
        raise RequestError(
            f"checkpoint '{checkpoint.folder}' does not fit {checkpoint.policy}: {error}"
        ) from error
    return model.to(device).eval()


def without_initial_weights(config: Any) -> Any:
    """Return a policy's settings without the file that training began from.

    The weights of a checkpoint come from the checkpoint: the file need not be there any more.
    """
    if getattr(config, INITIAL_WEIGHTS, None) is None:
        return config
    return dataclasses.replace(config, **{INITIAL_WEIGHTS: None})


def write_checkpoint(
    folder: Path,
    checkpoint: Checkpoint,
    model_state: Mapping[str, Tensor],
    trainer_tensors: Mapping[str, Tensor],
    trainer: Mapping[str, Any],
) -> Checkpoint:
    """Write a checkpoint folder, whole or not at all.

    Args:
        folder: name of the folder, which must not exist yet.
        checkpoint: what to say of the network; its ``folder`` and ``content_hash`` are not read.
        model_state: the state dict that evaluation uses.
        trainer_tensors: what training needs to go on, flat names.
        trainer: the same, as JSON.

    Returns:
        The checkpoint, with its folder and hash.
    """
    import safetensors.torch

    config, stats = _encode(checkpoint)
    with checkpoint_folder(folder) as temporary:
        safetensors.torch.save_file(_on_cpu(model_state), temporary / MODEL)
        safetensors.torch.save_file(_on_cpu(trainer_tensors), temporary / TRAINER_TENSORS)
        write_json(temporary / CONFIG, config)
        write_json(temporary / STATS, stats)
        write_json(temporary / TRAINER, trainer)
    return dataclasses.replace(checkpoint, folder=folder, content_hash=_hash(read_manifest(folder)))


def read_trainer(checkpoint: Checkpoint) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Read what training needs to go on, verified: tensors by name, and JSON.

    Raises:
        RequestError: it is missing or damaged.
    """
    import safetensors.torch

    digests = read_manifest(checkpoint.folder)
    tensors = safetensors.torch.load_file(verify(checkpoint.folder, digests, TRAINER_TENSORS))
    return tensors, read_json(verify(checkpoint.folder, digests, TRAINER))


def _on_cpu(tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Copies: safetensors takes neither shared memory nor other layouts than row by row."""
    return {
        name: tensor.detach().to("cpu", copy=True).contiguous() for name, tensor in tensors.items()
    }


def _hash(digests: Mapping[str, str]) -> str:
    """Digest of what makes the policy act as it does: the trainer's state may be deleted."""
    text = "".join(f"{name} {digests[name]}\n" for name in (MODEL, CONFIG, STATS))
    return hashlib.sha256(text.encode()).hexdigest()


_DATACLASSES = {
    "sizes": Sizes,
    "spec": ObservationSpec,
    "acting": Acting,
    "settings": TrainSettings,
}
_PLAIN = ("policy", "env", "control_period", "xml_hash", "step", "train_seed")
_DICTS = ("dataset", "versions")


def _encode(checkpoint: Checkpoint) -> tuple[dict[str, Any], dict[str, Any]]:
    config: dict[str, Any] = {name: getattr(checkpoint, name) for name in (*_PLAIN, *_DICTS)}
    config["config"] = dataclasses.asdict(checkpoint.config)
    config["action_names"] = list(checkpoint.action_names)
    config["split"] = checkpoint.split.to_json()
    for name in _DATACLASSES:
        value = getattr(checkpoint, name)
        config[name] = value.to_json() if name == "spec" else dataclasses.asdict(value)
    return config, checkpoint.normalization.to_json()


def _decode(config: dict[str, Any], stats: dict[str, Any]) -> dict[str, Any]:
    decoded: dict[str, Any] = {name: config[name] for name in (*_PLAIN, *_DICTS)}
    for name, kind in _DATACLASSES.items():
        values = config[name]
        decoded[name] = (
            kind.from_json(values) if kind is ObservationSpec else kind(**_with_tuples(values))
        )
    policy_config = load_part(policy_entry(config["policy"]).config)
    decoded["config"] = policy_config(**_with_tuples(config["config"]))
    decoded["action_names"] = tuple(config["action_names"])
    decoded["split"] = Split.from_json(config["split"])
    decoded["normalization"] = Normalization.from_json(stats)
    return decoded


def _with_tuples(values: Mapping[str, Any]) -> dict[str, Any]:
    return {
        name: tuple(value) if isinstance(value, list) else value for name, value in values.items()
    }
