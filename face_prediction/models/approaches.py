"""The paper's three approaches (IV.A): image only, simple fusion and cross-attention.

Shapes: B batch, T frames of history, H horizon, N frames, L = 468 landmarks, S side of the images,
D width of the tokens and image features, D_l width of the landmark features.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.nn import functional

from face_prediction.forecast.interface import LandmarkSequences
from face_prediction.models.interface import Future, History, Losses, Output, PredictorModel
from face_prediction.models.settings import ApproachSettings, CrossAttentionSettings, FusionSettings
from face_prediction.prediction.interface import ImageNeeds
from face_prediction.tracking.tracks import NUM_LANDMARKS

LANDMARK_NUMBERS = 2 * NUM_LANDMARKS
"""Numbers of the landmarks of one frame: u and v of each."""


class ImageEncoder(nn.Module):
    """The paper's "convolutional image encoder" (IV.A), each image on its own.

    Its depth is ours: 3 x 3 convolutions of stride 2, each with GELU, and a linear layer over all
    places of the last map, so that the position of a feature in the image is kept.
    """

    def __init__(self, size: int, channels: Sequence[int], width: int) -> None:
        super().__init__()
        self.convolutions = nn.ModuleList(
            nn.Conv2d(before, after, 3, stride=2, padding=1)
            for before, after in zip([3, *channels], channels, strict=False)
        )
        side = size >> len(channels)
        self.linear = nn.Linear(channels[-1] * side * side, width)
        self.norm = nn.LayerNorm(width)

    def forward(self, images: Tensor) -> Tensor:
        """Return features (B, N, D) of images (B, N, S, S, 3) uint8."""
        frames = images.flatten(0, 1).permute(0, 3, 1, 2)  # stays channels-last in memory
        x = frames.to(self.linear.weight.dtype) / 255 - 0.5
        for convolution in self.convolutions:
            x = functional.gelu(convolution(x))
        return self.norm(self.linear(x.flatten(1))).unflatten(0, images.shape[:2])


class LandmarkEncoder(nn.Module):
    """The paper's "linear landmark encoder" (IV.A).

    Landmarks are measured from the mean training face, in units of their spread about it, which
    `set_statistics` takes from the training sequences (ours; the paper does not say).
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
        """Return features (B, N, D_l) of landmarks (B, N, L, 2)."""
        return self.linear((landmarks.flatten(-2) - self.mean) / self.spread)


class ImageDecoder(nn.Module):
    """Images from a token alone: the encoder's convolutions in reverse (ours).

    Each stage doubles the image (nearest pixel), then convolves 3 x 3; a sigmoid ends it.
    """

    def __init__(self, size: int, channels: Sequence[int], width: int) -> None:
        super().__init__()
        self._side = size >> len(channels)
        self.linear = nn.Linear(width, channels[-1] * self._side**2)
        outputs = [*reversed(channels[:-1]), 3]
        self.convolutions = nn.ModuleList(
            nn.Conv2d(before, after, 3, padding=1)
            for before, after in zip(reversed(channels), outputs, strict=True)
        )

    def forward(self, tokens: Tensor) -> Tensor:
        """Return images (B, H, 3, S, S), 0 to 1, of tokens (B, H, D)."""
        x = self.linear(tokens.flatten(0, 1)).unflatten(1, (-1, self._side, self._side))
        for convolution in self.convolutions:
            x = convolution(functional.interpolate(functional.gelu(x), scale_factor=2.0))
        return x.sigmoid().unflatten(0, tokens.shape[:2])


class LandmarkDecoder(nn.Module):
    """Landmarks from a token, as positions in the crop (not as steps from the last frame).

    One hidden layer (ours). The output bias starts at the mean training face, so that training
    need not first find where faces are.
    """

    def __init__(self, width: int, hidden: int) -> None:
        super().__init__()
        self.hidden = nn.Linear(width, hidden)
        self.out = nn.Linear(hidden, LANDMARK_NUMBERS)

    def forward(self, tokens: Tensor) -> Tensor:
        """Return landmarks (B, H, L, 2) of tokens (B, H, D)."""
        return self.out(functional.gelu(self.hidden(tokens))).unflatten(-1, (NUM_LANDMARKS, 2))


class CrossAttention(nn.Module):
    """Attention with landmark features as queries and image features as keys and values.

        A = softmax(L I' / sqrt(d)),  C = A I

    L and I are the linearly projected features, d their width, one head. The landmarks act through
    the weights A only: the output is made of image features, as equations 1 to 3 have it. Where all
    images are alike it is the same whatever the landmarks are. With ``residual`` it is C + L, the
    usual connection around an attention, by which landmarks reach the output themselves.
    """

    def __init__(
        self, landmark_width: int, image_width: int, width: int, residual: bool = False
    ) -> None:
        super().__init__()
        self.residual = residual
        self.query = nn.Linear(landmark_width, width)
        self.key_and_value = nn.Linear(image_width, width)

    def forward(self, landmarks: Tensor, images: Tensor) -> Tensor:
        """Return fused features (B, T, d) of features (B, T, D_l) and (B, T, D)."""
        query = self.query(landmarks)
        image = self.key_and_value(images)  # one projection: equation 2 has the I of equation 1
        weights = (query @ image.transpose(-2, -1) / query.shape[-1] ** 0.5).softmax(dim=-1)
        fused = weights @ image
        return fused + query if self.residual else fused


def sinusoids(length: int, width: int) -> Tensor:
    """Return the positions (length, width) of Vaswani et al. 2017, section 3.5."""
    rates = torch.exp(torch.arange(0, width, 2) * (-math.log(10_000.0) / width))
    angles = torch.arange(length)[:, None] * rates
    return torch.stack([angles.sin(), angles.cos()], dim=-1).flatten(1)


class ApproachModel(PredictorModel):
    """Image encoder, Transformer over time, image decoder; subclasses define `tokens`."""

    positions: Tensor
    landmark_decoder: LandmarkDecoder | None

    def __init__(self, settings: ApproachSettings) -> None:
        super().__init__()
        self.history, self.horizon = settings.history, settings.horizon
        self.needs = ImageNeeds(settings.history, settings.size)
        self.landmark_decoder, self.landmark_weight = None, 0.0
        self.image_encoder = ImageEncoder(settings.size, settings.channels, settings.width)
        self.future = nn.Parameter(0.02 * torch.randn(settings.horizon, settings.width))
        positions = sinusoids(settings.history + settings.horizon, settings.width)
        self.register_buffer("positions", positions, persistent=False)
        sizes = (settings.width, settings.heads, settings.feedforward, settings.dropout)
        layer = nn.TransformerEncoderLayer(
            *sizes, activation="gelu", batch_first=True, norm_first=True
        )
        self.transformer = nn.TransformerEncoder(
            layer, settings.layers, nn.LayerNorm(settings.width), enable_nested_tensor=False
        )
        self.image_decoder = ImageDecoder(settings.size, settings.channels, settings.width)

    @abstractmethod
    def tokens(self, landmarks: Tensor, features: Tensor) -> Tensor:
        """Return tokens (B, T, D) of landmarks (B, T, L, 2) and image features (B, T, D)."""

    def encode(self, landmarks: Tensor, images: Tensor) -> Tensor:
        """Return image features (B, N, D); landmarks are encoded in `decode`."""
        return self.image_encoder(images)

    def decode(self, landmarks: Tensor, features: Tensor, make_images: bool = True) -> Output:
        """Predict images, and landmarks if this approach does; see `PredictorModel.decode`."""
        tokens = self.tokens(landmarks, features)
        future = tokens[:, -1:] + self.future.to(tokens.dtype)
        out: Tensor = self.transformer(torch.cat([tokens, future], dim=1) + self.positions)
        out = out[:, -self.horizon :]  # (B, H, D)
        return Output(
            landmarks=self.landmark_decoder(out).float() if self.landmark_decoder else None,
            images=self.image_decoder(out) if make_images else None,
        )

    def loss(self, history: History, future: Future) -> Losses:
        """Return equation 5: the errors squared and averaged over all their numbers."""
        output = self(history)
        images = future.images.permute(0, 1, 4, 2, 3).float() / 255
        total = functional.mse_loss(output.images.float(), images)
        terms = {"image": total.detach()}
        if output.landmarks is not None:
            landmark = functional.mse_loss(output.landmarks, future.landmarks)
            total = total + self.landmark_weight * landmark
            terms["landmark"] = landmark.detach()
        return Losses(total, terms)


class ImageOnlyModel(ApproachModel):
    """Predicts images and no landmarks: a detector may find those in the images."""

    def tokens(self, landmarks: Tensor, features: Tensor) -> Tensor:
        """Return the image features."""
        return features


class FusionModel(ApproachModel):
    """Sees and predicts landmarks beside the images; subclasses define how they are fused."""

    def __init__(self, settings: FusionSettings) -> None:
        super().__init__(settings)
        self.landmark_weight = settings.landmark_weight
        self.landmark_encoder = LandmarkEncoder(settings.landmark_width)
        self.landmark_decoder = LandmarkDecoder(settings.width, settings.feedforward)

    @abstractmethod
    def fuse(self, landmarks: Tensor, images: Tensor) -> Tensor:
        """Return tokens (B, T, D) of landmark features (B, T, D_l) and image features (B, T, D)."""

    @torch.no_grad()
    def prepare(self, sequences: LandmarkSequences) -> None:
        """Take the mean face and the landmarks' spread from all training frames."""
        landmarks = torch.as_tensor(sequences.landmarks, dtype=torch.float32)
        self.landmark_encoder.set_statistics(landmarks.flatten(0, 1))
        self.get_parameter("landmark_decoder.out.bias").copy_(self.landmark_encoder.mean)

    def tokens(self, landmarks: Tensor, features: Tensor) -> Tensor:
        """Return the fused features."""
        return self.fuse(self.landmark_encoder(landmarks), features)


class SimpleFusionModel(FusionModel):
    """Concatenates the features of each frame and projects them to the width of the tokens."""

    def __init__(self, settings: FusionSettings) -> None:
        super().__init__(settings)
        self.join = nn.Linear(settings.width + settings.landmark_width, settings.width)

    def fuse(self, landmarks: Tensor, images: Tensor) -> Tensor:
        """Return the projected concatenation."""
        return self.join(torch.cat([images, landmarks], dim=-1))


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
        self.attention = CrossAttention(
            settings.landmark_width, settings.width, d, settings.residual
        )
        self.join = nn.Linear(d, settings.width)
        for name, width in (("landmark", settings.landmark_width), ("image", settings.width)):
            positions = sinusoids(settings.history, width)
            self.register_buffer(f"{name}_positions", positions, persistent=False)

    def fuse(self, landmarks: Tensor, images: Tensor) -> Tensor:
        """Return the image features of all frames, weighted by the landmarks of each."""
        fused = self.attention(landmarks + self.landmark_positions, images + self.image_positions)
        return self.join(fused)
