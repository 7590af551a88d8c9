"""One module for each command of ``bin/``: its options, output and exit codes."""

from __future__ import annotations

import sys
from importlib import import_module
from typing import NoReturn

from robo_manip_baselines.envs.mujoco.cell.opengl import backend_problem
from robo_manip_baselines.runs.command import run_command


def run(name: str) -> NoReturn:
    """Run a command on ``sys.argv`` and end the process with its exit code.

    The command's module is imported inside, so that a package or an OpenGL backend that is missing
    becomes one line, too.

    Args:
        name: module of this package, whose ``main`` takes the arguments.

    Raises:
        SystemExit: always.
    """

    def main() -> int | None:
        return import_module(f"{__name__}.{name}").main(sys.argv[1:])

    run_command(main, backend_problem)
