"""Residual prediction: the adaptive prior, corrected by a network, and images warped to it.

Landmarks are those of the last frame, moved by the prior's principal shapes plus a learnt
correction. Images are the last image, warped by the predicted landmarks and refined.

Shapes: B batch, T frames of history, N frames, O origins, W recent frames up to an origin,
H horizon, L = 468 landmarks, K principal shapes, S side of the images, R = 4 regions, C side of a
region, D width, M tokens, G cells of the flow on a side.
"""

from __future__ import annotations

import math

import torch
from torch import Generator, Tensor, nn
from torch.nn import functional

from face_prediction.forecast.interface import LandmarkSequences
from face_prediction.models.interface import Future, History, Losses, Output, PredictorModel
from face_prediction.models.residual.prior import AdaptivePrior, PriorForecast
from face_prediction.models.settings import ResidualSettings
from face_prediction.prediction.interface import ImageNeeds
from face_prediction.tracking.geometry import LIPS
from face_prediction.tracking.tracks import NUM_LANDMARKS

_LIPS: list[int] = list(LIPS)

REGIONS: tuple[tuple[list[int], float], ...] = (
    (_LIPS, 0.5),
    ([33, 133], 0.35),  # corners of the right eye in MediaPipe's face mesh
    ([362, 263], 0.35),  # of the left eye
    (list(range(NUM_LANDMARKS)), 1.2),
)
"""Landmarks whose mean is the middle of a region, and its side as a share of the face's height."""

# Correction
_REACH = 5.0  # frames in which displacements add up to about so many root mean squares
_INPUT_LIMIT = 6.0  # units, beyond which inputs are cut off
_CORRECTION_UNIT = 0.5  # of the prior's error; a unit of the last layer
_LEAST_STEP = 1e-5  # crops a frame
# Degrees of freedom begin at 5 and stay above 2: the error has a variance. The standard deviation
# of a Student-t error with 5 is 1.36 times its mean absolute value and 1.29 times its scale, so the
# scale begins near the mean absolute error so far.
_LEAST_FREEDOM = 2.0
_FREEDOM_START = math.log(math.expm1(3.0))

# Warp
FLOW_CELLS = 32  # G, fine enough for a jaw
FLOW_REACH = 0.05  # crops, standard deviation of the Gaussian that moves cells around landmarks
BACKGROUND = 0.3  # weight of the background, which stays, beside the landmarks'

# Training
# Frames between the origins of a sequence that are trained on. The last is at its end; the first
# has as many frames before it as the network sees.
ORIGIN_STEP = 3
# crops, counts 1 in the loss: the best baselines' (docs/predictor_evaluation.md)
_USUAL_ERROR = 0.01


def cut_out(images: Tensor, landmarks: Tensor, side: int) -> Tensor:
    """Cut the regions (B, N, R, 3, C, C) out of images, bilinearly; black outside.

    Args:
        images: (B, N, 3, S, S), floating.
        landmarks: (B, N, L, 2), where the face is.
        side: C, pixels.
    """
    span = landmarks.amax(dim=2) - landmarks.amin(dim=2)  # (B, N, 2)
    height = span[..., 1].clamp_min(1e-3)
    cells = (torch.arange(side, device=images.device) + 0.5) / side - 0.5
    offsets = torch.stack(torch.meshgrid(cells, cells, indexing="xy"), dim=-1)  # (C, C, 2)
    flat = images.flatten(0, 1)
    regions = []
    for points, share in REGIONS:
        middle = landmarks[:, :, points].mean(dim=2)
        size = (share * height)[..., None, None, None]
        grid = middle[:, :, None, None] + size * offsets
        # grid_sample counts from -1 to 1, from border to border of the image
        grid = (2 * grid - 1).flatten(0, 1).to(images.dtype)
        regions.append(functional.grid_sample(flat, grid, align_corners=False))
    return torch.stack(regions, dim=1).unflatten(0, landmarks.shape[:2])


class RegionEncoder(nn.Module):
    """A token (D) for every region (C x C) of every frame, from it and its change since the last.

    Each of the convolutions halves the region.
    """

    def __init__(self, side: int, channels: tuple[int, ...], width: int) -> None:
        super().__init__()
        self.side = side
        layers: list[nn.Module] = []
        for before, after in zip((6, *channels), channels, strict=False):
            convolution = nn.Conv2d(before, after, 3, stride=2, padding=1)
            layers += [convolution, nn.GroupNorm(1, after), nn.GELU()]
        self.convolutions = nn.Sequential(*layers)
        self.token = nn.Linear(channels[-1], width)
        self.which = nn.Parameter(0.02 * torch.randn(len(REGIONS), width))

    def forward(self, images: Tensor, landmarks: Tensor) -> Tensor:
        """Return tokens (B, N - 1, R, D) of images (B, N, S, S, 3) uint8.

        The frame before is cut out at the later frame's place, so that what moved differs.
        """
        images = images.permute(0, 1, 4, 2, 3).to(self.token.weight.dtype) / 255 - 0.5
        now = cut_out(images[:, 1:], landmarks[:, 1:], self.side)
        before = cut_out(images[:, :-1], landmarks[:, 1:], self.side)
        both = torch.cat([now, now - before], dim=3)
        flat = self.convolutions(both.flatten(0, 2)).mean(dim=(2, 3))
        return self.token(flat).unflatten(0, both.shape[:3]) + self.which


class CorrectionNet(nn.Module):
    """Recurrent network over the motion, attention to the images' tokens, linear heads.

    The last layers begin at zero: an untrained network is the prior. Dropout is on the inputs of
    the layers.
    """

    def __init__(self, horizon: int, shapes: int, width: int, dropout: float) -> None:
        super().__init__()
        self.horizon = horizon
        self.inputs = nn.Linear(2 * (2 + shapes) + 1, width)
        self.motion = nn.GRU(width, width, batch_first=True)
        self.dropout = nn.Dropout(dropout)
        self.query, self.key, self.value, self.seen = (nn.Linear(width, width) for _ in range(4))
        self.hidden = nn.Linear(width + 4 * horizon, width)
        self.change = nn.Linear(width, horizon * (2 + shapes))
        self.log_scale = nn.Linear(width, 2 * horizon)
        self.freedom = nn.Parameter(torch.full((horizon, 2), _FREEDOM_START))
        _begin_at_zero(self.seen, self.change, self.log_scale)

    @property
    def degrees_of_freedom(self) -> Tensor:
        """Degrees of freedom (H, 2) of the Student-t error."""
        return _LEAST_FREEDOM + functional.softplus(self.freedom)

    def forward(
        self, mouth: Tensor, shapes: Tensor, step: Tensor, prior: PriorForecast, tokens: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Correct ``prior``.

        Args:
            mouth: (B, O, W, 2) up to each origin.
            shapes: (B, O, W, K).
            step: (K,) usual step of the shapes from frame to frame, over people.
            prior: at the same origins.
            tokens: (B, M, D) from the images up to the last origin, which alone attends to them.

        Returns:
            What to add to the prior's mouth (B, O, H, 2) and shapes (B, O, H, K), and the scale
            (B, O, H, 2) of the error of the corrected mouth, in crops.
        """
        motion, pace = _motion(mouth, shapes / step)
        code = self.inputs(self.dropout(motion.clamp(-_INPUT_LIMIT, _INPUT_LIMIT)).flatten(0, 1))
        code = self.motion(code)[0][:, -1].unflatten(0, mouth.shape[:2])
        code = torch.cat([code[:, :-1], code[:, -1:] + self._attend(code[:, -1:], tokens)], dim=1)
        doubt = torch.log(prior.error / pace[..., None])  # how predictable this face was
        expected = (prior.mouth / prior.error).clamp(-_INPUT_LIMIT, _INPUT_LIMIT)
        known = torch.cat([code, doubt.flatten(2), expected.flatten(2)], dim=-1)
        hidden = self.dropout(functional.gelu(self.hidden(known)))
        change = self.change(hidden).unflatten(-1, (self.horizon, -1))
        error = prior.error.mean(dim=-1, keepdim=True)
        usual = step * (error / pace[..., None])  # shapes' error, as the mouth's is to its pace
        log_scale = self.log_scale(hidden).unflatten(-1, (self.horizon, 2))
        return (
            _CORRECTION_UNIT * change[..., :2] * prior.error,
            _CORRECTION_UNIT * change[..., 2:] * usual,
            prior.error * log_scale.exp(),
        )

    def _attend(self, query: Tensor, tokens: Tensor) -> Tensor:
        """Return the attention (B, 1, D) of a code (B, 1, D) to tokens: equations 1 to 3."""
        key, value = self.key(tokens), self.value(tokens)
        weight = self.query(query) @ key.transpose(1, 2) / math.sqrt(key.shape[-1])
        return self.seen(torch.softmax(weight, dim=-1) @ value)


def _motion(mouth: Tensor, shapes: Tensor) -> tuple[Tensor, Tensor]:
    """Return motion (B, O, W, 2 (2 + K) + 1) without unit, and the mouth's pace (B, O, 1) in crops.

    Steps, and places seen from the newest frame, each divided by the root mean square of the
    steps; and how jerky a frame was beside the others, which shows repeated frames.
    """
    parts, paces = [], []
    for series in (mouth, shapes):
        steps = torch.diff(series, dim=2, prepend=series[:, :, :1])
        pace = steps.square().mean(dim=(2, 3), keepdim=True).sqrt() + _LEAST_STEP
        paces.append(pace)
        parts += [steps / pace, (series - series[:, :, -1:]) / (_REACH * pace)]
    jerk = torch.diff(parts[2], dim=2, prepend=parts[2][:, :, :1]).square().mean(-1, keepdim=True)
    parts.append(torch.log(jerk / (jerk.mean(dim=2, keepdim=True) + 1e-6) + 1e-3) / 2)
    return torch.cat(parts, dim=-1), paces[0][..., 0]


def flow(landmarks: Tensor, forecast: Tensor) -> Tensor:
    """Return the displacement (B, H, 2, G, G) of the content of each cell, in crops.

    Every cell moves by the mean of the landmarks predicted to be around it, and of a background at
    rest.

    Args:
        landmarks: (B, L, 2) of the last frame.
        forecast: (B, H, L, 2).
    """
    cells = (torch.arange(FLOW_CELLS, device=forecast.device) + 0.5) / FLOW_CELLS
    # the Gaussian of a distance is the product of one across and one down: two small products of
    # matrices instead of every cell against every landmark
    apart = forecast[..., None] - cells  # (B, H, L, 2, G)
    across, down = torch.exp(-apart.square() / (2 * FLOW_REACH**2)).unbind(dim=3)  # (B, H, L, G)
    down = down.transpose(2, 3)
    step = forecast - landmarks[:, None]
    moved = [down @ (across * step[..., axis, None]) for axis in range(2)]
    return torch.stack(moved, dim=2) / (down @ across + BACKGROUND)[:, :, None]


def warp(image: Tensor, moved: Tensor) -> Tensor:
    """Move the content of an image by a flow, bilinearly; return images (B, H, 3, S, S).

    Args:
        image: (B, 3, S, S).
        moved: (B, H, 2, G, G) from `flow`.
    """
    side, horizon = image.shape[-1], moved.shape[1]
    fine = functional.interpolate(moved.flatten(0, 1), (side, side), mode="bilinear")
    pixels = (torch.arange(side, device=image.device) + 0.5) / side
    place = torch.stack(torch.meshgrid(pixels, pixels, indexing="xy"), dim=-1)  # (S, S, 2)
    grid = 2 * (place - fine.permute(0, 2, 3, 1)) - 1
    repeated = image[:, None].expand(-1, horizon, -1, -1, -1).flatten(0, 1)
    warped = functional.grid_sample(
        repeated, grid.to(image.dtype), padding_mode="border", align_corners=False
    )
    return warped.unflatten(0, (-1, horizon))


class Refiner(nn.Module):
    """Corrects warped images at half their size; begins by changing nothing."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.first = nn.Conv2d(7, channels, 5, stride=2, padding=2)
        self.second = nn.Conv2d(channels, channels, 3, padding=1)
        self.last = nn.Conv2d(channels, 12, 3, padding=1)
        _begin_at_zero(self.last)

    def forward(self, image: Tensor, warped: Tensor) -> Tensor:
        """Return refined images (B, H, 3, S, S) of warped ones and the last (B, 3, S, S)."""
        horizon = warped.shape[1]
        ahead = torch.arange(1, horizon + 1, device=warped.device) / horizon
        frame = ahead[None, :, None, None, None].expand_as(warped[:, :, :1])
        seen = torch.cat([warped - 0.5, warped - image[:, None], frame.to(warped.dtype)], dim=2)
        hidden = functional.gelu(self.first(seen.flatten(0, 1)))
        refined = functional.pixel_shuffle(self.last(functional.gelu(self.second(hidden))), 2)
        return (warped + refined.unflatten(0, (-1, horizon))).clamp(0, 1)


def _begin_at_zero(*layers: nn.Linear | nn.Conv2d) -> None:
    for parameter in nn.ModuleList(layers).parameters():
        nn.init.zeros_(parameter)


class ResidualModel(PredictorModel):
    """Prior, correction, warp and refinement; see docs/predictors.md."""

    def __init__(self, settings: ResidualSettings) -> None:
        super().__init__()
        self.settings = settings
        self.history, self.horizon, self.span = settings.history, settings.horizon, 2
        self.needs = ImageNeeds(settings.pictures, settings.size)
        self.prior = AdaptivePrior(settings.horizon, settings.shapes)
        self.regions = RegionEncoder(settings.region, settings.channels, settings.width)
        self.correction = CorrectionNet(
            settings.horizon, settings.shapes, settings.width, settings.dropout
        )
        self.refiner = Refiner(settings.refiner)

    def prepare(self, sequences: LandmarkSequences, generator: Generator) -> None:
        """Fit the prior."""
        self.prior.fit(sequences)

    def encode(self, landmarks: Tensor, images: Tensor) -> Tensor:
        """Return tokens (B, N - 1, R, D) of the regions."""
        return self.regions(images, landmarks)

    def decode(
        self, landmarks: Tensor, features: Tensor, last_image: Tensor, make_images: bool = True
    ) -> Output:
        """Predict the frames after the last."""
        newest = torch.tensor([landmarks.shape[1] - 1], device=landmarks.device)
        forecast, scale = self._landmarks(landmarks, newest, features)
        images = self._images(landmarks[:, -1], forecast[:, 0], last_image) if make_images else None
        return Output(forecast[:, 0], images, scale[:, 0], self.correction.degrees_of_freedom)

    def loss(self, history: History, future: Future) -> Losses:
        """Return likelihood and absolute error of the mouth, error of landmarks and of images.

        Landmarks are trained at several origins of every sequence, images at its end.
        """
        s = self.settings
        landmarks = torch.cat([history.landmarks, future.landmarks], dim=1)
        newest = history.landmarks.shape[1] - 1
        first = min(newest, s.recent - 1)
        origins = torch.arange(newest, first - 1, -ORIGIN_STEP, device=landmarks.device).flip(0)
        tokens = self.encode(history.landmarks[:, -s.pictures :], history.images)
        forecast, scale = self._landmarks(landmarks, origins, tokens)
        ahead = origins[:, None] + torch.arange(1, s.horizon + 1, device=landmarks.device)
        truth = landmarks[:, ahead]  # (B, O, H, L, 2)
        error = (forecast[..., _LIPS, :] - truth[..., _LIPS, :]).mean(dim=-2)
        student = torch.distributions.StudentT(self.correction.degrees_of_freedom, 0.0, scale)
        images = self._images(history.landmarks[:, -1], forecast[:, -1], history.images[:, -1])
        target = future.images.permute(0, 1, 4, 2, 3).to(images.dtype) / 255
        terms = {
            "likelihood": -student.log_prob(error).mean(),
            "mouth": error.abs().mean() / _USUAL_ERROR,
            "landmarks": (forecast - truth).abs().mean() / _USUAL_ERROR,
            "pictures": functional.l1_loss(images, target),
        }
        total = terms["likelihood"] + s.mouth_weight * terms["mouth"]
        total = total + s.landmark_weight * terms["landmarks"]
        total = total + s.picture_weight * terms["pictures"]
        return Losses(total, {name: value.detach() for name, value in terms.items()})

    def _landmarks(
        self, landmarks: Tensor, origins: Tensor, tokens: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Return landmarks (B, O, H, L, 2), and the scale of the mouth's error (B, O, H, 2)."""
        with torch.autocast(landmarks.device.type, enabled=False):
            landmarks = landmarks.float()
            mouth, shapes = self.prior.series(landmarks)
            with torch.no_grad():
                prior = self.prior(mouth, shapes, origins)
            width = min(self.settings.recent, int(origins[0]) + 1)
            window = origins[:, None] + torch.arange(1 - width, 1, device=landmarks.device)
            tokens = tokens.float().flatten(1, 2)
            mouth_change, shape_change, scale = self.correction(
                mouth[:, window], shapes[:, window], self.prior.step, prior, tokens
            )
            moved = (prior.shapes + shape_change) @ self.prior.basis
            forecast = landmarks[:, origins][:, :, None] + moved.unflatten(-1, (-1, 2))
            # the mouth of the shapes is not quite the predicted one: the lips go the rest of the
            # way as one piece
            middle = mouth[:, origins][:, :, None] + prior.mouth + mouth_change
            rest = middle - forecast[..., _LIPS, :].mean(dim=-2)
            forecast[..., _LIPS, :] = forecast[..., _LIPS, :] + rest[..., None, :]
        return forecast, scale

    def _images(self, landmarks: Tensor, forecast: Tensor, last_image: Tensor) -> Tensor:
        """Return images (B, H, 3, S, S); their loss does not train the landmarks."""
        image = last_image.permute(0, 3, 1, 2).float() / 255
        return self.refiner(image, warp(image, flow(landmarks.float(), forecast.detach())))
