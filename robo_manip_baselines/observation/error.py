"""What stands between the true mouth and the observed one.

An error model takes the true mouth positions (..., K, 3) m, world frame, for the K = H + 1 frames
0 ... H, and returns observed ones of the same shape. Adding one is a function and a line in
``ERRORS``.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

ErrorModel = Callable[[NDArray[np.float64]], NDArray[np.float64]]


def no_error(mouth: NDArray[np.float64]) -> NDArray[np.float64]:
    """Show the truth."""
    return mouth


ERRORS: dict[str, ErrorModel] = {"none": no_error}
