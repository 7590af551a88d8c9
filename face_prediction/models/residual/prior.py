"""Adaptive prior of residual prediction: linear forecasters that keep learning from one face.

Each expert predicts the displacements of the next H frames linearly from the last displacements (of
principal shapes, or of the mouth centre). Its coefficients are fitted to the training people, for
the least absolute error of the mouth; an adaptive expert adds a ridge regression of the errors that
it has made on this very face so far. A periodic expert learns mostly from frames a multiple of
`PERIOD` before: video of 25 frames a second at 30 has interpolated or repeated frames in a pattern
of 6. The experts are mixed by their recent errors.

Shapes: B batch, T frames, O origins (an origin is the number of the newest frame seen), H horizon,
K principal shapes, F features, R = H (2 + K) outputs (U, V and shapes of every frame), E experts,
N rows to learn from, L = 468 landmarks.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from face_prediction.forecast.autoregression import principal_shapes
from face_prediction.forecast.interface import LandmarkSequences
from face_prediction.tracking.geometry import LIPS
from face_prediction.tracking.tracks import NUM_LANDMARKS

# Fit to the training people
_RIDGE = 3e-3  # share of the features' mean square added to the diagonal
_ROUNDS = 6  # of reweighting from least squares to least absolute error
_SMALL_ERROR = 1e-3  # crops: errors below it count alike
_WARM_UP = 16  # frames at the beginning of a sequence that are left out: they have no past
_STILL = 1e-3  # crops: a sequence with this mean step of the mouth counts half

# Adaptation to one face
PERIOD = 6  # frames of 30 a second after which the pattern of video of 25 repeats
OTHER_PHASES = 0.1  # weight of frames at another phase of the pattern, for a periodic expert
_REST = 1e-6  # least mean square of scaled features: a face at rest must not divide by 0

# Mixture
WINDOW = 40  # origins whose errors decide an expert's weight
# an expert whose errors are 1 + d times the best one's has exp(-SHARPNESS d) times its weight
SHARPNESS = 15.0
_WINDOW_OTHER_PHASES = 0.2  # weight of origins at another phase of the pattern
_ALIKE = 1e-5  # crops, added to errors before they are compared: a hundredth of a pixel of 256
_LEAST_ERROR = 2e-4  # crops: below the detector's jitter (0.0004 and more)


@dataclass(frozen=True)
class Block:
    """Features that experts share: the last displacements of shapes or of the mouth.

    Attributes:
        of: series whose displacements are taken.
        components: of the series, the first ones; 2 for the mouth.
        lags: displacements of each.
    """

    of: Literal["shapes", "mouth"]
    components: int
    lags: int


@dataclass(frozen=True)
class LinearExpert:
    """A forecaster on a block of features.

    Attributes:
        block: index in `BLOCKS`.
        shrink: weight of the people's coefficients against this face's own frames, in mean
            squares of the features; None for an expert that does not adapt.
        periodic: whether frames at another phase of the pattern count less.
    """

    block: int
    shrink: float | None
    periodic: bool = False


BLOCKS = (Block("shapes", 8, 3), Block("shapes", 4, 6), Block("shapes", 4, 2), Block("mouth", 2, 4))
EXPERTS = (
    LinearExpert(0, None),
    LinearExpert(0, 10.0),
    LinearExpert(1, 3.0),
    LinearExpert(1, 3.0, periodic=True),
    LinearExpert(2, None),
    LinearExpert(2, 1.0),
    LinearExpert(2, 1.0, periodic=True),
    LinearExpert(3, 3.0),
    LinearExpert(3, 1.0, periodic=True),
)
"""Chosen on folds of the development clips among 54; see docs/predictors.md. The expert that
expects no motion at all needs no line here."""


def features(block: Block, mouth: Tensor, shapes: Tensor) -> Tensor:
    """Return the features (B, T, F) at every origin, of mouth (B, T, 2) and shapes (B, T, K).

    Before the first frame the face is taken to have been at rest.
    """
    series = mouth if block.of == "mouth" else shapes[..., : block.components]
    steps = torch.diff(series, dim=1, prepend=series[:, :1])
    padded = nn.functional.pad(steps, (0, 0, block.lags - 1, 0))
    return padded.unfold(1, block.lags, 1).flatten(2)


def outcomes(mouth: Tensor, shapes: Tensor, horizon: int) -> Tensor:
    """Return the true displacements (B, T - H, R) from each origin whose H frames are known."""
    series = torch.cat([mouth, shapes], dim=-1)
    ahead = series.unfold(1, horizon + 1, 1).movedim(-1, 2)  # (B, T - H, H + 1, 2 + K)
    return (ahead[:, :, 1:] - ahead[:, :, :1]).flatten(2)


def fit_people(
    x: NDArray[np.float64], y: NDArray[np.float64], weight: NDArray[np.float64], horizon: int
) -> NDArray[np.float64]:
    """Fit coefficients (F, R) for the least absolute error of the mouth.

    Args:
        x: (N, F) scaled features.
        y: (N, R) outcomes, of which the first two of every frame are the mouth's.
        weight: (N,) of the rows.
        horizon: H. An error after h frames counts 1 / sqrt(h), as errors grow about so.
    """
    mouth = np.arange(y.shape[1]).reshape(horizon, -1)[:, :2].ravel()
    growth = np.sqrt(np.repeat(np.arange(1, horizon + 1), 2))
    used = weight
    solution = np.zeros((x.shape[1], y.shape[1]))
    for iteration in range(_ROUNDS):
        if iteration:
            error = (np.abs(y[:, mouth] - x @ solution[:, mouth]) / growth).mean(axis=1)
            used = weight / np.sqrt(error**2 + _SMALL_ERROR**2)
            used = used / used.mean()
        weighted = x * used[:, None]
        gram = weighted.T @ x + _RIDGE * len(x) * np.eye(x.shape[1])
        solution = np.linalg.solve(gram, weighted.T @ y)
    return np.asarray(solution, dtype=np.float64)


def learning_weights(origins: Tensor, count: int, horizon: int, other_phases: float) -> Tensor:
    """Return the weights (O, count) of the rows 0 ... ``count`` - 1 at ``origins`` (O,).

    Only rows whose H outcomes are known at the origin count; the newest frame of row t is t.
    """
    age = origins[:, None] - torch.arange(count, device=origins.device)
    weight = torch.where(age % PERIOD == 0, 1.0, other_phases)
    return torch.where(age >= horizon, weight, 0.0)


def adapted(x: Tensor, error: Tensor, now: Tensor, weight: Tensor, shrink: float) -> Tensor:
    """Return the correction (B, O, R) of the people's forecast, by ridge regression of its errors.

    Args:
        x: (B, N, F) scaled features of rows to learn from.
        error: (B, N, R) outcomes less the people's forecast.
        now: (B, O, F) features to forecast from.
        weight: (O, N) of the rows, 0 where their outcomes are not known yet.
        shrink: see `LinearExpert`.
    """
    batch, rows, size = x.shape
    products = (x[..., :, None] * x[..., None, :]).reshape(batch, rows, size * size)
    gram = (weight @ products).reshape(batch, -1, size, size)
    target = torch.einsum("on,bnf,bnr->bofr", weight, x, error)
    power = weight @ x.square().mean(dim=-1, keepdim=True) + _REST  # (B, O, 1)
    gram = gram + (shrink * power)[..., None] * torch.eye(size, device=x.device)
    change = torch.cholesky_solve(target, torch.linalg.cholesky(gram))
    return (now[..., None, :] @ change)[..., 0, :]


@dataclass(frozen=True)
class PriorForecast:
    """Forecast of the prior at O origins, as displacements from the newest frame.

    Attributes:
        mouth: (B, O, H, 2) of the mouth centre, in crops.
        shapes: (B, O, H, K).
        error: (B, O, H, 2) mean absolute error of the mouth's forecast so far, in crops.
    """

    mouth: Tensor
    shapes: Tensor
    error: Tensor


class AdaptivePrior(nn.Module):
    """Mixture of linear experts. All that is fitted is in buffers; gradients train nothing.

    Args:
        horizon: H.
        shapes: K.
        experts: to mix, beside the one that expects no motion.
    """

    basis: Tensor
    step: Tensor

    def __init__(
        self, horizon: int, shapes: int, experts: tuple[LinearExpert, ...] = EXPERTS
    ) -> None:
        super().__init__()
        self.horizon, self.experts = horizon, experts
        self.register_buffer("basis", torch.zeros(shapes, 2 * NUM_LANDMARKS))
        self.register_buffer("step", torch.ones(shapes))
        for i, block in enumerate(BLOCKS):
            size = block.components * block.lags  # F
            self.register_buffer(f"scale_{i}", torch.ones(size))
            self.register_buffer(f"people_{i}", torch.zeros(size, horizon * (2 + shapes)))

    def fit(self, sequences: LandmarkSequences) -> None:
        """Fit shapes, scales and the people's coefficients."""
        basis = torch.from_numpy(principal_shapes(sequences.landmarks, len(self.basis)))
        self.basis.zero_()[: len(basis)] = basis  # sequences may have fewer shapes
        landmarks = torch.tensor(sequences.landmarks, dtype=torch.float32, device=self.basis.device)
        mouth, shapes = self.series(landmarks)
        self.step.copy_(torch.diff(shapes, dim=1).square().mean(dim=(0, 1)).sqrt() + 1e-9)
        y = outcomes(mouth, shapes, self.horizon)[:, _WARM_UP:].double().cpu().numpy()
        pace = torch.diff(mouth, dim=1).abs().mean(dim=(1, 2)).double().cpu().numpy()
        weight = np.repeat(pace / (pace + _STILL), y.shape[1])
        for i, block in enumerate(BLOCKS):
            x = features(block, mouth, shapes)[:, _WARM_UP : _WARM_UP + y.shape[1]]
            rows = x.double().cpu().numpy().reshape(-1, x.shape[-1])
            scale = rows.std(axis=0) + 1e-9
            people = fit_people(rows / scale, y.reshape(len(rows), -1), weight, self.horizon)
            self.get_buffer(f"scale_{i}").copy_(torch.from_numpy(scale))
            self.get_buffer(f"people_{i}").copy_(torch.from_numpy(people))

    def series(self, landmarks: Tensor) -> tuple[Tensor, Tensor]:
        """Return mouth centre (B, T, 2) and shapes (B, T, K) of landmarks (B, T, L, 2)."""
        mouth = landmarks[:, :, list(LIPS)].mean(dim=2)
        return mouth, landmarks.flatten(2) @ self.basis.T

    def forward(self, mouth: Tensor, shapes: Tensor, origins: Tensor) -> PriorForecast:
        """Forecast at ``origins`` (O,) from the frames up to each.

        Args:
            mouth: (B, T, 2).
            shapes: (B, T, K).
            origins: numbers of the newest frames, ascending; later frames are not used.
        """
        frames = int(origins[-1]) + 1
        mouth, shapes = mouth[:, :frames], shapes[:, :frames]
        known = outcomes(mouth, shapes, self.horizon) if frames > self.horizon else None
        forecasts = self._experts(mouth, shapes, known).unflatten(-1, (self.horizon, -1))
        at = forecasts[:, :, origins]  # (B, E, O, H, 2 + K)
        error = at.new_zeros((*at.shape[:4], 2))
        if known is not None:
            count = known.shape[1]
            truth = known.unflatten(-1, (self.horizon, -1))[..., :2]
            errors = (forecasts[:, :, :count, ..., :2] - truth[:, None]).abs()
            weight = learning_weights(origins, count, self.horizon, _WINDOW_OTHER_PHASES)
            age = origins[:, None] - torch.arange(count, device=origins.device)
            weight = weight * (age < WINDOW + self.horizon)
            weight = weight / weight.sum(dim=1, keepdim=True).clamp_min(1e-9)
            error = (weight @ errors.flatten(3)).reshape(error.shape)
        both = error.mean(dim=-1, keepdim=True) + _ALIKE  # (B, E, O, H, 1)
        share = torch.softmax(-SHARPNESS * (both / both.amin(dim=1, keepdim=True) - 1), dim=1)
        mixed = (share * at).sum(dim=1)
        expected = (share * error).sum(dim=1).clamp_min(_LEAST_ERROR)
        return PriorForecast(mixed[..., :2], mixed[..., 2:], expected)

    def _experts(self, mouth: Tensor, shapes: Tensor, known: Tensor | None) -> Tensor:
        """Return the forecasts (B, E, T, R) of every expert at every origin."""
        rows = torch.arange(mouth.shape[1], device=mouth.device)
        people = []
        for i, block in enumerate(BLOCKS):
            x = features(block, mouth, shapes) / self.get_buffer(f"scale_{i}")
            people.append((x, x @ self.get_buffer(f"people_{i}")))
        result = [torch.zeros_like(people[0][1])]
        for expert in self.experts:
            x, forecast = people[expert.block]
            if expert.shrink is not None and known is not None:
                count = known.shape[1]
                other_phases = OTHER_PHASES if expert.periodic else 1.0
                weight = learning_weights(rows, count, self.horizon, other_phases)
                error = known - forecast[:, :count]
                forecast = forecast + adapted(x[:, :count], error, x, weight, expert.shrink)
            result.append(forecast)
        return torch.stack(result, dim=1)
