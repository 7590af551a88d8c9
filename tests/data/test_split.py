"""Holding episodes out: whole, repeatable, and the same whatever the order of the files."""

from __future__ import annotations

import json
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from robo_manip_baselines.data.demonstrations import Split, split_episodes
from robo_manip_baselines.runs.errors import RequestError

SEEDS = st.lists(st.integers(0, 10**6), min_size=1, max_size=60, unique=True)
FRACTION = st.floats(0.0, 1.0, exclude_max=True)


@given(SEEDS, FRACTION, st.integers(0, 2**40), st.randoms())
def test_every_episode_is_in_one_part(
    seeds: list[int], fraction: float, seed: int, random: Any
) -> None:
    split = split_episodes(seeds, fraction, seed)
    assert sorted(split.train + split.validation) == sorted(seeds)
    assert split.train
    assert split.train == tuple(sorted(split.train))
    assert split.validation == tuple(sorted(split.validation))
    random.shuffle(seeds)
    assert split_episodes(seeds, fraction, seed) == split


@pytest.mark.parametrize(
    ("episodes", "fraction", "held_out"),
    [
        *((50, 0.2, 10), (50, 0.0, 0), (1, 0.2, 0), (1, 0.99, 0), (2, 0.2, 1)),
        *((3, 0.2, 1), (2, 0.99, 1), (9, 0.25, 2), (50, 0.001, 1), (50, 0.999, 49)),
    ],
)
def test_how_many_are_held_out(episodes: int, fraction: float, held_out: int) -> None:
    assert len(split_episodes(range(episodes), fraction, 0).validation) == held_out


def test_a_split_stays_what_it_was() -> None:
    # A run that is resumed with a later release must hold out the same episodes.
    assert split_episodes(range(10), 0.3, 0).validation == (2, 4, 5)


def test_another_seed_holds_out_others() -> None:
    parts = {split_episodes(range(50), 0.2, seed).validation for seed in range(20)}
    assert len(parts) == 20
    assert set().union(*parts) == set(range(50))


@pytest.mark.parametrize(
    ("seeds", "fraction", "seed", "message"),
    [
        ([], 0.2, 0, "no episode to train on"),
        ([3, 4, 3], 0.2, 0, "seed 3 is there twice"),
        ([1, 2], 1.0, 0, "validation fraction 1.0: must be 0 or more, less than 1"),
        ([1, 2], -0.1, 0, "validation fraction -0.1"),
        ([1, 2], float("nan"), 0, "validation fraction nan"),
        ([1, 2], 0.5, -1, "seed -1: must be 0 or more"),
    ],
)
def test_what_cannot_be_split(seeds: list[int], fraction: float, seed: int, message: str) -> None:
    with pytest.raises(RequestError, match=message):
        split_episodes(seeds, fraction, seed)


def test_json_round_trip() -> None:
    split = split_episodes([5, 900, 1, 77], 0.5, 3)
    assert Split.from_json(json.loads(json.dumps(split.to_json()))) == split


@pytest.mark.parametrize(
    ("data", "message"),
    [
        ([1, 2], "split: must be an object, not a list of 2"),
        ({"train": [1]}, "split: validation: is missing"),
        ({"train": [1, "2"], "validation": []}, r"train\[1\]: must be a whole number, not '2'"),
        ({"train": [1, True], "validation": []}, r"train\[1\]: must be a whole number, not true"),
        ({"train": [], "validation": [1]}, "at least one training seed"),
        ({"train": [1, 2], "validation": [2]}, "none in both"),
    ],
)
def test_what_is_no_split(data: Any, message: str) -> None:
    with pytest.raises(RequestError, match=message):
        Split.from_json(data)
