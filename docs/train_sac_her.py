"""SAC with hindsight replay on FeedingGoalEnv; docs/reinforcement-learning.md describes it."""

from __future__ import annotations

import argparse

import gymnasium
import numpy as np
from stable_baselines3 import SAC, HerReplayBuffer

import robo_manip_baselines  # noqa: F401  (registers the environments)

TIME_LIMIT = 300  # steps, 6 s: that of the paper's approach


def make_env(arguments: argparse.Namespace, people: str) -> gymnasium.Env:
    return gymnasium.make(
        "robo_manip_baselines/FeedingGoalEnv-v0",
        max_episode_steps=TIME_LIMIT,
        start=arguments.start,
        reward=arguments.reward,
        tolerance=arguments.tolerance,
        motion=arguments.motion,
        people=people,
    )


def evaluate(model: SAC, env: gymnasium.Env, episodes: int) -> str:
    """Act without noise; count the episodes that reach the goal, and the time there."""
    times = []
    for seed in range(episodes):
        observation, _ = env.reset(seed=seed)
        at_goal, is_done = 0, False
        while not is_done:
            action, _ = model.predict(observation, deterministic=True)
            observation, _, terminated, truncated, info = env.step(action)
            at_goal += info["is_success"]
            is_done = terminated or truncated
        times.append(at_goal * 0.02)
    reached = np.count_nonzero(times)
    return f"{reached}/{episodes} episodes reached the goal; {np.mean(times):.2f} s at it of 6 s"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--steps", type=int, default=40_000)
    parser.add_argument("--start", default="grasped")
    parser.add_argument("--reward", default="sparse")
    parser.add_argument("--tolerance", type=float, default=0.03, help="m")
    parser.add_argument("--motion", default="recorded")
    parser.add_argument("--episodes", type=int, default=20, help="of the evaluation")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", default="sac_feeding", help="file of the policy, without .zip")
    arguments = parser.parse_args()

    env = make_env(arguments, "train")
    model = SAC(
        "MultiInputPolicy",
        env,
        replay_buffer_class=HerReplayBuffer,
        replay_buffer_kwargs={"n_sampled_goal": 4, "goal_selection_strategy": "future"},
        learning_rate=1e-3,
        gamma=0.97,
        tau=0.02,
        buffer_size=200_000,
        learning_starts=2 * TIME_LIMIT,  # hindsight needs a whole episode
        seed=arguments.seed,
        device="cpu",
        verbose=1,
    )
    others = make_env(arguments, "test")
    print("before training:", evaluate(model, others, arguments.episodes), flush=True)
    model.learn(arguments.steps, log_interval=10)
    print("after training:", evaluate(model, others, arguments.episodes), flush=True)
    model.save(arguments.out)


if __name__ == "__main__":
    main()
