"""Windows of sequences as the tensors a network is trained on.

Legend: N sequences, F frames of a sequence, B batch, T frames of history, H horizon, P pictures,
L = 468 landmarks, S side of the pictures.
"""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from face_prediction.dataset.reader import FaceDataset
from face_prediction.forecast.interface import LandmarkSequences
from face_prediction.models.interface import Future, History, PredictorModel
from face_prediction.training.pictures import PictureStore
from face_prediction.training.sampler import Sampler


class Batch(NamedTuple):
    """What a network is shown, and what came after."""

    history: History
    future: Future

    def to(self, device: torch.device) -> Batch:
        """The same on ``device``."""
        if device.type == "cpu":
            return self
        move = [
            tensor.pin_memory().to(device, non_blocking=True)
            for part in self
            for tensor in (part.landmarks, part.pictures)
        ]
        return Batch(History(move[0], move[1]), Future(move[2], move[3]))


class Windows:
    """The sequences of some people, cut to what a network needs.

    Args:
        dataset: open for reading; used by one thread.
        indices: (N,) the sequences in it.
        model: says which frames and pictures it needs.
        memory: bytes for decoded pictures.

    Attributes:
        sequences: their landmarks, whole.

    Raises:
        RequestError: a file is damaged, or its pictures do not suit.
    """

    def __init__(
        self,
        dataset: FaceDataset,
        indices: NDArray[np.int64],
        model: PredictorModel,
        memory: float,
    ) -> None:
        self._indices = indices
        self._history, self._horizon = model.history, model.horizon
        self._seen = model.needs.frames
        self._made = model.horizon if model.makes_pictures else 0
        self._size = model.needs.size
        uses_pictures = self._seen or self._made
        self._store = PictureStore(dataset, self._size, memory) if uses_pictures else None
        points = [dataset.landmarks(int(index))[..., :2] for index in indices]
        subjects = tuple(dataset.entry(int(index)).subject for index in indices)
        self.sequences = LandmarkSequences(np.stack(points), subjects)

    def __len__(self) -> int:
        return len(self._indices)

    def batch(self, rows: NDArray[np.int64], starts: NDArray[np.int64]) -> Batch:
        """Windows of the sequences ``rows`` (B,) that begin at the frames ``starts`` (B,).

        Raises:
            RequestError: a picture is damaged.
        """
        now = starts + self._history
        frames = starts[:, None] + np.arange(self._history + self._horizon)
        landmarks = torch.from_numpy(self.sequences.landmarks[rows[:, None], frames])
        # one read: the pictures that are seen and those that come after are neighbours
        pictures = torch.from_numpy(self._pictures(rows, now - self._seen))
        return Batch(
            History(landmarks[:, : self._history], pictures[:, : self._seen]),
            Future(landmarks[:, self._history :], pictures[:, self._seen :]),
        )

    def _pictures(self, rows: NDArray[np.int64], starts: NDArray[np.int64]) -> NDArray[np.uint8]:
        frames = self._seen + self._made
        if self._store is None:
            return np.empty((len(rows), 0, self._size, self._size, 3), dtype=np.uint8)
        return self._store.read_all(self._indices[rows].tolist(), starts.tolist(), frames)


@contextmanager
def batches(windows: Windows, sampler: Sampler, start: int, stop: int) -> Iterator[Iterator[Batch]]:
    """The batches of the steps ``start`` to ``stop``; each is made while the last one is used."""

    def made() -> Iterator[Batch]:
        following = worker.submit(lambda: windows.batch(*sampler.batch(start)))
        for step in range(start + 1, stop + 1):
            batch = following.result()
            if step < stop:
                following = worker.submit(windows.batch, *sampler.batch(step))
            yield batch

    with ThreadPoolExecutor(max_workers=1, thread_name_prefix="pictures") as worker:
        yield made()
