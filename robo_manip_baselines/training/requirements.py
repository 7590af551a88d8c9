"""What must be so before PyTorch is imported: that it is there, and how its threads wait."""

from __future__ import annotations

import os
from importlib.util import find_spec

from robo_manip_baselines.errors import RequestError

PACKAGES = {"torch": "torch", "safetensors": "safetensors", "yaml": "PyYAML"}
"""Module -> distribution."""


def prepare_pytorch() -> None:
    """Make sure that training can be imported; tell OpenMP how to wait.

    Threads that have nothing to do sleep. Left alone they spin, which takes the processor from
    the thread that they wait for as soon as another program is running: steps have taken two to
    four times as long. ``OMP_WAIT_POLICY`` overrides it.

    Raises:
        RequestError: naming what is missing, and the command that installs it.
    """
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    missing = [name for module, name in PACKAGES.items() if find_spec(module) is None]
    if missing:
        raise RequestError(
            f"policies need {', '.join(missing)}: pip install 'robo_manip_baselines[train]' "
            "(for a machine without a GPU add "
            "--extra-index-url https://download.pytorch.org/whl/cpu)"
        )
