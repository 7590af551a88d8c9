"""A training run: people, network and folder, new or carried on; then the trainer."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Mapping
from contextlib import ExitStack
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from tqdm.contrib.logging import logging_redirect_tqdm

from face_prediction.dataset.manifest import MANIFEST_NAME
from face_prediction.dataset.reader import FaceDataset
from face_prediction.models.checkpoint import (
    MODEL_FILE,
    CheckpointRecord,
    read_predictor_checkpoint,
)
from face_prediction.models.interface import PredictorModel
from face_prediction.models.settings import make_predictor_model
from face_prediction.training.options import FaceTrainOptions
from face_prediction.training.trainer import (
    METRICS_FILE,
    TRAINER_FILE,
    PredictorTrainer,
    TrainerProgress,
    read_trainer_state,
    result_step,
    run_record,
    save_result,
    torch_seed,
)
from face_prediction.training.validation import HeldOutLoss
from face_prediction.training.windows import SequenceWindows
from robo_manip_baselines.runs.errors import RequestError
from robo_manip_baselines.runs.files import file_digest, locked, remove_temporaries
from robo_manip_baselines.runs.interrupt import StopRequest
from robo_manip_baselines.runs.metrics import read_metrics, write_curves
from robo_manip_baselines.runs.seeds import stream_generator
from robo_manip_baselines.runs.versions import software_versions

CURVES_FILE = "curves.png"
CURVES = {
    "loss": ("loss",),
    "error of the mouth centre, crops": ("mouth_error", "persistence_mouth_error"),
}
"""Panels of ``curves.png``."""

_VALIDATION_SHARE = 0.25  # of the memory for images, for the held-out fold

logger = logging.getLogger(__name__)


def train_predictor(options: FaceTrainOptions) -> int:
    """Train a network, or carry on; see `run_train`."""
    model_settings, settings = options.resolved()
    device = _device(options.device)
    folder = options.folder
    with ExitStack() as stack:
        stack.enter_context(logging_redirect_tqdm())
        # one for each thread that reads: training's images are read ahead
        dataset, held_out = (stack.enter_context(FaceDataset(options.dataset)) for _ in range(2))
        people = choose_people(dataset, options)
        torch.manual_seed(torch_seed(options.seed, "weights"))
        model = make_predictor_model(options.model, model_settings)
        _require_frames(model, dataset)
        record = CheckpointRecord(
            model=options.model,
            settings=model_settings.to_json(),
            preset=options.preset,
            training=asdict(settings),
            seed=options.seed,
            dataset=dataset.manifest.settings.to_json(),
            dataset_sha256=file_digest(options.dataset / MANIFEST_NAME),
            folds=people.folds,
            train_subjects=people.train_subjects,
            step=0,
            validation={},
            versions=software_versions("torch"),
        )
        stack.enter_context(locked(folder))
        remove_temporaries(folder)
        found = _previous_state(folder, record)
        if found and found[1].step == settings.steps:
            _require_result(folder, record, *found)
            logger.info("%s: finished already, %d steps", folder, settings.steps)
            return 0
        stop = stack.enter_context(StopRequest())
        memory = options.memory_gb * 1e9
        validation = None
        if rows := len(people.validation):
            share, memory = memory * _VALIDATION_SHARE, memory * (1 - _VALIDATION_SHARE)
            validation = HeldOutLoss(held_out, people.validation, model, settings, share)
        windows = SequenceWindows(dataset, people.train, model, memory)
        if found is None:
            generator = torch.Generator().manual_seed(torch_seed(options.seed, "prepare"))
            model.prepare(windows.sequences, generator)
        trainer = PredictorTrainer(options, settings, record, model.to(device), windows, validation)
        if found is not None:
            trainer.restore(*found)
        logger.info(
            "%s: %d sequences of %d people, %d held out; step %d of %d on %s",
            *(folder, len(windows), len(people.train_subjects), rows),
            *(trainer.progress.step, settings.steps, device),
        )
        trainer.train(stop)
    write_curves(folder / CURVES_FILE, read_metrics(folder / METRICS_FILE), folder.name, CURVES)
    if stop.is_made:
        logger.info("%s: stopped; the same command carries on", folder)
        return 130
    logger.info("%s: done", folder)
    return 0


@dataclass(frozen=True)
class People:
    """Sequences to train on and to validate on; never one person in both.

    Attributes:
        train: (N,) sequences of the dataset.
        validation: (M,) sequences; empty where nobody is held out.
        folds: folds by use: ``train``, ``validation``, ``test``.
        train_subjects: people trained on.
    """

    train: NDArray[np.int64]
    validation: NDArray[np.int64]
    folds: dict[str, list[int]]
    train_subjects: list[str]


def choose_people(dataset: FaceDataset, options: FaceTrainOptions) -> People:
    """Divide the dataset by ``test_fold``, ``hold_out``, ``subjects`` and ``seed`` of the options.

    Raises:
        RequestError: there is no such fold, nobody to train on, or fewer subjects.
    """
    count = dataset.manifest.folds
    train, validation, test = tuple(range(count)), (), ()
    if options.test_fold is not None:
        split = dataset.split(options.test_fold)
        train, validation, test = split.train, split.validation, split.test
        if options.hold_out == "none":
            train, validation = tuple(sorted({*train, *validation})), ()
        elif not validation:
            raise RequestError(
                f"{dataset.folder}: {count} folds leave none to hold out; say --hold_out none"
            )
    elif options.hold_out == "next":
        raise RequestError("--test_fold None trains on everybody; say --hold_out none with it")
    rows = dataset.indices(folds=train)
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
    folds = {"train": list(train), "validation": list(validation), "test": list(test)}
    return People(rows, dataset.indices(folds=validation), folds, names)


def _require_frames(model: PredictorModel, dataset: FaceDataset) -> None:
    """Check that the sequences are long enough."""
    there = dataset.manifest.settings
    if model.history > there.history or model.horizon > there.future:
        raise RequestError(
            f"{dataset.folder}: sequences of {there.history} + {there.future} frames, this network "
            f"needs {model.history} + {model.horizon}; make the dataset with --history "
            f"{model.history} --future {model.horizon}"
        )


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
    tensors, run, progress = read_trainer_state(path)
    for name, old, new in _differences(run, run_record(record)):
        raise RequestError(
            f"--out {folder}: holds a run with {name} {old}, not {new}; "
            "choose another folder, or give the same options"
        )
    return tensors, progress


def _differences(there: Any, now: Any, name: str = "") -> Iterator[tuple[str, Any, Any]]:
    if isinstance(there, Mapping) and isinstance(now, Mapping):
        for key in [*now, *(key for key in there if key not in now)]:
            inner = f"{name}.{key}" if name else str(key)
            yield from _differences(there.get(key), now.get(key), inner)
    elif there != now:
        yield name, there, now


def _require_result(
    folder: Path, record: CheckpointRecord, tensors: dict[str, Tensor], progress: TrainerProgress
) -> None:
    """Write the network of a finished run again, if it was killed while writing it."""
    try:
        if read_predictor_checkpoint(folder)[0].step == result_step(progress):
            return
    except RequestError as error:
        logger.warning("%s", error)
        logger.warning("%s: the network is written again from %s", folder, TRAINER_FILE)
    save_result(folder, record, tensors, progress)


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
