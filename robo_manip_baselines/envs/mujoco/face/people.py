"""Split of the people of a motion library into those of demonstrations and those of evaluation.

Legend: R runs.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
from annotated_types import Len
from numpy.typing import NDArray

from robo_manip_baselines.runs.documents import convert
from robo_manip_baselines.runs.errors import RequestError

PEOPLE = ("all", "train", "test")
"""Everybody; people of demonstrations; people of evaluation, of whom no demonstration was seen."""

SPLIT_KEY = "people"
"""Key of a stored split in the metadata of a library."""


@dataclass(frozen=True)
class PeopleSplit:
    """Split that a library file stores under ``people`` in its metadata.

    Attributes:
        train, test: ids of people; somebody in neither is drawn in neither part.

    Raises:
        RequestError: somebody is in both.
    """

    train: Annotated[tuple[str, ...], Len(1)]
    test: Annotated[tuple[str, ...], Len(1)]

    def __post_init__(self) -> None:
        if both := sorted(set(self.train) & set(self.test)):
            raise RequestError(f"'{both[0]}' is in train and in test; leave one out")

    @classmethod
    def of(cls, metadata: Mapping[str, Any], source: str) -> PeopleSplit | None:
        """Read the split of a library's metadata; None where it stores none.

        Raises:
            RequestError: it is no split; ``source`` begins the message.
        """
        stored = metadata.get(SPLIT_KEY)
        return None if stored is None else convert(stored, cls, f"{source}: people")


def alternate(names: Sequence[str]) -> PeopleSplit:
    """Split two names or more by turns, train first, in the order of their SHA-256.

    The order depends on nothing but the names, and is neither that of the alphabet nor of the file.
    """
    ordered = sorted(set(names), key=lambda name: hashlib.sha256(name.encode()).hexdigest())
    return PeopleSplit(tuple(ordered[::2]), tuple(ordered[1::2]))


@dataclass(frozen=True)
class RunPart:
    """Runs of one part of a split.

    Attributes:
        run: (R,) number of the run in the library.
        start: (R,) first frame, counted from the start of the library.
        length: (R,) frames.
    """

    run: NDArray[np.int64]
    start: NDArray[np.int64]
    length: NDArray[np.int64]


def split_runs(
    people: Sequence[str],
    clips: Sequence[str],
    start: NDArray[np.int64],
    length: NDArray[np.int64],
    *,
    least: int,
    stored: PeopleSplit | None = None,
) -> dict[str, RunPart]:
    """Split the runs of a library into the parts ``train`` and ``test``.

    People are split as the library says, or else by `alternate`. With one person alone that
    person's clips are split likewise, with one clip its runs by turns, and the only run in its
    middle.

    Args:
        people: (R,) ids of who moves in each run.
        clips: (R,) ids of the clips.
        start: (R,) first frames.
        length: (R,) frames.
        least: frames of the shortest run that an episode can be drawn from; shorter ones are in no
            part.
        stored: split that the library stores.

    Raises:
        RequestError: a part has no run that is long enough.
    """
    usable = np.flatnonzero(length >= least)
    present = [people[run] for run in usable.tolist()]
    if stored is None and len(set(present)) == 1:
        own = [clips[run] for run in usable.tolist()]
        return _split_one_person(own, usable, start, length, least)
    found = stored or (alternate(present) if present else None)
    parts: dict[str, RunPart] = {}
    for name in ("train", "test"):
        wanted: tuple[str, ...] = getattr(found, name, ())
        runs = usable[np.array([name in wanted for name in present], dtype=bool)]
        if not runs.size:
            whose = f" of {', '.join(wanted)}" if wanted else ""
            raise RequestError(f"people '{name}': no run{whose} is long enough for an episode")
        parts[name] = RunPart(runs, start[runs], length[runs])
    return parts


def _split_one_person(
    clips: Sequence[str],
    usable: NDArray[np.int64],
    start: NDArray[np.int64],
    length: NDArray[np.int64],
    least: int,
) -> dict[str, RunPart]:
    """Split the runs of somebody who is alone in a library; ``clips`` are those of ``usable``."""
    if len(usable) > 1:
        if len(set(clips)) > 1:
            of_test = np.isin(clips, alternate(clips).test)
        else:
            of_test = np.arange(len(usable)) % 2 == 1
        chosen = {"train": usable[~of_test], "test": usable[of_test]}
        return {name: RunPart(runs, start[runs], length[runs]) for name, runs in chosen.items()}
    first = length[usable] // 2
    if first[0] < least:
        raise RequestError(
            "people 'train' and 'test': the library has one run of one person, and its halves are "
            "too short for an episode each; record more, or take people 'all'"
        )
    return {
        "train": RunPart(usable, start[usable], first),
        "test": RunPart(usable, start[usable] + first, length[usable] - first),
    }
