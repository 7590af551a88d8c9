"""Images as JPEG or PNG bytes. Images are RGB, (H, W, 3) uint8."""

from __future__ import annotations

import struct
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robo_manip_baselines.runs.errors import require_choice

CODECS = ("jpeg", "png", "raw")

# At 90 the error of a rendered scene is below what a policy's image augmentation adds;
# benchmarks/episode_io.py prints size and error for each codec.
DEFAULT_QUALITY = 90

MAX_SIDE = 8192
"""Pixels; larger images are not decoded."""

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
        ValueError: the bytes are no whole image, or ``reduce`` is not valid.
    """
    import cv2

    height, width = encoded_size(data)
    if data.ndim == 3:
        return data
    if reduce not in REDUCTIONS:
        raise ValueError(f"reduce {reduce}: one of {', '.join(map(str, REDUCTIONS))}")
    flag = cv2.IMREAD_COLOR if reduce == 1 else getattr(cv2, f"IMREAD_REDUCED_COLOR_{reduce}")
    try:
        image = cv2.imdecode(data, flag | cv2.IMREAD_IGNORE_ORIENTATION)
    except cv2.error as error:
        raise ValueError(f"no image: {str(error).strip()}") from error
    if image is None:
        raise ValueError("no image")
    # Rounded up for JPEG; PNG is shrunk after decoding, to whole pixels.
    if not all(
        size // reduce <= got <= -(-size // reduce)
        for size, got in zip((height, width), image.shape[:2], strict=True)
    ):
        raise ValueError(f"an image of {image.shape[:2]}, not of {height} x {width}")
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2RGB, dst=image), dtype=np.uint8)


def encoded_size(data: NDArray[Any]) -> tuple[int, int]:
    """Return height and width of an image as its header declares them; nothing is decoded.

    Args:
        data: of any codec.

    Raises:
        ValueError: the bytes are no whole RGB image of 8 bits, or it is larger than `MAX_SIDE`.
    """
    if data.dtype != np.uint8:
        raise ValueError(f"no image but {data.dtype}")
    if data.ndim == 3:
        height, width, channels = data.shape
    else:
        content = np.ascontiguousarray(data).reshape(-1).data
        if content[:2] == b"\xff\xd8":
            height, width, channels = _jpeg_size(content)
        elif content[:8] == _PNG_START:
            height, width, channels = _png_size(content)
        else:
            raise ValueError("no image: neither JPEG nor PNG")
    if channels != 3:
        raise ValueError(f"an image of {channels} channels, not of 3")
    if not (0 < height <= MAX_SIDE and 0 < width <= MAX_SIDE):
        raise ValueError(
            f"an image of {height} x {width} pixels; sides of 1 to {MAX_SIDE} are read"
        )
    return height, width


_PNG_START, _PNG_END = b"\x89PNG\r\n\x1a\n", b"\0\0\0\0IEND\xaeB`\x82"
_PNG_CHANNELS = {0: 1, 2: 3, 3: 1, 4: 2, 6: 4}


def _png_size(data: memoryview) -> tuple[int, int, int]:
    if len(data) < 33 or data[8:16] != b"\0\0\0\rIHDR" or data[-12:] != _PNG_END:
        raise ValueError("no image, or a truncated one")
    width, height, bits, color = struct.unpack(">IIBB", data[16:26])
    if bits != 8:
        raise ValueError(f"an image of {bits} bits, not of 8")
    return height, width, _PNG_CHANNELS.get(color, 0)


def _jpeg_size(data: memoryview) -> tuple[int, int, int]:
    """Height, width and components from the start-of-frame segment (ITU T.81, B.2.2)."""
    if data[-2:] != b"\xff\xd9":
        raise ValueError("no image, or a truncated one")
    place = 2
    while place + 9 < len(data) and data[place] == 0xFF:
        marker = data[place + 1]
        if marker in (0xC0, 0xC1, 0xC2):
            bits, height, width, components = struct.unpack(">BHHB", data[place + 4 : place + 10])
            if bits != 8:
                raise ValueError(f"an image of {bits} bits, not of 8")
            return height, width, components
        if marker == 0xFF:  # a fill byte
            place += 1
        else:
            place += 2 + int.from_bytes(data[place + 2 : place + 4], "big")
    raise ValueError("no image: a JPEG without a frame")
