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

logger = logging.getLogger(__name__)

DESCRIPTION = """Faces in video: tracks, and the recorded motion lifted from them.

Example:
  face-prediction extract clips/*.mp4 --out face_tracks
  face-prediction export-motion face_tracks --attribution clips.csv --out face_motion.npz
"""


def commands() -> list[tuple[str, type, Callable[[Any], int | None]]]:
    """(name, options, function) of every subcommand."""
    # imported here so that tracks can be made where the surface's own needs are missing
    try:
        from face_prediction.surface import ExportSurfaceOptions, export_surface
    except ImportError:
        return [
            ("extract", ExtractOptions, run_extract),
            ("export-motion", ExportMotionOptions, run_export_motion),
        ]

    return [
        ("extract", ExtractOptions, run_extract),
        ("export-motion", ExportMotionOptions, run_export_motion),
        ("export-surface", ExportSurfaceOptions, export_surface),
    ]


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one subcommand; returns the exit code.

    0 done, 2 the request was wrong, 1 something else failed, 130 interrupted.
    """
    logging.basicConfig(format="%(message)s", level=logging.INFO, stream=sys.stderr)
    known = commands()
    kinds = tuple(Annotated[options, tyro.conf.subcommand(name=name)] for name, options, _ in known)
    union: Any = kinds[0]
    for kind in kinds[1:]:
        union = union | kind
    try:
        options = tyro.cli(
            union,
            prog="face-prediction",
            description=DESCRIPTION,
            args=None if arguments is None else list(arguments),
            use_underscores=True,
            config=(tyro.conf.OmitSubcommandPrefixes,),
        )
        run = next(run for _, kind, run in known if isinstance(options, kind))
        return run(options) or 0
    except RequestError as error:
        logger.error("face-prediction: %s", error)
        return 2
    except KeyboardInterrupt:
        logger.error("face-prediction: interrupted; finished files are kept")
        return 130
