"""A training run: people, network and folder, new or carried on, and the loop.

``trainer.safetensors`` is the state to go on from exactly: ``weights/NAME``, ``average/NAME`` (with
a moving average), ``best/NAME`` (once a held-out fold has chosen), Adam's moments
``adam/NAME/...``, and a record: what is trained, and `TrainerProgress`.
"""

from __future__ import annotations

import contextlib
import copy
import logging
import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from tqdm.contrib.logging import logging_redirect_tqdm

from face_prediction.dataset.manifest import MANIFEST_NAME
from face_prediction.dataset.reader import FaceDataset
from face_prediction.dataset.split import NO_PART_LEFT, split_dataset
from face_prediction.models.interface import PredictorModel
from face_prediction.models.learned import (
    MODEL_FILE,
    CheckpointRecord,
    FoldUses,
    load_tensors,
    read_predictor_checkpoint,
    read_tensors,
    save_predictor_checkpoint,
    write_tensors,
)
from face_prediction.models.settings import (
    PredictorTrainSettings,
    make_predictor_model,
    settings_class,
)
from face_prediction.prediction.errors import mouth_distances, mouth_residuals
from face_prediction.training.options import FaceTrainOptions
from face_prediction.training.windows import SequenceWindows, WindowBatch, augment, window_batches
from robo_manip_baselines.runs.command import EXIT_INTERRUPTED
from robo_manip_baselines.runs.documents import Schema, convert
from robo_manip_baselines.runs.errors import RequestError
from robo_manip_baselines.runs.files import (
    FolderKind,
    file_digest,
    locked,
    remove_temporaries,
    require_out_folder,
)
from robo_manip_baselines.runs.interrupt import StopRequest
from robo_manip_baselines.runs.metrics import MetricsLog, read_metrics, write_curves
from robo_manip_baselines.runs.progress import StepProgress
from robo_manip_baselines.runs.ranges import Amount, NonNegativeInt
from robo_manip_baselines.runs.seeds import stream_generator
from robo_manip_baselines.runs.versions import software_versions

SCHEMA = Schema("face_trainer", 1)
TRAINER_FILE = "trainer.safetensors"
METRICS_FILE = "metrics.jsonl"
CURVES = {
    "loss": ("loss",),
    "error of the mouth centre, crops": ("mouth_error", "persistence_mouth_error"),
}
"""Panels of ``curves.png``."""
EXTENDABLE = "training.steps"
"""The one setting that may differ when a run is carried on."""
_VALIDATION_SHARE = 0.25  # of the memory for images, for the held-out fold

logger = logging.getLogger(__name__)


def train_predictor(options: FaceTrainOptions) -> int:
    """Train a network, or carry on; see `run_train`."""
    model_settings, settings = options.resolved()
    device = _device(options.device)
    folder = options.folder
    require_out_folder(folder, _RUN, [options.dataset])
    with ExitStack() as stack:
        stack.enter_context(logging_redirect_tqdm())
        # one for each thread that reads: training's images are read ahead
        dataset, held_out = (stack.enter_context(FaceDataset(options.dataset)) for _ in range(2))
        people = choose_people(dataset, options)
        torch.manual_seed(torch_seed(options.seed, "weights"))
        model = make_predictor_model(options.model, model_settings)
        frames = dataset.manifest.settings
        if model.history > frames.history or model.horizon > frames.future:
            raise RequestError(
                f"{dataset.folder}: sequences of {frames.history} + {frames.future} frames, this "
                f"network needs {model.history} + {model.horizon}; make the dataset with --history "
                f"{model.history} --future {model.horizon}"
            )
        record = CheckpointRecord(
            model=options.model,
            settings=model_settings.to_json(),
            preset=options.preset,
            training=asdict(settings),
            seed=options.seed,
            dataset=frames.to_json(),
            dataset_sha256=file_digest(options.dataset / MANIFEST_NAME),
            folds=people.folds,
            train_subjects=people.train_subjects,
            step=0,
            validation={},
            versions=software_versions("torch"),
            split=options.split,
            windows_sha256=people.windows_sha256,
        )
        stack.enter_context(locked(folder))
        remove_temporaries(folder)
        found = _previous_state(folder, record)
        if found and found[1].step == settings.steps:
            _require_result(folder, record, *found)
            done = folder, settings.steps
            logger.info("%s: finished already, %d steps; a larger --steps extends it", *done)
            return 0
        stop = stack.enter_context(StopRequest())
        memory = options.memory_gb * 1e9
        validation = None
        if count := len(people.validation):
            used = min(settings.validation_sequences or count, count)
            rows = people.validation[np.linspace(0, count - 1, used).astype(int)]
            validation = SequenceWindows(held_out, rows, model, memory * _VALIDATION_SHARE)
            memory *= 1 - _VALIDATION_SHARE
        windows = SequenceWindows(dataset, people.train, model, memory)
        if found is None:
            model.prepare(windows.sequences)
        trainer = PredictorTrainer(options, settings, record, model.to(device), windows, validation)
        if found is not None:
            trainer.restore(*found)
        logger.info(
            "%s: %d sequences of %d people, %d held out; step %d of %d on %s",
            *(folder, len(windows), len(people.train_subjects), count),
            *(trainer.progress.step, settings.steps, device),
        )
        trainer.train(stop)
    write_curves(folder / "curves.png", read_metrics(folder / METRICS_FILE), folder.name, CURVES)
    is_done = trainer.progress.step == settings.steps
    end = "done" if is_done else "stopped; the same command carries on"
    logger.info("%s: %s", folder, end)
    return 0 if is_done else EXIT_INTERRUPTED


@dataclass(frozen=True)
class People:
    """Sequences to train on and to validate on; never one person, or one frame, in both.

    Attributes:
        train: (N,) sequences of the dataset.
        validation: (M,) sequences; empty where nobody is held out.
        folds: folds by use: ``train``, ``validation``, ``test``.
        train_subjects: people trained on.
        windows_sha256: of the windows of a split by sequence.
    """

    train: NDArray[np.int64]
    validation: NDArray[np.int64]
    folds: FoldUses
    train_subjects: list[str]
    windows_sha256: str = ""


def choose_people(dataset: FaceDataset, options: FaceTrainOptions) -> People:
    """Divide the dataset by ``split``, ``test_fold``, ``hold_out``, ``subjects`` and ``seed``.

    Raises:
        RequestError: there is no such fold, nobody to train on, or fewer subjects.
    """
    split = split_dataset(dataset, options.split)
    count = split.parts
    train, validation, test = tuple(range(count)), (), ()
    if options.test_fold is not None:
        uses = split.uses(options.test_fold)
        train, validation, test = uses.train, uses.validation, uses.test
        if options.hold_out == "none":
            train, validation = tuple(sorted({*train, *validation})), ()
        elif not validation:
            raise RequestError(
                f"{dataset.folder}: {count} folds leave none to hold out; say --hold_out none"
            )
    elif options.split == "sequence":
        raise RequestError(f"--split sequence --test_fold None: {NO_PART_LEFT}")
    elif options.hold_out == "next":
        raise RequestError("--test_fold None trains on everybody; say --hold_out none with it")
    rows = split.training({*validation, *test})
    owners = [dataset.entry(int(row)).subject for row in rows]
    names = sorted(set(owners))
    if not names:
        raise RequestError(f"{dataset.folder}: nobody to train on in folds {list(train)}")
    if (subjects := options.subjects) is not None:
        if not 1 <= subjects <= len(names):
            raise RequestError(f"--subjects {subjects}: the folds to train on have {len(names)}")
        order = stream_generator(options.seed, "subjects").permutation(len(names))
        names = sorted(names[place] for place in order[:subjects])
        rows = rows[[owner in names for owner in owners]]
    folds = FoldUses(train=list(train), validation=list(validation), test=list(test))
    return People(rows, split.members(validation), folds, names, split.windows_sha256)


def _device(name: str) -> torch.device:
    if name == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    try:
        device = torch.device(name)
        torch.empty(0, device=device)
    except (RuntimeError, AssertionError):
        choices = "auto, cpu" + ", cuda" * torch.cuda.is_available()
        raise RequestError(f"--device {name}: not there; valid: {choices}") from None
    return device


@dataclass
class TrainerProgress:
    """Progress of a run.

    Attributes:
        step: optimizer steps done.
        seconds: spent on them, by all processes in turn.
        names: of the numbers of a step.
        rows: numbers of the steps since the last line of ``metrics.jsonl``.
        best_step: step whose weights did best on the held-out fold.
        best: their losses and errors on it.
    """

    step: NonNegativeInt = 0
    seconds: Amount = 0.0
    names: list[str] = field(default_factory=list)
    rows: list[list[float]] = field(default_factory=list)
    best_step: int | None = None
    best: dict[str, float] = field(default_factory=dict)

    @property
    def result_step(self) -> int:
        """Step whose weights are the result: the best on a held-out fold, else the last."""
        return self.step if self.best_step is None else self.best_step


def _is_run(folder: Path) -> bool:
    path = folder / TRAINER_FILE
    if path.exists():
        SCHEMA.without(read_tensors(path)[1], f"'{path}'")
    # a network without the state of its trainer is refused later, with its reason
    return path.exists() or (folder / MODEL_FILE).exists()


def _is_begun(path: Path) -> bool:
    if path.name != METRICS_FILE:
        return False
    read_metrics(path)  # refuses what no training wrote
    return True


_RUN = FolderKind("run of face-prediction train", _is_run, begun=_is_begun)


def _previous_state(
    folder: Path, record: CheckpointRecord
) -> tuple[dict[str, Tensor], TrainerProgress] | None:
    """Return the state of the run in ``folder``, if there is one; it must be this run."""
    path = folder / TRAINER_FILE
    if not path.exists():
        if (folder / MODEL_FILE).exists():
            raise RequestError(
                f"--out {folder}: holds a network, but no {TRAINER_FILE} to carry on from; "
                "choose another folder"
            )
        (folder / METRICS_FILE).unlink(missing_ok=True)
        return None
    tensors, state, _ = read_tensors(path)
    stored = convert(SCHEMA.without(state, f"'{path}'"), StoredTrainer, f"'{path}'")
    for name, old, new in _differences(_in_this_release(stored.run), _run_record(record)):
        if name != EXTENDABLE:
            raise RequestError(
                f"--out {folder}: holds a run with {name} {old}, not {new}; "
                "choose another folder, or give the same options"
            )
    progress = stored.progress
    if progress.step > record.training["steps"]:
        raise RequestError(
            f"--out {folder}: has done {progress.step} steps already, more than --steps "
            f"{record.training['steps']}; give a larger number to extend the run"
        )
    return tensors, progress


@dataclass(frozen=True)
class StoredTrainer:
    """Record of ``trainer.safetensors``: what is trained, and how far."""

    run: dict[str, Any]
    progress: TrainerProgress


def _run_record(record: CheckpointRecord) -> dict[str, Any]:
    """Return what must be the same when a run is carried on."""
    left_out = ("step", "validation", "versions")
    run = {name: value for name, value in asdict(record).items() if name not in left_out}
    return {"split": run.pop("split"), **run}  # first: it explains other folds


def _in_this_release(run: dict[str, Any]) -> dict[str, Any]:
    """Return the record of a run, perhaps of a release without some of its fields, with these."""
    settings = settings_class(run["model"]).from_json(run["settings"]).to_json()
    return {"split": "person", "windows_sha256": ""} | run | {"settings": settings}


def _differences(there: Any, now: Any, name: str = "") -> Iterator[tuple[str, Any, Any]]:
    if isinstance(there, dict) and isinstance(now, dict):
        for key in now | there:
            inner = f"{name}.{key}" if name else str(key)
            yield from _differences(there.get(key), now.get(key), inner)
    elif there != now:
        yield name, there, now


def _require_result(
    folder: Path, record: CheckpointRecord, tensors: dict[str, Tensor], progress: TrainerProgress
) -> None:
    """Write the network of a finished run again, if it was killed while writing it."""
    try:
        if read_predictor_checkpoint(folder)[0].step == progress.result_step:
            return
    except RequestError as error:
        logger.warning("%s", error)
        logger.warning("%s: the network is written again from %s", folder, TRAINER_FILE)
    _save_result(folder, record, tensors, progress)


def _save_result(
    folder: Path, record: CheckpointRecord, tensors: Mapping[str, Tensor], progress: TrainerProgress
) -> None:
    """Write the network of `result_step` from a trainer's tensors; the last one is averaged."""
    state = _without("best/", tensors)
    if progress.best_step is None:
        state = _without("average/", tensors) or _without("weights/", tensors)
    record = replace(record, step=progress.result_step, validation=progress.best)
    save_predictor_checkpoint(folder, record, state)


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
        validation: of the held-out fold; None: nobody is held out, and the last weights are kept.
    """

    def __init__(
        self,
        options: FaceTrainOptions,
        settings: PredictorTrainSettings,
        record: CheckpointRecord,
        model: PredictorModel,
        windows: SequenceWindows,
        validation: SequenceWindows | None,
    ) -> None:
        self.progress = TrainerProgress()
        self._options, self._settings, self._record = options, settings, record
        self._model, self._windows, self._validation = model, windows, validation
        self._average = copy.deepcopy(model).eval() if settings.ema_decay else None
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
        done = (settings.steps, progress.step, progress.seconds)
        bar = StepProgress(*done, shown=options.progress)
        batches = window_batches(self._windows, settings, seed, progress.step)
        log = MetricsLog(options.folder / METRICS_FILE, progress.step, board=None)
        with bar, log, contextlib.closing(batches):
            self._save(bar.seconds)
            for batch in batches:
                step = progress.step
                moved = batch.to(self._device)
                if settings.augment:
                    moved = augment(moved, stream_generator(seed, "augment", step))
                rate = settings.learning_rate_at(step)
                for group in optimizer.param_groups:
                    group["lr"] = rate
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
                    numbers |= {"learning_rate": rate, "seconds": bar.seconds}
                    log.write("train", progress.step, numbers)
                    bar.report(numbers["loss"])
                if self._validation and bar.is_due(settings.validate_every):
                    numbers = self._validate(self._validation)
                    log.write("validation", progress.step, numbers)
                    self._keep_best(numbers)
                if bar.is_due(options.checkpoint_every) or is_stopping:
                    self._save(bar.seconds)
                if is_stopping:
                    break

    @torch.no_grad()
    def restore(self, tensors: Mapping[str, Tensor], progress: TrainerProgress) -> None:
        """Go on from the state that another trainer saved.

        Raises:
            RequestError: the tensors do not fit the network.
        """
        path = self._options.folder / TRAINER_FILE
        load_tensors(self._model, _without("weights/", tensors), path)
        if self._average is not None:
            load_tensors(self._average, _without("average/", tensors), path)
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
        if self._average is None:
            return
        decay = min(self._settings.ema_decay, (1 + step) / (10 + step))  # short at first
        for mean, new in zip(self._average.parameters(), self._model.parameters(), strict=True):
            mean.lerp_(new, 1 - decay)
        for mean, new in zip(self._average.buffers(), self._model.buffers(), strict=True):
            mean.copy_(new)

    def _validate(self, windows: SequenceWindows) -> dict[str, float]:
        """Return means over the sequences of the held-out fold, each at the end of its history.

        ``loss`` and its terms; ``mouth_error``, the distance of the mouth centre in crops over all
        predicted frames (of a network that predicts landmarks), and beside it
        ``persistence_mouth_error``, that of predicting no motion; ``copy_image``, the squared error
        of the last image as a prediction.
        """
        model = (self._average or self._model).eval()
        sums: dict[str, list[float]] = {}
        for first in range(0, len(windows), self._settings.batch_size):
            rows = np.arange(first, min(first + self._settings.batch_size, len(windows)))
            batch = windows.batch(rows, np.full(len(rows), windows.validation_start))
            with torch.inference_mode(), self._autocast:
                moved = batch.to(self._device)
                losses = model.loss(*moved)
                numbers = {"loss": float(losses.total)}
                numbers |= {name: float(value) for name, value in losses.terms.items()}
                numbers |= _mouth_errors(batch, model(moved.history).landmarks)
            if batch.history.images.shape[1]:
                change = (batch.future.images.float() - batch.history.images[:, -1:].float()) / 255
                numbers["copy_image"] = float(change.square().mean())
            for name, value in numbers.items():
                sums.setdefault(name, []).append(len(rows) * value)
        return {name: math.fsum(values) / len(windows) for name, values in sums.items()}

    def _keep_best(self, numbers: dict[str, float]) -> None:
        error = _selection_error(numbers)
        self._require_finite(error)
        progress = self.progress
        if progress.best_step is None or error < _selection_error(progress.best):
            progress.best_step, progress.best = progress.step, numbers
            state = (self._average or self._model).state_dict()
            self._best = {name: tensor.detach().clone() for name, tensor in state.items()}

    def _save(self, seconds: float) -> None:
        """Write the trainer's state, and the network that is the result so far."""
        progress, folder = self.progress, self._options.folder
        progress.names, progress.rows = self._means.names, self._means.rows()
        progress.seconds = seconds
        self._require_finite(sum(row[0] for row in progress.rows))
        parts = {"weights/": self._model.state_dict()}
        if self._average is not None:
            parts["average/"] = self._average.state_dict()
        parts["best/"] = dict(self._best)
        for name, parameter in self._model.named_parameters():
            parts[f"adam/{name}/"] = self._optimizer.state.get(parameter, {})
        tensors = {f"{prefix}{k}": v for prefix, part in parts.items() for k, v in part.items()}
        record = {
            **SCHEMA.to_json(),
            "run": _run_record(self._record),
            "progress": asdict(progress),
        }
        write_tensors(folder / TRAINER_FILE, tensors, record)
        self._saved_step = progress.step
        if self._validation is None or progress.best_step is not None:
            _save_result(folder, self._record, tensors, progress)

    def _require_finite(self, number: float) -> None:
        if not math.isfinite(number):
            raise RequestError(
                f"the loss is not finite any more at step {self.progress.step}; lower "
                f"--learning_rate (the state of step {self._saved_step} is kept)"
            )


def _mouth_errors(batch: WindowBatch, predicted: Tensor | None) -> dict[str, float]:
    truth = batch.future.landmarks
    still = batch.history.landmarks[:, -1:].expand_as(truth)
    numbers = {}
    for name, landmarks in (("mouth_error", predicted), ("persistence_mouth_error", still)):
        if landmarks is not None:
            residuals = mouth_residuals(landmarks.float().cpu().numpy(), truth.numpy())
            numbers[name] = float(mouth_distances(residuals).mean())
    return numbers


def _selection_error(numbers: dict[str, float]) -> float:
    """Return the number by which the best weights are chosen: mouth error, or else loss."""
    return numbers.get("mouth_error", numbers["loss"])


def torch_seed(seed: int, stream: str, *numbers: int) -> int:
    """Return a seed of a named stream for PyTorch."""
    return int(stream_generator(seed, stream, *numbers).integers(2**63))


def _without(prefix: str, tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Return the tensors whose names begin with ``prefix``, named without it."""
    return {k.removeprefix(prefix): v for k, v in tensors.items() if k.startswith(prefix)}
