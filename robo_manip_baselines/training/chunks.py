"""Chunks of actions out of episodes that lie one after another.

Legend: B examples, K actions of a chunk, A elements of an action, E episodes, T steps.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Indices = NDArray[np.int64]


def chunk_rows(
    offsets: Indices, episodes: Indices, starts: Indices, chunk_size: int
) -> tuple[Indices, NDArray[np.bool_]]:
    """Find the rows of chunks that begin in the middle of episodes and end with them at the latest.

    Args:
        offsets: (E + 1,) row at which each episode begins, and the number of rows.
        episodes: (B,) index of each example's episode.
        starts: (B,) first step of each example within its episode.
        chunk_size: K.

    Returns:
        (B, K) rows, the last row of the episode wherever the chunk is past it, and (B, K) whether
        it is.
    """
    rows = (offsets[episodes] + starts)[:, None] + np.arange(chunk_size)
    end = offsets[episodes + 1][:, None]
    return np.minimum(rows, end - 1), rows >= end


def take_chunks(
    action: NDArray[np.float32],
    offsets: Indices,
    episodes: Indices,
    starts: Indices,
    chunk_size: int,
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Take (B, K, A) chunks of the (sum T, A) actions, and (B, K) whether each step is padding.

    Padding repeats the last action of the episode. The other arguments are those of `chunk_rows`.
    """
    rows, is_pad = chunk_rows(offsets, episodes, starts, chunk_size)
    return action[rows], is_pad
