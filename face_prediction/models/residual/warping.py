"""Pictures of the future: the last one, carried along with the landmarks, then refined.

Legend: B batch, H horizon, L = 468 landmarks, S side of the pictures, G side of the flow's grid.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

#: Cells of the flow on a side, and reach of a landmark (Gaussian, in crops): fine enough for a jaw.
GRID = 32
REACH = 0.05
#: What the background, which stays, weighs against landmarks.
BACKGROUND = 0.3


def flow(landmarks: Tensor, forecast: Tensor) -> Tensor:
    """How far (B, H, 2, G, G) what is seen in a cell has come, in crops.

    Every cell moves by the mean of the landmarks around it, where they are forecast to be, and of
    a background at rest.

    Args:
        landmarks: (B, L, 2) of the last frame.
        forecast: (B, H, L, 2).
    """
    cells = (torch.arange(GRID, device=forecast.device) + 0.5) / GRID
    # the Gaussian of a distance is the product of one across and one down: two small products of
    # matrices instead of every cell against every landmark
    apart = forecast[..., None] - cells  # (B, H, L, 2, G)
    across, down = torch.exp(-apart.square() / (2 * REACH**2)).unbind(dim=3)  # (B, H, L, G)
    down = down.transpose(2, 3)
    step = forecast - landmarks[:, None]
    moved = [down @ (across * step[..., axis, None]) for axis in range(2)]
    return torch.stack(moved, dim=2) / (down @ across + BACKGROUND)[:, :, None]


def warp(picture: Tensor, moved: Tensor) -> Tensor:
    """Pictures (B, H, 3, S, S): what was at a place less its flow, bilinearly.

    Args:
        picture: (B, 3, S, S).
        moved: (B, H, 2, G, G) from `flow`.
    """
    side, horizon = picture.shape[-1], moved.shape[1]
    fine = nn.functional.interpolate(
        moved.flatten(0, 1), size=(side, side), mode="bilinear", align_corners=False
    )
    pixels = (torch.arange(side, device=picture.device) + 0.5) / side
    place = torch.stack(torch.meshgrid(pixels, pixels, indexing="xy"), dim=-1)  # (S, S, 2)
    grid = 2 * (place - fine.permute(0, 2, 3, 1)) - 1
    repeated = picture[:, None].expand(-1, horizon, -1, -1, -1).flatten(0, 1)
    warped = nn.functional.grid_sample(
        repeated, grid.to(picture.dtype), padding_mode="border", align_corners=False
    )
    return warped.unflatten(0, (-1, horizon))


class Refiner(nn.Module):
    """Corrects a warped picture at half its size; begins by changing nothing.

    Args:
        channels: of the convolutions.
    """

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.first = nn.Conv2d(7, channels, 5, stride=2, padding=2)
        self.second = nn.Conv2d(channels, channels, 3, padding=1)
        self.last = nn.Conv2d(channels, 12, 3, padding=1)
        nn.init.zeros_(self.last.weight)
        if self.last.bias is not None:
            nn.init.zeros_(self.last.bias)

    def forward(self, picture: Tensor, warped: Tensor) -> Tensor:
        """Refined pictures (B, H, 3, S, S) of warped ones, seen beside the last (B, 3, S, S)."""
        horizon = warped.shape[1]
        ahead = torch.arange(1, horizon + 1, device=warped.device) / horizon
        change = warped - picture[:, None]
        frame = ahead[None, :, None, None, None].expand_as(warped[:, :, :1])
        seen = torch.cat([warped - 0.5, change, frame.to(warped.dtype)], dim=2).flatten(0, 1)
        gelu = nn.functional.gelu
        refined = self.last(gelu(self.second(gelu(self.first(seen)))))
        refined = nn.functional.pixel_shuffle(refined, 2)
        return (warped + refined.unflatten(0, (-1, horizon))).clamp(0, 1)
