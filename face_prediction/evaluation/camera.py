"""From errors in the image to errors in metres: equations 6 and 7 of the paper."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from face_prediction.errors import RequestError

#: What `Camera.metres` computes, as it stands in every file of error statistics.
EQUATIONS = (
    "max_dx = 2 * depth_m * tan(fov_x_deg / 2) * crop_width * dU",
    "max_dy = 2 * depth_m * tan(fov_y_deg / 2) * crop_height * dV",
)


@dataclass(frozen=True)
class Camera:
    """The camera that errors are converted for.

    The paper's equations have dU and dV in whole images. Where they were measured in crops,
    ``crop_width`` and ``crop_height`` say how large the crop is in that camera's image.
    """

    #: degrees, across and up: the webcam of section IV.C
    fov_x_deg: float = 75.0
    fov_y_deg: float = 47.0
    #: metres from the camera to the mouth (section IV.C)
    depth_m: float = 0.5
    #: the crop's side as a share of the image's width and height; 1: the crop is the image
    crop_width: float = 1.0
    crop_height: float = 1.0

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            limit = 180.0 if name.startswith("fov") else np.inf
            if not 0 < value < limit:
                raise RequestError(f"camera: {name} {value}; must be above 0 and below {limit}")

    def metres(self, errors: NDArray[np.floating]) -> NDArray[np.float64]:
        """Errors (..., 2) across and up in metres, parallel to the image, of (dU, dV)."""
        half = np.radians([self.fov_x_deg / 2, self.fov_y_deg / 2])
        view = 2 * self.depth_m * np.tan(half)  # width and height of what is seen, at that depth
        return np.asarray(errors) * view * (self.crop_width, self.crop_height)


PAPER_CAMERA = Camera()
