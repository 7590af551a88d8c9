"""Encoding and decoding of pictures."""

from __future__ import annotations

import numpy as np
import pytest

from robo_manip_baselines.data.example import make_frames
from robo_manip_baselines.runs.errors import RequestError
from robo_manip_baselines.runs.images import decode_image, encode_image


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
