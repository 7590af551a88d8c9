"""What training needs beside the evaluated weights to go on exactly: flat tensors and JSON.

Tensors are named ``weights/NAME`` (only where an average is what is evaluated),
``exp_avg/NAME`` and ``exp_avg_sq/NAME`` (AdamW), and ``metrics`` (sums since the last line of
``metrics.jsonl``); NAME is the parameter's name in the network.
"""

from __future__ import annotations

import contextlib
import dataclasses
import logging
import os
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import safetensors.torch
import torch
from torch import Tensor
from tqdm import tqdm

from robo_manip_baselines.data.demonstrations import Demonstrations
from robo_manip_baselines.policy.checkpoint import MODEL, Checkpoint, read_trainer, write_checkpoint
from robo_manip_baselines.runs.checkpoints import prune_checkpoints, step_folder
from robo_manip_baselines.runs.errors import RequestError
from robo_manip_baselines.runs.metrics import MetricsLog
from robo_manip_baselines.training.batching import BatchLoader
from robo_manip_baselines.training.device import Processes, autocast_type
from robo_manip_baselines.training.images import FrameSource, free_memory
from robo_manip_baselines.training.sampling import StateNoise
from robo_manip_baselines.training.setup import Job
from robo_manip_baselines.training.step import RunningMean, TrainStep
from robo_manip_baselines.training.validation import Validation

_MOMENTS = ("exp_avg", "exp_avg_sq")


@dataclass(frozen=True)
class Progress:
    """How far a run has come.

    Attributes:
        step: optimiser steps done.
        seconds: spent on them, by all processes that took part in turn.
    """

    step: int = 0
    seconds: float = 0.0


def trainer_state(
    train_step: TrainStep, mean: RunningMean, progress: Progress
) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Return what `restore` takes."""
    tensors: dict[str, Tensor] = {}
    if train_step.average:
        tensors |= {f"weights/{k}": v for k, v in train_step.model.state_dict().items()}
    steps: dict[str, int] = {}
    for name, parameter in _trained(train_step):
        if state := train_step.optimizer.state.get(parameter):
            tensors |= {f"{moment}/{name}": state[moment] for moment in _MOMENTS}
            steps[name] = int(state["step"])
    if mean.sums is not None:
        tensors["metrics"] = mean.sums
    # Every trained parameter has made as many steps as the others, unless some get no gradient.
    json = {
        "step": progress.step,
        "seconds": progress.seconds,
        "optimizer_steps": steps,
        "metrics": {"names": list(mean.names), "count": mean.count},
    }
    return tensors, json


@torch.no_grad()
def restore(
    train_step: TrainStep,
    mean: RunningMean,
    model_state: Mapping[str, Tensor],
    tensors: Mapping[str, Tensor],
    json: Mapping[str, Any],
) -> Progress:
    """Put a fresh `TrainStep` where another one was.

    Args:
        train_step: of the same network and settings; changed.
        mean: changed.
        model_state: the checkpoint's evaluated weights.
        tensors: as `trainer_state` gave them.
        json: the same.
    """
    online = model_state
    if train_step.average:
        train_step.average.model.load_state_dict(model_state)
        online = {
            name.removeprefix("weights/"): tensor
            for name, tensor in tensors.items()
            if name.startswith("weights/")
        }
    train_step.model.load_state_dict(online)
    fused = bool(train_step.optimizer.defaults["fused"])
    for name, parameter in _trained(train_step):
        if name not in json["optimizer_steps"]:
            continue
        device = parameter.device if fused else "cpu"
        # In the memory layout of the parameter, as AdamW itself makes them.
        moments = {m: torch.empty_like(parameter).copy_(tensors[f"{m}/{name}"]) for m in _MOMENTS}
        count = torch.tensor(float(json["optimizer_steps"][name]), device=device)
        train_step.optimizer.state[parameter] = {"step": count, **moments}
    mean.names = tuple(json["metrics"]["names"])
    mean.count = json["metrics"]["count"]
    mean.sums = tensors["metrics"].to(train_step.device) if mean.count else None
    return Progress(json["step"], json["seconds"])


def _trained(train_step: TrainStep) -> Iterator[tuple[str, torch.nn.Parameter]]:
    grouped = {id(p) for group in train_step.optimizer.param_groups for p in group["params"]}
    for name, parameter in train_step.model.named_parameters():
        if id(parameter) in grouped:
            yield name, parameter


@dataclass(frozen=True)
class Parts:
    """What a run is carried out with.

    Attributes:
        train_step: the network with its optimiser, where training begins or goes on.
        mean: of the losses since they were last written.
        progress: how far the run has come.
        loader: of the training batches.
        validation: None without episodes held out, and in all processes but the first.
    """

    train_step: TrainStep
    mean: RunningMean
    progress: Progress
    loader: BatchLoader
    validation: Validation | None


@contextmanager
def assembled(
    job: Job, start: Checkpoint | None, device: torch.device, processes: Processes
) -> Iterator[Parts]:
    """Put the parts of a run together; images are held or read while the block lasts.

    Args:
        job: what to train on what.
        start: where to go on from, None to begin.
        device: to train on.
        processes: that train together.

    Raises:
        RequestError: the network cannot be built, the device lacks the precision, or the
            checkpoint has lost what training needs.
    """
    settings, seed = job.options.training, job.options.seed
    autocast = autocast_type(settings.precision, device, bool(job.sizes.cameras))
    model = job.make_model(is_start=start is None).to(device)
    train_step = TrainStep(
        model,
        settings,
        total_steps=job.total_steps,
        seed=seed,
        autocast=autocast,
        processes=processes,
    )
    mean, progress = RunningMean(), Progress()
    if start:
        weights = safetensors.torch.load_file(start.folder / MODEL)
        progress = restore(train_step, mean, weights, *read_trainer(start))
    with _frames(job.demonstrations) as frames:
        loader = BatchLoader(
            job.demonstrations,
            job.normalization,
            job.demonstrations.indices(job.split.train),
            job.schedule,
            chunk_size=model.chunk_size,
            noise_size=model.noise_size,
            state_noise=StateNoise.of(job.demonstrations.spec, settings),
            seed=seed,
            device=device,
            rank=processes.rank,
            world_size=processes.world_size,
            frames=frames,
        )
        validation = None
        if job.split.validation and processes.is_main:
            validation = Validation(
                job.demonstrations,
                job.normalization,
                frames,
                episodes=job.demonstrations.indices(job.split.validation),
                batch_size=settings.batch_size,
                seed=seed,
                model=model,
                device=device,
                autocast=autocast,
            )
        yield Parts(train_step, mean, progress, loader, validation)


def _frames(
    demonstrations: Demonstrations,
) -> contextlib.AbstractContextManager[FrameSource | None]:
    if not demonstrations.spec.cameras:
        return contextlib.nullcontext()
    # Half of what is free is the source's own measure; the processes of one machine share it.
    share = free_memory() // 2 // int(os.environ.get("LOCAL_WORLD_SIZE", "1"))
    return FrameSource(demonstrations, memory_budget=share)


logger = logging.getLogger(__name__)

_STEPS_BETWEEN_VOTES = 10
"""On several GPUs, steps between asking whether any process was told to stop: asking waits."""

KEPT_CHECKPOINTS = 2

_LINES = 10
"""Lines about progress where there is no terminal for a bar."""


@dataclass(frozen=True)
class Outcome:
    """How training ended.

    Attributes:
        step: steps done in all.
        seconds: spent on them in all.
        train: last means of the losses, by name.
        validation: last losses on the episodes held out.
    """

    step: int
    seconds: float
    train: Mapping[str, float]
    validation: Mapping[str, float]


class Trainer:
    """Trains until the budget is spent or somebody asks to stop.

    Args:
        job: what is trained on what.
        parts: what it is trained with.
        log: None in all processes but the first.
        processes: that train together.
        stop: whether to stop after this step.
    """

    def __init__(
        self,
        job: Job,
        parts: Parts,
        *,
        log: MetricsLog | None,
        processes: Processes,
        stop: Callable[[], bool],
    ) -> None:
        options = job.options
        self._train_step = parts.train_step
        self._mean = parts.mean
        self._loader = parts.loader
        self._validation = parts.validation
        self._step = self._saved_step = parts.progress.step
        self._seconds_before = parts.progress.seconds
        self._checkpoint = job.checkpoint()
        self._total_steps = job.total_steps
        self._schedule = job.schedule
        self._run = options.folder
        self._log_every = options.log_every
        self._validate_every = options.validate_every
        self._checkpoint_every = options.checkpoint_every
        self._log = log
        self._processes = processes
        self._stop = stop
        self._train_losses: dict[str, float] = {}
        self._validation_losses: dict[str, float] = {}
        self._start = time.perf_counter()

    def train(self) -> Outcome:
        """Run the loop.

        Raises:
            RequestError: the loss is not finite any more.
        """
        self._start = time.perf_counter()
        bar = tqdm(
            total=self._total_steps,
            initial=self._step,
            unit="step",
            dynamic_ncols=True,
            disable=True if not self._processes.is_main else None,
        )
        batches = self._loader.batches(self._step, self._total_steps)
        with bar, contextlib.closing(batches):
            self._train_step.clock.skip()
            for batch in batches:
                self._mean.add(self._train_step(batch, self._step))
                self._step += 1
                bar.update()
                if self._after_step(bar):
                    break
        return Outcome(self._step, self._seconds(), self._train_losses, self._validation_losses)

    def _after_step(self, bar: tqdm) -> bool:
        """Write what is due; return whether to stop."""
        is_log = self._is_due(self._log_every)
        is_validation = self._is_due(self._validate_every)
        is_stopping = self._is_stopping()
        is_checkpoint = self._is_due(self._checkpoint_every) or is_stopping
        if is_log:
            self._write_losses()
            bar.set_postfix(loss=f"{self._train_losses['loss']:.4g}", refresh=False)
            self._say_progress(bar)
        if is_validation and self._validation:
            self._validation_losses = self._validation(self._train_step.result)
            self._write("validation", self._validation_losses)
        if is_checkpoint:
            self._save()
        if is_log or is_validation or is_checkpoint:
            self._train_step.clock.skip()
        return is_stopping

    def _is_due(self, interval: int) -> bool:
        return self._step % interval == 0 or self._step == self._total_steps

    def _is_stopping(self) -> bool:
        device = self._train_step.device
        alone = self._processes.world_size == 1
        if not alone and device.type == "cuda" and self._step % _STEPS_BETWEEN_VOTES:
            return False
        return self._processes.any(self._stop(), device)

    def _write_losses(self) -> None:
        means = self._processes.mean(self._mean.means()).tolist()  # the one transfer
        self._train_losses = dict(zip(self._mean.names, means, strict=True))
        self._mean.reset()
        loss = self._train_losses["loss"]
        self._require_finite(torch.isfinite(torch.tensor(loss)))
        group = self._train_step.optimizer.param_groups[0]
        phases = {f"seconds_{k}": v for k, v in self._train_step.clock.read().items()}
        more = {"learning_rate": group["lr"], "seconds": self._seconds(), **phases}
        self._write("train", {**self._train_losses, **more})

    def _write(self, kind: str, values: Mapping[str, float]) -> None:
        if self._log:
            epoch = self._schedule.epochs(self._step)
            self._log.write(kind, self._step, {"epoch": epoch, **values})

    def _say_progress(self, bar: tqdm) -> None:
        between = max(self._total_steps // _LINES, 1)
        if bar.disable and self._processes.is_main and self._step % between < self._log_every:
            seconds = self._seconds()
            left = seconds / self._step * (self._total_steps - self._step)
            logger.info(
                "step %d of %d, loss %.4g, %.0f s, %.0f s left",
                self._step,
                self._total_steps,
                self._train_losses["loss"],
                seconds,
                left,
            )
            sys.stderr.flush()

    def _save(self) -> None:
        sums = self._mean.sums
        state = self._train_step.result.state_dict()
        finite = [torch.isfinite(v).all() for v in state.values() if v.is_floating_point()]
        self._require_finite(
            torch.stack(finite + ([] if sums is None else [sums.isfinite().all()]))
        )
        if not self._processes.is_main:
            return
        folder = step_folder(self._run, self._step)
        progress = Progress(self._step, self._seconds())
        tensors, json = trainer_state(self._train_step, self._mean, progress)
        checkpoint = dataclasses.replace(self._checkpoint, step=self._step)
        write_checkpoint(folder, checkpoint, state, tensors, json)
        self._saved_step = self._step
        prune_checkpoints(self._run, KEPT_CHECKPOINTS)

    def _require_finite(self, flags: torch.Tensor) -> None:
        if not self._processes.any(not bool(flags.all()), self._train_step.device):
            return
        kept = f"the checkpoint of step {self._saved_step} is kept" if self._saved_step else ""
        raise RequestError(
            f"the loss is not finite any more at step {self._step}; lower --learning_rate, try "
            f"--clip_norm 1 or --precision fp32{'; ' * bool(kept)}{kept}"
        )

    def _seconds(self) -> float:
        return self._seconds_before + time.perf_counter() - self._start
