"""The loop: batches through `TrainStep`, and what is written on the way."""

from __future__ import annotations

import dataclasses
import logging
import math
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path

from torch import Tensor
from tqdm import tqdm

from face_prediction.models.checkpoint import CheckpointRecord, save_checkpoint
from face_prediction.models.settings import TrainSettings
from face_prediction.training.metrics import MetricsLog, RunningMean
from face_prediction.training.step import Progress, TrainStep, save_state
from face_prediction.training.validation import Validation, selection_error
from face_prediction.training.windows import Sampler, Windows, batches
from robo_manip_baselines.runs.errors import RequestError

logger = logging.getLogger(__name__)

#: Lines about progress where there is no terminal for a bar.
_LINES = 10


@dataclass(frozen=True)
class Pace:
    """How often something is said and saved; nothing that is trained depends on it."""

    log_every: int = 20
    checkpoint_every: int = 200
    progress: bool = True


class Trainer:
    """Trains until all steps are done or somebody asks to stop.

    Args:
        folder: of the run.
        record: what is trained; ``step`` and ``validation`` are filled in.
        settings: of training.
        train_step: with the network.
        windows: to train on.
        sampler: which of them when.
        validation: None: nobody is held out, and the last weights are the result.
        progress: how far the run has come.
        best: weights that did best so far, where somebody is held out.
        pace: how often something is said and saved.
        stop: whether to stop after this step.
    """

    def __init__(
        self,
        folder: Path,
        record: CheckpointRecord,
        settings: TrainSettings,
        train_step: TrainStep,
        windows: Windows,
        sampler: Sampler,
        validation: Validation | None,
        progress: Progress,
        best: dict[str, Tensor],
        pace: Pace,
        stop: Callable[[], bool],
    ) -> None:
        self._folder = folder
        self._record = record
        self._settings = settings
        self._train_step = train_step
        self._windows = windows
        self._sampler = sampler
        self._validation = validation
        self._progress = progress
        self._best = best
        self._pace = pace
        self._stop = stop
        self._mean = RunningMean(progress.names, progress.rows)
        self._saved_step = progress.step
        self._seconds_before = progress.seconds
        self._start = time.perf_counter()

    def train(self) -> None:
        """Run the loop.

        Raises:
            RequestError: a picture is damaged, or the loss is not finite any more.
        """
        self._start = time.perf_counter()
        first, total = self._progress.step, self._settings.steps
        log = MetricsLog(self._folder, first)
        bar = tqdm(
            total=total,
            initial=first,
            unit="step",
            dynamic_ncols=True,
            smoothing=0.0,  # the mean over all steps: looks at the held-out fold are in it
            disable=None if self._pace.progress else True,
        )
        with bar, batches(self._windows, self._sampler, first, total) as following:
            for batch in following:
                self._mean.add(self._train_step(batch, self._progress.step))
                self._progress.step += 1
                bar.update()
                if self._after_step(log, bar):
                    return

    def save(self) -> None:
        """Write the trainer's state, and the network that is the result so far."""
        self._progress.names = list(self._mean.names)
        self._progress.rows = self._mean.rows()
        self._progress.seconds = self._seconds()
        self._require_finite(sum(row[0] for row in self._progress.rows))
        run = run_record(self._record)
        save_state(self._folder, run, self._train_step, self._progress, self._best)
        self._saved_step = self._progress.step
        self.export()

    def export(self) -> None:
        """Write ``model.safetensors`` and ``config.json``, if there is a result yet."""
        if self._validation is None:
            state, step, numbers = (
                self._train_step.result.state_dict(),
                self._progress.step,
                {},
            )
        elif self._progress.best_step is not None:
            state, step, numbers = self._best, self._progress.best_step, self._progress.best
        else:
            return
        record = dataclasses.replace(self._record, step=step, validation=numbers)
        save_checkpoint(self._folder, record, state)

    def _after_step(self, log: MetricsLog, bar: tqdm) -> bool:
        """Write what is due; return whether to stop."""
        step = self._progress.step
        is_stopping = self._stop()
        if self._is_due(self._pace.log_every):
            numbers = self._mean.take()
            self._require_finite(numbers["loss"])
            rate = self._settings.learning_rate_at(step - 1)
            log.write("train", step, {**numbers, "learning_rate": rate, "seconds": self._seconds()})
            bar.set_postfix(loss=f"{numbers['loss']:.4g}", refresh=False)
            self._say_progress(bar, numbers["loss"])
        if self._validation and self._is_due(self._settings.validate_every):
            numbers = self._validation(self._train_step)
            log.write("validation", step, numbers)
            self._keep_best(numbers)
        if self._is_due(self._pace.checkpoint_every) or is_stopping:
            self.save()
        return is_stopping

    def _keep_best(self, numbers: dict[str, float]) -> None:
        self._require_finite(selection_error(numbers))
        progress = self._progress
        if progress.best_step is None or selection_error(numbers) < selection_error(progress.best):
            progress.best_step, progress.best = progress.step, numbers
            state = self._train_step.result.state_dict()
            self._best = {name: tensor.detach().clone() for name, tensor in state.items()}

    def _is_due(self, interval: int) -> bool:
        step = self._progress.step
        return step % interval == 0 or step == self._settings.steps

    def _require_finite(self, number: float) -> None:
        if not math.isfinite(number):
            raise RequestError(
                f"the loss is not finite any more at step {self._progress.step}; lower "
                f"--learning_rate (the state of step {self._saved_step} is kept)"
            )

    def _say_progress(self, bar: tqdm, loss: float) -> None:
        step, total = self._progress.step, self._settings.steps
        between = max(total // _LINES, 1)
        if not (bar.disable and self._pace.progress) or step % between >= self._pace.log_every:
            return
        seconds = self._seconds()
        left = seconds / step * (total - step)
        logger.info(
            "step %d of %d, loss %.4g, %.0f s, %.0f s left", step, total, loss, seconds, left
        )

    def _seconds(self) -> float:
        return self._seconds_before + time.perf_counter() - self._start


def run_record(record: CheckpointRecord) -> dict[str, object]:
    """What must be the same when a run is carried on."""
    run = asdict(record)
    for name in ("step", "validation", "versions"):
        del run[name]
    return run
