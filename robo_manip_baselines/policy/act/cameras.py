"""Small image encoders, one for each camera.

Legend: B batch, N cameras, F features of a camera, H and W image height and width.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from robo_manip_baselines.runs.errors import RequestError

CHANNELS = (24, 48, 48, 48)
KERNELS = ((8, 4, 2), (4, 2, 1), (3, 1, 1), (3, 2, 1))
"""Size, stride and padding of the convolutions; the first three are those of Mnih et al. 2015."""

MEAN, STD = 115.0, 58.0
"""Of colours from 0 to 255: ImageNet's, averaged over the three. One number each in place of one
for each channel saves 25 of 68 ms of a forward pass; the convolutions can do the rest."""

MIN_SIDE = 8
"""Pixels; smaller images have no cell."""


class CameraEncoder(nn.Module):
    """Convolutions, and a linear layer over all cells of the last feature map.

    Each camera has weights of its own: cameras do not move, so that a network may learn what is to
    be seen in which place, and one that sees a single view needs few channels.

    Args:
        cameras: N.
        features: F.
        image: (H, W).

    Raises:
        RequestError: the images are smaller than ``MIN_SIDE``.
    """

    def __init__(self, cameras: int, features: int, image: tuple[int, int]) -> None:
        super().__init__()
        if min(image) < MIN_SIDE:
            size = f"{image[0]}x{image[1]}"
            raise RequestError(f"image_size {size}: vision small needs {MIN_SIDE}x{MIN_SIDE}")
        height, width = image
        for size, stride, padding in KERNELS:
            height, width = ((n + 2 * padding - size) // stride + 1 for n in (height, width))
        cells = CHANNELS[-1] * height * width
        self.convolutions = nn.ModuleList(_convolutions() for _ in range(cameras))
        self.projections = nn.ModuleList(
            nn.Sequential(nn.Linear(cells, features), nn.LayerNorm(features))
            for _ in range(cameras)
        )

    def forward(self, images: Tensor) -> Tensor:
        """Return (B, N F) float32 from images (B, N, H, W, 3) uint8."""
        # (H, W, 3) images seen as (3, H, W) are in the channels-last order already.
        x = images.float().sub_(MEAN).mul_(1.0 / STD).permute(0, 1, 4, 2, 3)
        found = []
        parts = zip(self.convolutions, self.projections, strict=True)
        for camera, (convolutions, projection) in enumerate(parts):
            view = x[:, camera].to(next(convolutions.parameters()).dtype)
            cells = convolutions(view.contiguous(memory_format=torch.channels_last))
            found.append(projection(cells.flatten(1).float()))
        return torch.cat(found, dim=1)


def _convolutions() -> nn.Sequential:
    layers: list[nn.Module] = []
    for inputs, outputs, kernel in zip((3, *CHANNELS[:-1]), CHANNELS, KERNELS, strict=True):
        size, stride, padding = kernel
        convolution = nn.Conv2d(inputs, outputs, size, stride, padding)
        nn.init.kaiming_normal_(convolution.weight, nonlinearity="relu")
        nn.init.zeros_(convolution.bias)  # pyright: ignore[reportArgumentType]
        layers += [convolution, nn.ReLU(inplace=True)]
    return nn.Sequential(*layers)
