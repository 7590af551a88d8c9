"""What the three published approaches have in common.

Frames become tokens, in a way that each approach defines; H tokens that stand for the future are
put after them, each the last one plus a learned vector of its own; a Transformer encoder with
sinusoidal positions goes over all T + H; and what it makes of the H is decoded. (How the paper's
encoder reaches the future frames, it does not say: "Fused features are then processed by a 4-layer
Transformer encoder", IV.A.)

Legend: B batch, T frames of history, H horizon, L = 468 landmarks, S side of the pictures,
D width of the tokens.
"""

from __future__ import annotations

import math
from abc import abstractmethod

import torch
from torch import Tensor, nn

from face_prediction.models.decoders import ImageDecoder
from face_prediction.models.encoders import ImageEncoder
from face_prediction.models.interface import Future, PredictorModel
from face_prediction.models.settings import ApproachSettings
from face_prediction.predictor import PictureNeeds


class ApproachModel(PredictorModel):
    """Image encoder, Transformer over time, image decoder; `tokens` is left to subclasses."""

    positions: Tensor

    def __init__(self, settings: ApproachSettings) -> None:
        super().__init__()
        self.history = settings.history
        self.horizon = settings.horizon
        self.needs = PictureNeeds(frames=settings.history, size=settings.size)
        self.span = 1
        self.makes_pictures = True
        self.image_encoder = ImageEncoder(settings.size, settings.channels, settings.width)
        self.future = nn.Parameter(0.02 * torch.randn(settings.horizon, settings.width))
        positions = sinusoids(settings.history + settings.horizon, settings.width)
        self.register_buffer("positions", positions, persistent=False)
        layer = nn.TransformerEncoderLayer(
            settings.width,
            settings.heads,
            settings.feedforward,
            settings.dropout,
            activation="gelu",
            batch_first=True,
            norm_first=True,
        )
        self.transformer = nn.TransformerEncoder(
            layer, settings.layers, nn.LayerNorm(settings.width), enable_nested_tensor=False
        )
        self.image_decoder = ImageDecoder(settings.size, settings.channels, settings.width)

    @abstractmethod
    def tokens(self, landmarks: Tensor, features: Tensor) -> Tensor:
        """Tokens (B, T, D) of landmarks (B, T, L, 2) and image features (B, T, D)."""

    def encode(self, landmarks: Tensor, pictures: Tensor) -> Tensor:
        """Image features (B, N, D); the landmarks wait for `decode`."""
        features: Tensor = self.image_encoder(pictures)
        return features

    def future_tokens(self, landmarks: Tensor, features: Tensor) -> Tensor:
        """What the Transformer makes of the future, (B, H, D)."""
        tokens = self.tokens(landmarks, features)
        future = tokens[:, -1:] + self.future.to(tokens.dtype)
        out: Tensor = self.transformer(torch.cat([tokens, future], dim=1) + self.positions)
        return out[:, -self.horizon :]

    def image_loss(self, pictures: Tensor, future: Future) -> Tensor:
        """Mean squared error of pictures (B, H, 3, S, S): Loss_img of equation 5."""
        truth = future.pictures.permute(0, 1, 4, 2, 3).float() / 255
        return nn.functional.mse_loss(pictures.float(), truth)


def sinusoids(length: int, width: int) -> Tensor:
    """Positions (length, width) of Vaswani et al. 2017, section 3.5."""
    rates = torch.exp(torch.arange(0, width, 2) * (-math.log(10_000.0) / width))
    angles = torch.arange(length)[:, None] * rates
    return torch.stack([angles.sin(), angles.cos()], dim=-1).flatten(1)
