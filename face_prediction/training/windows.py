"""Training data: windows of sequences, sampled, read ahead and augmented.

Shapes: B batch, N frames, L = 468 landmarks, S side of the images.
"""

from __future__ import annotations

from collections.abc import Generator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from face_prediction.dataset.reader import FaceDataset
from face_prediction.forecast.interface import LandmarkSequences
from face_prediction.models.interface import Future, History, PredictorModel
from face_prediction.models.settings import PredictorTrainSettings
from face_prediction.tracking.tracks import NUM_LANDMARKS
from robo_manip_baselines.runs.errors import RequestError
from robo_manip_baselines.runs.seeds import stream_generator

MIDLINE = (0, 1, 2, 4, 5, 6, *range(8, 20), 94, 151, 152, 164, 168, 175, 195, 197, 199, 200)
"""Landmarks on the line that halves a face."""
_FIRST_LEFT = 248  # from here on landmarks are on the subject's left, ordered as on the right

GAIN, LIGHT = 0.2, 0.1
"""Brightness is multiplied by 1 ± GAIN at most, and ± LIGHT at most is added (ours)."""
MOVE = 0.08
"""Largest shift of a face in crops: the room that `build-dataset` leaves around it (ours)."""


class SequenceImages:
    """Images of sequences at one size; each frame is decoded when it is first needed.

    Decoded frames stay in memory until it is used up; after that, others are decoded every time.

    Args:
        dataset: open for reading; used by one thread.
        size: side of the images.
        memory: bytes.

    Raises:
        RequestError: the dataset's images cannot be read at this size.
    """

    def __init__(self, dataset: FaceDataset, size: int, memory: float) -> None:
        settings = dataset.manifest.settings
        crop, self._length = settings.crop_size, settings.length
        self._reduce = crop // size
        if crop != size * self._reduce or self._reduce not in (1, 2, 4, 8):
            raise RequestError(
                f"{dataset.folder}: images of {crop} pixels, but this network needs {size} "
                f"(or 2, 4 or 8 times that); make the dataset with --crop_size {size}"
            )
        self._dataset, self._size = dataset, size
        self._frames_left = int(memory // (3 * size * size))
        self._kept: dict[int, tuple[NDArray[np.uint8], NDArray[np.bool_]]] = {}

    def read(self, index: int, start: int, stop: int) -> NDArray[np.uint8]:
        """Return images (stop - start, S, S, 3) RGB of sequence ``index``.

        Raises:
            RequestError: they are damaged.
        """
        if index not in self._kept:
            if self._frames_left < self._length:
                return self._dataset.images(index, slice(start, stop), self._reduce)
            shape = (self._length, self._size, self._size, 3)
            self._kept[index] = np.empty(shape, np.uint8), np.zeros(self._length, dtype=bool)
            self._frames_left -= self._length
        images, is_decoded = self._kept[index]
        missing = np.flatnonzero(~is_decoded[start:stop])
        if len(missing):
            frames = slice(start + int(missing[0]), start + int(missing[-1]) + 1)
            images[frames] = self._dataset.images(index, frames, self._reduce)
            is_decoded[frames] = True
        return images[start:stop]


@dataclass(frozen=True)
class WindowSampler:
    """Batches of (sequence, first frame of its window), a pure function of seed and step.

    Every epoch goes through all sequences in an order of its own; epochs follow one another
    without a gap, so that every batch is full. Where a window (history and horizon) is shorter
    than the sequences, it lies anywhere in them.

    Attributes:
        sequences: number of them, each of ``length`` frames.
        window: frames of a window.
        batch_size: windows of a batch.
        seed: of the run.
    """

    sequences: int
    length: int
    window: int
    batch_size: int
    seed: int

    def batch(self, step: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return sequences (B,) of 0...N - 1 and first frames (B,) of the batch of ``step``."""
        places = step * self.batch_size + np.arange(self.batch_size)
        epochs, ranks = np.divmod(places, self.sequences)
        orders = [_epoch_order(self.sequences, self.seed, int(epoch)) for epoch in epochs]
        rows = np.array([order[rank] for order, rank in zip(orders, ranks, strict=True)])
        generator = stream_generator(self.seed, "window", step)
        return rows, generator.integers(self.length - self.window + 1, size=self.batch_size)


@lru_cache(maxsize=2)
def _epoch_order(sequences: int, seed: int, epoch: int) -> NDArray[np.int64]:
    return stream_generator(seed, "order", epoch).permutation(sequences)


class WindowBatch(NamedTuple):
    """Input and target of a network."""

    history: History
    future: Future

    def to(self, device: torch.device) -> WindowBatch:
        """Return the batch on ``device``."""
        if device.type == "cpu":
            return self
        tensors = [t for part in self for t in (part.landmarks, part.images)]
        moved = [tensor.pin_memory().to(device, non_blocking=True) for tensor in tensors]
        return WindowBatch(History(*moved[:2]), Future(*moved[2:]))


class SequenceWindows:
    """Sequences of some people, cut to the frames and images that a network needs.

    Args:
        dataset: open for reading; used by one thread.
        indices: (N,) sequences in it.
        model: decides which frames and images are needed.
        memory: bytes for decoded images.

    Attributes:
        sequences: their landmarks, whole.
        frames: of a window.
        validation_start: first frame of the windows whose history ends where the dataset's does.

    Raises:
        RequestError: a file is damaged, or its images do not fit.
    """

    def __init__(
        self, dataset: FaceDataset, indices: NDArray[np.int64], model: PredictorModel, memory: float
    ) -> None:
        self._indices, self._history = indices.tolist(), model.history
        self._seen, self._size = model.needs.frames, model.needs.size
        self._images = self._seen + model.horizon
        self._store = SequenceImages(dataset, self._size, memory)
        self.frames = model.history + model.horizon
        self.validation_start = dataset.manifest.settings.history - model.history
        points = np.stack([dataset.landmarks(index)[..., :2] for index in self._indices])
        subjects = tuple(dataset.entry(index).subject for index in self._indices)
        self.sequences = LandmarkSequences(points, subjects)

    def __len__(self) -> int:
        return len(self._indices)

    def batch(self, rows: NDArray[np.int64], starts: NDArray[np.int64]) -> WindowBatch:
        """Read the windows of the sequences ``rows`` (B,) from the frames ``starts`` (B,) on.

        Raises:
            RequestError: an image is damaged.
        """
        frames = starts[:, None] + np.arange(self.frames)
        landmarks = torch.from_numpy(self.sequences.landmarks[rows[:, None], frames])
        images = np.empty((len(rows), self._images, self._size, self._size, 3), dtype=np.uint8)
        # one read: the images of history and future are neighbours
        firsts = (starts + self._history - self._seen).tolist()
        for place, (row, first) in enumerate(zip(rows, firsts, strict=True)):
            images[place] = self._store.read(self._indices[row], first, first + self._images)
        seen, coming = torch.from_numpy(images).tensor_split([self._seen], dim=1)
        past, ahead = landmarks.tensor_split([self._history], dim=1)
        return WindowBatch(History(past, seen), Future(ahead, coming))


def window_batches(
    windows: SequenceWindows, settings: PredictorTrainSettings, seed: int, start: int
) -> Generator[WindowBatch]:
    """Yield the batches of the steps from ``start`` to the last, each read while one is used.

    To be closed, where it is not used up.
    """
    length, stop = windows.sequences.landmarks.shape[1], settings.steps
    sampler = WindowSampler(len(windows), length, windows.frames, settings.batch_size, seed)
    with ThreadPoolExecutor(max_workers=1, thread_name_prefix="images") as worker:
        following = worker.submit(windows.batch, *sampler.batch(start))
        for step in range(start + 1, stop + 1):
            batch = following.result()
            if step < stop:
                following = worker.submit(windows.batch, *sampler.batch(step))
            yield batch


def augment(batch: WindowBatch, rng: np.random.Generator) -> WindowBatch:
    """Mirror about half of the sequences; move each and change its light."""
    rows, size = len(batch.history.landmarks), batch.history.images.shape[2]
    is_mirrored = torch.from_numpy(rng.random(rows) < 0.5)
    pixels = torch.from_numpy(np.rint(rng.uniform(-MOVE, MOVE, (rows, 2)) * size).astype(np.int64))
    gain = torch.from_numpy(rng.uniform(1 - GAIN, 1 + GAIN, rows).astype(np.float32))
    light = torch.from_numpy(rng.uniform(-LIGHT, LIGHT, rows).astype(np.float32))

    def changed(part: History | Future) -> tuple[Tensor, Tensor]:
        landmarks = mirrored_landmarks(part.landmarks, is_mirrored)
        images = relit(mirrored_images(part.images, is_mirrored), gain, light)
        step = (pixels / size).to(landmarks)[:, None, None]
        return landmarks + step, moved_images(images, pixels)

    return WindowBatch(History(*changed(batch.history)), Future(*changed(batch.future)))


def mirror_indices() -> NDArray[np.int64]:
    """Return the landmark (L,) that each becomes when a face is mirrored left to right.

    Measured on MediaPipe's canonical face, which is its own mirror image to the last digit.
    """
    right = [i for i in range(_FIRST_LEFT) if i not in MIDLINE]
    left = range(_FIRST_LEFT, NUM_LANDMARKS)
    mirror = np.arange(NUM_LANDMARKS)
    mirror[right], mirror[left] = left, right
    return mirror


_MIRROR = torch.from_numpy(mirror_indices())


def mirrored_landmarks(landmarks: Tensor, is_mirrored: Tensor) -> Tensor:
    """Mirror the rows of landmarks (B, N, L, 2) where ``is_mirrored`` (B,): u becomes 1 - u."""
    mirrored = landmarks[:, :, _MIRROR.to(landmarks.device)]
    mirrored = torch.stack([1 - mirrored[..., 0], mirrored[..., 1]], dim=-1)
    return torch.where(_per_row(is_mirrored, landmarks), mirrored, landmarks)


def mirrored_images(images: Tensor, is_mirrored: Tensor) -> Tensor:
    """Mirror the rows of images (B, N, S, S, 3) where ``is_mirrored`` (B,)."""
    return torch.where(_per_row(is_mirrored, images), images.flip(3), images)


def moved_images(images: Tensor, pixels: Tensor) -> Tensor:
    """Move the rows of images (B, N, S, S, 3) by ``pixels`` (B, 2) to the right and down.

    Black comes in, as where a crop reaches beyond the video's image.
    """
    size = images.shape[2]
    result = torch.zeros_like(images)
    for row, (x, y) in enumerate(pixels.tolist()):
        to_y, to_x = (slice(max(d, 0), size + min(d, 0)) for d in (y, x))
        from_y, from_x = (slice(max(-d, 0), size + min(-d, 0)) for d in (y, x))
        result[row, :, to_y, to_x] = images[row, :, from_y, from_x]
    return result


def relit(images: Tensor, gain: Tensor, light: Tensor) -> Tensor:
    """Return images x ``gain`` (B,) + 255 x ``light`` (B,), for images (B, N, S, S, 3) uint8."""
    lit = (images * _per_row(gain, images)).add_(255 * _per_row(light, images))
    return lit.round_().clamp_(0, 255).to(torch.uint8)


def _per_row(values: Tensor, target: Tensor) -> Tensor:
    """Return ``values`` (B,) so that they broadcast over ``target`` (B, ...), on its device."""
    return values.to(target.device).reshape(-1, *[1] * (target.dim() - 1))
