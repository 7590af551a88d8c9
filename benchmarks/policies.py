"""Policies compared on the same demonstrations: success, time per action, time of training.

Trains every policy on each observation and training seed, evaluates it on common seeds, and writes
``policies.md``: a table over training seeds, with the differences from the first policy, and one of
single trainings. A call that was stopped goes on where it was, and calls for some of the policies
or training seeds add to one folder; other settings need another ``--out``:

    python benchmarks/policies.py --dataset dataset/dyskinetic --train_seeds 0 1 --num_episodes 100
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from robo_manip_baselines.benchmark.statistics.inference import paired_success, rate_estimate
from robo_manip_baselines.benchmark.statistics.outcomes import (
    OutcomeMatrix,
    ResultRow,
    on_common_seeds,
    outcome_matrix,
)
from robo_manip_baselines.commands.train import parse_config
from robo_manip_baselines.policy.presets import ActionExecution, PolicyDims
from robo_manip_baselines.rollout.evaluation import (
    FIRST_SEED,
    EvaluationConfig,
    evaluate,
)
from robo_manip_baselines.rollout.results import MANIFEST, SCHEMA, Proportion, read_results
from robo_manip_baselines.rollout.rollout import ActingPolicy
from robo_manip_baselines.runs.command import parse, run_command
from robo_manip_baselines.runs.documents import convert, parse_json, read_json
from robo_manip_baselines.runs.errors import RequestError, require_choice
from robo_manip_baselines.runs.files import write_json, write_text
from robo_manip_baselines.runs.markdown import markdown_table
from robo_manip_baselines.runs.ranges import Count, Episodes, NonNegativeInt, Processes, Seed
from robo_manip_baselines.training.config import (
    CONFIG,
    TrainConfig,
    read_config,
    require_same_config,
)
from robo_manip_baselines.training.requirements import prepare_pytorch

prepare_pytorch()  # before PyTorch is imported: how its threads wait

import torch  # noqa: E402

from robo_manip_baselines.policy.execution import PolicyRunner  # noqa: E402
from robo_manip_baselines.training.batching import BatchLoader  # noqa: E402
from robo_manip_baselines.training.device import StepTimer  # noqa: E402
from robo_manip_baselines.training.setup import TrainSetup  # noqa: E402
from robo_manip_baselines.training.state import TrainerState  # noqa: E402
from robo_manip_baselines.training.step import TrainingStep  # noqa: E402
from robo_manip_baselines.training.trainer import train  # noqa: E402

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

RATES = ("success, %", "strict success, %", "safe success, %")
"""Columns of a table."""

TABLE, TIMES = "policies.md", "times.md"
EPISODES, ROWS = "episodes", "rows"

TIMED_STEPS = 20
"""Steps of training whose processor time is measured; the median counts."""

TIMED_PREDICTIONS = 50
"""Predictions whose processor time is measured."""

TIMED_EPISODES = 4
"""Demonstrations that are read to measure times alone."""


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
        num_episodes: Episodes of each evaluation; where the folder has more, all of them count.
        seed: Seed of the first episode.
        num_envs: Episodes that run at once; results do not depend on it.
        workers: Processes in which environments step.
        only_times: Only measure processor times, on the first demonstrations and untrained
            networks: half a minute for all policies.
        out: Folder of runs, results and tables.
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
    only_times: bool = False
    out: Path = Path("results/policies")

    def __post_init__(self) -> None:
        for policy in self.policies:
            require_choice("policy", policy, POLICIES)
        for observation in self.observations:
            require_choice("observation", observation, OBSERVATIONS)


@dataclass(frozen=True)
class Row:
    """One training and its evaluation.

    Attributes:
        policy, observation, train_seed: trained.
        parameters: of the network.
        seconds: of one thread's processor time, for all steps of the training.
        milliseconds: of processor time a prediction and an action, median of many.
        success, strict_success, safe_success: of the episodes.
        episodes: how many.
        seed: of the first; None in rows of earlier versions, which are measured again.
    """

    policy: str
    observation: str
    train_seed: Seed
    parameters: Count
    seconds: float
    milliseconds: tuple[float, float]
    success: Proportion
    strict_success: Proportion
    safe_success: Proportion | None
    episodes: Count
    seed: Seed | None = None

    @property
    def name(self) -> str:
        """Name of its folders and files."""
        return run_name(self.policy, self.observation, self.train_seed)


def run_name(policy: str, observation: str, train_seed: int) -> str:
    """Return the name of a training."""
    return f"{policy.lower()}_{observation}_seed{train_seed}"


def configure(options: Options, policy: str, observation: str, train_seed: int) -> TrainConfig[Any]:
    """Return the configuration of a training."""
    folder = options.out / "runs" / run_name(policy, observation, train_seed)
    words = [*OBSERVATIONS[observation], "--delay", str(options.delay)]
    words += ["--preset", "cpu", "--seed", str(train_seed)]
    words += [] if options.steps is None else ["--steps", str(options.steps)]
    words += ["--dataset", str(options.dataset), "--logger", "none", "--out", str(folder)]
    return parse_config([policy, *words])


def run(options: Options, policy: str, observation: str, train_seed: int) -> Row:
    """Train, or continue; evaluate, or continue; and measure; or read what is done.

    Raises:
        RequestError: the folder holds a run or episodes of other settings, or something was
            interrupted.
    """
    name = run_name(policy, observation, train_seed)
    config = configure(options, policy, observation, train_seed)
    file, episodes = options.out / ROWS / f"{name}.json", options.out / EPISODES / name
    if file.is_file() or (episodes / MANIFEST).is_file():  # before, more steps extend the training
        require_same_run(config)
    if file.is_file():
        done = read_row(file)
        if done.seed == options.seed and done.episodes >= options.num_episodes:
            return done
    require_same_seed(episodes, options.seed)
    if train(config, resume=True):
        raise RequestError(f"the training of '{name}' was interrupted; call again to continue")
    evaluation = EvaluationConfig(
        checkpoint=config.folder,
        seeds=range(options.seed, options.seed + options.num_episodes),
        out=episodes,
        num_envs=options.num_envs,
        workers=options.workers,
    )
    plan, summary, _ = evaluate(evaluation)
    if summary.episodes < options.num_episodes:
        raise RequestError(f"the evaluation of '{name}' was interrupted; call again to continue")
    row = Row(
        *(policy, observation, train_seed),
        sum(parameter.numel() for parameter in plan.model.parameters()),
        time_training(TrainSetup.load(config)),
        time_prediction(plan.make_policy(1), plan.execution, plan.checkpoint.dims),
        *(summary.success, summary.strict_success, summary.success_safe, summary.episodes),
        seed=options.seed,
    )
    file.parent.mkdir(parents=True, exist_ok=True)
    write_json(file, asdict(row))
    return row


def require_same_run(config: TrainConfig[Any]) -> None:
    """Make sure that a run, if it is there, has these options and these demonstrations.

    Raises:
        RequestError: naming what differs.
    """
    run = config.folder
    if not (run / CONFIG).is_file():
        return
    try:
        require_same_config(run, config)
    except RequestError as error:  # this command has no --resume
        raise RequestError(str(error).replace("--resume extends it, ", "")) from error
    if read_config(run / CONFIG).get("dataset") != config.to_json()["dataset"]:
        TrainSetup.load(config).find_start(resume=True)  # compares what the folders hold


def require_same_delay(out: Path, delay: int) -> None:
    """Make sure that the runs that are there, which have rows in the same table, have this delay.

    Raises:
        RequestError: one has another.
    """
    for path in sorted((out / "runs").glob(f"*/{CONFIG}")):
        if (theirs := read_config(path).get("delay", 0)) != delay:
            raise RequestError(
                f"'{path.parent}' has delay {theirs}, not {delay}; choose another --out, or give "
                "the same --delay"
            )


def require_same_seed(episodes: Path, seed: int) -> None:
    """Make sure that an evaluation, if it is there, begins with this seed.

    Raises:
        RequestError: it begins with another.
    """
    if not (episodes / MANIFEST).is_file():
        return
    first = read_json(episodes / MANIFEST, schema=SCHEMA).get("first_seed", seed)
    if first != seed:
        raise RequestError(
            f"'{episodes}' holds episodes from seed {first} on, not {seed}; choose another --out, "
            "or give the same --seed"
        )


def read_row(file: Path) -> Row:
    """Read a row that `run` wrote.

    Raises:
        RequestError: the file is damaged.
    """
    return convert(parse_json(file.read_text("utf-8"), f"'{file}'"), Row, f"'{file}'")


def time_training(setup: TrainSetup) -> float:
    """Return s of one thread's processor time of a training, from the median of a few steps."""
    torch.set_num_threads(1)
    config, device = setup.config, torch.device("cpu")
    state = TrainerState(setup.make_model(), config.training)
    step = TrainingStep(
        *(state.model.loss, state),
        autocast=None,
        clip_norm=config.training.clip_norm,
        timer=StepTimer(device),
    )
    episodes = setup.demonstrations.indices(setup.split.train)
    loader = BatchLoader(
        *(setup.demonstrations, setup.normalization, episodes, setup.sampler, state.model),
        seed=config.seed,
        device=device,
        encoding=setup.encoding,
        skip=config.training.skip,
    )
    times: list[float] = []
    for number in range(TIMED_STEPS):
        begin = time.process_time()
        step(loader.batch(number))
        if state.average:
            state.average.update(number)
        times.append(time.process_time() - begin)
    return statistics.median(times) * setup.total_steps


def time_prediction(
    policy: ActingPolicy, execution: ActionExecution, dims: PolicyDims
) -> tuple[float, float]:
    """Return ms of one thread's processor time: of a prediction, and of the mean action."""
    torch.set_num_threads(1)
    env = np.array([0])
    policy.reset(env, [0])
    every = 1 if execution.temporal_ensemble else execution.n_action_steps
    times: list[float] = []
    for _ in range(TIMED_PREDICTIONS * every):
        begin = time.process_time()
        policy.act(np.zeros((1, dims.state), np.float32), None, env)
        times.append(1e3 * (time.process_time() - begin))
    return float(np.median(times[::every])), float(np.mean(times))


def times_table(options: Options) -> str:
    """Measure processor times without any training; return a Markdown table."""
    head = ["policy", "observation", "weights", "steps", "a step of training, ms", "training, s"]
    head += ["a prediction, ms", "an action, ms"]
    rows = []
    for observation in options.observations:
        for policy in options.policies:
            config = configure(options, policy, observation, options.train_seeds[0])
            setup = TrainSetup.load(replace(config, num_episodes=TIMED_EPISODES))
            model, seconds = setup.make_model(), time_training(setup)
            runner = PolicyRunner(
                *(model, setup.demonstrations.spec, setup.normalization, config.execution),
                encoding=setup.encoding,
                skip=config.training.skip,
                num_envs=1,
            )
            prediction, action = time_prediction(runner, config.execution, setup.dims)
            weights = sum(parameter.numel() for parameter in model.parameters())
            cells = [policy, observation, f"{weights:,}", str(setup.total_steps)]
            cells += [f"{1e3 * seconds / setup.total_steps:.1f}", f"{seconds:.0f}"]
            cells += [f"{prediction:.1f}", f"{action:.1f}"]
            rows.append(cells)
    return markdown_table(head, rows) + "\n"


def trainings_table(rows: Sequence[Row]) -> str:
    """Return a Markdown table, a row for each training."""
    head = ["policy", "observation", "training seed", "episodes", *RATES]
    cells = (
        [r.policy, r.observation, r.train_seed, r.episodes]
        + [_percent(share) for share in (r.success, r.strict_success, r.safe_success)]
        for r in rows
    )
    return markdown_table(head, cells) + "\n"


def policies_table(rows: Sequence[Row], outcomes: dict[str, OutcomeMatrix]) -> str:
    """Return a Markdown table, a row for each policy and observation, over training seeds.

    Args:
        rows: of all trainings.
        outcomes: of ``POLICY shown OBSERVATION``; each is compared with the first of them on the
            seeds that both have.
    """
    head = ["policy", "observation", "trainings", "episodes of each", *RATES]
    head += ["success less that of the first, points", "p", "weights"]
    head += ["training, s", "a prediction, ms", "an action, ms"]
    lines = []
    first = next(iter(outcomes), None)
    for name, own in outcomes.items():
        policy, _, observation = name.partition(" shown ")
        of_it = [r for r in rows if (r.policy, r.observation) == (policy, observation)]
        rates = [
            _percent(rate_estimate(grid, np.random.default_rng(0)))
            for grid in (own.success, own.strict, own.safe)
        ]
        difference = ["", ""]
        if first is not None and name != first:
            theirs, ours = on_common_seeds([outcomes[first], own], "success")
            found = paired_success(ours, theirs, np.random.default_rng(0))
            ends = (found.difference.mean, found.difference.low, found.difference.high)
            points = ["-" if x is None else f"{100.0 * x:+.0f}" for x in ends]
            difference = [
                "{} ({} to {})".format(*points),
                "-" if found.p is None else f"{found.p:.2g}",
            ]
        times = zip(*((r.seconds, *r.milliseconds) for r in of_it), strict=True)
        training, prediction, action = (statistics.median(values) for values in times)
        cells = [policy, observation, str(len(of_it)), f"{len(own.seeds)}", *rates, *difference]
        cells += [f"{of_it[0].parameters:,}", f"{training:.0f}"]
        cells += [f"{prediction:.1f}", f"{action:.1f}"]
        lines.append(cells)
    return markdown_table(head, lines) + "\n"


def page(out: Path) -> str:
    """Return both tables of everything that a folder holds."""
    rows = [read_row(file) for file in sorted((out / ROWS).glob("*.json"))]
    order = list(OBSERVATIONS)
    rows.sort(key=lambda r: (order.index(r.observation), POLICIES.index(r.policy), r.train_seed))
    outcomes: dict[str, OutcomeMatrix] = {}
    for r in rows:
        alike = [x for x in rows if (x.policy, x.observation) == (r.policy, r.observation)]
        fewest = min(x.episodes for x in alike)
        results = [
            ResultRow(x.name, number, result)
            for x in alike
            for number, result in enumerate(read_results(out / EPISODES / x.name)[:fewest], start=1)
        ]
        outcomes[f"{r.policy} shown {r.observation}"] = outcome_matrix(results)
    return f"{policies_table(rows, outcomes)}\nEach training:\n\n{trainings_table(rows)}"


def _percent(share: Proportion | None) -> str:
    if share is None or share.rate is None:
        return "-"
    values = (100.0 * (x or 0.0) for x in (share.rate, share.low, share.high))
    return "{:.0f} ({:.0f} to {:.0f})".format(*values)


def main() -> None:
    """Run the command."""
    options = parse(Options, EXAMPLE)
    options.out.mkdir(parents=True, exist_ok=True)
    if options.only_times:
        write_text(options.out / TIMES, times_table(options))
        print((options.out / TIMES).read_text("utf-8"))
        return
    require_same_delay(options.out, options.delay)
    for train_seed in options.train_seeds:
        for observation in options.observations:
            for policy in options.policies:
                run(options, policy, observation, train_seed)
                write_text(options.out / TABLE, page(options.out))
    print(f"{page(options.out)}\nwritten to {options.out}")


if __name__ == "__main__":
    run_command(main)
