# %% [markdown]
# # Training a policy class of one's own
#
# A policy is a settings dataclass, a PyTorch module and a line of the registry; training,
# resuming, checkpoints, evaluation and videos come with the package. Here all of it is in one
# file; `docs/add-a-policy.md` makes an installed package of it, which `bin/Train.py` knows by
# name. Run it cell by cell, or as a program: `python examples/own_policy.py`.

# %%
import os
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from torch import nn

from robo_manip_baselines.policy.interface import PolicyModel, masked_mean
from robo_manip_baselines.policy.presets import (
    STATE_ONLY_TRAINING,
    ActionExecution,
    Chunk,
    PolicyPreset,
    Width,
)
from robo_manip_baselines.policy.registry import POLICIES, PolicyEntry
from robo_manip_baselines.rollout.demonstrate import Collection, collect
from robo_manip_baselines.rollout.evaluation import EvaluationConfig, evaluate
from robo_manip_baselines.training.config import TrainConfig
from robo_manip_baselines.training.trainer import train

EPISODES = int(os.environ.get("EPISODES", "20"))
STEPS = int(os.environ.get("STEPS", "2000"))
TRIALS = int(os.environ.get("TRIALS", "20"))
FOLDER = Path(os.environ.get("FOLDER", "own_policy"))


# %% [markdown]
# Settings: every field would be an option of `bin/Train.py`, and is saved with the checkpoint.


# %%
@dataclass(frozen=True)
class GruConfig:
    """Settings of the policy.

    Attributes:
        chunk_size: actions predicted at once.
        hidden_size: units of the recurrent layer.
    """

    chunk_size: Chunk = 20
    hidden_size: Width = 128


# %% [markdown]
# The network. Shapes: B batch, O observation steps, S elements of the state, K actions of a chunk,
# A elements of an action; states and actions are normalised.


# %%
class GruModel(PolicyModel):
    """Chunk of actions from a recurrent layer over the last observations."""

    n_obs_steps = 4

    def __init__(self, config, dims):
        super().__init__()
        self.chunk_size = config.chunk_size
        self.memory = nn.GRU(dims.state, config.hidden_size, batch_first=True)
        self.head = nn.Linear(config.hidden_size, config.chunk_size * dims.action)

    def predict(self, state, images, noise):
        """Return normalised actions (B, K, A) from states (B, O, S)."""
        _, hidden = self.memory(state)
        return self.head(hidden[-1]).float().unflatten(-1, (self.chunk_size, -1))

    def loss(self, batch):
        """Return the mean Huber loss over the steps before the episode's end."""
        actions = self.predict(batch.state, batch.images, None)
        error = nn.functional.huber_loss(actions, batch.action, reduction="none", delta=0.1)
        return {"loss": masked_mean(error, batch.is_pad, batch.num_valid)}


# %% [markdown]
# A preset: what to observe, how to train, how to act. This one needs neither images nor a GPU.

# %%
PRESETS = {
    "cpu": PolicyPreset(
        config=GruConfig(),
        training=STATE_ONLY_TRAINING,
        execution=ActionExecution(temporal_ensemble=False, n_action_steps=5),
        cameras=(),
        object_pose=True,
    )
}
POLICIES["Gru"] = PolicyEntry(
    config=f"{__name__}:GruConfig", model=f"{__name__}:GruModel", presets=f"{__name__}:PRESETS"
)

# %% [markdown]
# Demonstrations of the scripted expert. What is there already is kept.

# %%
demonstrations = FOLDER / "demonstrations"
collect(
    Collection(
        env="FeedingEnv",
        out=demonstrations,
        expert="reactive",
        seeds=range(EPISODES),
        env_kwargs={"cameras": []},
    )
)

# %% [markdown]
# Training. A run that was stopped goes on from its last checkpoint with `resume=True`, bit for
# bit.

# %%
config = TrainConfig.from_preset(
    "Gru", "cpu", dataset=demonstrations, out=FOLDER / "run", logger="none"
)
config = replace(config, training=replace(config.training, steps=STEPS))
torch.set_num_threads(1)  # small matrices: more threads would only wait for each other
train(config, resume=(FOLDER / "run").exists())

# %% [markdown]
# Evaluation on seeds that no demonstration has. `results.jsonl` in the folder has a line for each
# episode.

# %%
plan, summary, _ = evaluate(
    EvaluationConfig(
        checkpoint=FOLDER / "run",
        seeds=range(1000, 1000 + TRIALS),
        out=FOLDER / "results",
        num_envs=min(8, TRIALS),
        workers=0,
    )
)
print(plan)
print(summary)
