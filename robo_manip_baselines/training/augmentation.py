"""Random changes to the images of a training batch, on the device of the batch.

The numbers of each step are functions of the seed and of the step, nothing else. Images of policies
that act, and of held-out losses, are never changed.

Legend: b examples of a step, O observation steps, N cameras, H and W image height and width.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from robo_manip_baselines.policy.presets import AUGMENTATIONS
from robo_manip_baselines.runs.errors import require_choice
from robo_manip_baselines.runs.seeds import derive_seed

CONTRAST, BRIGHTNESS, TINT = 0.2, 0.1, 0.05
"""Largest relative change of the contrast and, of 255, of all channels and of each by itself."""


@dataclass(frozen=True)
class ImageChanges:
    """Changes to the images of one batch, the same for all observation steps of an example.

    Attributes:
        shift: (b, N, 2) int64, pixels down and right by which the content moves; None for none.
        gain, offset: (b, N, 3) float32; colours x become ``gain * x + offset``; None for none.
    """

    shift: Tensor | None
    gain: Tensor | None
    offset: Tensor | None

    def part(self, part: slice) -> ImageChanges:
        """Return the changes to a part of the examples."""
        return self._map(lambda tensor: tensor[part])

    def to(self, device: torch.device) -> ImageChanges:
        """Copy to a device, without waiting for it."""
        if device.type == "cpu":
            return self
        return self._map(lambda tensor: tensor.pin_memory().to(device, non_blocking=True))

    def _map(self, change: Callable[[Tensor], Tensor]) -> ImageChanges:
        return ImageChanges(*(None if v is None else change(v) for v in vars(self).values()))


class ImageAugmentation:
    """Random shift with replicated borders, and random contrast, brightness and tint.

    Args:
        kind: one of ``AUGMENTATIONS`` but ``none``.
        shape: (N, H, W, 3) of the images of an observation.
        shift: largest shift as a proportion of their sides.

    Raises:
        RequestError: there is no such augmentation.
    """

    def __init__(self, kind: str, shape: tuple[int, ...], shift: float) -> None:
        self.kind = require_choice("augment", kind, AUGMENTATIONS)
        self._cameras, height, width, _ = shape
        self._limits = torch.tensor([round(shift * height), round(shift * width)])

    def draw(self, seed: int, step: int, count: int) -> ImageChanges:
        """Return the changes of a step to ``count`` examples."""
        generator = torch.Generator().manual_seed(derive_seed(seed, "augment", step))

        def uniform(*shape: int) -> Tensor:  # -1 to 1
            return 2.0 * torch.rand(count, self._cameras, *shape, generator=generator) - 1.0

        # From -limit - 0.5 to limit + 0.5, so that every whole number is as likely.
        shift = ((self._limits + 0.5) * uniform(2)).round().long()
        shift = shift.clamp(-self._limits, self._limits)
        if "colour" not in self.kind:
            return ImageChanges(shift, None, None)
        gain = 1.0 + CONTRAST * uniform(1).expand(-1, -1, 3)
        middle = 127.5 * (1.0 - gain)  # contrast leaves grey as it is
        offset = middle + 255.0 * (BRIGHTNESS * uniform(1) + TINT * uniform(3))
        return ImageChanges(shift, gain, offset)


def change_images(images: Tensor, changes: ImageChanges) -> Tensor:
    """Return changed images (b, O, N, H, W, 3) uint8, on the device of both."""
    if changes.shift is not None:
        images = _shifted(images, changes.shift)
    if changes.gain is not None and changes.offset is not None:
        gain, offset = (v[:, None, :, None, None] for v in (changes.gain, changes.offset))
        colours = torch.addcmul(offset, gain, images.float())
        images = colours.round_().clamp_(0.0, 255.0).to(torch.uint8)
    return images


def _shifted(images: Tensor, shift: Tensor) -> Tensor:
    """Move the content of each image; the border's pixels fill what becomes free."""
    count, window, cameras, height, width, _ = images.shape
    device = images.device
    down, right = shift[:, None, :, :, None].unbind(3)  # (b, 1, N, 1) each
    rows = (torch.arange(height, device=device) - down).clamp_(0, height - 1)
    columns = (torch.arange(width, device=device) - right).clamp_(0, width - 1)
    # Rows first, whole ones at a time; the numbers count rows, then pixels, of all images.
    first = torch.arange(count * window * cameras, device=device).view(count, window, cameras, 1)
    rows = (first * height + rows).flatten()
    moved = images.reshape(-1, width, 3).index_select(0, rows)
    columns = columns.expand(count, window, cameras, width).flatten(0, 2)
    moved = moved.view(-1, height, width, 3)
    index = columns[:, None, :, None].expand_as(moved)
    return moved.gather(2, index).view_as(images)
