"""Policies compared on the same demonstrations: success, time per action, time of training.

Trains every policy on each observation and training seed, evaluates it, and writes
``policies.md``. A call that was stopped goes on where it was:

    python benchmarks/policies.py --dataset dataset/dyskinetic --train_seeds 0 1 --num_episodes 100
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from robo_manip_baselines.commands.train import parse_config
from robo_manip_baselines.policy.checkpoint import read_checkpoint
from robo_manip_baselines.rollout.evaluation import (
    FIRST_SEED,
    EvaluationConfig,
    EvaluationPlan,
    evaluate,
)
from robo_manip_baselines.rollout.results import Proportion
from robo_manip_baselines.runs.command import parse, run_command
from robo_manip_baselines.runs.errors import RequestError, require_choice
from robo_manip_baselines.runs.files import write_text
from robo_manip_baselines.runs.metrics import read_metrics
from robo_manip_baselines.runs.ranges import Count, Episodes, NonNegativeInt, Processes, Seed
from robo_manip_baselines.training.config import METRICS
from robo_manip_baselines.training.requirements import prepare_pytorch
from robo_manip_baselines.training.trainer import train

EXAMPLE = "python benchmarks/policies.py --dataset dataset/dyskinetic --policies Act Flow"

_FORECAST = ["--obs", "current_pred", "--horizon", "16", "--relative"]

OBSERVATIONS = {
    "default": ["--obs", "current_pred"],
    "current": ["--obs", "current"],
    "forecast": _FORECAST,
    **{
        f"forecast_{frame}_{time}": [*_FORECAST, "--mouth_frame", frame, "--mouth_time", time]
        for frame in ("gripper", "actions", "both")
        for time in ("now", "forecast")
    },
}
"""Name of an observation -> its options of ``bin/Train.py``."""

POLICIES = ("Act", "Mlp", "Diffusion", "Flow", "Sarnn")

TABLE = "policies.md"


@dataclass(frozen=True)
class Options:
    """Train policies on the same demonstrations, evaluate them, and write a table.

    Attributes:
        dataset: Folder of demonstrations without images.
        policies: Policies.
        observations: default, that of the quick start (the mouth now and in 2 frames); current;
            forecast: the mouth now and in 16 frames; or forecast_FRAME_TIME, with a mouth_frame and
            a mouth_time.
        delay: Frames by which the mouth is observed late.
        train_seeds: Seeds of the trainings.
        steps: Optimiser steps of each training; those of the preset if not given.
        num_episodes: Episodes of each evaluation.
        seed: Seed of the first episode.
        num_envs: Episodes that run at once; results do not depend on it.
        workers: Processes in which environments step.
        out: Folder of runs, results and table.
    """

    dataset: Path
    policies: tuple[str, ...] = POLICIES
    observations: tuple[str, ...] = ("default",)
    delay: NonNegativeInt = 0
    train_seeds: tuple[Seed, ...] = (0, 1, 2)
    steps: Count | None = None
    num_episodes: Episodes = 200
    seed: Seed = FIRST_SEED
    num_envs: Episodes = 8
    workers: Processes = 2
    out: Path = Path("results/policies")

    def __post_init__(self) -> None:
        for policy in self.policies:
            require_choice("policy", policy, POLICIES)
        for observation in self.observations:
            require_choice("observation", observation, OBSERVATIONS)


@dataclass(frozen=True)
class Row:
    """Results of one training.

    Attributes:
        policy, observation, train_seed: trained.
        parameters: of the network.
        seconds: of training.
        milliseconds: of processor time a prediction and an action, median of many.
        success, strict_success, safe_success: of the episodes.
        episodes: how many.
    """

    policy: str
    observation: str
    train_seed: int
    parameters: int
    seconds: float
    milliseconds: tuple[float, float]
    success: Proportion
    strict_success: Proportion
    safe_success: Proportion | None
    episodes: int


def run(options: Options, policy: str, observation: str, train_seed: int) -> Row:
    """Train, or continue; evaluate, or continue; and measure."""
    name = f"{policy.lower()}_{observation}_seed{train_seed}"
    folder = options.out / "runs" / name
    words = [*OBSERVATIONS[observation], "--delay", str(options.delay)]
    words += ["--preset", "cpu", "--seed", str(train_seed)]
    words += [] if options.steps is None else ["--steps", str(options.steps)]
    words += ["--dataset", str(options.dataset), "--logger", "none", "--out", str(folder)]
    if train(parse_config([policy, *words]), resume=True):
        raise RequestError(f"the training of '{name}' was interrupted; call again to continue")
    config = EvaluationConfig(
        checkpoint=folder,
        seeds=range(options.seed, options.seed + options.num_episodes),
        out=options.out / "episodes" / name,
        num_envs=options.num_envs,
        workers=options.workers,
    )
    plan, summary, _ = evaluate(config)
    return Row(
        *(policy, observation, train_seed),
        sum(parameter.numel() for parameter in plan.model.parameters()),
        max(line.get("seconds", 0.0) for line in read_metrics(folder / METRICS)),
        time_prediction(plan),
        *(summary.success, summary.strict_success, summary.success_safe, summary.episodes),
    )


def time_prediction(plan: EvaluationPlan, repeats: int = 50) -> tuple[float, float]:
    """Return ms of one thread's processor time: of a prediction, and of the mean action."""
    dims = read_checkpoint(plan.config.checkpoint).dims
    torch.set_num_threads(1)
    policy, env = plan.make_policy(1), np.array([0])
    policy.reset(env, [0])
    execution = plan.execution
    every = 1 if execution.temporal_ensemble else execution.n_action_steps
    times: list[float] = []
    for _ in range(repeats * every):
        begin = time.process_time()
        policy.act(np.zeros((1, dims.state), np.float32), None, env)
        times.append(1e3 * (time.process_time() - begin))
    return float(np.median(times[::every])), float(np.mean(times))


def table(rows: list[Row]) -> str:
    """Return a Markdown table, a row for each training."""
    lines = [
        "| policy | shown | training seed | weights | training, s | a prediction, ms "
        "| an action, ms | success, % | strict success, % | safe success, % |",
        "|---|---|---|---|---|---|---|---|---|---|",
    ]
    for r in rows:
        cells: list[Any] = [r.policy, r.observation, r.train_seed, f"{r.parameters:,}"]
        cells += [f"{r.seconds:.0f}", *(f"{x:.1f}" for x in r.milliseconds)]
        cells += [_percent(share) for share in (r.success, r.strict_success, r.safe_success)]
        lines.append("| " + " | ".join(map(str, cells)) + " |")
    return "\n".join(lines) + "\n"


def _percent(share: Proportion | None) -> str:
    if share is None:
        return "-"
    values = (100.0 * (x or 0.0) for x in (share.rate, share.low, share.high))
    return "{:.0f} ({:.0f} to {:.0f})".format(*values)


def main() -> None:
    """Run the command."""
    options = parse(Options, EXAMPLE)
    prepare_pytorch()
    options.out.mkdir(parents=True, exist_ok=True)
    rows: list[Row] = []
    for train_seed in options.train_seeds:
        for observation in options.observations:
            for policy in options.policies:
                rows.append(run(options, policy, observation, train_seed))
                write_text(options.out / TABLE, table(rows))
    print(f"{table(rows)}\nwritten to {options.out}")


if __name__ == "__main__":
    run_command(main)
