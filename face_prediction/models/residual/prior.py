"""The forecasters that the prior mixes: linear ones that keep learning from the face they watch.

Each forecasts the displacements of the next H frames linearly from the last displacements (of
principal shapes, or of the mouth centre). Coefficients are fitted to the people trained on, for the
least absolute error of the mouth; an adaptive expert adds to them a ridge regression of what they
got wrong on this very face so far. An expert with a period learns mostly from frames that many
frames, or a multiple of it, before: video of 25 frames a second shown at 30 has interpolated or
repeated frames in a pattern of 6.

Legend: B batch, O origins (an origin is the number of frames seen), F features, R outputs
(H frames of U, V and the K shapes), T frames.
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

#: Frames of 30 a second after which the pattern of video of 25 repeats.
PERIOD = 6
#: What frames at another place in the pattern count for an expert with a period.
OTHER_PHASES = 0.1
#: Smallest mean square of scaled features: a face at rest teaches nothing and must not divide by 0.
_REST = 1e-6
#: Share of the features' mean square added to the diagonal of the fit to people.
_RIDGE = 3e-3
#: Rounds of reweighting from least squares to least absolute error, and, in crops, the error
#: below which all count alike.
_ROUNDS = 6
_SMALL_ERROR = 1e-3


@dataclass(frozen=True)
class Block:
    """Features that experts share: the last ``lags`` displacements of ``of``."""

    of: Literal["shapes", "mouth"]
    #: The first so many shapes; 2 for the mouth.
    components: int
    lags: int

    @property
    def size(self) -> int:
        """F."""
        return self.components * self.lags


@dataclass(frozen=True)
class Expert:
    """One forecaster on a block of features."""

    block: int
    #: Weight of the people's coefficients against this face's own frames, in features' mean
    #: squares; None: they are not adapted.
    shrink: float | None
    periodic: bool = False


BLOCKS = (
    Block("shapes", 8, 3),
    Block("shapes", 4, 6),
    Block("shapes", 4, 2),
    Block("mouth", 2, 4),
)
#: Chosen on folds of the development clips among 54; see docs/face_residual.md. The expert that
#: expects no motion at all needs no line here.
EXPERTS = (
    Expert(0, None),
    Expert(0, 10.0),
    Expert(1, 3.0),
    Expert(1, 3.0, periodic=True),
    Expert(2, None),
    Expert(2, 1.0),
    Expert(2, 1.0, periodic=True),
    Expert(3, 3.0),
    Expert(3, 1.0, periodic=True),
)


def features(block: Block, mouth: Tensor, shapes: Tensor) -> Tensor:
    """Displacements (B, T, F) known at origins 1 ... T, of mouth (B, T, 2) and shapes (B, T, K).

    Row t belongs to origin t + 1: the last of them is that of frame t. Before the first frame the
    face is taken to have been at rest.
    """
    series = mouth if block.of == "mouth" else shapes[..., : block.components]
    steps = torch.diff(series, dim=1, prepend=series[:, :1])
    padded = torch.nn.functional.pad(steps, (0, 0, block.lags - 1, 0))
    lagged = padded.unfold(1, block.lags, 1)  # (B, T, components, lags)
    return lagged.flatten(2)


def outcomes(mouth: Tensor, shapes: Tensor, horizon: int) -> Tensor:
    """Displacements (B, T - H, R) from the newest frame at origins 1 ... T - H."""
    series = torch.cat([mouth, shapes], dim=-1)
    ahead = series.unfold(1, horizon + 1, 1).movedim(-1, 2)  # (B, T - H, H + 1, 2 + K)
    return (ahead[:, :, 1:] - ahead[:, :, :1]).flatten(2)


def fit_people(
    x: NDArray[np.float64], y: NDArray[np.float64], weight: NDArray[np.float64], horizon: int
) -> NDArray[np.float64]:
    """Coefficients (F, R) of the least absolute error of the mouth on people.

    Args:
        x: (N, F) scaled features.
        y: (N, R) outcomes, of which the first two of every frame are the mouth's.
        weight: (N,) of the rows.
        horizon: H. An error after h frames counts 1 / sqrt(h): they grow about so.
    """
    mouth = np.arange(y.shape[1]).reshape(horizon, -1)[:, :2].ravel()
    grown = np.sqrt(np.repeat(np.arange(1, horizon + 1), 2))
    used = weight
    solution = np.zeros((x.shape[1], y.shape[1]))
    for round_ in range(_ROUNDS):
        if round_:
            error = (np.abs(y[:, mouth] - x @ solution[:, mouth]) / grown).mean(axis=1)
            used = weight / np.sqrt(error**2 + _SMALL_ERROR**2)
            used = used / used.mean()
        weighted = x * used[:, None]
        gram = weighted.T @ x + _RIDGE * len(x) * np.eye(x.shape[1])
        solution = np.linalg.solve(gram, weighted.T @ y)
    return np.asarray(solution, dtype=np.float64)


def learning_weights(origins: Tensor, count: int, horizon: int, other_phases: float) -> Tensor:
    """What each of rows 0 ... ``count`` - 1 counts (O, count) at ``origins`` (row numbers).

    Only rows whose H outcomes are all seen by then count; the newest frame of row t is t.
    """
    rows = torch.arange(count, device=origins.device)
    apart = origins[:, None] - rows[None, :]
    weight = torch.where(apart % PERIOD == 0, 1.0, other_phases)
    return torch.where(apart >= horizon, weight, 0.0)


def adapted(x: Tensor, wrong: Tensor, now: Tensor, weight: Tensor, shrink: float) -> Tensor:
    """What to add (B, O, R) to the people's forecast, from what it got wrong on this face.

    Args:
        x: (B, N, F) scaled features of rows to learn from.
        wrong: (B, N, R) outcomes less the people's forecast.
        now: (B, O, F) features to forecast from.
        weight: (O, N) of the rows, 0 where they are not known yet.
        shrink: see `Expert`.
    """
    batch, rows, size = x.shape
    products = (x[..., :, None] * x[..., None, :]).reshape(batch, rows, size * size)
    gram = (weight @ products).reshape(batch, -1, size, size)
    aim = torch.einsum("on,bnf,bnr->bofr", weight, x, wrong)
    power = weight @ x.square().mean(dim=-1, keepdim=True) + _REST  # (B, O, 1)
    gram = gram + (shrink * power)[..., None] * torch.eye(size, device=x.device)
    change = torch.cholesky_solve(aim, torch.linalg.cholesky(gram))
    return (now[..., None, :] @ change)[..., 0, :]


#: Origins that an expert is judged by, and what those at another place in the pattern count.
JUDGED = 40
_JUDGED_OTHER_PHASES = 0.2
#: An expert whose errors are 1 + d times the best one's has exp(-SHARPNESS d) times its weight.
SHARPNESS = 15.0
#: Added to errors (in crops) before they are compared: a hundredth of a pixel of 256 is no merit.
_ALIKE = 1e-5
#: Smallest error taken for possible, in crops: below the detector's jitter (0.0004 and more).
_FLOOR = 2e-4
#: Frames at the beginning of a sequence that people are not fitted to: they have no past.
_WARM_UP = 16
#: What a sequence of one who hardly moves counts in the fit to people: mean step of the mouth (in
#: crops) that counts half.
_STILL = 1e-3


@dataclass(frozen=True)
class PriorForecast:
    """What the prior expects at O origins, as displacements from the newest frame."""

    #: (B, O, H, 2) of the mouth centre, in crops
    mouth: Tensor
    #: (B, O, H, K) of the shapes
    shapes: Tensor
    #: (B, O, H, 2) mean absolute error of the mouth's forecast so far, in crops
    error: Tensor


class AdaptivePrior(nn.Module):
    """Everything that is fitted to people is a buffer; nothing is learnt by gradient.

    Args:
        horizon: H.
        shapes: K.
        experts: that are mixed, beside the one that expects no motion.
    """

    basis: Tensor
    step: Tensor

    def __init__(self, horizon: int, shapes: int, experts: tuple[Expert, ...] = EXPERTS) -> None:
        super().__init__()
        self.horizon = horizon
        self.experts = experts
        self.register_buffer("basis", torch.zeros(shapes, 2 * NUM_LANDMARKS))
        self.register_buffer("step", torch.ones(shapes))
        outputs = horizon * (2 + shapes)
        for i, block in enumerate(BLOCKS):
            self.register_buffer(f"scale_{i}", torch.ones(block.size))
            self.register_buffer(f"people_{i}", torch.zeros(block.size, outputs))

    def fit(self, sequences: LandmarkSequences) -> None:
        """Fit shapes, scales and the people's coefficients."""
        device = self.basis.device
        rank = len(self.basis)
        basis = np.zeros((rank, 2 * NUM_LANDMARKS))
        found = principal_shapes(sequences.landmarks, rank)
        basis[: len(found)] = found
        self.basis.copy_(torch.from_numpy(basis))
        landmarks = torch.tensor(sequences.landmarks, dtype=torch.float32, device=device)
        mouth, shapes = self.series(landmarks)
        self.step.copy_(torch.diff(shapes, dim=1).square().mean(dim=(0, 1)).sqrt() + 1e-9)
        y = outcomes(mouth, shapes, self.horizon)[:, _WARM_UP:].double().cpu().numpy()
        pace = torch.diff(mouth, dim=1).abs().mean(dim=(1, 2)).double().cpu().numpy()
        weight = np.repeat(pace / (pace + _STILL), y.shape[1])
        for i, block in enumerate(BLOCKS):
            x = features(block, mouth, shapes)[:, _WARM_UP : _WARM_UP + y.shape[1]]
            rows = x.double().cpu().numpy().reshape(-1, block.size)
            scale = rows.std(axis=0) + 1e-9
            people = fit_people(rows / scale, y.reshape(len(rows), -1), weight, self.horizon)
            self.get_buffer(f"scale_{i}").copy_(torch.from_numpy(scale))
            self.get_buffer(f"people_{i}").copy_(torch.from_numpy(people))

    def series(self, landmarks: Tensor) -> tuple[Tensor, Tensor]:
        """Mouth centre (B, T, 2) and shapes (B, T, K) of landmarks (B, T, L, 2)."""
        mouth = landmarks[:, :, list(LIPS)].mean(dim=2)
        return mouth, landmarks.flatten(2) @ self.basis.T

    def forward(self, mouth: Tensor, shapes: Tensor, origins: Tensor) -> PriorForecast:
        """Forecast at ``origins`` (O,), each the number of its newest frame, from frames up to it.

        Args:
            mouth: (B, T, 2).
            shapes: (B, T, K).
            origins: ascending; frames after the last of them are not looked at.
        """
        frames = int(origins[-1]) + 1
        mouth, shapes = mouth[:, :frames], shapes[:, :frames]
        known = outcomes(mouth, shapes, self.horizon) if frames > self.horizon else None
        forecasts = torch.stack(self._experts(mouth, shapes, known), dim=1)  # (B, E, T, R)
        forecasts = forecasts.unflatten(-1, (self.horizon, -1))  # (B, E, T, H, 2 + K)
        return self._mixed(forecasts, known, origins)

    def _experts(self, mouth: Tensor, shapes: Tensor, known: Tensor | None) -> list[Tensor]:
        """Forecasts (B, T, R) of every expert at every origin."""
        rows = torch.arange(mouth.shape[1], device=mouth.device)
        people: list[tuple[Tensor, Tensor]] = []
        for i, block in enumerate(BLOCKS):
            x = features(block, mouth, shapes) / self.get_buffer(f"scale_{i}")
            people.append((x, x @ self.get_buffer(f"people_{i}")))
        result = [torch.zeros_like(people[0][1])]
        for expert in self.experts:
            x, forecast = people[expert.block]
            if expert.shrink is not None and known is not None:
                count = known.shape[1]
                other = OTHER_PHASES if expert.periodic else 1.0
                weight = learning_weights(rows, count, self.horizon, other)
                wrong = known - forecast[:, :count]
                forecast = forecast + adapted(x[:, :count], wrong, x, weight, expert.shrink)
            result.append(forecast)
        return result

    def _mixed(self, forecasts: Tensor, known: Tensor | None, origins: Tensor) -> PriorForecast:
        """Mix (B, E, T, H, 2 + K) at the origins by the errors so far."""
        batch, experts = forecasts.shape[:2]
        at = forecasts[:, :, origins]  # (B, E, O, H, 2 + K)
        error = at.new_zeros((*at.shape[:4], 2))
        if known is not None:
            count = known.shape[1]
            mouth = known.unflatten(-1, (self.horizon, -1))[..., :2]
            wrong = (forecasts[:, :, :count, ..., :2] - mouth[:, None]).abs()
            weight = learning_weights(origins, count, self.horizon, _JUDGED_OTHER_PHASES)
            recent = origins[:, None] - torch.arange(count, device=origins.device) < (
                JUDGED + self.horizon
            )
            weight = weight * recent
            weight = weight / weight.sum(dim=1, keepdim=True).clamp_min(1e-9)
            error = (weight @ wrong.flatten(3)).reshape(batch, experts, -1, self.horizon, 2)
        both = error.mean(dim=-1, keepdim=True) + _ALIKE  # (B, E, O, H, 1)
        share = torch.softmax(-SHARPNESS * (both / both.amin(dim=1, keepdim=True) - 1), dim=1)
        mixed = (share * at).sum(dim=1)
        expected = (share * error).sum(dim=1).clamp_min(_FLOOR)
        return PriorForecast(mixed[..., :2], mixed[..., 2:], expected)
