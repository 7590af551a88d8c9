"""The loop: batches through `TrainStep`, and what is written on the way."""

from __future__ import annotations

import contextlib
import dataclasses
import logging
import sys
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import torch
from tqdm import tqdm

from robo_manip_baselines.errors import RequestError
from robo_manip_baselines.policy.checkpoint import write_checkpoint
from robo_manip_baselines.policy.checkpoint_files import step_folder
from robo_manip_baselines.training.distributed import Processes
from robo_manip_baselines.training.job import Job
from robo_manip_baselines.training.metrics import MetricsLog
from robo_manip_baselines.training.parts import Parts
from robo_manip_baselines.training.run_folder import prune
from robo_manip_baselines.training.trainer_state import Progress, trainer_state

logger = logging.getLogger(__name__)

_STEPS_BETWEEN_VOTES = 10
"""On several GPUs, steps between asking whether any process was told to stop: asking waits."""

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
        prune(self._run)

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
