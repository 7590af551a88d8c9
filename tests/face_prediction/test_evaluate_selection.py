"""Grouping of checkpoints, their common folds, and the permutation of the image ablation."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, replace
from itertools import zip_longest
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from face_prediction.evaluation.predictors import FittedPredictor, group_networks
from face_prediction.evaluation.setup import common_folds, shuffled_partners
from face_prediction.prediction.interface import Forecast, ImageNeeds
from robo_manip_baselines.runs.errors import RequestError

FOLDS = (0, 1, 2)


@dataclass
class Network:
    """A network that is never run."""

    name: str
    memory: int | None = 2
    needs = ImageNeeds(0, 0)

    def predict(self, landmarks, images, horizon: int) -> Forecast:
        raise NotImplementedError


def loaded(*given: tuple[str, int, str], folders: tuple[str, ...] = ()) -> list[FittedPredictor]:
    """Networks by name, test fold and preset."""
    return [
        FittedPredictor(
            Network(name),
            frozenset({"ann"}),
            Path(folder or f"{name}_{fold}_{preset}"),
            {"name": name, "test_fold": fold, "preset": preset},
        )
        for (name, fold, preset), folder in zip_longest(given, folders)
    ]


def test_checkpoints_of_one_network_are_one_row() -> None:
    rows = group_networks(loaded(("a", 1, "cpu"), ("b", 0, "cpu"), ("a", 0, "cpu")), FOLDS)
    assert [(row.name, row.role, tuple(row.by_fold)) for row in rows] == [
        ("a", "network", (0, 1)),
        ("b", "network", (0,)),
    ]
    assert rows[0].by_fold[1].subjects == {"ann"}
    assert common_folds(rows) == (0,)


def test_two_presets_are_two_rows_that_can_be_told_apart() -> None:
    rows = group_networks(loaded(("a", 0, "cpu"), ("a", 0, "paper"), ("b", 0, "cpu")), FOLDS)
    assert [row.name for row in rows] == ["a (cpu)", "a (paper)", "b"]


def test_the_same_network_twice_for_a_fold_is_refused_by_name() -> None:
    twice = loaded(("a", 2, "cpu"), ("a", 2, "cpu"), ("a", 2, "paper"), folders=("one", "two"))
    with pytest.raises(RequestError, match=r"one and two are both a \(cpu\) for test fold 2"):
        group_networks(twice, FOLDS)


@pytest.mark.parametrize(
    ("part", "message"),
    [
        ({"training": {"steps": 9}}, "training steps 20 and 9"),
        ({"settings": {"width": 1}}, "settings steps 20 and None|settings width None and 1"),
    ],
)
def test_folds_of_other_settings_are_no_row(part: dict[str, dict[str, int]], message: str) -> None:
    same = {"settings": {"steps": 20}, "training": {"steps": 20}}
    one, other = loaded(("a", 0, "cpu"), ("a", 1, "cpu"), folders=("one", "two"))
    group_networks([replace(one, shared=same), replace(other, shared=same)], FOLDS)
    with pytest.raises(RequestError, match=f"one and two are both a, with .*({message})"):
        group_networks([replace(one, shared=same), replace(other, shared={**same, **part})], FOLDS)


def test_networks_without_a_common_fold_are_refused() -> None:
    rows = group_networks(loaded(("a", 1, "cpu"), ("a", 2, "cpu"), ("b", 0, "cpu")), FOLDS)
    with pytest.raises(RequestError, match=r"no fold is covered by all .*a: 1, 2; b: 0"):
        common_folds(rows)


people = st.lists(
    st.tuples(st.sampled_from(["natural", "grid"]), st.sampled_from("abcde")), min_size=2
)


@given(people, st.integers(0, 5))
def test_images_are_shuffled_within_a_kind_and_nobody_keeps_theirs(
    who: list[tuple[str, str]], seed: int
) -> None:
    kinds = [kind for kind, _ in who]
    subjects = [kind + name for kind, name in who]
    if min(Counter(kinds).values()) < 2:
        with pytest.raises(RequestError, match="one sequence"):
            shuffled_partners(kinds, subjects, seed)
        return
    partner = shuffled_partners(kinds, subjects, seed)
    assert sorted(partner.tolist()) == list(range(len(who)))
    assert not np.any(partner == np.arange(len(who)))
    assert [kinds[p] for p in partner] == kinds
    for kind in set(kinds):
        amounts = Counter(s for s, k in zip(subjects, kinds, strict=True) if k == kind)
        if max(amounts.values()) <= sum(amounts.values()) / 2:
            own = [subjects[p] == s for p, s, k in zip(partner, subjects, kinds, strict=True) if k == kind]  # noqa: E501  # fmt: skip
            assert not any(own)


def test_the_permutation_follows_from_the_seed() -> None:
    kinds, subjects = ["natural"] * 40, [f"s{i % 7}" for i in range(40)]
    first = shuffled_partners(kinds, subjects, 1)
    np.testing.assert_array_equal(first, shuffled_partners(kinds, subjects, 1))
    assert np.any(first != shuffled_partners(kinds, subjects, 2))


def test_weights_of_elsewhere_are_for_every_fold() -> None:
    one = loaded(("a", 0, "cpu"))[0]
    foreign = replace(one, checkpoint={"name": "a", "test_fold": None, "preset": "cpu"})
    (row,) = group_networks([foreign], FOLDS)
    assert tuple(row.by_fold) == FOLDS
    assert row.predictor_for(2, "bob") is one.predictor
    other = replace(one, folder=Path("other"))
    with pytest.raises(RequestError, match="one that was trained on nobody here"):
        group_networks([foreign, other], FOLDS)
