"""Runs: every permitted start gives a whole window within reach, and no frame is wasted."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from face_prediction.motion.motion import longest_runs, permitted_starts


def slow_permitted(mouth: np.ndarray, window: int, reach: float) -> list[bool]:
    return [
        all(np.all(np.abs(mouth[t] - mouth[s]) <= reach) for t in range(s, s + window))
        for s in range(len(mouth) - window + 1)
    ]


def most_frames(permitted: tuple[bool, ...], window: int) -> int:
    """Exhaustive search for the most frames that disjoint runs can hold."""
    frames = len(permitted) + window - 1

    @cache
    def best(start: int) -> int:
        if start + window > frames:
            return 0
        result = best(start + 1)
        for stop in range(start + window, frames + 1):
            if not permitted[stop - window]:
                break
            result = max(result, stop - start + best(stop))
        return result

    return best(0)


walks = st.lists(
    st.tuples(*[st.floats(-0.05, 0.05, allow_subnormal=False)] * 3), min_size=1, max_size=40
).map(lambda steps: np.cumsum(np.array(steps), axis=0))


@given(mouth=walks, window=st.integers(2, 12))
def test_every_permitted_start_of_every_run_is_within_reach(mouth: np.ndarray, window: int) -> None:
    reach = 0.08
    permitted = permitted_starts(mouth, window, reach)
    runs = longest_runs(permitted, window)
    end = 0
    for start, stop in runs:
        assert start >= end  # disjoint, in order
        assert window <= stop - start
        assert stop <= len(mouth)
        end = stop
        for episode in range(start, stop - window + 1):
            inside = mouth[episode : episode + window] - mouth[episode]
            assert np.abs(inside).max() <= reach


@given(mouth=walks, window=st.integers(2, 12))
def test_permitted_starts_against_a_slow_oracle(mouth: np.ndarray, window: int) -> None:
    assert permitted_starts(mouth, window, 0.08).tolist() == slow_permitted(mouth, window, 0.08)


@given(permitted=st.lists(st.booleans(), max_size=25), window=st.integers(2, 6))
def test_no_other_choice_of_runs_holds_more_frames(permitted: list[bool], window: int) -> None:
    runs = longest_runs(np.array(permitted, dtype=bool), window)
    held = sum(stop - start for start, stop in runs)
    assert held == (most_frames(tuple(permitted), window) if permitted else 0)


@pytest.mark.parametrize(("displacement", "expected"), [(0.079, True), (0.081, False)])
@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize("axis", [0, 1, 2])
def test_reach_on_each_axis(axis: int, sign: int, displacement: float, expected: bool) -> None:
    mouth = np.zeros((10, 3))
    mouth[9, axis] = sign * displacement
    assert permitted_starts(mouth, 10, 0.08).tolist() == [expected]


def test_diagonals_count_axis_by_axis() -> None:
    mouth = np.zeros((10, 3))
    mouth[5] = 0.079
    assert permitted_starts(mouth, 10, 0.08).all()


def test_too_short_for_a_window() -> None:
    assert permitted_starts(np.zeros((9, 3)), 10, 0.08).size == 0
    assert longest_runs(np.zeros(0, dtype=bool), 10) == []
