"""Setup of a training run: demonstrations, split, normalisation, sampler, network, run folder."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from pkgutil import resolve_name
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from robo_manip_baselines.data.actions import ActionEncoding
from robo_manip_baselines.data.demonstrations import (
    Demonstrations,
    Split,
    load_demonstrations,
    split_episodes,
)
from robo_manip_baselines.data.normalization import METHODS, Normalization
from robo_manip_baselines.envs.mujoco.tasks.registry import task_entry
from robo_manip_baselines.observation.spec import size_text
from robo_manip_baselines.policy.checkpoint import (
    Checkpoint,
    read_checkpoint,
    read_weights,
    without_initial_weights,
)
from robo_manip_baselines.policy.interface import PolicyDims, PolicyModel
from robo_manip_baselines.policy.registry import make_model, policy_entry, require_memory
from robo_manip_baselines.runs.checkpoints import list_checkpoints, remove_partial_checkpoints
from robo_manip_baselines.runs.errors import RequestError
from robo_manip_baselines.runs.metrics import (
    EVENTS,
    EVENTS_SUFFIX,
    TENSORBOARD,
    MetricsLog,
    open_board,
)
from robo_manip_baselines.runs.seeds import derive_seed
from robo_manip_baselines.runs.versions import software_versions
from robo_manip_baselines.training.batching import ExampleSampler, chunk_rows
from robo_manip_baselines.training.config import (
    CONFIG,
    EXTENDING_OPTIONS,
    METRICS,
    RUNTIME_OPTIONS,
    TrainConfig,
    read_config,
    require_same_config,
    write_config,
)


@dataclass(frozen=True)
class TrainSetup:
    """Data and budget of a training run, a function of its configuration and demonstrations.

    Attributes:
        config: of the run.
        demonstrations: all episodes.
        split: training episodes and episodes held out.
        normalization: measured on the training episodes.
        encoding: of the actions.
        sampler: of the examples of each step.
        total_steps: the budget.
    """

    config: TrainConfig[Any]
    demonstrations: Demonstrations
    split: Split
    normalization: Normalization
    encoding: ActionEncoding
    sampler: ExampleSampler
    total_steps: int

    @classmethod
    def load(cls, config: TrainConfig[Any]) -> TrainSetup:
        """Read the demonstrations.

        Raises:
            RequestError: there are none, or they do not fit the configuration.
        """
        settings, seed = config.training, config.seed
        folder, env_id = config.demonstrations, task_entry(config.env).env_id
        given = load_demonstrations(folder, config.spec, limit=config.num_episodes, env=config.env)
        if given.env_id != env_id:
            raise RequestError(f"'{folder}' holds {given.env_id}, not {env_id}")
        if settings.intervention_weight != 1.0 and given.intervention is None:
            raise RequestError(
                f"intervention_weight {settings.intervention_weight:g}: no episode of '{folder}' "
                "has the steps of interventions marked; record some with bin/Teleop.py --policy, "
                "or leave it out"
            )
        split = split_episodes(given.seeds, settings.validation_fraction, seed)
        train = list(given.indices(split.train))
        step = settings.skip * given.control_period
        encoding = ActionEncoding(given.spec, step, settings.relative_actions)
        if config.init_from is None:
            normalize = METHODS.get(config.norm) or resolve_name(config.norm)
            actions = _encoded_actions(config, given, encoding, train)
            normalization = normalize(given.state[given.rows(train)], actions)
        else:
            normalization = _initial(config, given).normalization
        lengths = given.lengths[train]
        sampler = ExampleSampler(lengths, settings.sampler, settings.batch_size, seed)
        total = sampler.total_steps(settings)
        setup = cls(config, given, split, normalization, encoding, sampler, total)
        network = without_initial_weights(config.network)
        require_memory(config.policy, network, setup.dims, copies=4)
        return setup

    @property
    def dims(self) -> PolicyDims:
        """Dimensions of the network's inputs and outputs."""
        given, spec = self.demonstrations, self.demonstrations.spec
        sizes = given.state.shape[1], given.action.shape[1]
        return PolicyDims(*sizes, cameras=len(spec.cameras), image=spec.image_size)

    def make_model(self, *, initial_weights: bool = True) -> PolicyModel:
        """Build the network; the seed decides its random weights.

        Args:
            initial_weights: whether to read the policy's file of initial weights, if it names one.
        """
        config = self.config.network
        config = config if initial_weights else without_initial_weights(config)
        torch.manual_seed(derive_seed(self.config.seed, "weights"))
        model = make_model(self.config.policy, config, self.dims)
        self._require_range(model)
        if initial_weights and self.config.init_from is not None:
            initial = read_checkpoint(self.config.init_from)
            model.load_state_dict(read_weights(initial, model.state_dict()))
        return model

    def _require_range(self, model: PolicyModel) -> None:
        """Raise RequestError where the network cannot return the actions of the demonstrations."""
        if model.action_range is None:
            return
        train = self.demonstrations.indices(self.split.train)
        encoded = _encoded_actions(self.config, self.demonstrations, self.encoding, train)
        action = self.normalization.normalize_action(encoded)
        if (largest := float(np.abs(action).max())) > model.action_range * (1 + 1e-4):
            raise RequestError(
                f"norm {self.config.norm}: actions of the demonstrations reach {largest:.3g} and "
                f"those of {self.config.policy} {model.action_range:g}; give --clip_sample "
                f"{math.ceil(largest)}, or --norm action_min_max"
            )

    def checkpoint(self, step: int) -> Checkpoint:
        """Return the description of a checkpoint of the run; its folder is set when written."""
        config, given = self.config, self.demonstrations
        return Checkpoint(
            folder=Path(),
            policy=config.policy,
            config=config.network,
            dims=self.dims,
            spec=given.spec,
            env=config.env,
            execution=config.execution,
            normalization=self.normalization,
            action_names=given.action_names,
            control_period=given.control_period,
            xml_hash=given.xml_hash,
            step=step,
            train_seed=config.seed,
            settings=replace(config.training, norm=config.norm),
            split=self.split,
            dataset={
                "folder": str(config.demonstrations),
                "episodes": len(given.seeds),
                "content_hash": given.content_hash,
                "env_kwargs": dict(given.env_kwargs),
            },
            versions=software_versions("torch", "numpy", "robo_manip_baselines"),
        )

    def find_start(self, resume: bool) -> Checkpoint | None:
        """Return the newest checkpoint of the run folder; None to train from the beginning.

        Raises:
            RequestError: the run folder holds another run, or this one and ``resume`` is False; or
                the demonstrations have changed since.
        """
        run = self.config.folder
        if not list_checkpoints(run):
            return None
        extendable = RUNTIME_OPTIONS | EXTENDING_OPTIONS
        require_same_config(run, self.config, extendable if resume else RUNTIME_OPTIONS)
        checkpoint = read_checkpoint(run)
        if resume and checkpoint.step > self.total_steps:
            raise RequestError(
                f"'{run}' has done {checkpoint.step} steps already, more than {self.total_steps}; "
                "give a larger --steps or --epochs to extend the run"
            )
        if not resume:
            done = checkpoint.step >= self.total_steps
            state = "finished; choose another --out or --seed, or --resume with more --steps"
            if not done:
                state = f"at step {checkpoint.step}; --resume continues it"
            raise RequestError(f"'{run}' holds this run, {state}")
        if checkpoint.dataset.get("content_hash") != self.demonstrations.content_hash:
            raise RequestError(
                f"the demonstrations in '{self.config.demonstrations}' are not the ones that "
                f"'{run}' was trained on; give those with --dataset, or choose another --out"
            )
        trained, spec = checkpoint.spec, self.demonstrations.spec
        if trained.drawn_size != spec.drawn_size:  # of a release that squashed images
            raise RequestError(
                f"'{run}' was trained on images of {size_text(trained.image_size)} drawn at "
                f"{size_text(trained.drawn_size)}, and this release would go on with images drawn "
                f"at {size_text(spec.drawn_size)}; choose another --out, or the release that "
                "trained it"
            )
        if trained != spec:
            raise RequestError(
                f"the error statistics are not the ones that '{run}' was trained with; give those "
                "with --error_stats, or choose another --out"
            )
        return checkpoint

    def open_log(self, start: Checkpoint | None) -> MetricsLog:
        """Prepare the run folder and open its metrics.

        Raises:
            RequestError: the logger is not installed, or the folder is damaged.
        """
        run, config = self.config.folder, self.config
        remove_partial_checkpoints(run)
        if start is None:  # an earlier run may have left something before its first checkpoint
            if (run / CONFIG).is_file():
                require_same_config(run, config)
            else:
                write_config(run, config)
            (run / METRICS).unlink(missing_ok=True)
            for path in (run / TENSORBOARD).glob(f"{EVENTS}.*{EVENTS_SUFFIX}"):
                path.unlink()
        elif not (run / CONFIG).is_file():
            raise RequestError(f"'{run}' has lost its {CONFIG}; choose another --out")
        elif TrainConfig.from_json(read_config(run / CONFIG)).training != config.training:
            write_config(run, config)  # the run is extended
        step = start.step if start else 0
        board = open_board(config.logger, run, step, config.to_json())
        return MetricsLog(run / METRICS, step, board)


def _initial(config: TrainConfig[Any], given: Demonstrations) -> Checkpoint:
    """Read the checkpoint that a training begins with, or goes on with once it has begun.

    The weights are worth something with its normalisation alone.

    Raises:
        RequestError: there is none, or it is of another policy, norm or size.
    """
    assert config.init_from is not None
    begun = bool(list_checkpoints(config.folder))
    initial = read_checkpoint(config.folder if begun else config.init_from)
    norm = initial.settings.norm or policy_entry(initial.policy).normalization
    sizes = initial.dims.state, initial.dims.action
    pairs = {
        "policy": (initial.policy, config.policy),
        "norm": (norm, config.norm),
        "elements of state and action": (sizes, (given.state.shape[1], given.action.shape[1])),
    }
    for name, (there, here) in pairs.items():
        if there != here:
            raise RequestError(f"init_from '{config.init_from}': {name} {there}, not {here}")
    return initial


def _encoded_actions(
    config: TrainConfig[Any],
    given: Demonstrations,
    encoding: ActionEncoding,
    episodes: Sequence[int],
) -> NDArray[np.float32]:
    """Return the actions of some episodes as a policy is to predict them, (n, A).

    Relative to what is observed when a chunk begins, each is there once for each of its places in a
    chunk. A policy whose settings have no ``chunk_size`` is taken to predict one action.

    Raises:
        RequestError: they cannot be encoded.
    """
    rows = given.rows(episodes)
    if not encoding:
        return given.action[rows]
    encoding.require_round_trip(given.action[rows])
    columns, lengths = encoding.columns(given.action), given.lengths[list(episodes)]
    offsets = np.concatenate([np.zeros(1, np.int64), np.cumsum(lengths)])
    numbers = np.repeat(np.arange(len(lengths)), lengths)
    starts = np.arange(len(rows)) - offsets[numbers]
    size = getattr(config.network, "chunk_size", 1)
    chunks, _ = chunk_rows(offsets, numbers, starts, size, config.training.skip)
    encoded = np.empty((size, *given.action[rows].shape), np.float32)
    reference = encoding.reference(given.state[rows], size)
    for place in range(size):
        encoded[place] = columns[rows[chunks[:, place]]] - reference[:, place]
    return encoded.reshape(-1, encoded.shape[-1])
