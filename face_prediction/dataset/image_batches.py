"""Landmarks and images of some sequences at once, each image decoded once for all predictors.

Legend: B sequences, T frames of history, H horizon, L = 468 landmarks, P images, S their side.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import NDArray

from face_prediction.dataset.clip_file import reduction
from face_prediction.dataset.reader import FaceDataset
from face_prediction.prediction.interface import ImageNeeds


class SequenceBatch:
    """Landmarks and images of B sequences.

    Args:
        dataset: the open dataset.
        indices: (B,) sequences.
        needs: images of the history to decode.
        future_sizes: sides at which the frames to be forecast are decoded, too.
        images_of: (B,) sequences whose images stand in for their own (shuffled-image ablation).

    Attributes:
        history: (B, T, L, 2) float32 landmarks.
        future: (B, H, L, 2) float32 landmarks.
    """

    def __init__(
        self,
        dataset: FaceDataset,
        indices: Sequence[int],
        needs: Iterable[ImageNeeds],
        future_sizes: Iterable[int] = (),
        images_of: Sequence[int] | None = None,
    ) -> None:
        settings = dataset.manifest.settings
        frames = np.stack([dataset.landmarks(index)[..., :2] for index in indices])
        self.history: NDArray[np.float32] = frames[:, : settings.history]
        self.future: NDArray[np.float32] = frames[:, settings.history :]
        self._past: dict[int, NDArray[np.uint8]] = {}
        self._future: dict[int, NDArray[np.uint8]] = {}
        sources = indices if images_of is None else images_of
        most = dict.fromkeys(future_sizes, 0)  # side -> images of the history
        stops = dict.fromkeys(most, settings.length)
        for need in needs:
            if need.frames:
                most[need.size] = max(need.frames, most.get(need.size, 0))
        for size, past in sorted(most.items()):
            stop = stops.get(size, settings.history)
            wanted = slice(settings.history - past, stop)
            reduce = reduction(settings.crop_size, size)
            images = np.stack([dataset.images(index, wanted, reduce) for index in sources])
            self._past[size], self._future[size] = images[:, :past], images[:, past:]

    def images(self, needs: ImageNeeds) -> NDArray[np.uint8] | None:
        """Images (B, P, S, S, 3) of the last P frames of the history; None for P = 0."""
        if not needs.frames:
            return None
        past = self._past[needs.size]
        return past[:, past.shape[1] - needs.frames :]

    def future_images(self, size: int) -> NDArray[np.uint8]:
        """Images (B, H, S, S, 3) of the frames to be forecast."""
        return self._future[size]
