"""Chunks against a loop that anyone can read."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from robo_manip_baselines.training.sampling import take_chunks


def slow_chunk(
    episodes: list[np.ndarray], episode: int, start: int, size: int
) -> tuple[list[np.ndarray], list[bool]]:
    chunk, is_pad = [], []
    for k in range(size):
        is_past = start + k >= len(episodes[episode])
        chunk.append(episodes[episode][-1 if is_past else start + k])
        is_pad.append(is_past)
    return chunk, is_pad


@given(st.data())
def test_chunks_are_those_of_the_loop(data: st.DataObject) -> None:
    lengths = data.draw(st.lists(st.integers(1, 12), min_size=1, max_size=5))
    size = data.draw(st.integers(1, 15))
    examples = [
        (episode, data.draw(st.integers(0, lengths[episode] - 1)))
        for episode in data.draw(st.lists(st.integers(0, len(lengths) - 1), min_size=1, max_size=6))
    ]
    # Every number is different, so that a row taken from a neighbour shows.
    action = np.arange(2 * sum(lengths), dtype=np.float32).reshape(-1, 2)
    offsets = np.cumsum([0, *lengths])
    chosen, starts = np.array(examples, dtype=np.int64).T
    chunks, is_pad = take_chunks(action, offsets, chosen, starts, size)
    episodes = np.split(action, offsets[1:-1])
    slow = [slow_chunk(episodes, episode, start, size) for episode, start in examples]
    np.testing.assert_array_equal(chunks, np.array([chunk for chunk, _ in slow]), strict=True)
    np.testing.assert_array_equal(is_pad, np.array([pad for _, pad in slow]), strict=True)


def test_a_chunk_that_ends_with_its_episode_has_no_padding() -> None:
    action = np.arange(10, dtype=np.float32)[:, None]
    chunks, is_pad = take_chunks(action, np.array([0, 4, 10]), np.array([0]), np.array([1]), 3)
    np.testing.assert_array_equal(chunks[0, :, 0], [1, 2, 3])
    assert not is_pad.any()
