"""Mouth, eyes and face, cut out of pictures at the landmarks' places.

Legend: B batch, N frames, L = 468 landmarks, S side of the pictures, G regions, C side of a region.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from face_prediction.lifting import LIPS

#: Corners of the eyes in MediaPipe's face mesh: outer and inner, the subject's right and left.
_RIGHT_EYE = (33, 133)
_LEFT_EYE = (362, 263)
#: (landmarks whose mean is the middle, side as a share of the face's height)
REGIONS = (
    (tuple(LIPS), 0.5),
    (_RIGHT_EYE, 0.35),
    (_LEFT_EYE, 0.35),
    (tuple(range(468)), 1.2),
)


def cut_out(pictures: Tensor, landmarks: Tensor, side: int) -> Tensor:
    """Regions (B, N, G, 3, C, C) of pictures (B, N, 3, S, S), bilinearly; black outside.

    Args:
        pictures: any floating type.
        landmarks: (B, N, L, 2), where the face is.
        side: C.
    """
    batch, frames = landmarks.shape[:2]
    span = landmarks.amax(dim=2) - landmarks.amin(dim=2)  # (B, N, 2)
    height = span[..., 1].clamp_min(1e-3)
    cells = (torch.arange(side, device=pictures.device) + 0.5) / side - 0.5
    offsets = torch.stack(torch.meshgrid(cells, cells, indexing="xy"), dim=-1)  # (C, C, 2)
    flat = pictures.flatten(0, 1)
    regions: list[Tensor] = []
    for points, share in REGIONS:
        middle = landmarks[:, :, list(points)].mean(dim=2)
        size = (share * height)[..., None, None, None]
        grid = middle[:, :, None, None] + size * offsets
        # grid_sample counts from -1 to 1, from border to border of the picture
        grid = (2 * grid - 1).flatten(0, 1).to(pictures.dtype)
        regions.append(nn.functional.grid_sample(flat, grid, align_corners=False))
    return torch.stack(regions, dim=1).unflatten(0, (batch, frames))


class RegionEncoder(nn.Module):
    """A token for every region of every frame, from the region and its change since the last.

    Args:
        side: C.
        channels: of the convolutions, each of which halves the region.
        width: of the tokens.
    """

    def __init__(self, side: int, channels: tuple[int, ...], width: int) -> None:
        super().__init__()
        self.side = side
        layers: list[nn.Module] = []
        before = 6
        for after in channels:
            layers += [
                nn.Conv2d(before, after, 3, stride=2, padding=1),
                nn.GroupNorm(1, after),
                nn.GELU(),
            ]
            before = after
        self.convolutions = nn.Sequential(*layers)
        self.token = nn.Linear(before, width)
        self.which = nn.Parameter(0.02 * torch.randn(len(REGIONS), width))

    def forward(self, pictures: Tensor, landmarks: Tensor) -> Tensor:
        """Tokens (B, N - 1, G, width) of pictures (B, N, S, S, 3) uint8.

        The frame before is cut out at the later frame's place, so that what moved differs.
        """
        images = pictures.permute(0, 1, 4, 2, 3).to(self.token.weight.dtype) / 255 - 0.5
        now = cut_out(images[:, 1:], landmarks[:, 1:], self.side)
        before = cut_out(images[:, :-1], landmarks[:, 1:], self.side)
        both = torch.cat([now, now - before], dim=3)
        flat = self.convolutions(both.flatten(0, 2)).mean(dim=(2, 3))
        tokens: Tensor = self.token(flat).unflatten(0, both.shape[:3])
        return tokens + self.which
