"""Changes to images: against loops over pixels, and functions of seed and step alone."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from robo_manip_baselines.runs.errors import RequestError
from robo_manip_baselines.training.augmentation import (
    BRIGHTNESS,
    CONTRAST,
    TINT,
    ImageAugmentation,
    ImageChanges,
    change_images,
)

SHAPE = (2, 50, 75, 3)
"""Of the images of an observation: shifts of up to 2 and 3 pixels."""


def draw_images(count: int = 3, window: int = 2, shape: tuple[int, ...] = SHAPE) -> torch.Tensor:
    generator = torch.Generator().manual_seed(0)
    return torch.randint(0, 256, (count, window, *shape), generator=generator, dtype=torch.uint8)


def obvious_shift(image: NDArray[np.uint8], down: int, right: int) -> NDArray[np.uint8]:
    """Pad with the border's pixels, then crop."""
    height, width, _ = image.shape
    edge = max(abs(down), abs(right))
    padded = np.pad(image, ((edge, edge), (edge, edge), (0, 0)), mode="edge")
    return padded[edge - down :, edge - right :][:height, :width]


def test_a_shift_is_a_crop_of_the_padded_image() -> None:
    images = draw_images()
    changes = ImageAugmentation("shift", SHAPE, 0.04).draw(seed=1, step=2, count=3)
    assert changes.shift is not None
    assert changes.gain is None
    found = change_images(images, changes).numpy()
    for b, o, n in np.ndindex(3, 2, 2):
        expected = obvious_shift(images[b, o, n].numpy(), *changes.shift[b, n].tolist())
        np.testing.assert_array_equal(found[b, o, n], expected, strict=True)


def test_colours_are_scaled_and_moved() -> None:
    images = draw_images()
    changes = ImageAugmentation("shift+colour", SHAPE, 0.04).draw(seed=1, step=2, count=3)
    assert changes.gain is not None
    assert changes.offset is not None
    found = change_images(images, ImageChanges(None, changes.gain, changes.offset)).numpy()
    for b, o, n, channel in np.ndindex(3, 2, 2, 3):
        gain, offset = changes.gain[b, n, channel].item(), changes.offset[b, n, channel].item()
        exact = images[b, o, n, ..., channel].numpy() * gain + offset
        # Whole numbers: half of one, and float32's rounding.
        assert np.abs(found[b, o, n, ..., channel] - exact.clip(0, 255)).max() < 0.5 + 1e-3


def test_every_shift_is_as_likely_and_colours_stay_in_their_range() -> None:
    changes = ImageAugmentation("shift+colour", SHAPE, 0.04).draw(seed=0, step=0, count=4000)
    assert changes.shift is not None
    assert changes.gain is not None
    assert changes.offset is not None
    for axis, limit in enumerate((2, 3)):
        values, counts = changes.shift[..., axis].unique(return_counts=True)
        assert values.tolist() == list(range(-limit, limit + 1))
        # 8000 draws among 5 or 7: the deviation of a count is 36 or less; five times that.
        assert (counts - 8000 / (2 * limit + 1)).abs().max() < 180
    assert 0.99 * CONTRAST < (changes.gain - 1).abs().max() <= CONTRAST
    middle = 127.5 * changes.gain + changes.offset  # contrast leaves grey as it is
    assert (middle / 255 - 0.5).abs().max() <= BRIGHTNESS + TINT
    tint = changes.offset - changes.offset.mean(-1, keepdim=True)
    assert 0 < tint.abs().max() <= 2 * 255 * TINT


def test_changes_are_functions_of_seed_and_step() -> None:
    augmentation = ImageAugmentation("shift+colour", SHAPE, 0.04)
    images = draw_images(8)
    whole = change_images(images, augmentation.draw(5, 7, 8))
    again = change_images(images, augmentation.draw(5, 7, 8))
    assert torch.equal(whole, again)
    for seed, step in ((5, 8), (6, 7)):
        assert not torch.equal(change_images(images, augmentation.draw(seed, step, 8)), whole)
    # Processes that share a batch change each example as one process would.
    for part in (slice(0, 3), slice(3, 8)):
        changes = augmentation.draw(5, 7, 8).part(part)
        assert torch.equal(change_images(images[part], changes), whole[part])


def test_cameras_and_examples_are_changed_each_by_itself() -> None:
    images = draw_images(1, 1)[:, :, :1].expand(6, 1, 2, -1, -1, -1)
    changed = change_images(images, ImageAugmentation("shift+colour", SHAPE, 0.04).draw(0, 0, 6))
    assert len(torch.unique(changed.flatten(0, 2).flatten(1), dim=0)) == 12


def test_an_unknown_one_is_refused() -> None:
    with pytest.raises(RequestError, match=r"augment 'flip'.*none, shift, shift\+colour"):
        ImageAugmentation("flip", SHAPE, 0.04)
