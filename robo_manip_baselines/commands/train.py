"""``bin/Train.py``: what it does and says."""

from __future__ import annotations

import contextlib
import logging
import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch

from robo_manip_baselines.policy.checkpoint import Checkpoint, read_checkpoint
from robo_manip_baselines.runs.checkpoints import list_checkpoints, remove_partial_checkpoints
from robo_manip_baselines.runs.command import EXIT_INTERRUPTED
from robo_manip_baselines.runs.errors import RequestError
from robo_manip_baselines.runs.files import locked
from robo_manip_baselines.runs.interrupt import StopRequest
from robo_manip_baselines.runs.metrics import MetricsLog, open_board, read_metrics, write_curves
from robo_manip_baselines.training.device import (
    Processes,
    choose_device,
    describe_device,
    prepare_device,
)
from robo_manip_baselines.training.options import FREE, TrainOptions, parse_options
from robo_manip_baselines.training.requirements import prepare_pytorch
from robo_manip_baselines.training.run_folder import (
    CONFIG,
    CURVES,
    METRICS,
    require_same_config,
    start_anew,
    write_config,
)
from robo_manip_baselines.training.setup import Job
from robo_manip_baselines.training.trainer import Outcome, Parts, Trainer, assembled

logger = logging.getLogger(__name__)


def train(args: Sequence[str]) -> int:
    """Train what a command line asks for, then print a table and the next command.

    Returns:
        The exit code: 0, or 130 after an interruption whose state is saved.

    Raises:
        RequestError: the request cannot be met.
    """
    processes = Processes.from_environment()
    if not processes.is_main:
        logging.getLogger().setLevel(logging.WARNING)
    options = parse_options(args, torch.cuda.is_available())
    device = choose_device(options.device, processes.local_rank)
    prepare_device(device, options.training.compile)
    with processes.joined(device):
        # A function of its own: nothing of it must outlive the block and hold on to the processes.
        return _train(options, device, processes)


def _train(options: TrainOptions[Any], device: torch.device, processes: Processes) -> int:
    run = options.folder
    with contextlib.ExitStack() as stack:
        job = Job.of(options)
        if processes.is_main:
            stack.enter_context(locked(run))
        start = resume_point(options, job)
        if start and start.step >= job.total_steps:
            logger.info("%s is finished: %d steps", run, start.step)
            if processes.is_main:
                _finish(options)
            return 0
        processes.wait()  # until every process has seen the folder as it was
        log = stack.enter_context(_open_log(options, start)) if processes.is_main else None
        parts = stack.enter_context(assembled(job, start, device, processes))
        _announce(job, parts, processes)
        stop = StopRequest(once_more=processes.world_size == 1)
        trainer = Trainer(job, parts, log=log, processes=processes, stop=lambda: stop.is_made)
        with stop:
            outcome = trainer.train()
        if not processes.is_main:
            return 0 if outcome.step == job.total_steps else EXIT_INTERRUPTED
        if outcome.step < job.total_steps:
            logger.info("stopped at step %d; go on with: %s", outcome.step, resume_line(options))
            return EXIT_INTERRUPTED
        print(table(outcome, start.step if start else 0, run))  # noqa: T201
        _finish(options)
    return 0


def resume_point(options: TrainOptions[Any], job: Job) -> Checkpoint | None:
    """Return the checkpoint that training goes on from, None to begin.

    Raises:
        RequestError: the run folder holds another run, or this one without ``--resume``; or the
            demonstrations have changed since.
    """
    run = options.folder
    if not list_checkpoints(run):
        return None
    require_same_config(run, options.to_config(), FREE)
    checkpoint = read_checkpoint(run)
    if not options.resume:
        done = checkpoint.step >= job.total_steps
        raise RequestError(
            f"'{run}' holds this run, {'finished' if done else f'at step {checkpoint.step}'}; "
            + ("choose another --out or --seed" if done else "--resume continues it")
        )
    if checkpoint.dataset["content_hash"] != job.demonstrations.content_hash:
        raise RequestError(
            f"the demonstrations in '{options.demonstrations}' are not the ones that '{run}' was "
            "trained on; give those with --dataset, or choose another --out"
        )
    if checkpoint.spec != job.demonstrations.spec:
        raise RequestError(
            f"the error statistics are not the ones that '{run}' was trained with; give those with "
            "--error_stats, or choose another --out"
        )
    return checkpoint


def resume_line(options: TrainOptions[Any]) -> str:
    """Return the command that goes on with a run."""
    return f"python bin/Train.py {options.policy} --out {shlex.quote(str(options.folder))} --resume"


def rollout_line(options: TrainOptions[Any]) -> str:
    """Return the command that evaluates a run."""
    return (
        f"python bin/Rollout.py {options.env} --policy {options.policy} "
        f"--checkpoint {shlex.quote(str(options.folder))}"
    )


def table(outcome: Outcome, first_step: int, run: Path) -> str:
    """Lay out the closing table."""
    rows = {
        "steps": str(outcome.step) + (f" ({first_step} of them before)" if first_step else ""),
        "time": f"{outcome.seconds:.1f} s",
        "speed": f"{outcome.step / max(outcome.seconds, 1e-9):.1f} steps/s",
        "training": _losses(outcome.train),
        "held out": _losses(outcome.validation),
        "written to": str(run),
    }
    width = max(map(len, rows))
    return "\n".join(f"{name:<{width}}  {value}" for name, value in rows.items())


def _losses(losses: Any) -> str:
    return ", ".join(f"{name} {value:.4g}" for name, value in losses.items()) or "-"


def _finish(options: TrainOptions[Any]) -> None:
    """Draw the curves and say what comes next."""
    run = options.folder
    if write_curves(run / CURVES, read_metrics(run / METRICS), run.resolve().name):
        logger.info("curves: %s", run / CURVES)
    else:
        logger.info("no picture of the curves: pip install matplotlib")
    print(f"next: {rollout_line(options)}")  # noqa: T201


def _open_log(options: TrainOptions[Any], start: Checkpoint | None) -> MetricsLog:
    """Prepare the run folder and open what is written on the way."""
    run = options.folder
    remove_partial_checkpoints(run)
    if start is None:
        start_anew(run)
        write_config(run, options.to_config())
    elif not (run / CONFIG).is_file():
        raise RequestError(f"'{run}' has lost its {CONFIG}; choose another --out")
    step = start.step if start else 0
    board = open_board(options.logger, run, step, options.to_config())
    return MetricsLog(run / METRICS, step, board)


def _announce(job: Job, parts: Parts, processes: Processes) -> None:
    options, schedule, model = job.options, job.schedule, parts.train_step.model
    by_episode = options.training.sampler == "episode"
    lines = {
        "preset": f"{options.preset}, seed {options.seed}",
        "run folder": str(options.folder),
        "episodes": f"{len(job.split.train)} to train on, {len(job.split.validation)} held out",
        "budget": f"{schedule.epochs(job.total_steps):.4g} epochs x "
        f"{schedule.frames_per_epoch} {'starts' if by_episode else 'frames'} = {job.total_steps} "
        f"steps of {options.training.batch_size} = {job.total_frames} frames",
        "device": describe_device(parts.train_step.device)
        + (f", {processes.world_size} processes" if processes.world_size > 1 else "")
        + f", precision {'bf16' if parts.train_step.autocast else 'fp32'}",
        options.policy: f"{sum(p.numel() for p in model.parameters()):,} weights, "
        f"{sum(p.numel() for p in model.parameters() if p.requires_grad):,} trained",
    }
    for name, text in lines.items():
        logger.info("%s: %s", name, text)


def main(args: Sequence[str]) -> int:
    """Run ``bin/Train.py``."""
    prepare_pytorch()
    return train(args)
