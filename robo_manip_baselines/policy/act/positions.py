"""Where a token is: sines of its place in a sequence or in a picture.

Legend: L tokens of a sequence, D hidden size, H and W height and width of a feature map.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

TEMPERATURE = 10_000.0
"""Longest wavelength over the shortest (Vaswani et al. 2017; DETR)."""


def sine_positions(length: int, size: int) -> Tensor:
    """Return (L, D) sines and cosines, alternating, of the places 0 ... L - 1.

    Args:
        length: L.
        size: D, even.
    """
    return _waves(torch.arange(length, dtype=torch.float64), size).float()


def sine_positions_2d(height: int, width: int, size: int) -> Tensor:
    """Return (H * W, D) positions of the cells of a feature map, row by row.

    The first half of D is the row, the second the column, both scaled to (0, 2 pi], as in DETR:
    a cell keeps its position when the resolution changes.

    Args:
        height: H.
        width: W.
        size: D, a multiple of 4.
    """
    rows = _waves(torch.arange(1, height + 1, dtype=torch.float64) * (math.tau / height), size // 2)
    columns = _waves(
        torch.arange(1, width + 1, dtype=torch.float64) * (math.tau / width), size // 2
    )
    grid = torch.cat(
        [rows[:, None].expand(-1, width, -1), columns[None].expand(height, -1, -1)], dim=-1
    )
    return grid.flatten(0, 1).float()


def _waves(places: Tensor, size: int) -> Tensor:
    """(n, size): sin(p w_0), cos(p w_0), sin(p w_1), ..., w_i = TEMPERATURE ** (-2 i / size)."""
    rates = TEMPERATURE ** (-torch.arange(0, size, 2, dtype=torch.float64) / size)
    angles = places[:, None] * rates
    return torch.stack([angles.sin(), angles.cos()], dim=-1).flatten(1)
