"""What turns the pictures and the landmarks of frames into feature vectors.

Legend: B batch, N frames, L = 468 landmarks, S side of the pictures, D width of the features.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from face_prediction.tracks import NUM_LANDMARKS

#: Numbers of the landmarks of one frame: u and v of each.
LANDMARK_NUMBERS = 2 * NUM_LANDMARKS


class ImageEncoder(nn.Module):
    """The paper's "convolutional image encoder" (IV.A), each picture on its own.

    Its depth is ours: 3 x 3 convolutions of stride 2, each with GELU, and a linear layer over all
    places of the last map, so that where something is in the picture is not lost.
    """

    def __init__(self, size: int, channels: Sequence[int], width: int) -> None:
        super().__init__()
        before = [3, *channels[:-1]]
        self.convolutions = nn.ModuleList(
            nn.Conv2d(a, b, 3, stride=2, padding=1) for a, b in zip(before, channels, strict=True)
        )
        side = size >> len(channels)
        self.linear = nn.Linear(channels[-1] * side * side, width)
        self.norm = nn.LayerNorm(width)

    def forward(self, pictures: Tensor) -> Tensor:
        """Features (B, N, D) of pictures (B, N, S, S, 3) uint8."""
        frames = pictures.flatten(0, 1).permute(0, 3, 1, 2)  # stays channels-last in memory
        x = frames.to(self.linear.weight.dtype) / 255 - 0.5
        for convolution in self.convolutions:
            x = nn.functional.gelu(convolution(x))
        features: Tensor = self.norm(self.linear(x.flatten(1)))
        return features.unflatten(0, pictures.shape[:2])


class LandmarkEncoder(nn.Module):
    """The paper's "linear landmark encoder" (IV.A).

    Landmarks are measured from the mean face that was trained on, in units of their spread about
    it, which `set_statistics` takes from the training sequences (ours; the paper is silent).
    """

    mean: Tensor
    spread: Tensor

    def __init__(self, width: int) -> None:
        super().__init__()
        self.linear = nn.Linear(LANDMARK_NUMBERS, width)
        self.register_buffer("mean", torch.zeros(LANDMARK_NUMBERS))
        self.register_buffer("spread", torch.ones(()))

    @torch.no_grad()
    def set_statistics(self, landmarks: Tensor) -> None:
        """Take mean and spread from landmarks (frames, L, 2)."""
        flat = landmarks.flatten(-2).to(self.mean)
        self.mean.copy_(flat.mean(dim=0))
        # not below a ten-thousandth of the crop: drawn faces that never move stay finite
        self.spread.copy_((flat - self.mean).square().mean().sqrt().clamp(min=1e-4))

    def forward(self, landmarks: Tensor) -> Tensor:
        """Features (B, N, D) of landmarks (B, N, L, 2)."""
        features: Tensor = self.linear((landmarks.flatten(-2) - self.mean) / self.spread)
        return features
