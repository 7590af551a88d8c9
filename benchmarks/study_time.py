"""Processor time of a study without images, part by part: trainings, evaluations, and all of it.

Lets a trained policy act through the same episodes several times, trains one of its kind for a few
steps, and prints a Markdown table and the time of a whole study. All of it is the processor time of
one thread, as a work item of a benchmark has.

Other programs on a machine slow a processor down. A repeated call does the same work, so beside the
mean stands the sum of the fastest of each call, and the fastest tenth of training steps: what is
left of the difference to an idle machine is what never pauses.

    python benchmarks/study_time.py --checkpoint runs/current --dataset dataset/feeding

- ``physics``: MuJoCo's steps; ``rest of the environment``: observation, contacts, metrics.
- ``network``: predictions; ``rest of the policy``: normalisation, ensemble.
- ``rest``: recording, requests.
"""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from robo_manip_baselines.commands.train import parse_config
from robo_manip_baselines.rollout.evaluation import FIRST_SEED, EvaluationConfig, EvaluationPlan
from robo_manip_baselines.rollout.workers import LocalEnvs
from robo_manip_baselines.runs.command import parse, run_command
from robo_manip_baselines.runs.ranges import Count, Episodes
from robo_manip_baselines.training.requirements import prepare_pytorch

prepare_pytorch()  # before PyTorch is imported: how its threads wait

import torch  # noqa: E402

from robo_manip_baselines.policy.execution import PolicyRunner  # noqa: E402
from robo_manip_baselines.training.device import PHASES, Processes, StepTimer  # noqa: E402
from robo_manip_baselines.training.setup import TrainSetup  # noqa: E402
from robo_manip_baselines.training.step import TrainingStep  # noqa: E402
from robo_manip_baselines.training.trainer import Trainer  # noqa: E402

Parts = dict[str, list[float]]
"""Part -> s in the mean, and s of the fastest calls."""

WARM_UP = 3
"""Steps of training before the clock runs."""

SHARE = 10.0
"""% of training steps that count as the fastest."""

START = """
from robo_manip_baselines.rollout import evaluation
from robo_manip_baselines.policy import execution
from robo_manip_baselines.benchmark import worker
import time
print(time.process_time())
"""
"""What every work item imports first."""


@dataclass(frozen=True)
class Options:
    """Measure the parts of a study, and add them up.

    Attributes:
        checkpoint: Trained policy without images.
        dataset: Demonstrations for the steps of training.
        episodes: Episodes in which the policy acts.
        repeats: How often it does.
        train_steps: Steps of training.
        num_envs: Episodes that run at once.
        trainings: Trainings of the study (12 conditions, 5 seeds).
        num_episodes: Evaluation episodes of each training.
        episode_block: Episodes of a work item.
    """

    checkpoint: Path
    dataset: Path
    episodes: Episodes = 8
    repeats: Count = 3
    train_steps: Count = 60
    num_envs: Count = 8
    trainings: Count = 60
    num_episodes: Episodes = 200
    episode_block: Episodes = 50


class Meter:
    """Times calls of functions by name, in the order of the calls."""

    def __init__(self) -> None:
        self.seconds: dict[str, list[float]] = {}

    def watch(self, owner: Any, name: str) -> None:
        """Replace a function of a class or module by one that is timed."""
        inner: Callable[..., Any] = getattr(owner, name)
        times = self.seconds.setdefault(name, [])

        def timed(*args: Any, **kwargs: Any) -> Any:
            begin = time.process_time()
            try:
                return inner(*args, **kwargs)
            finally:
                times.append(time.process_time() - begin)

        setattr(owner, name, timed)


class Clock(StepTimer):
    """Processor time at the end of each phase of a step.

    Attributes:
        marks: s, first the beginning of the step.
    """

    marks: list[float]

    def mark(self, phase: str) -> None:
        """Mark the end of a phase."""
        self.marks.append(time.process_time())


def time_evaluation(options: Options) -> tuple[Parts, float]:
    """Return s of each part a control step, mean and fastest, and the steps of an episode."""
    meter = Meter()
    meter.watch(mujoco, "mj_step")
    meter.watch(LocalEnvs, "submit")
    meter.watch(PolicyRunner, "act")
    meter.watch(PolicyRunner, "_forward")
    seeds = range(FIRST_SEED, FIRST_SEED + options.episodes)
    config = EvaluationConfig(
        options.checkpoint, seeds, num_envs=options.num_envs, workers=0, device="cpu"
    )
    plan, totals, steps = EvaluationPlan.of(config), list[float](), list[int]()
    runs: list[dict[str, np.ndarray[Any, Any]]] = []
    for _ in range(options.repeats):
        for times in meter.seconds.values():
            times.clear()
        begin = time.process_time()
        steps.clear()
        plan.run(seeds, lambda result, recording: steps.append(result.steps))
        totals.append(time.process_time() - begin)
        runs.append({name: np.array(times) for name, times in meter.seconds.items()})
    calls = {name: np.stack([run[name] for run in runs]) for name in runs[0]}
    rest = np.array(totals) - sum(calls[name].sum(axis=1) for name in ("submit", "act"))
    parts: dict[str, list[float]] = {}
    for best in (np.mean, np.min):
        own = {name: float(best(times, axis=0).sum()) for name, times in calls.items()}
        values = {
            "physics": own["mj_step"],
            "rest of the environment": own["submit"] - own["mj_step"],
            "network": own["_forward"],
            "rest of the policy": own["act"] - own["_forward"],
            "rest": float(best(rest)),
        }
        for name, seconds in values.items():
            parts.setdefault(name, []).append(seconds / sum(steps))
    return parts, sum(steps) / options.episodes


def time_training(options: Options) -> tuple[Parts, int, float]:
    """Return s of each part of a step, mean and fastest, the steps, and s of the start."""
    plan = EvaluationPlan.of(EvaluationConfig(options.checkpoint, range(1), device="cpu"))
    words = [plan.checkpoint.policy, "--preset", "cpu", "--dataset", str(options.dataset)]
    config = parse_config([*words, "--logger", "none", "--device", "cpu"])
    config = replace(config, spec=plan.checkpoint.spec)
    begin = time.process_time()
    setup, device = TrainSetup.load(config), torch.device("cpu")
    trainer = Trainer(setup, None, device, Processes())
    start = time.process_time() - begin
    state, clock = trainer.state, Clock(device)
    loss, clip_norm = state.model.loss, config.training.clip_norm
    compute = TrainingStep(loss, state, autocast=None, clip_norm=clip_norm, timer=clock)
    state.model.train()
    rows: list[list[float]] = []
    for step in range(WARM_UP + options.train_steps):
        clock.marks = [time.process_time()]
        batch = trainer.loader.batch(step)
        clock.mark("data")
        compute(batch)
        if state.average:
            state.average.update(step)
        clock.mark("optimizer")
        rows.append(np.diff(clock.marks).tolist())
    times = np.array(rows[WARM_UP:])
    both = np.stack([times.mean(axis=0), np.percentile(times, SHARE, axis=0)], axis=1)
    parts: Parts = dict(zip(PHASES, both.tolist(), strict=True))
    return parts, setup.total_steps, start


def time_start() -> float:
    """Return s until a work item has imported what it needs."""
    command = [sys.executable, "-c", START]
    done = subprocess.run(command, check=True, capture_output=True, text=True)
    return float(done.stdout)


def table(title: str, parts: Parts) -> str:
    """Return a Markdown table of parts in ms, and their sum."""
    lines = [f"| {title} | ms | % | ms, fastest | % |", "|---|--:|--:|--:|--:|"]
    mean, least = (sum(values) for values in zip(*parts.values(), strict=True))
    for name, (one, other) in [*parts.items(), ("all", [mean, least])]:
        shares = 100.0 * one / mean, 100.0 * other / least
        lines.append(
            f"| {name} | {1e3 * one:.3f} | {shares[0]:.0f} | {1e3 * other:.3f} | {shares[1]:.0f} |"
        )
    return "\n".join(lines) + "\n"


def main() -> None:
    """Measure and print."""
    options = parse(
        Options,
        "python benchmarks/study_time.py --checkpoint runs/current --dataset dataset/feeding",
    )
    torch.set_num_threads(1)
    start = time_start()
    training, train_steps, load = time_training(options)
    acting, length = time_evaluation(options)
    print(table("a control step", acting))
    print(table("a step of training", training))
    items = -(-options.num_episodes // options.episode_block)
    print(f"| {options.trainings} times | s | s, fastest |\n|---|--:|--:|")
    rows = []
    for kind in (0, 1):
        one = train_steps * sum(values[kind] for values in training.values()) + load + start
        own = length * options.num_episodes * sum(values[kind] for values in acting.values())
        rows.append((one, own, items * start))
    names = (
        f"a training of {train_steps} steps, with its start",
        f"{options.num_episodes} episodes of {length:.0f} control steps",
        f"starts of their {items} work items",
    )
    for name, *values in zip(names, *rows, strict=True):
        print(f"| {name} | {values[0]:.0f} | {values[1]:.0f} |")
    sums = [sum(row) for row in rows]
    hours = [options.trainings * value / 3600.0 for value in sums]
    print(f"| all | {sums[0]:.0f} | {sums[1]:.0f} |")
    print(f"\nThe study: {hours[0]:.1f} hours of a core; by the fastest calls {hours[1]:.1f}")


if __name__ == "__main__":
    run_command(main)
