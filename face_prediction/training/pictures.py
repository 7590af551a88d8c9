"""Decoded pictures of sequences, kept in memory as far as it goes.

Legend: F frames of a sequence, S side of the pictures.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from face_prediction.dataset.reader import FaceDataset
from face_prediction.errors import RequestError


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
