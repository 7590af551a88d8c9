"""Checkpoints: a trained network with everything that acting with it needs.

A folder of safetensors and JSON, described in ``docs/training.md``; never pickle. PyTorch is
imported only by the functions that touch weights.
"""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from pkgutil import resolve_name
from typing import TYPE_CHECKING, Any

from typing_extensions import TypedDict

from robo_manip_baselines.data.actions import ActionEncoding
from robo_manip_baselines.data.demonstrations import Split
from robo_manip_baselines.data.normalization import Normalization
from robo_manip_baselines.observation import ObservationSpec
from robo_manip_baselines.policy.presets import (
    ActionExecution,
    PolicyDims,
    TrainSettings,
)
from robo_manip_baselines.policy.registry import make_model, policy_entry
from robo_manip_baselines.runs.checkpoints import (
    checkpoint_folder,
    find_checkpoint,
    read_manifest,
    verify,
)
from robo_manip_baselines.runs.documents import Schema, convert, read_json
from robo_manip_baselines.runs.errors import RequestError, require_choice
from robo_manip_baselines.runs.files import write_json
from robo_manip_baselines.runs.ranges import Amount, NonNegativeInt, Positive, Seed
from robo_manip_baselines.runs.tensors import read_tensors, require_alike, require_finite

if TYPE_CHECKING:
    import torch
    from torch import Tensor

    from robo_manip_baselines.policy.interface import PolicyModel


MODEL = "model.safetensors"
CONFIG = "config.json"
STATS = "stats.json"
TRAINER_TENSORS = "trainer.safetensors"
TRAINER = "trainer.json"
ORIGIN = "origin.json"

ACTING_FILES = (MODEL, CONFIG, STATS)
"""Files that decide a policy's actions; the trainer's state may be deleted."""

SHIPPED = Path(str(files("robo_manip_baselines.policy") / "shipped"))
"""Folder of the checkpoints that come with the package, each with an ``ORIGIN``."""

SHIPPED_PREFIX = "shipped:"
"""Before the name of a checkpoint that comes with the package, in place of a folder."""

ORIGIN_SCHEMA = Schema("robo_manip_baselines/checkpoint_origin", 1)

INITIAL_WEIGHTS = "backbone_weights"
"""Setting of a policy that names a file of weights to start from, where it has one."""


class DatasetFacts(TypedDict, total=False):
    """Facts of the demonstrations that a policy was trained on.

    Attributes:
        folder: of the episodes.
        episodes: how many.
        content_hash: SHA-256 of their contents.
        env_kwargs: arguments of their environment beside the observation spec.
    """

    folder: str
    episodes: int
    content_hash: str
    env_kwargs: dict[str, Any]


@dataclass(frozen=True)
class Checkpoint:
    """A trained policy, without its weights.

    Attributes:
        folder: its folder.
        policy: name of the policy in the registry.
        config: the policy's own frozen dataclass.
        dims: dimensions of its inputs and outputs.
        spec: its observations in training.
        env: name of the task.
        execution: default execution of its action chunks.
        normalization: of states and actions, from the training episodes.
        action_names: (A,) elements of an action.
        control_period: seconds between actions.
        xml_hash: of the simulated model that the demonstrations were recorded in.
        step: optimiser steps done.
        train_seed: seed of the training run.
        settings: optimiser, sampling and budget of the training run.
        split: training episodes and episodes held out.
        dataset: facts of the demonstrations.
        versions: of the libraries that wrote it.
        content_hash: SHA-256 over weights, configuration and statistics; 64 hexadecimal digits.
    """

    folder: Path
    policy: str
    config: Any
    dims: PolicyDims
    spec: ObservationSpec
    env: str
    execution: ActionExecution
    normalization: Normalization
    action_names: tuple[str, ...]
    control_period: float
    xml_hash: str
    step: int
    train_seed: int
    settings: TrainSettings
    split: Split
    dataset: DatasetFacts
    versions: dict[str, str]
    content_hash: str = ""

    @property
    def encoding(self) -> ActionEncoding:
        """Encoding of the actions that the network predicts."""
        step = self.settings.skip * self.control_period
        return ActionEncoding(self.spec, step, self.settings.relative_actions)


def shipped_checkpoints() -> list[str]:
    """Return the names of the checkpoints that come with the package."""
    return sorted(path.parent.name for path in SHIPPED.glob(f"*/{ORIGIN}"))


def locate_checkpoint(path: str | Path) -> Path:
    """Return the checkpoint folder that a path or ``shipped:NAME`` means.

    Raises:
        RequestError: there is none.
    """
    text = str(path)
    if not text.startswith(SHIPPED_PREFIX):
        return find_checkpoint(Path(path))
    name = text.removeprefix(SHIPPED_PREFIX)
    return SHIPPED / require_choice("shipped checkpoint", name, shipped_checkpoints())


@dataclass(frozen=True)
class CheckpointOrigin:
    """Content of ``origin.json``: how a checkpoint that comes with the package was made.

    Attributes:
        commands: that made it, in order.
        demonstrations: SHA-256 of the contents of its demonstrations, as in ``config.json``.
        date: of the last command, ISO 8601.
        package_version: that made it.
    """

    commands: tuple[str, ...]
    demonstrations: str
    date: str
    package_version: str


def read_origin(checkpoint: Checkpoint) -> CheckpointOrigin:
    """Read how a shipped checkpoint was made.

    Raises:
        RequestError: it has no ``origin.json``, or a damaged one.
    """
    folder = checkpoint.folder
    return read_json(verify(folder, read_manifest(folder), ORIGIN), CheckpointOrigin, ORIGIN_SCHEMA)


def read_checkpoint(path: str | Path) -> Checkpoint:
    """Read a checkpoint: its folder, a run folder (the newest one), or ``shipped:NAME``.

    Weights, configuration and statistics are verified against their digests.

    Raises:
        RequestError: it is missing, damaged, of another kind, or of a newer schema.
    """
    folder = locate_checkpoint(path)
    digests = read_manifest(folder)
    verify(folder, digests, MODEL)
    try:
        stored = read_json(verify(folder, digests, CONFIG), CheckpointDocument)
        stats = read_json(verify(folder, digests, STATS))
        network = resolve_name(policy_entry(stored.policy).config)
        checkpoint = Checkpoint(
            folder=folder,
            config=convert(stored.config, network, "config"),
            dims=stored.sizes,
            spec=ObservationSpec.from_json(stored.spec),
            execution=ActionExecution.from_json(stored.acting),
            normalization=Normalization.from_json(stats, f"'{folder / STATS}'"),
            action_names=stored.action_names,
            settings=stored.settings,
            split=stored.split,
            content_hash=_content_hash(digests),
            **{name: getattr(stored, name) for name in _UNCHANGED},
        )
        _require_same_sizes(checkpoint)
    except RequestError as error:
        raise RequestError(
            f"checkpoint '{folder}' does not fit this package: {error}; use the package that "
            "wrote it"
        ) from error
    return checkpoint


@dataclass(frozen=True)
class CheckpointDocument:
    """Content of ``config.json``, named as in the first release; see `Checkpoint`."""

    policy: str
    env: str
    control_period: Positive
    xml_hash: str
    step: NonNegativeInt
    train_seed: Seed
    dataset: DatasetFacts
    versions: dict[str, str]
    config: dict[str, Any]
    action_names: tuple[str, ...]
    split: Split
    sizes: PolicyDims
    spec: dict[str, Any]
    acting: dict[str, Any]
    settings: TrainSettings


def _require_same_sizes(checkpoint: Checkpoint) -> None:
    """Raise RequestError unless statistics and names are as many as the network's elements."""
    dims, statistics = checkpoint.dims, checkpoint.normalization
    sizes = {
        "state_mean": (len(statistics.state_mean), dims.state),
        "action_mean": (len(statistics.action_mean), dims.action),
        "action_names": (len(checkpoint.action_names), dims.action),
    }
    for name, (found, wanted) in sizes.items():
        if found != wanted:
            raise RequestError(f"'{name}' has {found} elements, the network {wanted}")


def load_model(checkpoint: Checkpoint, device: torch.device | str = "cpu") -> PolicyModel:
    """Build the network with the checkpoint's weights, for evaluation.

    The weights are the moving average where training kept one.

    Raises:
        RequestError: the weights do not fit the network.
    """
    config = without_initial_weights(checkpoint.config)
    model = make_model(checkpoint.policy, config, checkpoint.dims)
    model.load_state_dict(read_weights(checkpoint, model.state_dict()))
    return model.to(device).eval()


def read_weights(checkpoint: Checkpoint, wanted: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Read the weights for evaluation, of the names, types and shapes of ``wanted``.

    Raises:
        RequestError: they do not fit, or hold NaN or infinity; names the tensor.
    """
    path = verify(checkpoint.folder, read_manifest(checkpoint.folder), MODEL)
    state, _ = read_tensors(path)
    try:
        require_alike(state, wanted, MODEL)
        require_finite(state, MODEL)
    except RequestError as error:
        raise RequestError(
            f"checkpoint '{checkpoint.folder}' does not fit {checkpoint.policy}: {error}"
        ) from error
    return state


def without_initial_weights(config: Any) -> Any:
    """Return a policy's settings without the file of initial weights.

    The weights of a checkpoint come from the checkpoint: that file may be gone.
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
        folder: must not exist yet.
        checkpoint: description of the network; returned with this ``folder`` and its hash.
        model_state: the state dict for evaluation.
        trainer_tensors: tensors for resuming, flat names.
        trainer: numbers for resuming, for JSON.
    """
    import safetensors.torch

    config = {
        **{name: getattr(checkpoint, name) for name in _UNCHANGED},
        "config": dataclasses.asdict(checkpoint.config),
        "action_names": list(checkpoint.action_names),
        "split": checkpoint.split.to_json(),
        # Named as in the first release.
        "sizes": dataclasses.asdict(checkpoint.dims),
        "spec": checkpoint.spec.to_json(),
        "acting": checkpoint.execution.to_json(),
        "settings": dataclasses.asdict(checkpoint.settings),
    }
    with checkpoint_folder(folder) as temporary:
        for name, tensors in ((MODEL, model_state), (TRAINER_TENSORS, trainer_tensors)):
            # not save_file, which takes no path that is not UTF-8
            (temporary / name).write_bytes(safetensors.torch.save(_on_cpu(tensors)))
        write_json(temporary / CONFIG, config)
        write_json(temporary / STATS, checkpoint.normalization.to_json())
        write_json(temporary / TRAINER, trainer)
    content_hash = _content_hash(read_manifest(folder))
    return dataclasses.replace(checkpoint, folder=folder, content_hash=content_hash)


@dataclass(frozen=True)
class TrainerDocument:
    """Content of ``trainer.json``: numbers for resuming.

    Attributes:
        step: optimiser steps done.
        seconds: spent on them.
        optimizer_steps: parameter -> steps in which it had a gradient.
        metrics: ``names`` of the losses, and ``count`` of the steps whose sums are a tensor.
    """

    step: NonNegativeInt
    seconds: Amount
    optimizer_steps: dict[str, NonNegativeInt]
    metrics: TrainerMetrics


class TrainerMetrics(TypedDict):
    """Losses since the last line of ``metrics.jsonl``."""

    names: list[str]
    count: NonNegativeInt


def read_trainer(checkpoint: Checkpoint) -> tuple[dict[str, Tensor], TrainerDocument]:
    """Read the trainer's state, verified: tensors by name, and numbers.

    Raises:
        RequestError: it is missing or damaged.
    """
    digests = read_manifest(checkpoint.folder)
    tensors, _ = read_tensors(verify(checkpoint.folder, digests, TRAINER_TENSORS))
    return tensors, read_json(verify(checkpoint.folder, digests, TRAINER), TrainerDocument)


_UNCHANGED = (
    *("policy", "env", "control_period", "xml_hash"),
    *("step", "train_seed", "dataset", "versions"),
)
"""Attributes that are in ``config.json`` as they are."""


def _on_cpu(tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Copies: safetensors takes neither shared memory nor other layouts than row by row."""
    return {k: v.detach().to("cpu", copy=True).contiguous() for k, v in tensors.items()}


def _content_hash(digests: Mapping[str, str]) -> str:
    """Digest of the files that decide the policy's actions."""
    text = "".join(f"{name} {digests[name]}\n" for name in ACTING_FILES)
    return hashlib.sha256(text.encode()).hexdigest()
