"""Preparation for importing PyTorch: installed packages, and how its threads wait."""

from __future__ import annotations

import os
from importlib.util import find_spec

from robo_manip_baselines.runs.errors import RequestError
from robo_manip_baselines.runs.extras import install_command

PACKAGES = {
    "torch": "torch",
    "safetensors": "safetensors",
    "yaml": "PyYAML",
    "statsmodels": "statsmodels",
}
"""Module -> distribution."""

SPINS = 3000
"""Spins of an OpenMP thread before it sleeps, some 10 us. Chosen with ACT's preset ``cpu`` on two
cores: 0 gave 13 steps/s idle and 11 beside a busy program, 3000 gave 20 and 9, 30 000 gave 21 and
5."""


def prepare_pytorch() -> None:
    """Make sure that PyTorch is installed, and set how OpenMP waits; call it before the import.

    Threads of GNU OpenMP that have nothing to do spin for long before they sleep, which takes the
    processor from the thread that they wait for as soon as another program is running: steps have
    taken four times as long. Asleep at once, they cost as much to wake on an idle machine as they
    save. A short spin does well in both cases; ``GOMP_SPINCOUNT`` and ``OMP_WAIT_POLICY`` override
    it.

    Raises:
        RequestError: naming what is missing, and the command that installs it.
    """
    if "OMP_WAIT_POLICY" not in os.environ:
        os.environ.setdefault("GOMP_SPINCOUNT", str(SPINS))
    missing = [name for module, name in PACKAGES.items() if find_spec(module) is None]
    if missing:
        raise RequestError(
            f"policies need {', '.join(missing)}; run: {install_command('train')} "
            "(for a machine without a GPU add "
            "--extra-index-url https://download.pytorch.org/whl/cpu)"
        )
