"""``python -m face_prediction``, and the command ``face-prediction``."""

from __future__ import annotations

from typing import NoReturn

from face_prediction.commands import cli
from robo_manip_baselines.runs.command import run_command


def main() -> NoReturn:
    """Run the command line and end the process with its exit code."""
    run_command(cli.main)


if __name__ == "__main__":
    main()
