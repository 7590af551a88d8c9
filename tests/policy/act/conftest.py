"""A network small enough to train in milliseconds, and batches for it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest
import torch

from robo_manip_baselines.policy.act.config import ActConfig
from robo_manip_baselines.policy.act.model import ActModel
from robo_manip_baselines.policy.interface import Batch, PolicyDims

CONFIG = ActConfig(
    chunk_size=6,
    hidden_size=16,
    feedforward_size=24,
    num_heads=2,
    encoder_layers=2,
    decoder_layers=3,
    latent_size=4,
    cvae_layers=2,
    dropout=0.0,
    backbone_width=8,  # 11 million weights take long to draw
)
DIMS = PolicyDims(state=5, action=3, cameras=2, image=(40, 70))


@pytest.fixture
def make_model() -> Callable[..., ActModel]:
    """Build a tiny network with the same weights for the same settings."""

    def make(dims: PolicyDims = DIMS, **settings: Any) -> ActModel:
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(7)
            return ActModel(replace(CONFIG, **settings), dims)

    return make


@pytest.fixture
def make_batch() -> Callable[..., Batch]:
    """Draw a batch in which the examples are of different lengths."""

    def make(dims: PolicyDims = DIMS, batch: int = 3, chunk: int = 6, latent: int = 4) -> Batch:
        generator = torch.Generator().manual_seed(11)
        lengths = torch.arange(batch) * 2 + 1
        is_pad = torch.arange(chunk)[None] >= lengths[:, None]
        images = torch.randint(
            0, 256, (batch, 1, dims.cameras, *dims.image, 3), generator=generator, dtype=torch.uint8
        )
        return Batch(
            state=torch.randn(batch, 1, dims.state, generator=generator),
            images=images if dims.cameras else None,
            action=torch.randn(batch, chunk, dims.action, generator=generator),
            is_pad=is_pad,
            noise=torch.randn(batch, latent, generator=generator),
            num_valid=(~is_pad).sum().float(),
            num_examples=torch.tensor(float(batch)),
        )

    return make
