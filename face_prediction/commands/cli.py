"""The command line: ``face-prediction extract | export-motion | …``.

The command ``x-y`` is the function ``run_x_y`` of the module ``x_y`` of this package; the type of
its parameter ``options`` gives the options of the command. Only the module of the command that is
asked for is imported.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from importlib import import_module
from typing import get_type_hints

from robo_manip_baselines.runs.command import parse
from robo_manip_baselines.runs.errors import RequestError, require_choice

COMMANDS = {
    "extract": "Follow one face through each video.",
    "export-motion": "Lift face tracks to metres, and write the runs that can be trusted.",
    "export-surface": "Average face tracks into one surface with a jaw.",
    "build-dataset": "Cut face tracks and their videos into sequences to learn from.",
    "fit": "Fit residual prediction, the predictor to use.",
    "train": "Train a network of the paper that forecasts faces.",
    "evaluate": "Compare trained networks and baselines on people that they never saw.",
    "export-stats": "Measure the errors of forecasts of the mouth.",
    "predict": "Forecast every frame of a library of recorded motion.",
    "live": "Follow and forecast a face in a camera or a video.",
}

HELP = """usage: face-prediction COMMAND [--help] [options]

Faces in video: tracks, recorded motion, forecasts and how good they are.

{commands}

Example:
  face-prediction extract clips/*.mp4 --out face_tracks
  face-prediction export-motion face_tracks --attribution clips.csv --out face_motion.npz
  face-prediction build-dataset face_tracks --videos clips --attribution clips.csv
  face-prediction fit --dataset face_dataset --test_fold 0
  face-prediction evaluate --dataset face_dataset --checkpoints checkpoints/residual_fold0

'face-prediction COMMAND --help' lists the options of a command."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command on ``arguments``, by default those of the process.

    Returns:
        The exit code: 0 done, 2 a part of the request was wrong, 130 interrupted.

    Raises:
        RequestError: the request was wrong.
        SystemExit: after ``--help`` of a command.
    """
    given = list(sys.argv[1:] if arguments is None else arguments)
    if given and given[0] in ("-h", "--help"):
        width = max(map(len, COMMANDS))
        lines = [f"  {name:<{width}}  {summary}" for name, summary in COMMANDS.items()]
        print(HELP.format(commands="\n".join(lines)))  # noqa: T201
        return 0
    if not given:
        raise RequestError(f"no command given; valid: {', '.join(COMMANDS)}")
    name = require_choice("command", given[0], COMMANDS)
    stem = name.replace("-", "_")
    run = getattr(import_module(f"face_prediction.commands.{stem}"), f"run_{stem}")
    options_type = get_type_hints(run)["options"]
    return run(parse(options_type, None, args=given[1:], prog=f"face-prediction {name}")) or 0
