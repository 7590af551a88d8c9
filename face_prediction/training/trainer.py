"""The training loop, and the state that it saves to go on exactly.

``trainer.safetensors`` holds ``weights/NAME``, ``average/NAME`` (with a moving average),
``best/NAME`` (once a held-out fold has chosen), Adam's moments ``adam/NAME/...``, and a record:
what is trained, and `TrainerProgress`.
"""

from __future__ import annotations

import contextlib
import copy
import logging
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from face_prediction.models.checkpoint import (
    CheckpointRecord,
    load_tensors,
    read_tensors,
    require_kind,
    save_predictor_checkpoint,
    write_tensors,
)
from face_prediction.models.interface import PredictorModel
from face_prediction.models.settings import PredictorTrainSettings
from face_prediction.training.options import FaceTrainOptions
from face_prediction.training.validation import HeldOutLoss, selection_error
from face_prediction.training.windows import SequenceWindows, augment, window_batches
from robo_manip_baselines.runs.errors import RequestError
from robo_manip_baselines.runs.interrupt import StopRequest
from robo_manip_baselines.runs.metrics import MetricsLog
from robo_manip_baselines.runs.progress import StepProgress
from robo_manip_baselines.runs.seeds import stream_generator

KIND = {"schema": "face_trainer", "version": 1}
TRAINER_FILE = "trainer.safetensors"
METRICS_FILE = "metrics.jsonl"

logger = logging.getLogger(__name__)


@dataclass
class TrainerProgress:
    """How far a run has come.

    Attributes:
        step: optimizer steps done.
        seconds: spent on them, by all processes in turn.
        names: of the numbers of a step.
        rows: numbers of the steps since the last line of ``metrics.jsonl``.
        best_step: step whose weights did best on the held-out fold.
        best: their losses and errors on it.
    """

    step: int = 0
    seconds: float = 0.0
    names: list[str] = field(default_factory=list)
    rows: list[list[float]] = field(default_factory=list)
    best_step: int | None = None
    best: dict[str, float] = field(default_factory=dict)


class StepMeans:
    """Means over steps of numbers that stay on the device until they are needed.

    Args:
        names: of the numbers.
        rows: of earlier steps, as `rows` gave them.
    """

    def __init__(self, names: Sequence[str] = (), rows: Sequence[Sequence[float]] = ()) -> None:
        self.names = list(names)
        self._rows = [list(row) for row in rows]
        self._pending: list[Tensor] = []

    def add(self, numbers: Mapping[str, Tensor]) -> None:
        """Add the numbers of a step."""
        self.names = list(numbers)
        self._pending.append(torch.stack([value.detach().double() for value in numbers.values()]))

    def rows(self) -> list[list[float]]:
        """Return the numbers of every step since the last `take`."""
        if self._pending:
            self._rows += torch.stack(self._pending).tolist()
            self._pending.clear()
        return self._rows

    def take(self) -> dict[str, float]:
        """Return the means by name, and begin new ones."""
        columns, self._rows = list(zip(*self.rows(), strict=True)), []
        return {n: math.fsum(c) / len(c) for n, c in zip(self.names, columns, strict=True)}


class PredictorTrainer:
    """Trains a network until all steps are done or a stop is requested.

    Args:
        options: of the command.
        settings: of training.
        record: what is trained on what; ``step`` and ``validation`` are filled in.
        model: on its device, prepared.
        windows: to train on.
        validation: on the held-out fold; None: nobody is held out, and the last weights are kept.

    Attributes:
        average: network with the moving average of the weights, or None.
        progress: how far the run has come.
    """

    def __init__(
        self,
        options: FaceTrainOptions,
        settings: PredictorTrainSettings,
        record: CheckpointRecord,
        model: PredictorModel,
        windows: SequenceWindows,
        validation: HeldOutLoss | None,
    ) -> None:
        self.average = copy.deepcopy(model).eval() if settings.ema_decay else None
        self.progress = TrainerProgress()
        self._options, self._settings, self._record = options, settings, record
        self._model, self._windows, self._validation = model, windows, validation
        self._optimizer = torch.optim.Adam(model.parameters(), lr=settings.learning_rate)
        self._device = next(model.parameters()).device
        precisions = ("auto", "bf16") if self._device.type == "cuda" else ("bf16",)
        is_half = settings.precision in precisions
        self._autocast = torch.autocast(self._device.type, torch.bfloat16, enabled=is_half)
        self._means = StepMeans()
        self._best: Mapping[str, Tensor] = {}
        self._saved_step = 0

    def train(self, stop: StopRequest) -> None:
        """Run the loop.

        Raises:
            RequestError: an image is damaged, or the loss is not finite any more.
        """
        options, settings, seed = self._options, self._settings, self._options.seed
        model, optimizer, progress = self._model, self._optimizer, self.progress
        bar = StepProgress(
            settings.steps,
            progress.step,
            progress.seconds,
            shown=options.progress,
            log_every=options.log_every,
        )
        batches = window_batches(
            self._windows, settings.batch_size, seed, progress.step, settings.steps
        )
        log = MetricsLog(options.folder / METRICS_FILE, progress.step, board=None)
        with bar, log, contextlib.closing(batches):
            self._save(bar.seconds)
            for batch in batches:
                step = progress.step
                moved = batch.to(self._device)
                if settings.augment:
                    moved = augment(moved, stream_generator(seed, "augment", step))
                for group in optimizer.param_groups:
                    group["lr"] = settings.learning_rate_at(step)
                torch.manual_seed(torch_seed(seed, "dropout", step))
                model.train()
                with self._autocast:
                    losses = model.loss(*moved)
                optimizer.zero_grad(set_to_none=True)
                losses.total.backward()
                norm = nn.utils.clip_grad_norm_(model.parameters(), settings.clip_norm or math.inf)
                optimizer.step()
                self._update_average(step)
                self._means.add({"loss": losses.total, **losses.terms, "gradient": norm})

                progress.step += 1
                bar.advance()
                is_stopping = stop.is_made
                if bar.is_due(options.log_every):
                    numbers = self._means.take()
                    self._require_finite(numbers["loss"])
                    rate = settings.learning_rate_at(step)
                    numbers |= {"learning_rate": rate, "seconds": bar.seconds}
                    log.write("train", progress.step, numbers)
                    bar.report(numbers["loss"])
                if self._validation and bar.is_due(settings.validate_every):
                    numbers = self._validation(self.average or model, self._autocast)
                    log.write("validation", progress.step, numbers)
                    self._keep_best(numbers)
                if bar.is_due(options.checkpoint_every) or is_stopping:
                    self._save(bar.seconds)
                if is_stopping:
                    break

    @torch.no_grad()
    def restore(self, tensors: Mapping[str, Tensor], progress: TrainerProgress) -> None:
        """Go on from where another trainer was, as `read_trainer_state` returns it.

        Raises:
            RequestError: the tensors do not fit the network.
        """
        path = self._options.folder / TRAINER_FILE
        load_tensors(self._model, _without("weights/", tensors), path)
        if self.average is not None:
            load_tensors(self.average, _without("average/", tensors), path)
        for name, parameter in self._model.named_parameters():
            if moments := _without(f"adam/{name}/", tensors):
                self._optimizer.state[parameter] = {
                    # Adam keeps its count of steps on the CPU
                    key: value if key == "step" else value.to(parameter.device)
                    for key, value in moments.items()
                }
        self._best = _without("best/", tensors)
        self._means = StepMeans(progress.names, progress.rows)
        self.progress = progress
        self._saved_step = progress.step

    @torch.no_grad()
    def _update_average(self, step: int) -> None:
        if self.average is None:
            return
        decay = min(self._settings.ema_decay, (1 + step) / (10 + step))  # short at first
        for mean, new in zip(self.average.parameters(), self._model.parameters(), strict=True):
            mean.lerp_(new, 1 - decay)
        for mean, new in zip(self.average.buffers(), self._model.buffers(), strict=True):
            mean.copy_(new)

    def _keep_best(self, numbers: dict[str, float]) -> None:
        error = selection_error(numbers)
        self._require_finite(error)
        progress = self.progress
        if progress.best_step is None or error < selection_error(progress.best):
            progress.best_step, progress.best = progress.step, numbers
            state = (self.average or self._model).state_dict()
            self._best = {name: tensor.detach().clone() for name, tensor in state.items()}

    def _save(self, seconds: float) -> None:
        """Write the trainer's state, and the network that is the result so far."""
        progress = self.progress
        progress.names, progress.rows = self._means.names, self._means.rows()
        progress.seconds = seconds
        self._require_finite(sum(row[0] for row in progress.rows))
        tensors = _prefixed("weights/", self._model.state_dict())
        if self.average is not None:
            tensors |= _prefixed("average/", self.average.state_dict())
        tensors |= _prefixed("best/", self._best)
        for name, parameter in self._model.named_parameters():
            tensors |= _prefixed(f"adam/{name}/", self._optimizer.state.get(parameter, {}))
        record = {**KIND, "run": run_record(self._record), "progress": asdict(progress)}
        write_tensors(self._options.folder / TRAINER_FILE, tensors, record)
        self._saved_step = progress.step
        if self._validation is None or progress.best_step is not None:
            save_result(self._options.folder, self._record, tensors, progress)

    def _require_finite(self, number: float) -> None:
        if not math.isfinite(number):
            raise RequestError(
                f"the loss is not finite any more at step {self.progress.step}; lower "
                f"--learning_rate (the state of step {self._saved_step} is kept)"
            )


def torch_seed(seed: int, stream: str, *numbers: int) -> int:
    """Return a seed of a named stream for PyTorch."""
    return int(stream_generator(seed, stream, *numbers).integers(2**63))


def run_record(record: CheckpointRecord) -> dict[str, Any]:
    """Return what must be the same when a run is carried on."""
    left_out = ("step", "validation", "versions")
    return {name: value for name, value in asdict(record).items() if name not in left_out}


def read_trainer_state(path: Path) -> tuple[dict[str, Tensor], dict[str, Any], TrainerProgress]:
    """Read a trainer's tensors, `run_record` and progress.

    Raises:
        RequestError: the file is damaged or of another schema.
    """
    tensors, record, _ = read_tensors(path)
    require_kind(path, record, KIND)
    return tensors, record["run"], TrainerProgress(**record["progress"])


def result_step(progress: TrainerProgress) -> int:
    """Return the step whose weights are the result: the best on a held-out fold, else the last."""
    return progress.step if progress.best_step is None else progress.best_step


def save_result(
    folder: Path, record: CheckpointRecord, tensors: Mapping[str, Tensor], progress: TrainerProgress
) -> None:
    """Write the network of `result_step` from a trainer's tensors; the last one is averaged."""
    state = _without("best/", tensors)
    if progress.best_step is None:
        state = _without("average/", tensors) or _without("weights/", tensors)
    record = replace(record, step=result_step(progress), validation=progress.best)
    save_predictor_checkpoint(folder, record, state)


def _prefixed(prefix: str, tensors: Mapping[str, Any]) -> dict[str, Tensor]:
    return {f"{prefix}{name}": tensor for name, tensor in tensors.items()}


def _without(prefix: str, tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Return the tensors whose names begin with ``prefix``, named without it."""
    return {k.removeprefix(prefix): v for k, v in tensors.items() if k.startswith(prefix)}
