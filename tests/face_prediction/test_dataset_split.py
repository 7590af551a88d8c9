"""Folds of people, and kinds of footage."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from face_prediction.commands.build_dataset import with_one_name
from face_prediction.dataset.manifest import ClipEntry, assign_folds, fold_split
from face_prediction.dataset.sequences import kind_of
from face_prediction.motion.attribution import Attribution, read_attributions
from robo_manip_baselines.runs.errors import RequestError


def clip(subject: str, kind: str, sequences: int) -> ClipEntry:
    made_of = dict.fromkeys(("licence", "source", "track_sha256", "video", "video_sha256"), "")
    return ClipEntry(
        "", subject, kind, None, True, sequences=sequences, candidates=0, dropped={}, **made_of
    )


def totals(clips, folds, seed=0):
    chosen = assign_folds(clips, folds, seed)
    result = np.zeros(folds, dtype=int)
    for entry in clips:
        if entry.subject in chosen:
            result[chosen[entry.subject]] += entry.sequences
    return result


@given(
    counts=st.lists(st.integers(1, 200), min_size=5, max_size=60),
    folds=st.integers(1, 5),
    seed=st.integers(0, 9),
)
def test_everybody_is_in_one_fold_and_none_is_empty(counts, folds, seed) -> None:
    clips = [clip(f"p{i}", "natural", n) for i, n in enumerate(counts)]
    chosen = assign_folds(clips, folds, seed)
    assert sorted(chosen) == sorted(a.subject for a in clips)
    held = totals(clips, folds, seed)
    assert held.min() > 0
    # the largest first, to the emptiest fold: no two differ by more than one person
    assert held.max() - held.min() <= max(counts)
    assert assign_folds(clips[::-1], folds, seed) == chosen


def test_clips_of_one_person_stay_together() -> None:
    clips = [clip(f"p{i % 6}", "natural", 10 + i) for i in range(30)]
    chosen = assign_folds(clips, 3, 0)
    assert len(chosen) == 6
    assert totals(clips, 3).tolist() == pytest.approx([sum(range(10, 40)) / 3] * 3, rel=0.1)


def test_every_kind_is_spread() -> None:
    clips = [clip(f"n{i}", "natural", 20) for i in range(10)]
    clips += [clip(f"h{i}", "head_motion", 5) for i in range(10)]
    chosen = assign_folds(clips, 5, 3)
    for letter in "nh":
        in_fold = [fold for name, fold in chosen.items() if name[0] == letter]
        assert np.bincount(in_fold, minlength=5).tolist() == [2] * 5


def test_people_without_sequences_are_in_no_fold() -> None:
    clips = [clip("a", "natural", 3), clip("b", "natural", 0), clip("c", "grid", 1)]
    assert sorted(assign_folds(clips, 2, 0)) == ["a", "c"]
    with pytest.raises(RequestError, match="--folds 3: only 2 subjects have sequences"):
        assign_folds(clips, 3, 0)


def test_the_seed_matters_only_for_ties() -> None:
    different = [clip(f"p{i}", "natural", 2**i) for i in range(8)]
    assert len({tuple(assign_folds(different, 4, s).items()) for s in range(5)}) == 1
    same = [clip(f"p{i}", "natural", 7) for i in range(8)]
    assert len({tuple(assign_folds(same, 4, s).items()) for s in range(5)}) > 1


@pytest.mark.parametrize(("folds", "seed", "word"), [(0, 0, "--folds 0"), (2, -1, "--seed -1")])
def test_numbers_out_of_range(folds, seed, word) -> None:
    with pytest.raises(RequestError, match=word):
        assign_folds([clip("a", "natural", 1)] * 3, folds, seed)


@pytest.mark.parametrize(
    ("folds", "test", "train", "validation"),
    [
        (5, 0, (2, 3, 4), (1,)),
        (5, 4, (1, 2, 3), (0,)),
        (3, 1, (0,), (2,)),
        (2, 0, (1,), ()),
        (1, 0, (), ()),
    ],
)
def test_what_a_fold_is_used_for(folds, test, train, validation) -> None:
    split = fold_split(folds, test)
    assert (split.train, split.validation, split.test) == (train, validation, (test,))
    assert sorted(train + validation + split.test) == list(range(folds))


def test_a_fold_that_is_not_there() -> None:
    with pytest.raises(RequestError, match="fold 5: this dataset has folds 0 to 4"):
        fold_split(5, 5)


@pytest.mark.parametrize(
    ("clip", "kind", "what", "expected"),
    [
        ("a", "", "webcam,talk", "natural"),
        ("a", "", "talk,turn,low-res", "head_motion"),
        ("a", "", "turn (full turntable)", "head_motion"),
        ("a", "", "half-body,talk,nod", "head_motion"),
        ("a", "", "talk,large motion", "head_motion"),
        ("a", "", "talk,studio,small motion", "natural"),
        ("a", "", "return to the saturnine", "natural"),  # words, not letters
        ("grid10_x", "", "talk,turn", "grid"),
        ("GRID_1", "", "", "grid"),
        ("grid10_x", "natural", "turn", "natural"),
    ],
)
def test_kinds(clip, kind, what, expected) -> None:
    row = Attribution(clip, "person", False, "none", "none", kind=kind, what=what)
    assert kind_of(row) == expected


def test_an_unknown_kind_is_refused() -> None:
    row = Attribution("a", "person", False, "none", "none", kind="funny")
    with pytest.raises(RequestError, match="kind 'funny' of clip 'a'; one of natural"):
        kind_of(row)


def test_kinds_from_tables(tmp_path: Path) -> None:
    table = tmp_path / "clips.csv"
    table.write_text(
        "clip,subject,ship,licence,source,what,kind\n"
        'a.mp4,x,no,l,s,"talk, nod",\nb.mp4,y,no,l,s,talk,grid\nc.mp4,z,no,l,s,talk,\n'
    )
    kinds = {clip: kind_of(row) for clip, row in read_attributions(table).items()}
    assert kinds == {"a": "head_motion", "b": "grid", "c": "natural"}


@pytest.mark.parametrize(
    ("what", "rotations", "expected"),
    [
        ("", [19.9, 3.0, 25.0], "natural"),
        ("", [20.0], "head_motion"),
        ("", [], "natural"),
        ("talk", [90.0], "natural"),
        ("nod", [1.0], "head_motion"),
    ],
)
def test_clips_that_nobody_described_are_told_by_how_far_the_head_turns(
    what: str, rotations: list[float], expected: str
) -> None:
    row = Attribution("clip", "ann", True, "MIT", "here", what=what)
    assert kind_of(row, rotations) == expected


def test_two_names_of_one_person_become_one() -> None:
    rows = {name: Attribution(name, name, True) for name in ("ann", "bob", "cat")}
    merged = with_one_name(rows, ["bob=ann", "cat=eve"])
    assert {clip: row.subject for clip, row in merged.items()} == {
        "ann": "ann", "bob": "ann", "cat": "eve",
    }  # fmt: skip
    for order in (["cat=bob", "bob=ann"], ["bob=ann", "cat=bob", "bob=ann"]):
        assert {row.subject for row in with_one_name(rows, order).values()} == {"ann"}
    with pytest.raises(RequestError, match="--same_person bob: no pair of names; valid: NAME=OTHE"):
        with_one_name(rows, ["bob"])
    with pytest.raises(RequestError, match="'ann' becomes two; name one, and say bob=eve if these"):
        with_one_name(rows, ["ann=bob", "ann=eve"])
    with pytest.raises(RequestError, match=r"goes in a circle \(ann, bob, ann\); leave one out"):
        with_one_name(rows, ["ann=bob", "bob=ann"])
    with pytest.raises(RequestError, match="subject of --same_person 'dan'"):
        with_one_name(rows, ["dan=ann"])
