"""What sees a face and forecasts it: of another package, and imported where it is used.

It is named here as ``module:callable``, so that an environment that shows the truth needs neither a
detector nor a predictor (``docs/decisions/0014-perception-by-name.md``). An entry point of the
group ``robo_manip_baselines.perception`` takes the place of the shipped one.
"""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from importlib.metadata import entry_points
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from robo_manip_baselines.runs.errors import RequestError
from robo_manip_baselines.runs.extras import install_command

Floats = NDArray[np.float64]

TRACKER = "face_prediction.live.mouth:open_tracker"
"""``module:callable`` that opens the `MouthTracker`; entry point ``mouth_tracker``."""

PATH_PREDICTOR = "face_prediction.models.residual.paths:fit_paths"
"""``module:callable`` that fits the `PathPredictor`; entry point ``path_predictor``."""


class MouthTracker(Protocol):
    """Source of the mouth from images one after another."""

    def reset(self) -> None:
        """Forget everything: the next image is of another scene."""
        ...

    def update(
        self, image: NDArray[np.uint8], time: float, depth: NDArray[np.float32] | None = None
    ) -> Floats | None:
        """Take in an image (H, W, 3) of ``time`` s, and its depth (H, W) m along the view.

        Returns (K, 3) m, camera frame: the mouth in the image and 1 ... K - 1 frames of 1/30 s
        after it; None where no face was found.
        """
        ...

    def close(self) -> None:
        """Free what it holds."""
        ...


OpenTracker = Callable[[float, int], MouthTracker]
"""Opens a tracker, given the camera's vertical field of view (degrees) and the frames ahead."""


class PathFollower(Protocol):
    """State of a predictor that follows mouths, each through an episode of its own."""

    def update(self, mouths: Floats) -> None:
        """Take in the mouths (N, 3) m in the next frame, 1/30 s after the one before."""
        ...

    def forecast(self, recent: Floats, horizon: int) -> Floats:
        """Return the mouths (N, H, 3) m in the frames after ``recent`` (N, W, 3), the newest last.

        These are 1/30 s apart, and need not be frames that were taken in.
        """
        ...


class PathPredictor(Protocol):
    """A predictor that knows where the mouth was, in metres, and no image.

    Attributes:
        recent: W, frames that a forecast is made from, beside what was learnt.
    """

    recent: int

    def follow(self, mouths: int) -> PathFollower:
        """Return the state of N mouths that are seen for the first time."""
        ...


FitPaths = Callable[[Floats], PathPredictor]
"""Fits a predictor to paths (E, T, 3) m, each of another person, in frames of 1/30 s; the first
axis is the depth as a camera sees it that looks at the face."""


def find_tracker() -> OpenTracker:
    """Return what opens the tracker.

    Raises:
        RequestError: its package is missing.
    """
    return _find("mouth_tracker", TRACKER, "mouth_source camera: its tracker")


def find_path_predictor() -> FitPaths:
    """Return what fits the predictor of paths.

    Raises:
        RequestError: its package is missing.
    """
    return _find("path_predictor", PATH_PREDICTOR, "prediction residual: its predictor")


def _find(entry_point: str, shipped: str, what: str) -> Any:
    points = entry_points(group="robo_manip_baselines.perception", name=entry_point)
    reference = next(iter(points)).value if points else shipped
    module, _, name = reference.partition(":")
    try:
        return getattr(import_module(module), name)
    except ImportError as error:
        raise RequestError(
            f"{what} cannot be imported ({error}); run: {install_command('face-prediction')}"
        ) from None
