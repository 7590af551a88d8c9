"""Crops: where they lie, what they show, and how landmarks come out in them."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from face_prediction.tracking.geometry import Crop, crop_around


def box(left: float, top: float, right: float, bottom: float, size=(640, 480)) -> np.ndarray:
    """Landmarks (1, 2, 3) at two corners given in pixels."""
    corners = np.array([[left, top, 0.0], [right, bottom, 0.0]])
    return (corners / [size[0], size[1], 1.0])[None]


@pytest.mark.parametrize(
    ("corners", "margin", "expected"),
    [
        ((300, 200, 400, 280), 0.0, (300, 190, 100)),
        ((300, 200, 400, 280), 0.1, (290, 180, 120)),
        ((300, 200, 380, 300), 0.25, (265, 175, 150)),  # the longer side is the height
        ((10, 200, 110, 300), 0.2, (0, 180, 140)),  # moved inside on the left
        ((560, 390, 640, 470), 0.1, (544, 382 + 0, 96)),  # ... and on the right
        ((0, 0, 640, 480), 0.0, (0, -80, 640)),  # wider than high: black above and below
    ],
)
def test_where_a_crop_lies(corners, margin, expected) -> None:
    crop = crop_around(box(*corners), (640, 480), margin)
    assert (crop.left, crop.top, crop.side) == expected


def test_a_crop_holds_every_frame() -> None:
    frames = np.concatenate([box(100, 100, 150, 150), box(300, 120, 350, 170)])
    crop = crop_around(frames, (640, 480), 0.1)
    assert crop.side == 300
    assert (crop.left, crop.left + crop.side) == (75, 375)


@given(
    left=st.integers(0, 500),
    top=st.integers(0, 300),
    width=st.integers(2, 120),
    height=st.integers(2, 120),
    margin=st.floats(0.0, 0.3),
)
def test_the_face_is_inside_and_the_crop_too(left, top, width, height, margin) -> None:
    landmarks = box(left, top, left + width, top + height)
    crop = crop_around(landmarks, (640, 480), margin)
    inside = crop.normalise(landmarks, (640, 480))[..., :2]
    # half a pixel: edges of the crop are whole pixels
    assert inside.min() >= -0.5 / crop.side - 1e-9
    assert inside.max() <= 1 + 0.5 / crop.side + 1e-9
    assert crop.padding((640, 480)) == 0.0


def test_landmarks_are_where_the_picture_shows_them() -> None:
    image = np.zeros((480, 640, 3), dtype=np.uint8)
    image[230:234, 310:314] = 255  # the middle of this spot is at (312, 232)
    landmark = np.array([[[312 / 640, 232 / 480, 0.05]]])
    for crop in (Crop(260, 180, 100), Crop(200, 100, 256), Crop(-80, -10, 600)):
        picture = crop.cut(image, 256)[..., 0].astype(float)
        assert picture.shape == (256, 256)
        grid = np.arange(256) + 0.5
        seen = np.array([picture.sum(0) @ grid, picture.sum(1) @ grid]) / picture.sum() / 256
        # OpenCV rounds to whole grey values: a tenth of a pixel of the picture
        np.testing.assert_allclose(
            crop.normalise(landmark, (640, 480))[0, 0, :2], seen, atol=0.1 / 256
        )
        # depth is given in image widths and comes out in crop sides
        assert crop.normalise(landmark, (640, 480))[0, 0, 2] == pytest.approx(
            0.05 * 640 / crop.side
        )


def test_outside_the_image_is_black() -> None:
    image = np.full((100, 100, 3), 200, dtype=np.uint8)
    crop = Crop(-50, 0, 100)
    picture = crop.cut(image, 64)
    assert picture[:, :32].max() == 0
    assert picture[:, 32:].min() == 200
    assert crop.padding((100, 100)) == 0.5
    assert Crop(500, 500, 10).cut(image, 16).max() == 0
    assert Crop(500, 500, 10).padding((100, 100)) == 1.0


def test_colours_and_directions_are_kept() -> None:
    rng = np.random.default_rng(0)
    image = rng.integers(0, 256, (64, 64, 3), dtype=np.uint8)
    np.testing.assert_array_equal(Crop(0, 0, 64).cut(image, 64), image)
    np.testing.assert_array_equal(Crop(16, 8, 32).cut(image, 32), image[8:40, 16:48])
