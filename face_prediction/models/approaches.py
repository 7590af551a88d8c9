"""What turns the pictures and the landmarks of frames into feature vectors.

Legend: B batch, N frames, L = 468 landmarks, S side of the pictures, D width of the features.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Sequence

import torch
from torch import Tensor, nn

from face_prediction.forecast.interface import LandmarkSequences
from face_prediction.models.interface import Future, History, Losses, Output, PredictorModel
from face_prediction.models.settings import ApproachSettings, CrossAttentionSettings, FusionSettings
from face_prediction.prediction.interface import PictureNeeds
from face_prediction.tracking.tracks import NUM_LANDMARKS

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


class ImageOnlyModel(ApproachModel):
    """Makes pictures and no landmarks: those are for a detector to find in the pictures."""

    def tokens(self, landmarks: Tensor, features: Tensor) -> Tensor:
        """The image features themselves."""
        return features

    def decode(
        self,
        landmarks: Tensor,
        features: Tensor,
        last_picture: Tensor,
        make_pictures: bool = True,
    ) -> Output:
        """Pictures; see `PredictorModel.decode`."""
        if not make_pictures:
            return Output()
        return Output(pictures=self.image_decoder(self.future_tokens(landmarks, features)))

    def loss(self, history: History, future: Future) -> Losses:
        """The mean squared error of the pictures."""
        pictures = self(history).pictures
        loss = self.image_loss(pictures, future)
        return Losses(loss, {"image": loss.detach()})


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
