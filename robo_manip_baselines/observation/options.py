"""How cameras, image sizes and corruptions are spelt on a command line."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

from robo_manip_baselines.errors import RequestError
from robo_manip_baselines.observation.corruption import MEASURED_ERRORS, Corruption


@dataclass(frozen=True)
class CorruptionOptions:
    """What stands between the true mouth and the one that a policy is shown; see `Corruption`."""

    error: str | None = None
    """Error of the forecast: none, uniform (the paper's), gaussian, empirical or model."""
    error_stats: Path | None = None
    """File of error statistics; the one that ships with the package if not given."""
    delay: int | None = None
    """Frames of 1/30 s from the camera to the policy; 0 if not given."""
    face_dropout: float | None = None
    """Share of the frames in which the face is lost; 0 if not given."""
    face_dropout_length: float | None = None
    """Mean frames of a loss; 15 if not given."""
    detector_rate: float | None = None
    """Reports of the detector per second, at most 30; one at every step if not given."""
    corruption_seed: int | None = None
    """Seed of errors and losses, beside that of the episode; 0 if not given."""
    corruption: bool = True
    """--no_corruption shows the truth, whatever else is said."""

    def apply(self, before: Corruption | None = None) -> Corruption | None:
        """Return the corruption that results when what was given replaces what was there before.

        Raises:
            RequestError: a value that is not valid.
        """
        given = {
            "error": self.error,
            "error_stats": self.error_stats and str(self.error_stats),
            "delay": self.delay,
            "face_dropout": self.face_dropout,
            "face_dropout_length": self.face_dropout_length,
            "detector_rate": self.detector_rate,
            "seed": self.corruption_seed,
        }
        changes = {name: value for name, value in given.items() if value is not None}
        if not self.corruption:
            return None
        start = before or Corruption()
        if changes.get("error", start.error) not in MEASURED_ERRORS:
            start = replace(start, error_stats=None, stats_sha256=None)
        elif self.error_stats is not None:
            start = replace(start, stats_sha256=None)
        result = replace(start, **changes)
        return None if result.is_off else result


def parse_cameras(cameras: tuple[str, ...]) -> tuple[str, ...]:
    """Return camera names; ``none`` stands for no camera at all, and commas may separate them."""
    names = tuple(name for part in cameras for name in part.split(",") if name)
    return () if names == ("none",) else names


def parse_image_size(size: str) -> tuple[int, int]:
    """Return (height, width) from ``HEIGHTxWIDTH``.

    Raises:
        RequestError: it is not of that form.
    """
    height, cross, width = size.lower().partition("x")
    if not (cross and height.isdecimal() and width.isdecimal()):
        raise RequestError(f"image size '{size}': must be HEIGHTxWIDTH, for example 480x640")
    return int(height), int(width)
