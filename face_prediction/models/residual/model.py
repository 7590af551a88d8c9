"""Residual prediction: prior, correction, warped pictures.

Legend: B batch, T frames of history, O origins (number of the newest frame), H horizon, K shapes,
L = 468 landmarks, S side of the pictures, P pictures.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from face_prediction.forecast.interface import LandmarkSequences
from face_prediction.lifting import LIPS
from face_prediction.models.interface import Future, History, Losses, Output, PredictorModel
from face_prediction.models.residual.correction import CorrectionNet
from face_prediction.models.residual.prior import AdaptivePrior
from face_prediction.models.residual.regions import RegionEncoder
from face_prediction.models.residual.settings import ResidualSettings
from face_prediction.models.residual.warping import Refiner, flow, warp
from face_prediction.predictor import PictureNeeds

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
