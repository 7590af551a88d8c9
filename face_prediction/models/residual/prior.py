"""The prior: experts, mixed by how well each did on this face so far.

Legend: B batch, T frames, O origins, E experts (the first expects no motion), H horizon,
K shapes, R = H (2 + K) outputs: U and V of the mouth centre, then the shapes, frame by frame.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, nn

from face_prediction.forecast.autoregression import principal_shapes
from face_prediction.forecast.interface import LandmarkSequences
from face_prediction.lifting import LIPS
from face_prediction.models.residual.experts import (
    BLOCKS,
    EXPERTS,
    OTHER_PHASES,
    Expert,
    adapted,
    features,
    fit_people,
    learning_weights,
    outcomes,
)
from face_prediction.tracks import NUM_LANDMARKS

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
