"""Rows of chunks and of windows against a loop that anyone can read."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from robo_manip_baselines.training.batching import chunk_rows, window_rows


@given(st.data())
def test_rows_are_those_of_the_loop(data: st.DataObject) -> None:
    lengths = data.draw(st.lists(st.integers(1, 12), min_size=1, max_size=5))
    size = data.draw(st.integers(1, 15))
    examples = [
        (episode, data.draw(st.integers(0, lengths[episode] - 1)))
        for episode in data.draw(st.lists(st.integers(0, len(lengths) - 1), min_size=1, max_size=6))
    ]
    offsets = np.cumsum([0, *lengths])
    episodes, starts = np.array(examples, dtype=np.int64).T
    rows, is_pad = chunk_rows(offsets, episodes, starts, size)
    windows = window_rows(offsets, episodes, starts, size)
    for i, (episode, start) in enumerate(examples):
        first, last = offsets[episode], offsets[episode + 1] - 1
        for k in range(size):
            step = first + start + k
            assert rows[i, k] == min(step, last)
            assert is_pad[i, k] == (step > last)
            assert windows[i, size - 1 - k] == max(first + start - k, first)


def test_a_chunk_that_ends_with_its_episode_has_no_padding() -> None:
    rows, is_pad = chunk_rows(np.array([0, 4, 10]), np.array([0]), np.array([1]), 3)
    np.testing.assert_array_equal(rows, [[1, 2, 3]])
    assert not is_pad.any()
