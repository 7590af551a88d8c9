"""The two decoders: what makes pictures and landmarks of the tokens of future frames.

Legend: B batch, H horizon, L = 468 landmarks, S side of the pictures, D width of the tokens.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from face_prediction.models.encoders import LANDMARK_NUMBERS
from face_prediction.tracks import NUM_LANDMARKS


class ImageDecoder(nn.Module):
    """Pictures from nothing but a token: the encoder's convolutions in reverse (ours).

    Each stage doubles the picture (nearest pixel), then convolves 3 x 3; a sigmoid ends it.
    """

    def __init__(self, size: int, channels: Sequence[int], width: int) -> None:
        super().__init__()
        self._side = size >> len(channels)
        first, *others = [*reversed(channels), 3]
        self.linear = nn.Linear(width, first * self._side**2)
        before = [first, *others[:-1]]
        self.convolutions = nn.ModuleList(
            nn.Conv2d(a, b, 3, padding=1) for a, b in zip(before, others, strict=True)
        )

    def forward(self, tokens: Tensor) -> Tensor:
        """Pictures (B, H, 3, S, S), 0 to 1, of tokens (B, H, D)."""
        x = self.linear(tokens.flatten(0, 1)).unflatten(1, (-1, self._side, self._side))
        for convolution in self.convolutions:
            x = nn.functional.interpolate(nn.functional.gelu(x), scale_factor=2.0)
            x = convolution(x)
        return x.sigmoid().unflatten(0, tokens.shape[:2])


class LandmarkDecoder(nn.Module):
    """Landmarks, as places in the picture (not as steps from the last frame), from a token.

    One hidden layer (ours). Its bias starts at the mean face that is trained on, so that training
    need not first find where faces are.
    """

    def __init__(self, width: int, hidden: int) -> None:
        super().__init__()
        self.hidden = nn.Linear(width, hidden)
        self.out = nn.Linear(hidden, LANDMARK_NUMBERS)

    @torch.no_grad()
    def set_mean(self, mean: Tensor) -> None:
        """Start from a mean face (2 L,)."""
        self.out.bias.copy_(mean)

    def forward(self, tokens: Tensor) -> Tensor:
        """Landmarks (B, H, L, 2) of tokens (B, H, D)."""
        flat: Tensor = self.out(nn.functional.gelu(self.hidden(tokens)))
        return flat.unflatten(-1, (NUM_LANDMARKS, 2))
