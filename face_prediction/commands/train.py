"""``face-prediction train``: a dataset in, the folder of a trained network out."""

from __future__ import annotations

from face_prediction.training.options import FaceTrainOptions
from robo_manip_baselines.runs.errors import RequestError
from robo_manip_baselines.runs.extras import install_command
from robo_manip_baselines.runs.threads import choose_waiting


def run_train(options: FaceTrainOptions) -> int:
    """Train a network, or carry on where training was stopped.

    Returns:
        0, or 130 after a requested stop, whose state is saved.

    Raises:
        RequestError: the dataset, the options or the folder cannot be used, or PyTorch is not
            installed.
    """
    choose_waiting()
    try:
        from face_prediction.training.trainer import train_predictor  # not at the top: loads torch
    except ModuleNotFoundError as error:
        if error.name != "torch":
            raise
        install = install_command("face-prediction")
        raise RequestError(f"training needs PyTorch; run: {install}") from None
    return train_predictor(options)
