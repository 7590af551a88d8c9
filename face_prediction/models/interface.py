"""Interface of the networks that predict faces, for the trainer and for `LearnedPredictor`.

A network is a ``torch.nn.Module`` made from frozen settings. The trainer calls ``prepare`` once
(statistics), then ``loss`` on batches; a predictor calls ``forward``.

Shapes: B batch, T frames of history, H horizon, L = 468 landmarks, S side of the images,
P images at the end of the history, N frames.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass

from torch import Tensor, nn

from face_prediction.forecast.interface import LandmarkSequences
from face_prediction.prediction.interface import ImageNeeds


@dataclass(frozen=True)
class History:
    """Input of a network.

    Attributes:
        landmarks: (B, T, L, 2) float32, normalised to the crop.
        images: (B, P, S, S, 3) uint8 RGB of the last P frames; P may be 0.
    """

    landmarks: Tensor
    images: Tensor


@dataclass(frozen=True)
class Future:
    """Target of a network.

    Attributes:
        landmarks: (B, H, L, 2) float32.
        images: (B, H, S, S, 3) uint8 RGB.
    """

    landmarks: Tensor
    images: Tensor


@dataclass(frozen=True)
class Output:
    """Prediction of a network; None where it has no such output.

    Attributes:
        landmarks: (B, H, L, 2).
        images: (B, H, 3, S, S), 0 to 1.
    """

    landmarks: Tensor | None = None
    images: Tensor | None = None


@dataclass(frozen=True)
class Losses:
    """Loss of a batch: a scalar to minimise, and its parts before weighting, without gradient."""

    total: Tensor
    terms: dict[str, Tensor]


class PredictorModel(nn.Module, ABC):
    """A network with its settings.

    ``forward`` is ``decode`` of ``encode``, which works frame by frame, so that a live predictor
    keeps the features of past frames and encodes each image once.

    Attributes:
        history: T, frames of landmarks in the input.
        horizon: H, frames predicted.
        needs: images in the input.
    """

    history: int
    horizon: int
    needs: ImageNeeds

    def prepare(self, sequences: LandmarkSequences) -> None:
        """Set buffers from the training landmarks, whole sequences (75 frames), before training."""

    @abstractmethod
    def encode(self, landmarks: Tensor, images: Tensor) -> Tensor:
        """Return features (B, N, ...), those of a frame from its landmarks and image alone.

        Args:
            landmarks: (B, N, L, 2) of the same frames as the images.
            images: (B, N, S, S, 3) uint8.
        """

    @abstractmethod
    def decode(self, landmarks: Tensor, features: Tensor, make_images: bool = True) -> Output:
        """Predict H frames.

        Args:
            landmarks: (B, T, L, 2).
            features: (B, P, ...) from `encode`.
            make_images: False where `Output.images` is not needed.
        """

    @abstractmethod
    def loss(self, history: History, future: Future) -> Losses:
        """Return the training loss of one batch."""

    def forward(self, history: History) -> Output:
        """Predict the H frames after ``history``."""
        frames = history.images.shape[1]
        features = self.encode(history.landmarks[:, -frames:], history.images)
        return self.decode(history.landmarks, features)
