"""The cross-attention of the paper (III.A, equations 1 to 3).

Legend: B batch, T frames, D_l and D_i widths of landmark and image features, d width of the
projected vectors.
"""

from __future__ import annotations

from torch import Tensor, nn


class CrossAttention(nn.Module):
    """Landmark features ask, image features answer: both key and value, over all frames.

        A = softmax(L I' / sqrt(d)),  C = A I

    L and I are the linearly projected features, d their width, one head. The landmarks act through
    the weights A only: what comes out is made of image features, as the equations say. (The usual
    connection around the attention, C + L, is not in them.)
    """

    def __init__(self, landmark_width: int, image_width: int, width: int) -> None:
        super().__init__()
        self.query = nn.Linear(landmark_width, width)
        self.key_and_value = nn.Linear(image_width, width)

    def forward(self, landmarks: Tensor, images: Tensor) -> Tensor:
        """Fused features (B, T, d) of landmark (B, T, D_l) and image features (B, T, D_i)."""
        query = self.query(landmarks)
        image = self.key_and_value(images)  # one projection: equation 2 has the I of equation 1
        weights = (query @ image.transpose(-2, -1) / query.shape[-1] ** 0.5).softmax(dim=-1)
        return weights @ image
