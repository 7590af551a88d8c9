"""Weights of any predictor by their folder: of `train`, of `fit`, and those shipped."""

from __future__ import annotations

from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING

from face_prediction.forecast import Forecaster, restore_forecaster
from robo_manip_baselines.runs.errors import RequestError

if TYPE_CHECKING:
    from face_prediction.models.learned import CheckpointRecord, LearnedPredictor
    from face_prediction.models.residual.predictor import ResidualFit, ResidualPredictor

SHIPPED = "shipped"
"""Name of the weights that come with the package."""
RESIDUAL = "residual"
BASELINES_FILE = "baselines.safetensors"
"""Baselines fitted to the same people as the weights beside it."""


def checkpoint_folder(name: str | Path) -> Path:
    """The folder of weights: a path, or that of ``shipped``.

    Raises:
        RequestError: there is none.
    """
    if str(name) == SHIPPED:
        return Path(str(files("face_prediction"))) / "assets" / "residual"
    folder = Path(name)
    if not folder.is_dir():
        valid = f"valid: {SHIPPED}, or a folder written by face-prediction fit or train"
        raise RequestError(f"{name}: no such folder; {valid}")
    return folder


def load_predictor(
    folder: str | Path,
) -> tuple[LearnedPredictor | ResidualPredictor, CheckpointRecord]:
    """Load weights and their record.

    Raises:
        RequestError: they are absent, damaged or of another schema.
    """
    from face_prediction.models.learned import (
        CONFIG_FILE,
        LearnedPredictor,
        read_predictor_checkpoint,
    )
    from face_prediction.models.residual.predictor import ResidualFit, ResidualPredictor

    folder = checkpoint_folder(folder)
    record, tensors = read_predictor_checkpoint(folder)
    if record.model != RESIDUAL:
        network = LearnedPredictor.load(folder)
        return network, network.record
    try:
        arrays = {name: tensor.double().numpy() for name, tensor in tensors.items()}
        fit = ResidualFit.from_arrays(arrays)
    except RequestError as error:
        raise RequestError(f"{folder / CONFIG_FILE}: {error}") from None
    return ResidualPredictor(fit), record


def save_residual(
    folder: Path, record: CheckpointRecord, fit: ResidualFit, baselines: list[Forecaster]
) -> None:
    """Write the weights of residual prediction, and baselines fitted to the same people.

    The record, without which the weights are none, is written last.

    Raises:
        RequestError: the folder cannot be written to.
    """
    import torch

    from face_prediction.models.learned import save_predictor_checkpoint, write_tensors

    arrays = {
        f"{forecaster.name}/{name}": torch.from_numpy(array.copy())
        for forecaster in baselines
        for name, array in forecaster.arrays().items()
    }
    write_tensors(folder / BASELINES_FILE, arrays, {"train_subjects": record.train_subjects})
    tensors = {name: torch.from_numpy(array).float() for name, array in fit.arrays().items()}
    save_predictor_checkpoint(folder, record, tensors)


def holds_residual(path: Path) -> bool:
    """Return whether a file is one of tensors that `save_residual` writes.

    Raises:
        RequestError: it holds no tensors that this package wrote.
    """
    from face_prediction.models.learned import read_tensors

    tensors, record, _ = read_tensors(path)
    return "basis" in tensors or (path.name == BASELINES_FILE and "train_subjects" in record)


def load_baselines(folder: str | Path) -> tuple[list[Forecaster], frozenset[str]]:
    """The baselines beside weights of residual prediction, and the people they are fitted to.

    Raises:
        RequestError: there are none.
    """
    from face_prediction.models.learned import read_tensors

    tensors, record, _ = read_tensors(checkpoint_folder(folder) / BASELINES_FILE)
    names = dict.fromkeys(name.partition("/")[0] for name in sorted(tensors))
    restored = [
        restore_forecaster(
            kind,
            {
                name.partition("/")[2]: tensor.numpy()
                for name, tensor in tensors.items()
                if name.startswith(f"{kind}/")
            },
        )
        for kind in names
    ]
    return restored, frozenset(record["train_subjects"])
