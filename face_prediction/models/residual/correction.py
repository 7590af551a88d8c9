"""The network that corrects the prior, and says how far off the result may be.

What it sees of the motion is divided by the motion's own size, and what it answers is multiplied by
the prior's error so far: a face that moves twice as much is corrected twice as much.

Legend: B batch, O origins, W frames that are seen, H horizon, K shapes, D width.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from face_prediction.models.residual.prior import PriorForecast

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
