"""Positions against loops over their definition."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from robo_manip_baselines.policy.act.model import sine_positions, sine_positions_2d

ROUNDING = 1e-6  # fp32 of numbers up to 1


def wave(place: float, size: int) -> list[float]:
    """The definition: sine and cosine in turn, wavelengths from 2 pi to 2 pi * 10,000."""
    angles = [place / 10_000 ** (2 * (i // 2) / size) for i in range(size)]
    return [math.sin(a) if i % 2 == 0 else math.cos(a) for i, a in enumerate(angles)]


def test_places_in_a_sequence():
    expected = np.array([wave(place, 12) for place in range(102)])
    np.testing.assert_allclose(sine_positions(102, 12).numpy(), expected, atol=ROUNDING)


@pytest.mark.parametrize(("height", "width"), [(1, 1), (3, 5), (15, 20)])
def test_cells_of_a_feature_map(height: int, width: int):
    expected = np.array(
        [
            wave(2 * math.pi * (row + 1) / height, 8) + wave(2 * math.pi * (column + 1) / width, 8)
            for row in range(height)
            for column in range(width)
        ]
    )
    np.testing.assert_allclose(
        sine_positions_2d(height, width, 16).numpy(), expected, atol=ROUNDING
    )


def test_the_last_cell_has_one_position_at_every_resolution():
    assert torch.allclose(sine_positions_2d(3, 4, 16)[-1], sine_positions_2d(15, 20, 16)[-1])


def test_no_two_cells_are_alike():
    cells = sine_positions_2d(15, 20, 512)
    assert torch.pdist(cells).min() > 0.1
