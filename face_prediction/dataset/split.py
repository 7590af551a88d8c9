"""Splits of a dataset: by person into its folds, or by sequence into parts as the paper drew them.

Legend: N sequences of the dataset.
"""

from __future__ import annotations

import hashlib
from collections import defaultdict
from collections.abc import Collection
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from face_prediction.dataset.manifest import FoldSplit, fold_split
from face_prediction.dataset.reader import FaceDataset
from face_prediction.dataset.sequences import KINDS
from robo_manip_baselines.runs.errors import RequestError
from robo_manip_baselines.runs.seeds import stream_generator

SplitName = Literal["person", "sequence"]

SEQUENCE_PARTS = 10
"""Parts of a split by sequence. One is left for the report: the paper's 100 of 1000 (IV.A)."""

NO_PART_LEFT = f"a split by sequence leaves a part for the report; valid: 0 to {SEQUENCE_PARTS - 1}"


@dataclass(frozen=True)
class DatasetSplit:
    """Parts of a dataset, one of which is left for the report.

    By person a part is a fold, and nobody is in two. By sequence a part holds windows that do not
    overlap, of the same people as the other parts.

    Attributes:
        by: person or sequence.
        parts: how many.
        part: (N,) part of every sequence; -1: of none, since it overlaps one that is in a part.
        clip: (N,) number of its clip.
        start: (N,) its first frame; zeros where people are kept apart.
        length: frames of a sequence.
        names: of the clips.
        seed: of the draw.
    """

    by: SplitName
    parts: int
    part: NDArray[np.int64]
    clip: NDArray[np.int64]
    start: NDArray[np.int64]
    length: int
    names: tuple[str, ...]
    seed: int

    @property
    def used(self) -> list[int]:
        """Parts that hold a sequence."""
        return [part for part in np.unique(self.part).tolist() if part >= 0]

    @property
    def windows_sha256(self) -> str:
        """SHA-256 of clip, first frame and part of every window; empty by person."""
        if self.by == "person":
            return ""
        digest = hashlib.sha256(f"{self.parts} parts of {self.length} frames\n".encode())
        for index in np.flatnonzero(self.part >= 0).tolist():
            name = self.names[self.clip[index]]
            digest.update(f"{name} {self.start[index]} {self.part[index]}\n".encode())
        return digest.hexdigest()

    def uses(self, test: int) -> FoldSplit:
        """Parts to train on, to choose by and to report on; see `fold_split`."""
        return fold_split(self.parts, test)

    def members(self, parts: Collection[int]) -> NDArray[np.int64]:
        """Sequences of these parts."""
        return np.flatnonzero(np.isin(self.part, list(parts)))

    def training(self, left_out: Collection[int]) -> NDArray[np.int64]:
        """Sequences that may be trained on where the parts ``left_out`` are not.

        By person those of the other folds. By sequence all that share no frame with a window of
        these parts, which may overlap one another.
        """
        is_free = ~np.isin(self.part, list(left_out))
        if self.by == "sequence":
            for index in self.members(left_out).tolist():
                is_near = np.abs(self.start - self.start[index]) < self.length
                is_free &= ~(is_near & (self.clip == self.clip[index]))
        return np.flatnonzero(is_free)

    def windows(self, parts: Collection[int]) -> dict[str, list[tuple[int, int]]]:
        """First frame and end of the windows of these parts, by clip; none by person."""
        found: dict[str, list[tuple[int, int]]] = defaultdict(list)
        if self.by == "sequence":
            for index in self.members(parts).tolist():
                start = int(self.start[index])
                found[self.names[self.clip[index]]].append((start, start + self.length))
        return dict(found)


def split_dataset(dataset: FaceDataset, by: SplitName = "person") -> DatasetSplit:
    """Split a dataset by person, into its folds, or by sequence, into `SEQUENCE_PARTS`.

    By sequence, each clip's sequences are gone through from its beginning, and one that begins
    after the last that was taken is taken, too. Those of each kind of footage are dealt to the
    parts in turn, in an order drawn from the dataset's seed.

    Raises:
        RequestError: there are fewer windows than parts.
    """
    manifest = dataset.manifest
    counts = [clip.sequences for clip in manifest.clips]
    clip = np.repeat(np.arange(len(counts)), counts)
    length, names = manifest.settings.length, tuple(entry.clip for entry in manifest.clips)
    if by == "person":
        folds = [-1 if entry.fold is None else entry.fold for entry in manifest.clips]
        part, start = np.repeat(np.array(folds, np.int64), counts), np.zeros_like(clip)
        return DatasetSplit(by, manifest.folds, part, clip, start, length, names, manifest.seed)
    start = dataset.starts()
    windows = _apart(clip, start, length)
    if len(windows) < SEQUENCE_PARTS:
        raise RequestError(
            f"{dataset.folder}: {len(windows)} sequences that do not overlap; --split sequence "
            f"needs {SEQUENCE_PARTS} or more, add footage or say --split person"
        )
    kinds = np.array([manifest.clips[place].kind for place in clip[windows].tolist()])
    rng = stream_generator(manifest.seed, "parts")
    dealt = np.concatenate([rng.permutation(windows[kinds == kind]) for kind in KINDS])
    part = np.full(len(clip), -1, dtype=np.int64)
    part[dealt] = np.arange(len(dealt)) % SEQUENCE_PARTS
    return DatasetSplit(by, SEQUENCE_PARTS, part, clip, start, length, names, manifest.seed)


def _apart(clip: NDArray[np.int64], start: NDArray[np.int64], length: int) -> NDArray[np.int64]:
    """Sequences of which no two of one clip share a frame, taken from its beginning."""
    taken: list[int] = []
    last = (-1, 0)  # clip, and the frame after its last window
    for index in np.lexsort((start, clip)).tolist():
        if clip[index] != last[0] or start[index] >= last[1]:
            taken.append(index)
            last = (int(clip[index]), int(start[index]) + length)
    return np.array(taken, dtype=np.int64)
