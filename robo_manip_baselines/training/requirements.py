"""Preparation for importing PyTorch: installed packages, and waiting of its threads."""

from __future__ import annotations

from importlib.util import find_spec

from robo_manip_baselines.runs.errors import RequestError
from robo_manip_baselines.runs.extras import install_command
from robo_manip_baselines.runs.threads import choose_waiting

PACKAGES = {
    "torch": "torch",
    "safetensors": "safetensors",
    "yaml": "PyYAML",
    "statsmodels": "statsmodels",
}
"""Module -> distribution."""


def prepare_pytorch() -> None:
    """Make sure that PyTorch is installed, and choose how its threads wait; before its import.

    Raises:
        RequestError: naming what is missing, and the command that installs it.
    """
    choose_waiting()
    missing = [name for module, name in PACKAGES.items() if find_spec(module) is None]
    if missing:
        raise RequestError(
            f"policies need {', '.join(missing)}; run: {install_command('train')} "
            "(for a machine without a GPU add "
            "--extra-index-url https://download.pytorch.org/whl/cpu)"
        )
