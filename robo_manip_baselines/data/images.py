"""Pictures to bytes and back: JPEG, PNG or raw. Images are RGB, (H, W, 3) uint8."""

from __future__ import annotations

import zlib
from typing import Literal, get_args

import cv2
import numpy as np

from robo_manip_baselines.errors import require_choice

ImageCodec = Literal["jpeg", "png", "raw"]
CODECS: tuple[str, ...] = get_args(ImageCodec)

# At 90 the error of a rendered scene is below what a policy's image augmentation adds;
# benchmarks/episode_io.py prints size and error for each codec.
DEFAULT_QUALITY = 90


def encode_image(
    image: np.ndarray, codec: str = "jpeg", quality: int = DEFAULT_QUALITY
) -> np.ndarray:
    """Encode one picture.

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
    require_choice("image codec", codec, CODECS)
    if image.ndim != 3 or image.shape[2] != 3 or image.dtype != np.uint8 or not image.size:
        raise ValueError(f"an image is (H, W, 3) uint8, not {image.shape} {image.dtype}")
    if codec == "raw":
        return np.array(image, order="C")
    bgr = cv2.cvtColor(image, cv2.COLOR_RGB2BGR)
    if codec == "png":
        is_done, data = cv2.imencode(".png", bgr, [cv2.IMWRITE_PNG_COMPRESSION, 3])
    else:
        options = [
            cv2.IMWRITE_JPEG_QUALITY,
            quality,
            cv2.IMWRITE_JPEG_SAMPLING_FACTOR,
            cv2.IMWRITE_JPEG_SAMPLING_FACTOR_420,
        ]
        is_done, data = cv2.imencode(".jpg", bgr, options)
    if not is_done:
        raise ValueError(f"OpenCV did not encode an image of shape {image.shape} as {codec}")
    return np.asarray(data, dtype=np.uint8).reshape(-1)


def decode_image(data: np.ndarray) -> np.ndarray:
    """Undo `encode_image`, whatever the codec.

    Args:
        data: (N,) uint8 of a JPEG or PNG file, or a raw (H, W, 3) uint8 image.

    Returns:
        (H, W, 3) uint8, RGB.

    Raises:
        ValueError: if the bytes are no picture.
    """
    if data.ndim == 3:
        return data
    try:
        bgr = cv2.imdecode(data, cv2.IMREAD_COLOR) if data.size else None
    except cv2.error as error:
        raise ValueError(f"no picture: {str(error).strip()}") from error
    if bgr is None:
        raise ValueError("no picture")
    return cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB)


def image_checksum(data: np.ndarray) -> int:
    """CRC-32 of an encoded picture, as kept beside it in the episode file."""
    return zlib.crc32(np.ascontiguousarray(data).reshape(-1).data)
