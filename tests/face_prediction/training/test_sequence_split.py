"""Split of a dataset by sequence: windows that do not overlap, of the same people."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from face_prediction.commands.fit import FitOptions, run_fit
from face_prediction.dataset.manifest import ClipEntry, Manifest
from face_prediction.dataset.reader import FaceDataset
from face_prediction.dataset.sequences import KINDS, SequenceSettings
from face_prediction.dataset.split import SEQUENCE_PARTS, DatasetSplit, split_dataset
from face_prediction.dataset.tracks import FaceStretch, dataset_stretches, without_windows
from face_prediction.evaluation.predictors import load_network
from face_prediction.evaluation.setup import require_unseen, select_sequences
from robo_manip_baselines.runs.errors import RequestError

SETTINGS = SequenceSettings(history=7, future=3, stride=4)


@dataclass
class Starts:
    """A dataset of which only the first frames of its sequences are there."""

    manifest: Manifest
    first: list[list[int]]
    folder: Path = Path("faces")

    def starts(self) -> np.ndarray:
        return np.concatenate([np.empty(0, np.int64), *map(np.array, self.first)]).astype(np.int64)


def drawn(first: list[list[int]], seed: int = 0) -> Starts:
    """Clips with sequences from these frames on, by a new person each."""
    made_of = dict.fromkeys(("licence", "source", "track_sha256", "video", "video_sha256"), "")
    clips = tuple(
        ClipEntry(
            f"c{i}", f"p{i}", KINDS[i % 3], 0, True,
            sequences=len(starts), candidates=0, dropped={}, **made_of,
        )
        for i, starts in enumerate(first)
    )  # fmt: skip
    return Starts(Manifest(SETTINGS, folds=1, seed=seed, clips=clips), first)


def by_sequence(dataset: Starts) -> DatasetSplit:
    return split_dataset(dataset, "sequence")  # type: ignore[arg-type]


starts_of_clips = st.lists(
    st.lists(st.integers(0, 150), max_size=12, unique=True).map(sorted), min_size=1, max_size=6
)


def frames(dataset: Starts, index: int) -> set[tuple[int, int]]:
    """Clip and frame, one by one."""
    flat = [(clip, start) for clip, starts in enumerate(dataset.first) for start in starts]
    clip, start = flat[index]
    return {(clip, frame) for frame in range(start, start + SETTINGS.length)}


@given(first=starts_of_clips, seed=st.integers(0, 3), test=st.integers(0, SEQUENCE_PARTS - 1))
def test_no_frame_is_both_trained_on_and_reported_on(first, seed: int, test: int) -> None:
    dataset = drawn(first, seed)
    try:
        split = by_sequence(dataset)
    except RequestError:
        return
    use = split.uses(test)
    held_out = {*use.test, *use.validation}
    trained = [frames(dataset, i) for i in split.training(held_out).tolist()]
    seen = set().union(*trained)
    reported = [frames(dataset, i) for i in split.members(use.test).tolist()]
    chosen = [frames(dataset, i) for i in split.members(use.validation).tolist()]
    for window in reported + chosen:
        assert not window & seen
    # nothing that could have been trained on is left out
    lost = set().union(*reported, *chosen)
    every = range(sum(map(len, first)))
    assert len(trained) == sum(not frames(dataset, i) & lost for i in every)
    windows = [frames(dataset, i) for i in split.members(range(SEQUENCE_PARTS)).tolist()]
    assert sum(map(len, windows)) == len(set().union(*windows)), "two windows overlap"


def test_parts_hold_a_tenth_of_every_kind_and_depend_on_the_seed() -> None:
    first = [list(range(0, 4 * 50, 4))] * 6  # 20 windows of each clip, if 10 frames apart
    dataset = drawn(first)
    split = by_sequence(dataset)
    kinds = np.array(KINDS)[split.clip % 3]
    counts = [Counter(kinds[split.members({part})].tolist()) for part in range(SEQUENCE_PARTS)]
    for kind in KINDS:
        held = [count[kind] for count in counts]
        assert max(held) - min(held) <= 1
        assert min(held) > 0
    again, other = by_sequence(drawn(first)), by_sequence(drawn(first, seed=1))
    assert again.windows_sha256 == split.windows_sha256 != other.windows_sha256


def test_windows_are_needed_for_every_part() -> None:
    with pytest.raises(RequestError, match="9 sequences that do not overlap; --split sequence "):
        by_sequence(drawn([[10 * i for i in range(9)]]))
    assert by_sequence(drawn([[10 * i for i in range(10)]])).used == list(range(10))


@given(
    length=st.integers(1, 40),
    start=st.integers(0, 9),
    windows=st.lists(st.tuples(st.integers(0, 60), st.integers(1, 9)), max_size=5),
)
def test_stretches_without_windows_are_their_other_frames(length, start, windows) -> None:
    frames = np.arange(start, start + length)
    landmarks = np.repeat(frames, 468 * 2).reshape(length, 468, 2).astype(np.float32)
    whole = FaceStretch("a", "ann", "natural", 0, start, landmarks)
    spans = [(first, first + count) for first, count in windows]
    pieces = without_windows([whole], {"a": spans, "b": [(0, 100)]})
    dropped = {frame for first, end in spans for frame in range(first, end)}
    left = [[*range(p.start, p.start + len(p))] for p in pieces]
    assert [frame for piece in left for frame in piece] == [f for f in frames if f not in dropped]
    for piece, numbers in zip(pieces, left, strict=True):
        assert piece.landmarks[:, 0, 0].tolist() == numbers
    for one, following in pairwise(left):
        assert following[0] > one[-1] + 1, "two pieces touch"


@pytest.fixture
def opened(tmp_path_factory, make_faces):
    with FaceDataset(make_faces(tmp_path_factory.mktemp("split"))) as dataset:
        yield dataset


def test_rows_of_a_selection_have_the_part(opened: FaceDataset) -> None:
    split = split_dataset(opened, "sequence")
    selection = select_sequences(opened, {3, 4}, ("natural",), split=split)
    assert selection.indices.tolist() == split.members({3, 4}).tolist()
    assert [row.fold for row in selection.rows] == split.part[selection.indices].tolist()
    assert {row.fold for row in selection.rows} == {3, 4}
    by_person = select_sequences(opened, {1}, ("natural",))
    assert {row.subject for row in by_person.rows} == {"cat"}


@pytest.mark.parametrize(
    ("trained", "judged", "digest", "words"),
    [
        ("sequence", "person", None, "leaves out windows, .* not by --split person"),
        ("person", "sequence", None, "leaves out people, .* not by --split sequence"),
        ("sequence", "sequence", "other", "the windows of its parts are not those"),
    ],
)
def test_weights_of_another_split_are_refused(
    opened: FaceDataset, tmp_path: Path, monkeypatch, trained, judged, digest, words
) -> None:
    loading = pytest.importorskip("face_prediction.models.loading")
    windows = split_dataset(opened, "sequence").windows_sha256
    network = SimpleNamespace(name="net")
    record = SimpleNamespace(
        dataset_sha256="b", folds={"test": [1]}, train_subjects=["ann"], preset="cpu",
        settings={}, training={}, dataset={}, split=trained, windows_sha256=digest or windows,
    )  # fmt: skip
    monkeypatch.setattr(loading, "load_predictor", lambda folder: (network, record))
    (tmp_path / "model.safetensors").write_bytes(b"")
    split = split_dataset(opened, judged)
    with pytest.raises(RequestError, match=words):
        load_network(tmp_path, "b", split)
    # weights of another dataset know no windows of this one
    foreign = load_network(tmp_path, "c", split)
    assert foreign.checkpoint is not None
    assert foreign.checkpoint["test_fold"] is None
    assert foreign.subjects == {"ann"}
    own = split_dataset(opened, "sequence")
    record.split, record.windows_sha256 = "sequence", windows
    fitted = load_network(tmp_path, "b", own)
    assert fitted.subjects == frozenset()
    assert (fitted.checkpoint or {})["split"] == "sequence"


def test_a_part_that_is_not_there_is_refused(opened: FaceDataset) -> None:
    split = split_dataset(opened, "sequence")
    missing = SimpleNamespace(name="net", by_fold={10: None}, predictor_for=lambda *_: None)
    with pytest.raises(RequestError, match=r"net is for fold 10; .* has folds 0 to 9"):
        require_unseen(opened, split, [missing])  # type: ignore[list-item]


class FittedError(Exception):
    pass


@pytest.mark.parametrize("part", [0, 4])
def test_fit_sees_no_frame_that_is_reported_on(
    opened: FaceDataset, tmp_path: Path, monkeypatch, part: int
) -> None:
    fits = pytest.importorskip("face_prediction.models.residual.fit")
    seen: set[tuple[str, bytes]] = set()  # people move alike, some frames later

    def fit(landmarks: list[np.ndarray], subjects: list[str]) -> None:
        for track, subject in zip(landmarks, subjects, strict=True):
            seen.update((subject, frame.tobytes()) for frame in track)
        raise FittedError

    monkeypatch.setattr(fits, "fit_residual", fit)
    options = FitOptions(opened.folder, test_fold=part, split="sequence", out=tmp_path / "out")
    with pytest.raises(FittedError):
        run_fit(options)
    split = split_dataset(opened, "sequence")
    windows = split.windows({part})
    whole = {s.clip: s for s in dataset_stretches(opened)}
    reported = {
        (clip, whole[clip].landmarks[frame - whole[clip].start].tobytes())
        for clip, spans in windows.items()
        for first, end in spans
        for frame in range(first, end)
    }
    assert len(reported) >= split.length
    assert not seen & reported
    assert len(seen) > len(reported)
    with pytest.raises(RequestError, match="leaves a part for the report; valid: 0 to 9"):
        run_fit(replace(options, test_fold=None))
    with pytest.raises(RequestError, match="--test_fold 10: no such fold; valid: 0 to 9"):
        run_fit(replace(options, test_fold=10))


def test_what_a_killed_fit_left_is_not_in_the_way(
    opened: FaceDataset, tmp_path: Path, monkeypatch
) -> None:
    """The record is written last; without it the other files are those of a fit that was begun."""
    loading = pytest.importorskip("face_prediction.models.loading")
    learned = pytest.importorskip("face_prediction.models.learned")
    fits = pytest.importorskip("face_prediction.models.residual.fit")
    shipped, _ = loading.load_predictor("shipped")
    monkeypatch.setattr(fits, "fit_residual", lambda *_: shipped.fit)
    out = tmp_path / "out"
    options = FitOptions(opened.folder, out=out)
    whole = {"attribution.csv", "baselines.safetensors", "model.safetensors", "config.json"}

    def killed(*_: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(learned, "write_json", killed)
        with pytest.raises(KeyboardInterrupt):
            run_fit(options)
    assert {path.name for path in out.iterdir()} == whole - {"config.json"}
    assert run_fit(options) == 0
    assert {path.name for path in out.iterdir()} == whole
    (out / "config.json").unlink()
    (out / "attribution.csv").write_text("somebody,else\n")
    with pytest.raises(RequestError, match=r"holds attribution.csv and no weights"):
        run_fit(options)
