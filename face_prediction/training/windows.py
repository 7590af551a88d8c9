"""Decoded pictures of sequences, kept in memory as far as it goes.

Legend: F frames of a sequence, S side of the pictures.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import lru_cache
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from face_prediction.dataset.reader import FaceDataset
from face_prediction.forecast.interface import LandmarkSequences
from face_prediction.models.interface import Future, History, PredictorModel
from face_prediction.tracking.tracks import NUM_LANDMARKS
from face_prediction.training.seeds import generator
from robo_manip_baselines.runs.errors import RequestError


class PictureStore:
    """Reads pictures of one size; each frame is decoded when it is first needed.

    What has been decoded stays in memory until ``memory`` is used up; after that, what is not
    there is decoded every time.

    Args:
        dataset: open for reading; used by one thread.
        size: side of the pictures.
        memory: bytes.

    Raises:
        RequestError: the dataset's pictures cannot be read at this size.
    """

    def __init__(self, dataset: FaceDataset, size: int, memory: float) -> None:
        crop = dataset.manifest.settings.crop_size
        self._length = dataset.manifest.settings.length
        self._reduce = crop // size
        if crop != size * self._reduce or self._reduce not in (1, 2, 4, 8):
            raise RequestError(
                f"{dataset.folder}: pictures of {crop} pixels, but this network needs {size} "
                f"(or 2, 4 or 8 times that); make the dataset with --crop_size {size}"
            )
        self._dataset = dataset
        self._size = size
        self._frames_left = int(memory // (3 * size * size))
        self._kept: dict[int, NDArray[np.uint8]] = {}
        self._is_there: dict[int, NDArray[np.bool_]] = {}

    def read(self, index: int, start: int, stop: int) -> NDArray[np.uint8]:
        """Pictures (stop - start, S, S, 3) RGB of sequence ``index``.

        Raises:
            RequestError: they are damaged.
        """
        if index not in self._kept and self._frames_left < self._length:
            return self._decode(index, start, stop)
        if index not in self._kept:
            shape = (self._length, self._size, self._size, 3)
            self._kept[index] = np.empty(shape, dtype=np.uint8)
            self._is_there[index] = np.zeros(self._length, dtype=bool)
            self._frames_left -= self._length
        kept, is_there = self._kept[index], self._is_there[index]
        missing = np.flatnonzero(~is_there[start:stop])
        if len(missing):
            first, last = start + int(missing[0]), start + int(missing[-1]) + 1
            kept[first:last] = self._decode(index, first, last)
            is_there[first:last] = True
        return kept[start:stop]

    def read_all(
        self, indices: Sequence[int], starts: Sequence[int], frames: int
    ) -> NDArray[np.uint8]:
        """Windows (B, frames, S, S, 3). Raises as `read` does."""
        result = np.empty((len(indices), frames, self._size, self._size, 3), dtype=np.uint8)
        for row, (index, start) in enumerate(zip(indices, starts, strict=True)):
            result[row] = self.read(index, start, start + frames)
        return result

    def _decode(self, index: int, start: int, stop: int) -> NDArray[np.uint8]:
        return self._dataset.pictures(index, slice(start, stop), self._reduce)


class Sampler:
    """Batches of (sequence, first frame of its window), a pure function of (seed, step).

    Every epoch goes through all sequences in an order of its own; epochs follow one another
    without a seam, so that every batch is full. Where a window (history and horizon) is shorter
    than the sequences, it lies anywhere in them.

    Args:
        sequences: how many there are.
        length: frames of each.
        window: frames of a window.
        batch_size: of a batch.
        seed: of the run.
    """

    def __init__(
        self, sequences: int, length: int, window: int, batch_size: int, seed: int
    ) -> None:
        self._sequences = sequences
        self._last_start = length - window
        self._batch_size = batch_size
        self._seed = seed
        self._order = lru_cache(maxsize=2)(self._draw_order)

    def batch(self, step: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Sequences (B,) of 0...N - 1 and first frames (B,) of the batch of ``step``."""
        places = step * self._batch_size + np.arange(self._batch_size)
        epochs, ranks = np.divmod(places, self._sequences)
        rows = np.array([self._order(int(e))[r] for e, r in zip(epochs, ranks, strict=True)])
        starts = generator(self._seed, "window", step).integers(
            self._last_start + 1, size=self._batch_size
        )
        return rows, starts

    def _draw_order(self, epoch: int) -> NDArray[np.int64]:
        return generator(self._seed, "order", epoch).permutation(self._sequences)


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


#: Landmarks on the line that halves a face.
MIDLINE = (
    *(0, 1, 2, 4, 5, 6, *range(8, 20)),
    *(94, 151, 152, 164, 168, 175, 195, 197, 199, 200),
)
#: From here on landmarks are on the subject's left, in the order of those on the right.
_FIRST_LEFT = 248

#: Brightness is multiplied by up to 1 more or less this, and that much of it is added (ours).
GAIN, LIGHT = 0.2, 0.1
#: A face is moved by up to this, in crops: the room that `build-dataset` leaves around it (ours).
MOVE = 0.08


def mirror_indices() -> np.ndarray:
    """(L,) int: the landmark that each becomes when a face is turned left to right.

    Measured on MediaPipe's canonical face, which is its own mirror image to the last digit.
    """
    right = [i for i in range(_FIRST_LEFT) if i not in MIDLINE]
    left = range(_FIRST_LEFT, NUM_LANDMARKS)
    mirror = np.arange(NUM_LANDMARKS)
    mirror[right], mirror[left] = left, right
    return mirror


_MIRROR = torch.from_numpy(mirror_indices())


def augment(batch: Batch, rng: np.random.Generator) -> Batch:
    """Turn about half of the sequences; move each and change its light."""
    rows, size = len(batch.history.landmarks), batch.history.pictures.shape[2]
    is_turned = torch.from_numpy(rng.random(rows) < 0.5)
    pixels = torch.from_numpy(np.rint(rng.uniform(-MOVE, MOVE, (rows, 2)) * size).astype(np.int64))
    gain = torch.from_numpy(rng.uniform(1 - GAIN, 1 + GAIN, rows).astype(np.float32))
    light = torch.from_numpy(rng.uniform(-LIGHT, LIGHT, rows).astype(np.float32))

    def landmarks(values: Tensor) -> Tensor:
        step = (pixels / size).to(values)[:, None, None]
        return mirrored_landmarks(values, is_turned) + step

    def pictures(values: Tensor) -> Tensor:
        return moved_pictures(relit(mirrored_pictures(values, is_turned), gain, light), pixels)

    return Batch(
        History(landmarks(batch.history.landmarks), pictures(batch.history.pictures)),
        Future(landmarks(batch.future.landmarks), pictures(batch.future.pictures)),
    )


def mirrored_landmarks(landmarks: Tensor, is_turned: Tensor) -> Tensor:
    """Landmarks (B, N, L, 2), the rows of ``is_turned`` (B,) in the mirror: u becomes 1 - u."""
    turned = landmarks[:, :, _MIRROR.to(landmarks.device)]
    turned = torch.stack([1 - turned[..., 0], turned[..., 1]], dim=-1)
    return torch.where(is_turned.to(landmarks.device)[:, None, None, None], turned, landmarks)


def mirrored_pictures(pictures: Tensor, is_turned: Tensor) -> Tensor:
    """Pictures (B, N, S, S, 3), the rows of ``is_turned`` (B,) in the mirror."""
    result = pictures.clone()
    rows = is_turned.nonzero()[:, 0].to(pictures.device)
    result[rows] = pictures[rows].flip(3)
    return result


def moved_pictures(pictures: Tensor, pixels: Tensor) -> Tensor:
    """Pictures (B, N, S, S, 3), each row moved by ``pixels`` (B, 2) to the right and down.

    Black comes in, as where a crop reaches beyond the video's picture.
    """
    size = pictures.shape[2]
    result = torch.zeros_like(pictures)
    for row, (x, y) in enumerate(pixels.tolist()):
        to_y, to_x = (slice(max(d, 0), size + min(d, 0)) for d in (y, x))
        from_y, from_x = (slice(max(-d, 0), size + min(-d, 0)) for d in (y, x))
        result[row, :, to_y, to_x] = pictures[row, :, from_y, from_x]
    return result


def relit(pictures: Tensor, gain: Tensor, light: Tensor) -> Tensor:
    """Pictures (B, N, S, S, 3) uint8 in other light: ``gain`` (B,) x + ``light`` (B,) of 255."""
    at = (slice(None), None, None, None, None)
    gain, light = gain.to(pictures.device)[at], light.to(pictures.device)[at]
    return (pictures * gain).add_(255 * light).round_().clamp_(0, 255).to(torch.uint8)
