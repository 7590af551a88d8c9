"""The command line: ``face-prediction extract | export-motion | export-surface``."""

from __future__ import annotations

import logging
import sys
from collections.abc import Callable, Sequence
from typing import Annotated, Any

import tyro

from face_prediction.errors import RequestError
from face_prediction.extract_command import ExtractOptions, run_extract
from face_prediction.motion_command import ExportMotionOptions, run_export_motion
from face_prediction.surface import ExportSurfaceOptions, export_surface

logger = logging.getLogger(__name__)

DESCRIPTION = """Faces in video: tracks, and the motion and the surface lifted from them.

Example:
  face-prediction extract clips/*.mp4 --out face_tracks
  face-prediction export-motion face_tracks --attribution clips.csv --out face_motion.npz
"""

#: (name, options, function) of every subcommand
COMMANDS: tuple[tuple[str, type, Callable[[Any], int | None]], ...] = (
    ("extract", ExtractOptions, run_extract),
    ("export-motion", ExportMotionOptions, run_export_motion),
    ("export-surface", ExportSurfaceOptions, export_surface),
)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one subcommand; returns the exit code.

    0 done, 2 the request was wrong, 130 interrupted. Anything else that fails is not the user's
    doing: it raises, and Python exits with 1.
    """
    logging.basicConfig(format="%(message)s", level=logging.INFO, stream=sys.stderr)
    union: Any = None
    for name, kind, _ in COMMANDS:
        subcommand = Annotated[kind, tyro.conf.subcommand(name=name)]
        union = subcommand if union is None else union | subcommand
    options = tyro.cli(
        union,
        prog="face-prediction",
        description=DESCRIPTION,
        args=None if arguments is None else list(arguments),
        use_underscores=True,
        config=(tyro.conf.OmitSubcommandPrefixes,),
    )
    run = next(run for _, kind, run in COMMANDS if isinstance(options, kind))
    try:
        return run(options) or 0
    except RequestError as error:
        logger.error("face-prediction: %s", error)
        return 2
    except KeyboardInterrupt:
        logger.error("face-prediction: interrupted; finished files are kept")
        return 130
