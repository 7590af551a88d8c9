"""The command line: ``face-prediction extract | export-motion | …``."""

from __future__ import annotations

import contextlib
import io
import itertools
import logging
import re
import sys
from collections.abc import Callable, Sequence
from typing import Annotated, Any

import tyro

from face_prediction.commands.build_dataset import BuildDatasetOptions, run_build_dataset
from face_prediction.commands.evaluate import EvaluateOptions, run_evaluate
from face_prediction.commands.export_motion import ExportMotionOptions, run_export_motion
from face_prediction.commands.export_stats import ExportStatsOptions, run_export_stats
from face_prediction.commands.export_surface import ExportSurfaceOptions, export_surface
from face_prediction.commands.extract import ExtractOptions, run_extract
from face_prediction.commands.live import LiveOptions, run_live
from face_prediction.commands.predict import PredictOptions, run_predict
from face_prediction.commands.train import run_train
from face_prediction.training.options import FaceTrainOptions
from robo_manip_baselines.runs.errors import RequestError

_COLOUR = re.compile(r"\x1b\[[0-9;]*m")
_FRAME = re.compile(r"^[\s│|╭╰─+-]+|[\s│|╮╯─+-]+$")

logger = logging.getLogger(__name__)

DESCRIPTION = """Faces in video: tracks, recorded motion, forecasts and how good they are.

Example:
  face-prediction extract clips/*.mp4 --out face_tracks
  face-prediction export-motion face_tracks --attribution clips.csv --out face_motion.npz
  face-prediction build-dataset face_tracks --videos clips --attribution clips.csv
  face-prediction train residual --dataset face_dataset --test_fold 0
  face-prediction evaluate --dataset face_dataset --checkpoints checkpoints/residual_cpu_fold0_seed0
"""

#: (name, options, function) of every subcommand
COMMANDS: tuple[tuple[str, type, Callable[[Any], int | None]], ...] = (
    ("extract", ExtractOptions, run_extract),
    ("export-motion", ExportMotionOptions, run_export_motion),
    ("export-surface", ExportSurfaceOptions, export_surface),
    ("build-dataset", BuildDatasetOptions, run_build_dataset),
    ("train", FaceTrainOptions, run_train),
    ("evaluate", EvaluateOptions, run_evaluate),
    ("export-stats", ExportStatsOptions, run_export_stats),
    ("predict", PredictOptions, run_predict),
    ("live", LiveOptions, run_live),
)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one subcommand; returns the exit code.

    0 done, 2 the request was wrong, 130 interrupted. Anything else that fails is not the user's
    doing: it raises, and Python exits with 1.
    """
    logging.basicConfig(format="%(message)s", level=logging.INFO, stream=sys.stderr)
    try:
        options = _parse(arguments)
        run = next(run for _, kind, run in COMMANDS if isinstance(options, kind))
        return run(options) or 0
    except RequestError as error:
        logger.error("face-prediction: %s", error)
        return 2
    except KeyboardInterrupt:
        logger.error("face-prediction: interrupted; finished files are kept")
        return 130


def _parse(arguments: Sequence[str] | None) -> Any:
    """Read the command line; what is wrong with it becomes one line."""
    union: Any = None
    for name, kind, _ in COMMANDS:
        subcommand = Annotated[kind, tyro.conf.subcommand(name=name)]
        union = subcommand if union is None else union | subcommand
    told = io.StringIO()
    try:
        with contextlib.redirect_stderr(told):
            return tyro.cli(
                union,
                prog="face-prediction",
                description=DESCRIPTION,
                args=None if arguments is None else list(arguments),
                use_underscores=True,
                config=(tyro.conf.OmitSubcommandPrefixes,),
            )
    except SystemExit as stop:
        if not stop.code:
            raise
        raise RequestError(f"{_first_words(told.getvalue())}; see face-prediction --help") from None


def _first_words(box: str) -> str:
    """What tyro says in its box, up to the first rule or gap, as one line."""
    lines = [_FRAME.sub("", _COLOUR.sub("", line)) for line in box.splitlines()[1:]]
    words = itertools.takewhile(bool, lines)
    return " ".join(words).rstrip(".") or "these options are not valid"
