"""One module for each command of ``bin/``: its options, output and exit codes."""

from __future__ import annotations

import sys
from importlib import import_module
from typing import NoReturn

from robo_manip_baselines.envs.mujoco.cell.opengl import backend_problem
from robo_manip_baselines.runs.command import run_command


def run(name: str) -> NoReturn:
    """Run a command on ``sys.argv`` and end the process with its exit code.

    The command's module, ``name`` in this package, is imported inside, so that a package or an
    OpenGL backend that is missing becomes one line, too.

    Raises:
        SystemExit: always.
    """
    run_command(lambda: import_module(f"{__name__}.{name}").main(sys.argv[1:]), backend_problem)


def run_rollout() -> NoReturn:
    """Run ``rmb-rollout``, which is ``bin/Rollout.py`` of an installed package."""
    run("rollout")


def run_train() -> NoReturn:
    """Run ``rmb-train``."""
    run("train")


def run_benchmark() -> NoReturn:
    """Run ``rmb-benchmark``."""
    run("benchmark")


def run_dataset() -> NoReturn:
    """Run ``rmb-dataset``."""
    run("dataset")


def run_replay() -> NoReturn:
    """Run ``rmb-replay``."""
    run("replay")


def run_teleop() -> NoReturn:
    """Run ``rmb-teleop``."""
    run("teleop")


def run_tasks() -> NoReturn:
    """Run ``rmb-tasks``."""
    run("tasks")
