"""The folder of a training run: one process at a time, and always the same run."""

from __future__ import annotations

import dataclasses
import fcntl
import logging
import os
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor
from tqdm.contrib.logging import logging_redirect_tqdm

from face_prediction.dataset.manifest import MANIFEST_NAME
from face_prediction.dataset.reader import FaceDataset
from face_prediction.models.checkpoint import (
    MODEL_FILE,
    CheckpointRecord,
    library_versions,
    read_checkpoint,
    save_checkpoint,
)
from face_prediction.models.interface import PredictorModel
from face_prediction.models.settings import TrainSettings, make_model
from face_prediction.training.metrics import METRICS_FILE, draw_curves
from face_prediction.training.options import People, TrainOptions, choose_people
from face_prediction.training.seeds import torch_seed
from face_prediction.training.step import (
    TRAINER_FILE,
    Progress,
    TrainStep,
    read_state,
    restore,
    result,
)
from face_prediction.training.trainer import Pace, Trainer, run_record
from face_prediction.training.validation import Validation
from face_prediction.training.windows import Sampler, Windows
from robo_manip_baselines.runs.errors import RequestError
from robo_manip_baselines.runs.files import file_digest
from robo_manip_baselines.runs.interrupt import StopRequest


@contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Hold the folder for one training process; a killed process holds nothing.

    Raises:
        RequestError: another process holds it, or it cannot be written to.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        descriptor = os.open(folder / ".lock", os.O_RDWR | os.O_CREAT, 0o644)
    except OSError as error:
        raise RequestError(
            f"--out {folder}: cannot be written ({error.strerror}); choose another folder"
        ) from None
    try:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise RequestError(
                f"--out {folder}: another process trains here; choose another folder"
            ) from None
        for partial in folder.glob(".*.partial"):  # of a process that was killed while writing
            partial.unlink()
        yield
    finally:
        os.close(descriptor)


def require_same_run(folder: Path, there: Mapping[str, Any], now: Mapping[str, Any]) -> None:
    """Check that the run in ``folder`` is the one that is asked for.

    Raises:
        RequestError: it is another; the first difference is named.
    """
    for name, old, new in _differences(there, now):
        raise RequestError(
            f"--out {folder}: holds a run with {name} {old}, not {new}; "
            "choose another folder, or give the same options"
        )


def _differences(there: Any, now: Any, name: str = "") -> Iterator[tuple[str, Any, Any]]:
    if isinstance(there, Mapping) and isinstance(now, Mapping):
        for key in [*now, *(key for key in there if key not in now)]:
            inner = f"{name}.{key}" if name else str(key)
            yield from _differences(there.get(key), now.get(key), inner)
    elif there != now:
        yield name, there, now


logger = logging.getLogger(__name__)

#: Of the memory for pictures, what the fold that is held out may take.
_VALIDATION_SHARE = 0.25


def train(options: TrainOptions) -> int:
    """Train, or carry on; returns the exit code. See `run_train`."""
    model_settings, settings = options.resolved()
    device = _device(options.device)
    folder = options.folder
    with ExitStack() as stack:
        stack.enter_context(logging_redirect_tqdm())
        # one for each thread that reads: training's pictures are read ahead
        dataset, held_out = (stack.enter_context(FaceDataset(options.dataset)) for _ in range(2))
        people = choose_people(
            dataset,
            test_fold=options.test_fold,
            hold_out=options.hold_out,
            subjects=options.subjects,
            seed=options.seed,
        )
        torch.manual_seed(torch_seed(options.seed, "weights"))
        model = make_model(options.model, model_settings)
        require_frames(model, dataset)
        record = CheckpointRecord(
            model=options.model,
            settings=model_settings.to_json(),
            preset=options.preset,
            training=settings.to_json(),
            seed=options.seed,
            dataset=dataset.manifest.settings.to_json(),
            dataset_sha256=file_digest(options.dataset / MANIFEST_NAME),
            folds=people.folds,
            train_subjects=people.train_subjects,
            step=0,
            validation={},
            versions=library_versions(),
        )
        stack.enter_context(locked(folder))
        found = _found(folder, record)
        if found and found[1].step == settings.steps:
            _require_result(folder, record, *found)
            logger.info("%s: finished already, %d steps", folder, settings.steps)
            return 0
        stop = stack.enter_context(StopRequest())
        trainer = _trainer(
            options, settings, record, people, dataset, held_out, model, device, found, stop
        )
        trainer.train()
    draw_curves(folder)
    if stop.is_made:
        logger.info("%s: stopped; the same command carries on", folder)
        return 130
    logger.info("%s: done", folder)
    return 0


def require_frames(model: PredictorModel, dataset: FaceDataset) -> None:
    """Check that the sequences are long enough.

    Raises:
        RequestError: they are not.
    """
    there = dataset.manifest.settings
    if model.history > there.history or model.horizon > there.future:
        raise RequestError(
            f"{dataset.folder}: sequences of {there.history} + {there.future} frames, this network "
            f"needs {model.history} + {model.horizon}; make the dataset with --history "
            f"{model.history} --future {model.horizon}"
        )


def _found(folder: Path, record: CheckpointRecord) -> tuple[dict[str, Tensor], Progress] | None:
    """What a run in ``folder`` left, if there is one."""
    path = folder / TRAINER_FILE
    if not path.exists():
        if (folder / MODEL_FILE).exists():
            raise RequestError(
                f"--out {folder}: holds a network, but no {TRAINER_FILE} to carry on from; "
                "choose another folder"
            )
        (folder / METRICS_FILE).unlink(missing_ok=True)
        return None
    tensors, run, progress = read_state(path)
    require_same_run(folder, run, run_record(record))
    return tensors, progress


def _require_result(
    folder: Path, record: CheckpointRecord, tensors: dict[str, Tensor], progress: Progress
) -> None:
    """Write the network of a finished run again, if it was killed while writing it."""
    state, step = result(tensors, progress)
    try:
        if read_checkpoint(folder)[0].step == step:
            return
    except RequestError as error:
        logger.warning("%s", error)
        logger.warning("%s: the network is written again from %s", folder, TRAINER_FILE)
    record = dataclasses.replace(record, step=step, validation=progress.best)
    save_checkpoint(folder, record, state)


def _trainer(
    options: TrainOptions,
    settings: TrainSettings,
    record: CheckpointRecord,
    people: People,
    dataset: FaceDataset,
    held_out: FaceDataset,
    model: PredictorModel,
    device: torch.device,
    found: tuple[dict[str, Tensor], Progress] | None,
    stop: StopRequest,
) -> Trainer:
    memory = options.memory_gb * 1e9
    rows = len(people.validation)
    windows = Windows(dataset, people.train, model, memory * (1 - _VALIDATION_SHARE * bool(rows)))
    validation = None
    if rows:
        count = min(settings.validation_sequences or rows, rows)
        chosen = people.validation[np.linspace(0, rows - 1, count).astype(int)]
        seen = Windows(held_out, chosen, model, memory * _VALIDATION_SHARE)
        start = dataset.manifest.settings.history - model.history
        validation = Validation(seen, start, settings.batch_size)
    if found is None:
        generator = torch.Generator().manual_seed(torch_seed(options.seed, "prepare"))
        model.prepare(windows.sequences, generator)
    train_step = TrainStep(model.to(device), settings, options.seed)
    progress, best = Progress(), {}
    if found is not None:
        progress = found[1]
        best = restore(train_step, found[0], options.folder / TRAINER_FILE)
    length = windows.sequences.landmarks.shape[1]
    sampler = Sampler(
        len(windows), length, model.history + model.horizon, settings.batch_size, options.seed
    )
    pace = Pace(options.log_every, options.checkpoint_every, options.progress)
    trainer = Trainer(
        options.folder,
        record,
        settings,
        train_step,
        windows,
        sampler,
        validation,
        progress,
        best,
        pace,
        lambda: stop.is_made,
    )
    logger.info(
        "%s: %d sequences of %d people, %d held out; step %d of %d on %s",
        options.folder,
        len(windows),
        len(people.train_subjects),
        rows,
        progress.step,
        settings.steps,
        device,
    )
    trainer.save()
    return trainer


def _device(name: str) -> torch.device:
    if name == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    try:
        device = torch.device(name)
        torch.empty(0, device=device)
    except (RuntimeError, AssertionError):
        raise RequestError(
            f"--device {name}: not there; auto, cpu" + ", cuda" * torch.cuda.is_available()
        ) from None
    return device
