"""Images as JPEG or PNG bytes. Images are RGB, (H, W, 3) uint8."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from robo_manip_baselines.runs.errors import require_choice

CODECS = ("jpeg", "png", "raw")

# At 90 the error of a rendered scene is below what a policy's image augmentation adds;
# benchmarks/episode_io.py prints size and error for each codec.
DEFAULT_QUALITY = 90

REDUCTIONS = (1, 2, 4, 8)
"""JPEG images can be decoded at 1 / these of their size without decoding the whole first."""


def encode_image(
    image: NDArray[np.uint8], codec: str = "jpeg", quality: int = DEFAULT_QUALITY
) -> NDArray[np.uint8]:
    """Encode one image.

    Args:
        image: (H, W, 3) uint8, RGB.
        codec: ``jpeg`` (4:2:0), ``png`` (lossless) or ``raw``.
        quality: of JPEG, 1…100.

    Returns:
        (N,) uint8, a whole JPEG or PNG file; for ``raw`` a copy of the image itself.

    Raises:
        RequestError: for an unknown codec.
        ValueError: if ``image`` is not (H, W, 3) uint8.
    """
    import cv2  # slow to import; only images need it

    require_choice("image codec", codec, CODECS)
    if image.ndim != 3 or image.shape[2] != 3 or image.dtype != np.uint8 or not image.size:
        raise ValueError(f"an image is (H, W, 3) uint8, not {image.shape} {image.dtype}")
    if codec == "raw":
        return np.array(image, order="C")
    bgr = cv2.cvtColor(image, cv2.COLOR_RGB2BGR)
    if codec == "png":
        is_done, data = cv2.imencode(".png", bgr, [cv2.IMWRITE_PNG_COMPRESSION, 3])
    else:
        sampling = (cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_420)
        is_done, data = cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, quality, *sampling])
    if not is_done:
        raise ValueError(f"OpenCV did not encode an image of shape {image.shape} as {codec}")
    return np.asarray(data, dtype=np.uint8).reshape(-1)


def decode_image(data: NDArray[Any], reduce: int = 1) -> NDArray[np.uint8]:
    """Return the (H / reduce, W / reduce, 3) uint8 RGB image of which `encode_image` made ``data``.

    Args:
        data: of any codec.
        reduce: of JPEG, one of `REDUCTIONS`; raw images are returned whole.

    Raises:
        ValueError: the bytes are no image, or ``reduce`` is not valid.
    """
    import cv2

    if data.ndim == 3:
        return data
    if reduce not in REDUCTIONS:
        raise ValueError(f"reduce {reduce}: one of {', '.join(map(str, REDUCTIONS))}")
    flag = cv2.IMREAD_COLOR if reduce == 1 else getattr(cv2, f"IMREAD_REDUCED_COLOR_{reduce}")
    try:
        image = cv2.imdecode(data, flag) if data.size else None
    except cv2.error as error:
        raise ValueError(f"no image: {str(error).strip()}") from error
    if image is None:
        raise ValueError("no image")
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2RGB, dst=image), dtype=np.uint8)
