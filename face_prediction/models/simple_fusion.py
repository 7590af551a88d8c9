"""Approach 2 of the paper (IV.A): image and landmark features side by side into one Transformer.

Also what approach 3 shares with it. Legend: B batch, T frames of history, H horizon, L = 468
landmarks, D width of the tokens.
"""

from __future__ import annotations

from abc import abstractmethod

import torch
from torch import Tensor, nn

from face_prediction.forecast.interface import LandmarkSequences
from face_prediction.models.approach import ApproachModel
from face_prediction.models.decoders import LandmarkDecoder
from face_prediction.models.encoders import LandmarkEncoder
from face_prediction.models.interface import Future, History, Losses, Output
from face_prediction.models.settings import FusionSettings


class FusionModel(ApproachModel):
    """Landmarks in beside the pictures, and both out; how they meet is left to subclasses."""

    def __init__(self, settings: FusionSettings) -> None:
        super().__init__(settings)
        self._landmark_weight = settings.landmark_weight
        self.landmark_encoder = LandmarkEncoder(settings.landmark_width)
        self.landmark_decoder = LandmarkDecoder(settings.width, settings.feedforward)

    @abstractmethod
    def fuse(self, landmarks: Tensor, images: Tensor) -> Tensor:
        """Tokens (B, T, D) of landmark features (B, T, D_l) and image features (B, T, D)."""

    def prepare(self, sequences: LandmarkSequences, generator: torch.Generator) -> None:
        """Take the mean face and the landmarks' spread from all training frames."""
        landmarks = torch.as_tensor(sequences.landmarks, dtype=torch.float32)
        self.landmark_encoder.set_statistics(landmarks.flatten(0, 1))
        self.landmark_decoder.set_mean(self.landmark_encoder.mean)

    def tokens(self, landmarks: Tensor, features: Tensor) -> Tensor:
        """Both features, fused."""
        return self.fuse(self.landmark_encoder(landmarks), features)

    def decode(
        self,
        landmarks: Tensor,
        features: Tensor,
        last_picture: Tensor,
        make_pictures: bool = True,
    ) -> Output:
        """Landmarks and pictures; see `PredictorModel.decode`."""
        tokens = self.future_tokens(landmarks, features)
        return Output(
            landmarks=self.landmark_decoder(tokens).float(),
            pictures=self.image_decoder(tokens) if make_pictures else None,
        )

    def loss(self, history: History, future: Future) -> Losses:
        """Equation 5: both errors squared and averaged over all their numbers."""
        output = self(history)
        image = self.image_loss(output.pictures, future)
        landmark = nn.functional.mse_loss(output.landmarks, future.landmarks)
        total = image + self._landmark_weight * landmark
        return Losses(total, {"image": image.detach(), "landmark": landmark.detach()})


class SimpleFusionModel(FusionModel):
    """The features of each frame are concatenated, and projected to the width of the tokens."""

    def __init__(self, settings: FusionSettings) -> None:
        super().__init__(settings)
        self.join = nn.Linear(settings.width + settings.landmark_width, settings.width)

    def fuse(self, landmarks: Tensor, images: Tensor) -> Tensor:
        """Side by side."""
        tokens: Tensor = self.join(torch.cat([images, landmarks], dim=-1))
        return tokens
