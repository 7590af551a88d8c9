"""Encoding and decoding of pictures."""

from __future__ import annotations

import struct
import zlib

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from robo_manip_baselines.data.example import make_frames
from robo_manip_baselines.runs.errors import RequestError
from robo_manip_baselines.runs.images import decode_image, encode_image, encoded_size


@pytest.mark.parametrize("codec", ["png", "raw"])
def test_lossless_codecs(codec: str) -> None:
    image = np.random.default_rng(0).integers(0, 256, (17, 23, 3), dtype=np.uint8)
    np.testing.assert_array_equal(decode_image(encode_image(image, codec)), image, strict=True)


@pytest.mark.parametrize("colour", [(255, 0, 0), (0, 255, 0), (0, 0, 255), (200, 170, 150)])
def test_jpeg_keeps_colours_in_rgb_order(colour: tuple[int, int, int]) -> None:
    image = np.full((32, 48, 3), colour, dtype=np.uint8)
    decoded = decode_image(encode_image(image, "jpeg"))
    # A flat colour is hit up to the rounding of YCbCr.
    assert np.abs(decoded.astype(int) - image).max() <= 3


def test_jpeg_quality_is_used() -> None:
    image = make_frames(1, size=(96, 128))[0]
    sizes = [encode_image(image, "jpeg", quality).size for quality in (30, 90, 100)]
    assert sizes == sorted(sizes)
    assert sizes[0] < sizes[2]


def test_raw_is_a_copy() -> None:
    image = make_frames(1)[0]
    encoded = encode_image(image, "raw")
    image[:] = 0
    assert encoded.any()


@pytest.mark.parametrize(
    "image",
    [
        np.zeros((4, 4), np.uint8),
        np.zeros((4, 4, 4), np.uint8),
        np.zeros((4, 4, 3), np.float32),
        np.zeros((0, 4, 3), np.uint8),
    ],
)
def test_what_is_no_image_is_refused(image: np.ndarray) -> None:
    with pytest.raises(ValueError, match=r"\(H, W, 3\) uint8"):
        encode_image(image, "jpeg")


def test_unknown_codec_lists_the_valid_ones() -> None:
    with pytest.raises(RequestError, match=r"unknown image codec 'jpg'.*jpeg, png, raw"):
        encode_image(make_frames(1)[0], "jpg")


@pytest.mark.parametrize("data", [b"", b"x", b"\xff\xd8\xff garbage"])
def test_bytes_that_are_no_picture(data: bytes) -> None:
    with pytest.raises(ValueError, match="no image"):
        decode_image(np.frombuffer(data, np.uint8))


def png_header(width: int, height: int, bits: int = 8, color: int = 2) -> bytes:
    """A PNG file that declares a size and holds no pixels."""
    chunk = b"IHDR" + struct.pack(">IIBBBBB", width, height, bits, color, 0, 0, 0)
    crc = struct.pack(">I", zlib.crc32(chunk))
    return b"\x89PNG\r\n\x1a\n\0\0\0\r" + chunk + crc + b"\0\0\0\0IEND\xaeB`\x82"


def by_opencv(suffix: str, shape: tuple[int, ...], dtype: str = "uint8") -> bytes:
    return cv2.imencode(suffix, np.zeros(shape, dtype))[1].tobytes()


JPEG = encode_image(make_frames(1)[0], "jpeg").tobytes()
PNG = encode_image(make_frames(1)[0], "png").tobytes()


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (png_header(30_000, 30_000), "an image of 30000 x 30000 pixels"),
        (png_header(0, 24), "an image of 24 x 0"),
        (png_header(32, 24, color=6), "an image of 4 channels, not of 3"),
        (png_header(32, 24, color=0), "an image of 1 channels, not of 3"),
        (png_header(32, 24, bits=16), "an image of 16 bits, not of 8"),
        (png_header(32, 24), "no image"),
        (JPEG[:-2], "no image, or a truncated one"),
        (JPEG[: len(JPEG) // 2], "no image, or a truncated one"),
        (PNG[:-1], "no image, or a truncated one"),
        (PNG[: len(PNG) // 2], "no image, or a truncated one"),
        (by_opencv(".jpg", (24, 32)), "an image of 1 channels"),
        (by_opencv(".png", (24, 32, 3), "uint16"), "an image of 16 bits"),
        (by_opencv(".bmp", (24, 32, 3)), "neither JPEG nor PNG"),
        (b"\xff\xd8" + b"\xff" * 50 + b"\xff\xd9", "a JPEG without a frame"),
        (b"\xff\xd8\xff\xe0\0\0\0\0\0\0\0\0\0\0\xff\xd9", "a JPEG without a frame"),
    ],
)
def test_headers_are_checked_before_decoding(data: bytes, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        decode_image(np.frombuffer(data, np.uint8))


@given(place=st.floats(0, 1, exclude_max=True), value=st.integers(0, 255), png=st.booleans())
@settings(deadline=None, derandomize=True)
def test_a_changed_byte_never_changes_the_size_unseen(place: float, value: int, png: bool) -> None:
    data = bytearray(PNG if png else JPEG)
    data[int(place * len(data))] = value
    content = np.frombuffer(bytes(data), np.uint8)
    try:
        assert decode_image(content).shape[:2] == encoded_size(content)
    except ValueError:
        return
