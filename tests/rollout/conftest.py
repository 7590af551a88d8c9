"""A policy that nobody trained, and short episodes."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
import torch

from robo_manip_baselines.data.demonstrations import Split
from robo_manip_baselines.data.normalization import Normalization
from robo_manip_baselines.envs.mujoco.tasks.face_env import world_of
from robo_manip_baselines.observation import ObservationSpec
from robo_manip_baselines.policy.checkpoint import Checkpoint, write_checkpoint
from robo_manip_baselines.policy.mlp.config import MlpConfig
from robo_manip_baselines.policy.mlp.model import MlpModel
from robo_manip_baselines.policy.presets import ActionExecution, PolicyDims, TrainSettings
from robo_manip_baselines.rollout.workers import EnvConfig

SPEC = ObservationSpec(obs="current_pred", cameras=(), object_pose=True)
STEPS = 30

MakeCheckpoint = Callable[..., Checkpoint]


@pytest.fixture(scope="session")
def env_config() -> EnvConfig:
    """The environment of ``make_checkpoint``."""
    return EnvConfig("FeedingEnv", SPEC, {"max_episode_steps": STEPS})


@pytest.fixture(scope="session")
def make_checkpoint(env_config: EnvConfig) -> MakeCheckpoint:
    """Write a small perceptron into a folder; it moves the arm about its home pose."""
    with closing(env_config.make()) as env:
        world = world_of(env)
        names, xml_hash = tuple(world.action_names), world.xml_hash
        middle = world.data.ctrl[world._actuators].astype(np.float32)

    def make(folder: Path, **changes: object) -> Checkpoint:
        config = MlpConfig(chunk_size=6, hidden_size=16, hidden_layers=1)
        dims = PolicyDims(env_config.vector_size, env_config.action_size, 0, SPEC.image_size)
        model = MlpModel(config, dims)
        generator = torch.Generator().manual_seed(0)
        with torch.no_grad():
            for parameter in model.parameters():
                parameter.copy_(torch.randn(parameter.shape, generator=generator) * 0.3)
        facts = {
            "policy": "Mlp",
            "config": config,
            "dims": dims,
            "spec": SPEC,
            "env": "FeedingEnv",
            "execution": ActionExecution(),
            "normalization": Normalization(
                np.zeros(dims.state, np.float32),
                np.ones(dims.state, np.float32),
                middle,
                np.full(dims.action, 0.05, np.float32),
            ),
            "action_names": names,
            "control_period": 0.02,
            "xml_hash": xml_hash,
            "step": 5,
            "train_seed": 3,
            "settings": TrainSettings(steps=5),
            "split": Split(train=(0, 1), validation=(2,)),
            "dataset": {"env_kwargs": env_config.env_kwargs},
            "versions": {"robo_manip_baselines": "0.0.9"},
        }
        checkpoint = Checkpoint(folder=folder, **{**facts, **changes})
        return write_checkpoint(folder, checkpoint, model.state_dict(), {}, {})

    return make
