"""Approach 3 of the paper (III.A, IV.A): landmark features attend to image features."""

from __future__ import annotations

from torch import Tensor, nn

from face_prediction.models.approach import sinusoids
from face_prediction.models.attention import CrossAttention
from face_prediction.models.settings import CrossAttentionSettings
from face_prediction.models.simple_fusion import FusionModel


class CrossAttentionModel(FusionModel):
    """`CrossAttention`, projected to the width of the tokens.

    Both features carry their frame's position into it (ours): equations 1 to 3 know no order, and
    without it the weights cannot tell the last frame from the first.
    """

    landmark_positions: Tensor
    image_positions: Tensor

    def __init__(self, settings: CrossAttentionSettings) -> None:
        super().__init__(settings)
        d = settings.attention_width
        self.attention = CrossAttention(settings.landmark_width, settings.width, d)
        self.join = nn.Linear(d, settings.width)
        for name, width in (("landmark", settings.landmark_width), ("image", settings.width)):
            positions = sinusoids(settings.history, width)
            self.register_buffer(f"{name}_positions", positions, persistent=False)

    def fuse(self, landmarks: Tensor, images: Tensor) -> Tensor:
        """Image features of all frames, weighted by the landmarks of each."""
        fused = self.attention(landmarks + self.landmark_positions, images + self.image_positions)
        tokens: Tensor = self.join(fused)
        return tokens
