"""Options of ``face-prediction train``. PyTorch is not imported here."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Annotated, Literal

import tyro
from annotated_types import Interval

from face_prediction.dataset.split import SplitName
from face_prediction.models.settings import (
    Decay,
    ModelSettings,
    Precision,
    PredictorTrainSettings,
    preset_settings,
)
from robo_manip_baselines.runs.documents import parse_settings
from robo_manip_baselines.runs.ranges import (
    Amount,
    Count,
    Fraction,
    NonNegativeInt,
    Seed,
    require_ranges,
)


@dataclass(frozen=True)
class FaceTrainOptions:
    """Train a network that predicts faces: a dataset in, a folder with its weights out.

    The same command again carries on where training was stopped, or says that it is done; with more
    --steps it extends a finished run. Options that are None are the preset's.

    Example: face-prediction train cross_attention --dataset face_dataset --preset cpu

    Attributes:
        model: Network; see docs/predictors.md.
        dataset: Folder made by build-dataset.
        test_fold: Fold whose people are left for the report, or part of a split by sequence. None:
            nobody is, for weights that are shipped.
        split: person: parts are the dataset's folds. sequence: ten parts of windows that do not
            overlap, drawn from the same people, as the paper's.
        hold_out: next: the fold after it chooses the weights that are kept. none: it is trained on
            too, and the last weights are kept.
        preset: Sizes: paper (256 x 256, for a GPU) or cpu (64 x 64, for a core or two).
        out: Folder for the network; None: checkpoints/MODEL_PRESET_foldK_seedN (sequenceK with
            --split sequence).
        seed: Seed of weights, order, windows, dropout and augmentation.
        subjects: Train on the first so many people of an order drawn from the seed; None: on all.
        settings: Settings of the network that differ from the preset's, as NAME=VALUE (width=96).
        steps: Optimizer steps in all.
        batch_size: Sequences of a step.
        learning_rate: Learning rate of Adam.
        schedule: Learning rate over the steps: constant, or cosine down to a hundredth of it.
        warmup_steps: Steps over which the learning rate rises.
        clip_norm: Largest norm of the gradient; 0: any.
        ema_decay: Decay of the moving average of the weights, which is then what is kept; 0: none.
        augment: Mirror half of the sequences, and change position and light.
        precision: bf16 (autocast), fp32, or auto: bf16 on a GPU.
        validate_every: Steps between validations on the held-out fold.
        validation_sequences: Sequences of that fold used for it, evenly spread; 0: all.
        device: auto: the GPU if there is one; or cpu, cuda, cuda:1.
        memory_gb: Memory for decoded images in GB; beyond it they are decoded every time.
        log_every: Steps between lines of metrics.jsonl.
        checkpoint_every: Steps between saves: what a killed run loses at most.
        progress: Show a progress bar (on a terminal) or lines about progress.
    """

    model: tyro.conf.Positional[Literal["image_only", "simple_fusion", "cross_attention"]]
    dataset: Path = Path("face_dataset")
    test_fold: NonNegativeInt | None = 0
    split: SplitName = "person"
    hold_out: Literal["next", "none"] = "next"
    preset: Literal["paper", "cpu"] = "cpu"
    out: Path | None = None
    seed: Seed = 0
    subjects: Count | None = None
    settings: tuple[str, ...] = ()
    steps: Count | None = None
    batch_size: Count | None = None
    learning_rate: Amount | None = None
    schedule: Decay | None = None
    warmup_steps: NonNegativeInt | None = None
    clip_norm: Amount | None = None
    ema_decay: Fraction | None = None
    augment: bool | None = None
    precision: Precision | None = None
    validate_every: Count | None = None
    validation_sequences: NonNegativeInt | None = None
    device: str = "auto"
    memory_gb: Annotated[float, Interval(ge=0.0, le=1e6)] = 6.0
    log_every: Count = 20
    checkpoint_every: Count = 200
    progress: bool = True

    @property
    def folder(self) -> Path:
        """Folder of the run."""
        part = "fold" if self.split == "person" else "sequence"
        fold = "all" if self.test_fold is None else f"{part}{self.test_fold}"
        name = f"{self.model}_{self.preset}_{fold}_seed{self.seed}"
        return self.out or Path("checkpoints") / name

    def resolved(self) -> tuple[ModelSettings, PredictorTrainSettings]:
        """Return the preset's settings of network and training, with those given instead.

        Raises:
            RequestError: an option is not valid, or a setting is none of this network's.
        """
        require_ranges(self, "--{} {}")
        model, training = preset_settings(self.model, self.preset)
        given = {x.name: getattr(self, x.name) for x in fields(training)}
        given = {name: value for name, value in given.items() if value is not None}
        changes = parse_settings(self.settings, "--settings")
        return model.changed(changes), replace(training, **given)
