"""What stands between the true mouth and the one that is shown, as one frozen dataclass."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

from robo_manip_baselines.observation.error_stats import load_error_stats
from robo_manip_baselines.runs.errors import RequestError, require_choice

MEASURED_ERRORS = ("uniform", "gaussian", "empirical")
"""Errors of the forecast that are drawn, with the statistics of a file."""

ERRORS = ("none", *MEASURED_ERRORS, "model")
"""Errors of the forecast; ``model`` is the recorded output of a trained predictor."""

FRAME_RATE = 30.0
"""Hz of the video in which the detector looks for the face (paper, section IV.A)."""

DROPOUT_LENGTH = 15.0
"""frames that the face stays lost, on average, if nothing else is said: half a second."""


@dataclass(frozen=True)
class Corruption:
    """Errors of the forecast, delay, lost faces, and a detector that is slower than the robot.

    Everything is off by default; ``None`` in place of a `Corruption` turns all of it off.

    Attributes:
        error: of the forecast: ``none``; ``uniform``, the paper's; ``gaussian``; ``empirical``,
            measured ones played again; ``model``, the recorded output of a trained predictor.
        error_stats: file of error statistics; the one that ships with the package if None.
        stats_sha256: SHA-256 of that file, where a policy was trained with it; any if None.
        delay: frames of 1/30 s from the camera to the policy.
        face_dropout: share of the frames, 0 up to 1, in which the face is lost.
        face_dropout_length: mean frames of a loss.
        detector_rate: reports of the detector per second, at most 30; at every step if None.
        seed: of everything that is drawn, beside the seed of the episode.

    Raises:
        RequestError: a value that is not valid.
    """

    error: str = "none"
    error_stats: str | None = None
    stats_sha256: str | None = None
    delay: int = 0
    face_dropout: float = 0.0
    face_dropout_length: float = DROPOUT_LENGTH
    detector_rate: float | None = None
    seed: int = 0

    def __post_init__(self) -> None:
        require_choice("error model", self.error, ERRORS)
        if self.error_stats is not None and self.error not in MEASURED_ERRORS:
            raise RequestError(
                f"error_stats '{self.error_stats}' goes with the errors "
                f"{', '.join(MEASURED_ERRORS)}, not with '{self.error}'; leave it out"
            )
        if self.delay < 0:
            raise RequestError(f"delay {self.delay}: must be 0 or more frames of 1/30 s")
        if not (math.isfinite(self.face_dropout_length) and self.face_dropout_length >= 1.0):
            raise RequestError(
                f"face_dropout_length {self.face_dropout_length:g}: must be 1 or more frames"
            )
        # Losses of that length, however close together, leave at least one frame between them.
        most = self.face_dropout_length / (self.face_dropout_length + 1.0)
        if not 0.0 <= self.face_dropout <= most:
            raise RequestError(
                f"face_dropout {self.face_dropout:g}: must be 0 to {most:.3g}, the share of frames "
                f"in which the face is lost, with losses of {self.face_dropout_length:g} frames"
            )
        rate = self.detector_rate
        if rate is not None and not 0.0 < rate <= FRAME_RATE:
            raise RequestError(
                f"detector_rate {rate:g}: must be above 0 and at most {FRAME_RATE:g} Hz, the "
                "camera's; leave it out for a report at every step"
            )
        if self.seed < 0:
            raise RequestError(f"seed {self.seed} of the corruption: must be 0 or more")

    @classmethod
    def of(cls, values: Mapping[str, Any]) -> Corruption:
        """Make one from its fields, as they come out of JSON.

        Raises:
            RequestError: a value or a name that is not valid.
        """
        names = [field.name for field in fields(cls)]
        for name in values:
            require_choice("setting of the corruption", name, names)
        return cls(**values)

    @property
    def is_off(self) -> bool:
        """Whether the truth is shown."""
        return (
            self.error == "none"
            and not self.delay
            and not self.face_dropout
            and self.detector_rate is None
        )

    @property
    def label(self) -> str:
        """Name what is corrupted and how, for arms and folders: ``uniform_delay3``."""
        parts = []
        if self.error != "none":
            stem = f"_{Path(self.error_stats).stem}" if self.error_stats else ""
            parts.append(f"{self.error}{stem}")
        if self.delay:
            parts.append(f"delay{self.delay}")
        if self.face_dropout:
            length = (
                f"x{self.face_dropout_length:g}"
                if self.face_dropout_length != DROPOUT_LENGTH
                else ""
            )
            parts.append(f"dropout{self.face_dropout:g}{length}")
        if self.detector_rate is not None:
            parts.append(f"rate{self.detector_rate:g}")
        if self.seed:
            parts.append(f"draw{self.seed}")
        return "_".join(parts)

    def pinned(self) -> Corruption:
        """Return the same with the SHA-256 of its file of statistics, if it uses one.

        Raises:
            RequestError: the file cannot be used, or is not the one of ``stats_sha256``.
        """
        if self.error not in MEASURED_ERRORS:
            return self
        stats = load_error_stats(self.error_stats, self.stats_sha256)
        return replace(self, stats_sha256=stats.sha256)
