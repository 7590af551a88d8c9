"""Which sequences, and where in them, each step of training sees: functions of the seed alone."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from face_prediction.training.seeds import generator


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
