"""How alike two pictures are: SSIM.

Legend: B sequences, H horizon, S side of the pictures, s side they are compared at.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from face_prediction.errors import RequestError

#: Standard deviation (pixels) of the Gaussian window of Wang et al. 2004, which scikit-image cuts
#: off at 3.5 of them: 11 pixels across, as in that paper.
SIGMA = 1.5
#: Side (pixels) of that window: the smallest picture that has a similarity.
SMALLEST = 11


def similarities(forecast: NDArray[np.uint8], truth: NDArray[np.uint8]) -> NDArray[np.float64]:
    """SSIM (B, H) of pictures (B, H, S, S, 3): the mean over the picture and the three colours.

    Of scikit-image, with the settings of Wang, Bovik, Sheikh and Simoncelli (2004): a Gaussian
    window with a standard deviation of 1.5 pixels, and population covariances.

    Raises:
        RequestError: scikit-image is not installed, the shapes differ, or the pictures are smaller
            than the window.
    """
    if forecast.shape != truth.shape or truth.ndim != 5 or truth.shape[2] < SMALLEST:
        raise RequestError(
            f"pictures of shape {forecast.shape} against {truth.shape}; expected the same "
            f"(sequences, horizon, size, size, 3), of {SMALLEST} pixels or more"
        )
    try:
        from skimage.metrics import structural_similarity
    except ImportError as error:
        raise RequestError(
            f"SSIM needs scikit-image ({error}); pip install "
            "'robo_manip_baselines[face_prediction]'"
        ) from None
    ours, true = forecast.astype(np.float32), truth.astype(np.float32)
    result = np.empty(truth.shape[:2])
    for place in np.ndindex(result.shape):
        result[place] = structural_similarity(
            ours[place],
            true[place],
            gaussian_weights=True,
            sigma=SIGMA,
            use_sample_covariance=False,
            data_range=255,
            channel_axis=-1,
        )
    return result


def area_average(pictures: NDArray[np.uint8], size: int) -> NDArray[np.uint8]:
    """Pictures (B, H, S, S, 3) at side ``size``: each pixel the mean of those that it covers.

    Raises:
        RequestError: S is no multiple of ``size``.
    """
    side = pictures.shape[2]
    if side == size:
        return pictures
    if size < 1 or side % size:
        raise RequestError(f"pictures of {side} pixels cannot be averaged to {size}")
    step = side // size
    blocks = pictures.reshape(*pictures.shape[:2], size, step, size, step, 3)
    mean = blocks.astype(np.float32).mean(axis=(3, 5))
    return np.rint(mean).astype(np.uint8)
