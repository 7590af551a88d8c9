"""What a training run is: demonstrations, split, statistics, schedule, network."""

from __future__ import annotations

import platform
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import torch

from robo_manip_baselines.data.demonstrations import (
    Demonstrations,
    Split,
    load_demonstrations,
    split_episodes,
)
from robo_manip_baselines.data.normalization import Normalization
from robo_manip_baselines.envs.mujoco.tasks.registry import task_entry
from robo_manip_baselines.policy.checkpoint import (
    Checkpoint,
    without_initial_weights,
)
from robo_manip_baselines.policy.interface import PolicyModel
from robo_manip_baselines.policy.presets import Sizes
from robo_manip_baselines.policy.registry import load_part, make_model, policy_entry
from robo_manip_baselines.runs.errors import RequestError
from robo_manip_baselines.runs.seeds import derive_seed
from robo_manip_baselines.training.options import TrainOptions
from robo_manip_baselines.training.sampling import Schedule


@dataclass(frozen=True)
class Job:
    """What is trained on what; a function of the options and of the demonstrations.

    Attributes:
        options: as given.
        demonstrations: all episodes.
        split: which are trained on.
        normalization: measured on those.
        schedule: which examples each step sees.
        total_steps: the budget.
    """

    options: TrainOptions[Any]
    demonstrations: Demonstrations
    split: Split
    normalization: Normalization
    schedule: Schedule
    total_steps: int

    @classmethod
    def of(cls, options: TrainOptions[Any]) -> Job:
        """Read the demonstrations and plan the run.

        Raises:
            RequestError: there are none, or they do not fit the options.
        """
        settings, seed = options.training, options.seed
        given = load_demonstrations(
            options.demonstrations, options.spec, limit=options.num_episodes, env=options.env
        )
        env_id = task_entry(options.env).env_id
        if given.env_id != env_id:
            raise RequestError(f"'{options.demonstrations}' holds {given.env_id}, not {env_id}")
        split = split_episodes(given.seeds, settings.validation_fraction, seed)
        train = given.indices(split.train)
        rows = given.rows(train)
        normalization = Normalization.of(given.state[rows], given.action[rows])
        schedule = Schedule(given.lengths[list(train)], settings.sampler, settings.batch_size, seed)
        total = schedule.total_steps(settings)
        return cls(options, given, split, normalization, schedule, total)

    @property
    def sizes(self) -> Sizes:
        """What the network must fit."""
        return Sizes(
            state=self.demonstrations.state.shape[1],
            action=self.demonstrations.action.shape[1],
            cameras=len(self.demonstrations.spec.cameras),
            image=self.demonstrations.spec.image_size,
        )

    @property
    def total_frames(self) -> int:
        """Examples of the whole budget."""
        return self.total_steps * self.schedule.batch_size

    def make_model(self, is_start: bool) -> PolicyModel:
        """Build the network; the seed decides its random weights.

        Args:
            is_start: whether these are the weights that training begins with.
        """
        config = self.options.network
        torch.manual_seed(derive_seed(self.options.seed, "weights"))
        return make_model(
            self.options.policy,
            config if is_start else without_initial_weights(config),
            self.sizes,
        )

    def checkpoint(self) -> Checkpoint:
        """What every checkpoint of the run says; folder and step are set when it is written."""
        options, given = self.options, self.demonstrations
        presets = load_part(policy_entry(options.policy).presets)
        return Checkpoint(
            folder=Path(),
            policy=options.policy,
            config=options.network,
            sizes=self.sizes,
            spec=given.spec,
            env=options.env,
            acting=presets[options.preset].acting,
            normalization=self.normalization,
            action_names=given.action_names,
            control_period=given.control_period,
            xml_hash=given.xml_hash,
            step=0,
            train_seed=options.seed,
            settings=options.training,
            split=self.split,
            dataset={
                "folder": str(options.demonstrations),
                "episodes": len(given.seeds),
                "content_hash": given.content_hash,
                "env_kwargs": dict(given.env_kwargs),
            },
            versions={
                "python": platform.python_version(),
                **{name: version(name) for name in ("torch", "numpy", "robo_manip_baselines")},
            },
        )
