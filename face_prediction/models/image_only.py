"""Approach 1 of the paper (IV.A): future pictures from past pictures."""

from __future__ import annotations

from torch import Tensor

from face_prediction.models.approach import ApproachModel
from face_prediction.models.interface import Future, History, Losses, Output


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
