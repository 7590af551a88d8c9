"""The mouth centre in image coordinates.

Legend: L = 468 landmarks.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from face_prediction.lifting import LIPS

_LIPS = list(LIPS)


def mouth_centre(landmarks: NDArray[np.floating]) -> NDArray[np.float64]:
    """Mean (..., 2) of the 40 lip landmarks of (..., L, 2 or 3), in the landmarks' own unit.

    The paper's mouth centre: "the average of the U and V coordinates of all mouth-related
    landmarks" (section IV.B).
    """
    return np.asarray(landmarks)[..., _LIPS, :2].mean(axis=-2, dtype=np.float64)
