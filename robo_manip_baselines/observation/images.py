"""Images as policies are shown them: the one function between a drawn or recorded image and those.

Environments apply it to what they draw, training to what was recorded.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def fit_image(image: NDArray[np.uint8], size: tuple[int, int]) -> NDArray[np.uint8]:
    """Crop an (H, W, 3) image to the aspect ratio of ``size``, and shrink it to that size.

    The crop is the largest one about the centre, so that nothing is squashed; each pixel of the
    result is then the mean of its area. An image of that size already is returned as it is.

    Args:
        image: uint8.
        size: height and width, neither larger than the image's.

    Raises:
        ValueError: the image would have to be enlarged.
    """
    (height, width), (rows, columns) = image.shape[:2], size
    if (height, width) == (rows, columns):
        return image
    if rows > height or columns > width:
        raise ValueError(f"an image of {height}x{width} cannot be shown at {rows}x{columns}")
    import cv2  # slow to import; only images need it

    kept_height = min(height, round(width * rows / columns))
    kept_width = min(width, round(height * columns / rows))
    top, left = (height - kept_height) // 2, (width - kept_width) // 2
    part = image[top : top + kept_height, left : left + kept_width]
    small = cv2.resize(part, (columns, rows), interpolation=cv2.INTER_AREA)
    return np.asarray(small, dtype=np.uint8)
