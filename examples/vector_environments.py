# %% [markdown]
# # Environments in parallel, with a wrapper
#
# Four `FeedingEnv` step at once, each in a process of its own. A wrapper adds a dense reward: how
# much nearer the gripper has come to the mouth. Run it cell by cell in an editor, or as a program:
# `python examples/vector_environments.py`.

# %%
import os

import gymnasium
import numpy as np

import robo_manip_baselines  # registers the environments

NUM_ENVS = int(os.environ.get("NUM_ENVS", "4"))
STEPS = int(os.environ.get("STEPS", "500"))


# %% [markdown]
# `info` holds what a reward may need: positions in metres, world frame. It is the truth, whatever
# the policy observes.


# %%
class ApproachReward(gymnasium.Wrapper):
    """Reward by the distance (m) between gripper and mouth that a step has closed."""

    def reset(self, **kwargs):
        observation, info = self.env.reset(**kwargs)
        self.distance = self.measure(info)
        return observation, info

    def step(self, action):
        observation, _, terminated, truncated, info = self.env.step(action)
        before, self.distance = self.distance, self.measure(info)
        return observation, before - self.distance, terminated, truncated, info

    def measure(self, info):
        return float(np.linalg.norm(info["gripper_position"] - info["mouth_position"]))


# %% [markdown]
# Wrappers of Gymnasium work as well: actions from -1 to 1, and one flat vector of observations.
# Without cameras no image is rendered.

# %%
envs = gymnasium.make_vec(
    "robo_manip_baselines/FeedingEnv-v0",
    num_envs=NUM_ENVS,
    vectorization_mode="async",
    wrappers=[
        ApproachReward,
        lambda env: gymnasium.wrappers.RescaleAction(env, np.float32(-1), np.float32(1)),
        gymnasium.wrappers.FlattenObservation,
    ],
    vector_kwargs={"context": "fork"},  # this file has no __main__ guard
    obs="current",
    cameras=(),
)
print(robo_manip_baselines.__name__, envs.single_observation_space, envs.single_action_space)

# %% [markdown]
# All randomness comes from the seed of `reset`: environment i gets seed + i. An episode that ends
# is started again by the next step.

# %%
observation, info = envs.reset(seed=0)
envs.action_space.seed(0)
returns, episodes = np.zeros(NUM_ENVS), 0
for _ in range(STEPS):
    observation, reward, terminated, truncated, info = envs.step(envs.action_space.sample())
    returns += reward
    episodes += int((terminated | truncated).sum())
print(
    f"{STEPS * NUM_ENVS} steps, {episodes} episodes ended, distance closed (m): {returns.round(3)}"
)
envs.close()
