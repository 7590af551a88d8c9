"""What an evaluation was made from: checkpoints, dataset, options and versions, as JSON."""

from __future__ import annotations

import platform
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from face_prediction.dataset.manifest import MANIFEST_NAME
from face_prediction.dataset.reader import FaceDataset
from face_prediction.errors import RequestError
from face_prediction.evaluation.contestants import Contestant, TrainedPredictor
from face_prediction.video import sha256_of

#: Packages that the numbers may depend on.
PACKAGES = (
    "numpy", "scipy", "scikit-image", "torch", "mediapipe", "opencv-python-headless", "h5py",
)  # fmt: skip
WEIGHTS_NAME = "model.safetensors"


@dataclass(frozen=True)
class Checkpoint:
    """A trained network and where it came from."""

    folder: Path
    predictor: TrainedPredictor
    #: of the weights
    sha256: str


def load_checkpoint(folder: Path, dataset_sha256: str) -> Checkpoint:
    """The network in ``folder``, trained with the dataset whose ``dataset.json`` has that hash.

    Raises:
        RequestError: there is none, or it was trained with another dataset.
    """
    from face_prediction.models.learned import LearnedPredictor  # PyTorch: only where needed

    predictor = LearnedPredictor.load(folder)
    trained_with = predictor.record.dataset_sha256
    if trained_with != dataset_sha256:
        raise RequestError(
            f"{folder}: was trained with another dataset ({MANIFEST_NAME} of SHA-256 "
            f"{trained_with[:12]}, not {dataset_sha256[:12]}), whose folds are of other people; "
            "give that one, or train again"
        )
    return Checkpoint(folder, predictor, sha256_of(folder / WEIGHTS_NAME))


def provenance(
    dataset: FaceDataset,
    dataset_sha256: str,
    checkpoints: Sequence[Checkpoint],
    options: dict[str, Any],
) -> dict[str, Any]:
    """The part of ``results.json`` that says what the numbers are of."""
    manifest = dataset.manifest
    return {
        "dataset": {
            "sha256": dataset_sha256,
            "folds": manifest.folds,
            "sequences": len(dataset),
            "settings": manifest.settings.to_json(),
        },
        "checkpoints": [
            {
                "folder": item.folder.resolve().name,
                "name": item.predictor.name,
                "preset": item.predictor.preset,
                "test_fold": item.predictor.test_fold,
                "train_subjects": len(item.predictor.train_subjects),
                "sha256": item.sha256,
            }
            for item in checkpoints
        ],
        "options": options,
        "versions": versions(),
    }


def notes(
    trained: Sequence[Contestant],
    folds: Sequence[int],
    all_folds: int,
    max_sequences: int | None,
) -> list[str]:
    """What a reader of the tables must know of what was left out."""
    result: list[str] = []
    if len(folds) < all_folds:
        result.append(f"{len(folds)} of the dataset's {all_folds} folds are reported on.")
    for contestant in trained:
        more = [fold for fold in contestant.folds if fold not in folds]
        if more:
            result.append(
                f"{contestant.name} also has fold {', '.join(map(str, more))}, "
                "which not every network has; left out."
            )
    if max_sequences is not None:
        result.append(f"Of each kind at most {max_sequences} sequences, drawn at random.")
    return result


def versions() -> dict[str, str]:
    """Of Python and the packages that are installed."""
    found = {"python": platform.python_version()}
    for name in PACKAGES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            continue
    return found
