"""Images as coordinates of keypoints: convolutions and a spatial softmax.

Legend: B batch, I images, N cameras, P keypoints of a camera, H and W image height and width, h and
w those of the maps.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from robo_manip_baselines.policy.act.resnet import MEAN, STD
from robo_manip_baselines.runs.errors import RequestError

MIN_SIDE = 8
"""Pixels; smaller images have no cell."""

WIDTHS = (32, 64, 64)
"""Channels of the three convolutions (Mnih et al. 2015)."""


def keypoints(maps: Tensor) -> Tensor:
    """Return the mean places (I, 2 P), -1 to 1, of softmaxes over maps (I, P, h, w)."""
    weight = maps.flatten(2).softmax(-1).unflatten(2, maps.shape[2:])
    rows, columns = (torch.linspace(-1.0, 1.0, n, device=maps.device) for n in maps.shape[2:])
    y = (weight.sum(3) * rows).sum(2)
    x = (weight.sum(2) * columns).sum(2)
    return torch.cat([x, y], dim=1)


class KeypointEncoder(nn.Module):
    """Keypoints of the images of all cameras.

    Each camera has convolutions of its own: cameras do not move, and a network that sees one view
    only needs fewer channels. The first two halve the image three times; the third keeps its size,
    a cell for 8 x 8 pixels, between which the softmax interpolates.

    Args:
        cameras: N.
        points: P.
        image: (H, W).

    Raises:
        RequestError: the images are smaller than ``MIN_SIDE``.
    """

    mean: Tensor
    scale: Tensor

    def __init__(self, cameras: int, points: int, image: tuple[int, int]) -> None:
        super().__init__()
        if min(image) < MIN_SIDE:
            size = f"{image[0]}x{image[1]}"
            raise RequestError(f"image_size {size}: vision keypoints needs {MIN_SIDE}x{MIN_SIDE}")
        first, second, third = WIDTHS
        self.cameras = nn.ModuleList(
            nn.Sequential(
                nn.Conv2d(3, first, 8, stride=4, padding=2),
                nn.ReLU(inplace=True),
                nn.Conv2d(first, second, 4, stride=2, padding=1),
                nn.ReLU(inplace=True),
                nn.Conv2d(second, third, 3, padding=1),
                nn.ReLU(inplace=True),
                nn.Conv2d(third, points, 1),
            )
            for _ in range(cameras)
        )
        for module in self.modules():
            if isinstance(module, nn.Conv2d):
                nn.init.kaiming_normal_(module.weight, nonlinearity="relu")
                assert module.bias is not None
                nn.init.zeros_(module.bias)
        mean, std = (255.0 * torch.tensor(values)[:, None, None] for values in (MEAN, STD))
        self.register_buffer("mean", mean, persistent=False)
        self.register_buffer("scale", 1.0 / std, persistent=False)

    def forward(self, images: Tensor) -> Tensor:
        """Return (B, 2 N P) float32 from images (B, N, H, W, 3) uint8."""
        # (H, W, 3) images seen as (3, H, W) are in the channels-last order already.
        x = (images.permute(0, 1, 4, 2, 3) - self.mean) * self.scale
        found = []
        for camera, network in enumerate(self.cameras.children()):
            kind = next(network.parameters()).dtype
            view = x[:, camera].to(kind).contiguous(memory_format=torch.channels_last)
            found.append(keypoints(network(view).float()))
        return torch.cat(found, dim=1)
