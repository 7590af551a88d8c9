"""Who is trained on, who is looked at meanwhile, and who is left for the report."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import tyro
from numpy.typing import NDArray

from face_prediction.dataset.reader import FaceDataset
from face_prediction.models.settings import (
    ModelSettings,
    Precision,
    Schedule,
    TrainSettings,
    preset_settings,
)
from face_prediction.training.seeds import generator
from robo_manip_baselines.runs.errors import RequestError

HoldOut = Literal["next", "none"]


@dataclass(frozen=True)
class People:
    """The sequences to train on and to validate on; never one person in both."""

    #: (N,) sequences of the dataset
    train: NDArray[np.int64]
    #: none: nobody is held out
    validation: NDArray[np.int64]
    #: folds by use
    folds: dict[str, list[int]]
    train_subjects: list[str]


def choose_people(
    dataset: FaceDataset,
    *,
    test_fold: int | None,
    hold_out: HoldOut,
    subjects: int | None,
    seed: int,
) -> People:
    """Divide the dataset.

    Args:
        dataset: with its folds.
        test_fold: left out of everything; None: no fold is (for weights that are to be shipped).
        hold_out: ``next``: the fold after it validates; ``none``: all others train.
        subjects: train on the first so many people of an order drawn from ``seed``; None: on all.
        seed: of the run.

    Raises:
        RequestError: there is no such fold, nobody to train on, or fewer subjects.
    """
    if test_fold is None and hold_out == "next":
        raise RequestError("--test_fold None trains on everybody; say --hold_out none with it")
    count = dataset.manifest.folds
    test: tuple[int, ...] = ()
    train, validation = tuple(range(count)), ()
    if test_fold is not None:
        split = dataset.split(test_fold)
        train, validation, test = split.train, split.validation, split.test
        if hold_out == "none":
            train, validation = tuple(sorted({*train, *validation})), ()
        elif not validation:
            raise RequestError(
                f"{dataset.folder}: {count} folds leave none to hold out; say --hold_out none"
            )
    rows = dataset.indices(folds=train)
    owners = [dataset.entry(int(row)).subject for row in rows]
    names = sorted(set(owners))
    if not names:
        raise RequestError(f"{dataset.folder}: nobody to train on in folds {list(train)}")
    if subjects is not None:
        if not 1 <= subjects <= len(names):
            raise RequestError(f"--subjects {subjects}: the folds to train on have {len(names)}")
        order = generator(seed, "subjects").permutation(len(names))
        names = sorted(names[place] for place in order[:subjects])
        rows = rows[[owner in names for owner in owners]]
    return People(
        train=rows,
        validation=dataset.indices(folds=validation),
        folds={"train": list(train), "validation": list(validation), "test": list(test)},
        train_subjects=names,
    )


ModelName = Literal["image_only", "simple_fusion", "cross_attention", "residual"]

#: Options that, where given, replace what the preset says.
_TRAINING = (
    "steps",
    "batch_size",
    "learning_rate",
    "schedule",
    "warmup_steps",
    "clip_norm",
    "ema_decay",
    "augment",
    "precision",
    "validate_every",
    "validation_sequences",
)


@dataclass(frozen=True)
class TrainOptions:
    """Train a network that forecasts faces: a dataset in, a folder with its weights out.

    The same command again carries on where training was stopped, or says that it is done. Options
    that are None are the preset's.

    Example: face-prediction train cross_attention --dataset face_dataset --preset cpu
    """

    #: Which network; see docs/face_models.md.
    model: tyro.conf.Positional[ModelName]
    #: Folder made by build-dataset.
    dataset: Path = Path("face_dataset")
    #: Fold whose people are left for the report. None: nobody is, for weights that are shipped.
    test_fold: int | None = 0
    #: next: the fold after it chooses the weights that are kept. none: it is trained on too, and
    #: the last weights are kept.
    hold_out: HoldOut = "next"
    #: Sizes: paper (256 x 256, for a GPU) or cpu (64 x 64, for a core or two).
    preset: Literal["paper", "cpu"] = "cpu"
    #: Folder for the network; None: checkpoints/MODEL_PRESET_foldK_seedN.
    out: Path | None = None
    #: Of weights, order, windows, dropout and augmentation.
    seed: int = 0
    #: Train on the first so many people of an order drawn from the seed; None: on all.
    subjects: int | None = None
    #: Settings of the network that differ from the preset's, as NAME=VALUE (width=96).
    settings: tuple[str, ...] = ()
    #: Steps of training in all.
    steps: int | None = None
    #: Sequences of a step.
    batch_size: int | None = None
    #: Of Adam.
    learning_rate: float | None = None
    #: Of the learning rate: constant, or cosine down to a hundredth of it.
    schedule: Schedule | None = None
    #: Steps over which the learning rate rises.
    warmup_steps: int | None = None
    #: Longest gradient; 0: any.
    clip_norm: float | None = None
    #: Of the moving average of the weights, which is then what is kept; 0: none.
    ema_decay: float | None = None
    #: Turn half of the sequences left to right, and change the light.
    augment: bool | None = None
    #: bf16 (autocast), fp32, or auto: bf16 on a GPU.
    precision: Precision | None = None
    #: Steps between looks at the fold that is held out.
    validate_every: int | None = None
    #: Sequences of it that are looked at; 0: all.
    validation_sequences: int | None = None
    #: auto: the GPU if there is one; or cpu, cuda, cuda:1.
    device: str = "auto"
    #: Memory for decoded pictures in GB; beyond it they are decoded every time.
    memory_gb: float = 6.0
    #: Steps between lines of metrics.jsonl.
    log_every: int = 20
    #: Steps between saves: what a killed run loses at most.
    checkpoint_every: int = 200
    #: Show a progress bar (on a terminal) or lines about progress.
    progress: bool = True

    @property
    def folder(self) -> Path:
        """Where the network goes."""
        if self.out is not None:
            return self.out
        fold = "all" if self.test_fold is None else f"fold{self.test_fold}"
        return Path("checkpoints") / f"{self.model}_{self.preset}_{fold}_seed{self.seed}"

    def resolved(self) -> tuple[ModelSettings, TrainSettings]:
        """The preset's settings of network and training, with what was given instead.

        Raises:
            RequestError: an option is out of its range, or a setting is none of this network's.
        """
        for name, least in (
            ("seed", 0),
            ("memory_gb", 0),
            ("log_every", 1),
            ("checkpoint_every", 1),
        ):
            if not getattr(self, name) >= least:
                raise RequestError(f"--{name} {getattr(self, name)}: {least} or more")
        model, training = preset_settings(self.model, self.preset)
        given = {name: getattr(self, name) for name in _TRAINING if getattr(self, name) is not None}
        return model.changed(_parsed(self.settings)), replace(training, **given)


def _parsed(settings: tuple[str, ...]) -> dict[str, Any]:
    values: dict[str, Any] = {}
    for text in settings:
        name, equals, value = text.partition("=")
        if not equals:
            raise RequestError(f"--settings {text}: NAME=VALUE is expected, like width=96")
        try:
            values[name] = json.loads(value)
        except ValueError:
            values[name] = value
    return values
