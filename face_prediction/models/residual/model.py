"""Mouth, eyes and face, cut out of pictures at the landmarks' places.

Legend: B batch, N frames, L = 468 landmarks, S side of the pictures, G regions, C side of a region.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from face_prediction.forecast.interface import LandmarkSequences
from face_prediction.models.interface import Future, History, Losses, Output, PredictorModel
from face_prediction.models.residual.prior import AdaptivePrior, PriorForecast
from face_prediction.models.residual.settings import ResidualSettings
from face_prediction.prediction.interface import PictureNeeds
from face_prediction.tracking.geometry import LIPS

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


#: Frames in which displacements add up to about this many of their root mean square.
_REACH = 5.0
#: Corrections are small beside the prior's error; a unit of the last layer is this share of it.
_GAIN = 0.5
#: Inputs beyond this many units say no more than that they are large.
_LIMIT = 6.0
#: Degrees of freedom begin at 5 and stay above 2: the error has a variance.
_LEAST_FREEDOM = 2.0
_START = math.log(math.expm1(3.0))
#: Standard deviation of a Student-t error with 5 degrees of freedom over its mean absolute value is
#: 1.36, over its scale 1.29: the scale begins near the mean absolute error so far.
_LEAST_STEP = 1e-5


@dataclass(frozen=True)
class Correction:
    """What to add to the prior, and the scale of what error is left."""

    #: (B, O, H, 2) in crops
    mouth: Tensor
    #: (B, O, H, K)
    shapes: Tensor
    #: (B, O, H, 2) in crops
    scale: Tensor


class CorrectionNet(nn.Module):
    """Motion code by a recurrent network, then attention to the pictures' tokens, then heads.

    The last layers begin at zero: an untrained network is the prior.

    Args:
        horizon: H.
        shapes: K.
        width: D.
        dropout: on the inputs of the layers.
    """

    def __init__(self, horizon: int, shapes: int, width: int, dropout: float) -> None:
        super().__init__()
        self.horizon = horizon
        self.inputs = nn.Linear(2 * (2 + shapes) + 1, width)
        self.motion = nn.GRU(width, width, batch_first=True)
        self.dropout = nn.Dropout(dropout)
        self.query = nn.Linear(width, width)
        self.key = nn.Linear(width, width)
        self.value = nn.Linear(width, width)
        self.seen = nn.Linear(width, width)
        self.hidden = nn.Linear(width + 4 * horizon, width)
        self.change = nn.Linear(width, horizon * (2 + shapes))
        self.log_scale = nn.Linear(width, 2 * horizon)
        self.freedom = nn.Parameter(torch.full((horizon, 2), _START))
        for layer in (self.seen, self.change, self.log_scale):
            nn.init.zeros_(layer.weight)
            nn.init.zeros_(layer.bias)

    @property
    def degrees_of_freedom(self) -> Tensor:
        """(H, 2) of the Student-t error."""
        return _LEAST_FREEDOM + nn.functional.softplus(self.freedom)

    def forward(
        self,
        mouth: Tensor,
        shapes: Tensor,
        step: Tensor,
        prior: PriorForecast,
        tokens: Tensor | None,
    ) -> Correction:
        """Correct ``prior``.

        Args:
            mouth: (B, O, W, 2) up to each origin.
            shapes: (B, O, W, K).
            step: (K,) usual step of the shapes from frame to frame, over people.
            prior: at the same origins.
            tokens: (B, M, D) from the pictures up to the last origin; None: no pictures. Only the
                last origin is shown them.
        """
        batch, origins = mouth.shape[:2]
        motion, pace = _inputs(mouth, shapes / step)
        code = self.inputs(self.dropout(motion.clamp(-_LIMIT, _LIMIT)).flatten(0, 1))
        code = self.motion(code)[0][:, -1].unflatten(0, (batch, origins))
        if tokens is not None:
            code = torch.cat([code[:, :-1], code[:, -1:] + self._look(code[:, -1:], tokens)], dim=1)
        doubt = torch.log(prior.error / pace[..., None])  # how predictable this face was
        expected = (prior.mouth / prior.error).clamp(-_LIMIT, _LIMIT)
        known = torch.cat([code, doubt.flatten(2), expected.flatten(2)], dim=-1)
        hidden = self.dropout(nn.functional.gelu(self.hidden(known)))
        change = self.change(hidden).unflatten(-1, (self.horizon, -1))
        error = prior.error.mean(dim=-1, keepdim=True)
        usual = step * (error / pace[..., None])  # shapes' error, as the mouth's is to its pace
        log_scale = self.log_scale(hidden).unflatten(-1, (self.horizon, 2))
        return Correction(
            _GAIN * change[..., :2] * prior.error,
            _GAIN * change[..., 2:] * usual,
            prior.error * log_scale.exp(),
        )

    def _look(self, query: Tensor, tokens: Tensor) -> Tensor:
        """What the pictures' tokens (B, M, D) add to a code (B, 1, D): equations 1 to 3."""
        key, value = self.key(tokens), self.value(tokens)
        weight = self.query(query) @ key.transpose(1, 2) / math.sqrt(key.shape[-1])
        added: Tensor = self.seen(torch.softmax(weight, dim=-1) @ value)
        return added


def _inputs(mouth: Tensor, shapes: Tensor) -> tuple[Tensor, Tensor]:
    """Motion (B, O, W, 2 (2 + K) + 1) without unit, and the mouth's pace (B, O, 1) in crops.

    Steps, and places seen from the newest frame, each divided by the root mean square of the
    steps; and how jerky a frame was beside the others, which shows repeated frames.
    """
    parts: list[Tensor] = []
    paces: list[Tensor] = []
    for series in (mouth, shapes):
        steps = torch.diff(series, dim=2, prepend=series[:, :, :1])
        pace = steps.square().mean(dim=(2, 3), keepdim=True).sqrt() + _LEAST_STEP
        paces.append(pace)
        parts += [steps / pace, (series - series[:, :, -1:]) / (_REACH * pace)]
    jerk = torch.diff(parts[2], dim=2, prepend=parts[2][:, :, :1]).square().mean(-1, keepdim=True)
    parts.append(torch.log(jerk / (jerk.mean(dim=2, keepdim=True) + 1e-6) + 1e-3) / 2)
    return torch.cat(parts, dim=-1), paces[0][..., 0]


#: Cells of the flow on a side, and reach of a landmark (Gaussian, in crops): fine enough for a jaw.
GRID = 32
REACH = 0.05
#: What the background, which stays, weighs against landmarks.
BACKGROUND = 0.3


def flow(landmarks: Tensor, forecast: Tensor) -> Tensor:
    """How far (B, H, 2, G, G) what is seen in a cell has come, in crops.

    Every cell moves by the mean of the landmarks around it, where they are forecast to be, and of
    a background at rest.

    Args:
        landmarks: (B, L, 2) of the last frame.
        forecast: (B, H, L, 2).
    """
    cells = (torch.arange(GRID, device=forecast.device) + 0.5) / GRID
    # the Gaussian of a distance is the product of one across and one down: two small products of
    # matrices instead of every cell against every landmark
    apart = forecast[..., None] - cells  # (B, H, L, 2, G)
    across, down = torch.exp(-apart.square() / (2 * REACH**2)).unbind(dim=3)  # (B, H, L, G)
    down = down.transpose(2, 3)
    step = forecast - landmarks[:, None]
    moved = [down @ (across * step[..., axis, None]) for axis in range(2)]
    return torch.stack(moved, dim=2) / (down @ across + BACKGROUND)[:, :, None]


def warp(picture: Tensor, moved: Tensor) -> Tensor:
    """Pictures (B, H, 3, S, S): what was at a place less its flow, bilinearly.

    Args:
        picture: (B, 3, S, S).
        moved: (B, H, 2, G, G) from `flow`.
    """
    side, horizon = picture.shape[-1], moved.shape[1]
    fine = nn.functional.interpolate(
        moved.flatten(0, 1), size=(side, side), mode="bilinear", align_corners=False
    )
    pixels = (torch.arange(side, device=picture.device) + 0.5) / side
    place = torch.stack(torch.meshgrid(pixels, pixels, indexing="xy"), dim=-1)  # (S, S, 2)
    grid = 2 * (place - fine.permute(0, 2, 3, 1)) - 1
    repeated = picture[:, None].expand(-1, horizon, -1, -1, -1).flatten(0, 1)
    warped = nn.functional.grid_sample(
        repeated, grid.to(picture.dtype), padding_mode="border", align_corners=False
    )
    return warped.unflatten(0, (-1, horizon))


class Refiner(nn.Module):
    """Corrects a warped picture at half its size; begins by changing nothing.

    Args:
        channels: of the convolutions.
    """

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.first = nn.Conv2d(7, channels, 5, stride=2, padding=2)
        self.second = nn.Conv2d(channels, channels, 3, padding=1)
        self.last = nn.Conv2d(channels, 12, 3, padding=1)
        nn.init.zeros_(self.last.weight)
        if self.last.bias is not None:
            nn.init.zeros_(self.last.bias)

    def forward(self, picture: Tensor, warped: Tensor) -> Tensor:
        """Refined pictures (B, H, 3, S, S) of warped ones, seen beside the last (B, 3, S, S)."""
        horizon = warped.shape[1]
        ahead = torch.arange(1, horizon + 1, device=warped.device) / horizon
        change = warped - picture[:, None]
        frame = ahead[None, :, None, None, None].expand_as(warped[:, :, :1])
        seen = torch.cat([warped - 0.5, change, frame.to(warped.dtype)], dim=2).flatten(0, 1)
        gelu = nn.functional.gelu
        refined = self.last(gelu(self.second(gelu(self.first(seen)))))
        refined = nn.functional.pixel_shuffle(refined, 2)
        return (warped + refined.unflatten(0, (-1, horizon))).clamp(0, 1)


#: Origins of a sequence that are trained on lie so many frames apart, the last at its end; the
#: first has as many frames before it as the network looks at.
ORIGIN_STEP = 3
#: An error of this size counts 1 in the loss: what the best baselines reach (docs/forecasting.md).
_USUAL_ERROR = 0.01


class ResidualModel(PredictorModel):
    """See the package's docs page; an untrained model is its prior."""

    def __init__(self, settings: ResidualSettings) -> None:
        super().__init__()
        self.settings = settings
        self.history = settings.history
        self.horizon = settings.horizon
        self.needs = PictureNeeds(settings.pictures, settings.size)
        self.span = 2
        self.makes_pictures = True
        self.prior = AdaptivePrior(settings.horizon, settings.shapes)
        self.regions = RegionEncoder(settings.region, settings.channels, settings.width)
        self.correction = CorrectionNet(
            settings.horizon, settings.shapes, settings.width, settings.dropout
        )
        self.refiner = Refiner(settings.refiner)

    def prepare(self, sequences: LandmarkSequences, generator: torch.Generator) -> None:
        """Fit the prior."""
        self.prior.fit(sequences)

    def encode(self, landmarks: Tensor, pictures: Tensor) -> Tensor:
        """Tokens (B, N - 1, G, D) of the regions."""
        tokens: Tensor = self.regions(pictures, landmarks)
        return tokens

    def decode(
        self,
        landmarks: Tensor,
        features: Tensor,
        last_picture: Tensor,
        make_pictures: bool = True,
    ) -> Output:
        """Forecast after the last frame."""
        newest = torch.tensor([landmarks.shape[1] - 1], device=landmarks.device)
        forecast, scale = self._landmarks(landmarks, newest, features)
        return Output(
            landmarks=forecast[:, 0],
            pictures=self._pictures(landmarks[:, -1], forecast[:, 0], last_picture)
            if make_pictures
            else None,
            mouth_scale=scale[:, 0],
            degrees_of_freedom=self.correction.degrees_of_freedom,
        )

    def loss(self, history: History, future: Future) -> Losses:
        """Likelihood and absolute error of the mouth, error of landmarks and of pictures.

        Landmarks are trained at several origins of every sequence, pictures at its end.
        """
        s = self.settings
        landmarks = torch.cat([history.landmarks, future.landmarks], dim=1)
        newest = history.landmarks.shape[1] - 1
        first = min(newest, s.recent - 1)
        origins = torch.arange(newest, first - 1, -ORIGIN_STEP, device=landmarks.device).flip(0)
        tokens = self.encode(history.landmarks[:, -s.pictures :], history.pictures)
        forecast, scale = self._landmarks(landmarks, origins, tokens)
        ahead = origins[:, None] + torch.arange(1, s.horizon + 1, device=landmarks.device)
        truth = landmarks[:, ahead]  # (B, O, H, L, 2)
        lips = list(LIPS)
        error = (forecast[..., lips, :] - truth[..., lips, :]).mean(dim=-2)
        likelihood = -torch.distributions.StudentT(
            self.correction.degrees_of_freedom, 0.0, scale
        ).log_prob(error)
        made = self._pictures(history.landmarks[:, -1], forecast[:, -1], history.pictures[:, -1])
        shown = future.pictures.permute(0, 1, 4, 2, 3).to(made.dtype) / 255
        terms = {
            "likelihood": likelihood.mean(),
            "mouth": error.abs().mean() / _USUAL_ERROR,
            "landmarks": (forecast - truth).abs().mean() / _USUAL_ERROR,
            "pictures": nn.functional.l1_loss(made, shown),
        }
        total = (
            terms["likelihood"]
            + s.mouth_weight * terms["mouth"]
            + s.landmark_weight * terms["landmarks"]
            + s.picture_weight * terms["pictures"]
        )
        return Losses(total, {name: value.detach() for name, value in terms.items()})

    def _landmarks(
        self, landmarks: Tensor, origins: Tensor, tokens: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Forecast landmarks (B, O, H, L, 2), and the scale of the mouth's error (B, O, H, 2)."""
        with torch.autocast(landmarks.device.type, enabled=False):
            landmarks = landmarks.float()
            mouth, shapes = self.prior.series(landmarks)
            with torch.no_grad():
                prior = self.prior(mouth, shapes, origins)
            width = min(self.settings.recent, int(origins[0]) + 1)
            window = origins[:, None] + torch.arange(1 - width, 1, device=landmarks.device)
            fixed = self.correction(
                mouth[:, window],
                shapes[:, window],
                self.prior.step,
                prior,
                tokens.float().flatten(1, 2),
            )
            moved = (prior.shapes + fixed.shapes) @ self.prior.basis
            forecast = landmarks[:, origins][:, :, None] + moved.unflatten(-1, (-1, 2))
            # the shapes' mouth is not quite the one that was forecast: the lips go the rest of
            # the way as one piece
            lips = list(LIPS)
            middle = mouth[:, origins][:, :, None] + prior.mouth + fixed.mouth
            rest = middle - forecast[..., lips, :].mean(dim=-2)
            forecast[..., lips, :] = forecast[..., lips, :] + rest[..., None, :]
        return forecast, fixed.scale

    def _pictures(self, landmarks: Tensor, forecast: Tensor, last_picture: Tensor) -> Tensor:
        """Pictures (B, H, 3, S, S); they do not teach the landmarks anything."""
        picture = last_picture.permute(0, 3, 1, 2).float() / 255
        warped = warp(picture, flow(landmarks.float(), forecast.detach()))
        refined: Tensor = self.refiner(picture, warped)
        return refined
