"""Pictures to JPEG bytes and back. RGB, (H, W, 3) uint8."""

from __future__ import annotations

import zlib

import numpy as np

#: Sizes that JPEG can be decoded at without first decoding the whole picture: 1 / these.
REDUCTIONS = (1, 2, 4, 8)


def encode_picture(image: np.ndarray, quality: int) -> np.ndarray:
    """JPEG bytes (N,) uint8 (4:2:0) of ``image`` (H, W, 3)."""
    import cv2  # not at the top: the command line starts without OpenCV

    options = [
        cv2.IMWRITE_JPEG_QUALITY,
        quality,
        cv2.IMWRITE_JPEG_SAMPLING_FACTOR,
        cv2.IMWRITE_JPEG_SAMPLING_FACTOR_420,
    ]
    is_done, data = cv2.imencode(".jpg", cv2.cvtColor(image, cv2.COLOR_RGB2BGR), options)
    if not is_done:
        raise ValueError(f"OpenCV did not encode an image of shape {image.shape}")
    return np.asarray(data, dtype=np.uint8).reshape(-1)


def decode_picture(data: np.ndarray, reduce: int = 1) -> np.ndarray:
    """(H / reduce, W / reduce, 3) uint8 of JPEG bytes (N,) uint8.

    Raises:
        ValueError: the bytes are no picture, or ``reduce`` is none of `REDUCTIONS`.
    """
    import cv2

    flags = {
        1: cv2.IMREAD_COLOR,
        2: cv2.IMREAD_REDUCED_COLOR_2,
        4: cv2.IMREAD_REDUCED_COLOR_4,
        8: cv2.IMREAD_REDUCED_COLOR_8,
    }
    if reduce not in flags:
        raise ValueError(f"reduce {reduce}: one of {', '.join(map(str, REDUCTIONS))}")
    try:
        image = cv2.imdecode(data, flags[reduce]) if data.size else None
    except cv2.error as error:
        raise ValueError(f"no picture: {str(error).strip()}") from error
    if image is None:
        raise ValueError("no picture")
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2RGB, dst=image), dtype=np.uint8)


def checksum(data: np.ndarray) -> int:
    """CRC-32 of encoded bytes."""
    return zlib.crc32(np.ascontiguousarray(data).data)
