"""What every network that forecasts faces offers to the trainer and to `LearnedPredictor`.

A network is a ``torch.nn.Module`` made from frozen settings. The trainer calls ``prepare`` once
(statistics, a fitted prior), then ``loss`` on batches; a predictor calls ``forward``.

Legend: B batch, T frames of history, H horizon, L = 468 landmarks, S side of the pictures,
P pictures at the end of the history.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from face_prediction.forecast.interface import LandmarkSequences
from face_prediction.prediction.interface import PictureNeeds


@dataclass(frozen=True)
class History:
    """What a network is shown."""

    #: (B, T, L, 2) float32, normalised to the crop
    landmarks: Tensor
    #: (B, P, S, S, 3) uint8 RGB of the last P frames; P may be 0
    pictures: Tensor


@dataclass(frozen=True)
class Future:
    """What came after."""

    #: (B, H, L, 2) float32
    landmarks: Tensor
    #: (B, H, S, S, 3) uint8 RGB; H may be 0 for a network that makes no pictures
    pictures: Tensor


@dataclass(frozen=True)
class Output:
    """What a network forecasts; None: it has no such output."""

    #: (B, H, L, 2)
    landmarks: Tensor | None = None
    #: (B, H, 3, S, S), 0 to 1
    pictures: Tensor | None = None
    #: (B, H, 2) scale of the mouth centre's error, in crops
    mouth_scale: Tensor | None = None
    #: (H, 2) degrees of freedom of that error (Student-t)
    degrees_of_freedom: Tensor | None = None


@dataclass(frozen=True)
class Losses:
    """One number to descend, and what it is made of (each a scalar, detached)."""

    total: Tensor
    terms: dict[str, Tensor]


class PredictorModel(nn.Module, ABC):
    """A network with its settings.

    ``forward`` is ``decode`` of what ``encode`` makes of the pictures, frame by frame, so that a
    live predictor keeps the features of past frames and encodes each picture once.

    Attributes:
        history: T, frames of landmarks it is shown.
        horizon: H, frames it forecasts.
        needs: pictures it is shown.
        span: how many neighbouring pictures the features of one frame come from: 1, or 2 where
            differences between frames count.
        makes_pictures: whether `Future.pictures` must be there in training.
    """

    history: int
    horizon: int
    needs: PictureNeeds
    span: int
    makes_pictures: bool

    def prepare(self, sequences: LandmarkSequences, generator: torch.Generator) -> None:
        """Set buffers that come from the training landmarks; called once, before training.

        All frames (75) of the sequences that are trained on are there. The default does nothing.
        """

    @abstractmethod
    def encode(self, landmarks: Tensor, pictures: Tensor) -> Tensor:
        """Features (B, N - span + 1, ...) of the last pictures, one row a frame.

        Args:
            landmarks: (B, N, L, 2) of the same frames as the pictures.
            pictures: (B, N, S, S, 3) uint8; N is ``span`` or more.
        """

    @abstractmethod
    def decode(
        self,
        landmarks: Tensor,
        features: Tensor,
        last_picture: Tensor,
        make_pictures: bool = True,
    ) -> Output:
        """Forecast H frames.

        Args:
            landmarks: (B, T, L, 2).
            features: (B, P - span + 1, ...) from `encode`.
            last_picture: (B, S, S, 3) uint8, of the last frame.
            make_pictures: False: `Output.pictures` is not wanted, and need not be made.
        """

    @abstractmethod
    def loss(self, history: History, future: Future) -> Losses:
        """What training descends, on one batch."""

    def forward(self, history: History) -> Output:
        """Forecast H frames after ``history``."""
        frames = history.pictures.shape[1]
        features = self.encode(history.landmarks[:, -frames:], history.pictures)
        return self.decode(history.landmarks, features, history.pictures[:, -1])
