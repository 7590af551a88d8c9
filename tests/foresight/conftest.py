"""Environments for tests of the study of foresight, made once."""

from __future__ import annotations

import pytest

from robo_manip_baselines.benchmark.foresight.episodes import EpisodePlayer, open_world
from robo_manip_baselines.envs.mujoco.tasks.feeding.env import FeedingEnv


@pytest.fixture(scope="session")
def player() -> EpisodePlayer:
    return EpisodePlayer()


@pytest.fixture(scope="session")
def dyskinetic() -> FeedingEnv:
    return open_world("dyskinetic")


@pytest.fixture(scope="session")
def recorded() -> FeedingEnv:
    return open_world("recorded")
