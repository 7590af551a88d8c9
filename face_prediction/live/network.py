"""A trained network that encodes each picture once.

Legend: T frames of history, H horizon, L = 468 landmarks, S side of the pictures, P pictures at
the end of the history, K neighbouring pictures that one frame's features come from.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from face_prediction.errors import RequestError
from face_prediction.predictor import PictureNeeds
from face_prediction.tracks import NUM_LANDMARKS

if TYPE_CHECKING:
    import torch

    from face_prediction.models.interface import PredictorModel


class NetworkForecasting:
    """Features and forecasts of one network, in eval mode.

    Args:
        network: on its device.
        name: what messages call it.

    Raises:
        RequestError: the network forecasts no landmarks.
    """

    def __init__(self, network: PredictorModel, name: str) -> None:
        self._network = network.eval()
        self._device = next(network.parameters()).device
        needs = network.needs
        # a first run, which takes longer than others, before a camera waits for it
        still = np.zeros((network.history, NUM_LANDMARKS, 2), dtype=np.float32)
        black = np.zeros((network.span, needs.size, needs.size, 3), dtype=np.uint8)
        features = self.features(still[: network.span], black)
        ahead = self._decode(still, [features] * (needs.frames - network.span + 1), black[-1])
        if ahead is None:
            raise RequestError(f"{name}: forecasts pictures and no landmarks; use another network")

    @property
    def needs(self) -> PictureNeeds:
        """Which pictures it looks at."""
        return self._network.needs

    @property
    def span(self) -> int:
        """K."""
        return self._network.span

    def features(self, landmarks: NDArray[np.float32], pictures: NDArray[np.uint8]) -> Any:
        """Features (1, 1, ...) of one frame, from landmarks (K, L, 2) and pictures (K, S, S, 3)."""
        import torch

        with torch.inference_mode():
            return self._network.encode(self._tensor(landmarks), self._tensor(pictures))

    def forecast(
        self,
        landmarks: NDArray[np.float32],
        features: list[Any],
        last_picture: NDArray[np.uint8] | None,
    ) -> NDArray[np.float32]:
        """Landmarks (H, L, 2) after those (T, L, 2), with P - K + 1 frames' features."""
        assert last_picture is not None
        ahead = self._decode(landmarks[-self._network.history :], features, last_picture)
        assert ahead is not None
        return ahead

    def _decode(
        self,
        landmarks: NDArray[np.float32],
        features: list[Any],
        last_picture: NDArray[np.uint8],
    ) -> NDArray[np.float32] | None:
        import torch

        with torch.inference_mode():
            output = self._network.decode(
                self._tensor(landmarks),
                torch.cat(features, dim=1),
                self._tensor(last_picture),
                make_pictures=False,
            )
        return None if output.landmarks is None else output.landmarks[0].float().cpu().numpy()

    def _tensor(self, values: NDArray[Any]) -> torch.Tensor:
        """A batch of one, on the network's device."""
        import torch

        return torch.from_numpy(np.ascontiguousarray(values))[None].to(self._device)
