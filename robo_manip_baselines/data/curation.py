"""Merging and splitting folders of episodes: files are copied byte for byte, with their origin.

The sources are only read. The new folder has a file `PROVENANCE`, written before any episode, that
names the source and the content of each file. A run that was stopped, even killed, leaves whole
files only, and the same request continues it.
"""

from __future__ import annotations

import shutil
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from annotated_types import Interval

from robo_manip_baselines.data.demonstrations import Split, split_episodes
from robo_manip_baselines.data.episode import read_metadata
from robo_manip_baselines.data.files import (
    FAILED_FOLDER,
    list_episodes,
    list_failures,
    remove_partial_episodes,
)
from robo_manip_baselines.data.verify import mixture_problems, verify_dataset
from robo_manip_baselines.runs.documents import read_json
from robo_manip_baselines.runs.errors import RequestError, require_choice
from robo_manip_baselines.runs.files import (
    FolderKind,
    atomic_file,
    locked,
    require_out_folder,
    write_json,
)
from robo_manip_baselines.runs.progress import track
from robo_manip_baselines.runs.ranges import Seed, require_ranges
from robo_manip_baselines.runs.versions import software_versions

PROVENANCE = "provenance.json"
"""File of a merged or split folder that says where each episode comes from."""

SCHEMA = "robo_manip_baselines/provenance"
SCHEMA_VERSION = 1

PARTS = ("train", "validation")
"""Folders that a split makes."""

UNITS = ("episode", "person")
"""Units that a split keeps together."""


@dataclass(frozen=True)
class Copied:
    """Result of a merge or a split.

    Attributes:
        demonstrations: number of episodes, by folder.
        failures: likewise, in its ``failed/``.
        duplicates: files that were there twice with the same content, and were taken once.
        new: files copied by this run; the others were there already.
    """

    demonstrations: Mapping[Path, int]
    failures: Mapping[Path, int]
    duplicates: int
    new: int


def merge_datasets(sources: Sequence[Path], out: Path) -> Copied:
    """Copy the episodes of several folders, their failures included, into one.

    Args:
        sources: folders of episodes that belong together.
        out: folder to make, or to continue.

    Raises:
        RequestError: a file is damaged, episodes differ in what the episodes of a folder share, two
            different episodes have one seed, or ``out`` is in the way. Nothing has been copied
            then.
        WriteError: the disk is full, or fails.
    """
    if len(sources) < 2:
        raise RequestError("merge needs two folders or more; name them, then --out")
    metadata = _read_sources(sources, out)
    first: dict[int, Path] = {}
    files: dict[Path, Path] = {}
    duplicates = 0
    for path, attributes in metadata.items():
        seed = attributes["seed"]
        other = first.setdefault(seed, path)
        if other is path:
            is_failure = path.parent.name == FAILED_FOLDER
            files[Path(FAILED_FOLDER, path.name) if is_failure else Path(path.name)] = path
        elif metadata[other]["content_sha256"] == attributes["content_sha256"]:
            duplicates += 1
        else:
            raise RequestError(
                f"'{path}' and '{other}' are two episodes of seed {seed}; an episode keeps its "
                "seed, so leave one of them out (record with --seed to avoid that)"
            )
    request = {"operation": "merge", "options": {}}
    return _copy(files, metadata, sources, out, request, duplicates)


@dataclass(frozen=True)
class SplitRequest:
    """Division of a folder of episodes.

    Attributes:
        fraction: share of the episodes to hold out, more than 0 and less than 1.
        seed: of the draw.
        by: what stays together: ``episode``, as ``Train.py`` splits them, or ``person``, so that
            no person is in both parts.
    """

    fraction: Annotated[float, Interval(gt=0.0, lt=1.0)] = 0.2
    seed: Seed = 0
    by: str = UNITS[0]

    def __post_init__(self) -> None:
        require_choice("split by", self.by, UNITS)
        require_ranges(self)


def split_dataset(source: Path, out: Path, request: SplitRequest) -> Copied:
    """Copy the demonstrations of a folder into two, ``train`` and ``validation`` below ``out``.

    Failures are left out.

    Raises:
        RequestError: a file is damaged, the episodes are a mixture, there are too few of them, or
            ``out`` is in the way. Nothing has been copied then.
        WriteError: the disk is full, or fails.
    """
    metadata = _read_sources([source], out)
    kept = {p: item for p, item in metadata.items() if p.parent.name != FAILED_FOLDER}
    people = {item["seed"]: item.get("motion_subject", "") for item in kept.values()}
    split = choose_split(people, request)
    place = dict.fromkeys(split.train, PARTS[0]) | dict.fromkeys(split.validation, PARTS[1])
    files = {Path(place[item["seed"]], path.name): path for path, item in kept.items()}
    options = {"fraction": request.fraction, "seed": request.seed, "by": request.by}
    made = {"operation": "split", "options": options, "split": split.to_json()}
    return _copy(files, kept, [source], out, made, 0)


def choose_split(people: Mapping[int, str], request: SplitRequest) -> Split:
    """Hold out a random share of the episodes, or of the people.

    Whole people are held out, in random order, as long as that brings the number of episodes
    nearer to the share that was asked for; at least one is.

    Args:
        people: seed of an episode -> who moves in it.
        request: share, seed and unit.

    Raises:
        RequestError: there is only one episode or person.
    """
    if request.by == "episode":
        if len(people) < 2:
            raise RequestError(f"{len(people)} demonstrations cannot be split; record more")
        return split_episodes(people, request.fraction, request.seed)
    groups: dict[str, list[int]] = defaultdict(list)
    for seed, person in sorted(people.items()):
        groups[person].append(seed)
    if len(groups) < 2:
        raise RequestError(
            f"one person ({', '.join(groups) or 'none'}) cannot be split; record others, or split "
            "by episode"
        )
    generator = np.random.default_rng([request.seed, *b"people"])
    names = sorted(groups)
    wanted, held_out = request.fraction * len(people), list[int]()
    for number, index in enumerate(generator.permutation(len(names))):
        seeds = groups[names[index]]
        is_nearer = abs(len(held_out) + len(seeds) - wanted) < abs(len(held_out) - wanted)
        leaves_some = len(held_out) + len(seeds) < len(people)
        if number == 0 or (is_nearer and leaves_some):
            held_out += seeds
    train = set(people) - set(held_out)
    return Split(tuple(sorted(train)), tuple(sorted(held_out)))


def _read_sources(sources: Sequence[Path], out: Path) -> dict[Path, dict[str, Any]]:
    """Return the attributes of all episodes, after everything about them has been checked."""
    require_out_folder(out, _KIND, sources)
    for source in sources:
        if source.is_dir() and out.resolve().is_relative_to(source.resolve()):
            raise RequestError(f"--out {out}: is in '{source}', which is read; name another folder")
    seen: set[Path] = set()
    metadata: dict[Path, dict[str, Any]] = {}
    for source in sources:
        if source.resolve() in seen:
            raise RequestError(f"'{source}' is named twice; name each folder once")
        problems = verify_dataset(source, images=False)
        if errors := [problem for problem in problems if not problem.is_warning]:
            raise RequestError(
                f"{errors[0]}; python bin/Dataset.py verify lists all {len(errors)} problems of "
                f"'{source}'"
            )
        seen.add(source.resolve())
        paths = list_episodes(source) + list_failures(source)
        metadata |= {path: read_metadata(path) for path in paths}
    mixed = [problem for problem in mixture_problems(metadata) if not problem.is_warning]
    if mixed:
        raise RequestError(f"{mixed[0]}; keep episodes of one kind in one folder")
    return metadata


def _copy(
    files: Mapping[Path, Path],
    metadata: Mapping[Path, Mapping[str, Any]],
    sources: Sequence[Path],
    out: Path,
    request: Mapping[str, Any],
    duplicates: int,
) -> Copied:
    """Copy files, given by their path below ``out``; write first where they come from."""
    record = {
        "schema": SCHEMA,
        "schema_version": SCHEMA_VERSION,
        **request,
        "sources": [{"folder": str(s), "provenance": _origin(s)} for s in sources],
        "episodes": {
            str(target): {
                "source": str(path),
                "content_sha256": metadata[path]["content_sha256"],
            }
            for target, path in sorted(files.items())
        },
        "versions": software_versions("robo_manip_baselines"),
    }
    _require_continuation(out, record)
    folders = sorted({out / target.parent for target in files})
    new = 0
    with locked(out, is_kept=False):
        remove_partial_episodes(out)
        for part in PARTS:
            remove_partial_episodes(out / part)
        if not (out / PROVENANCE).exists():
            write_json(out / PROVENANCE, record)
        for target, path in track(sorted(files.items()), len(files), "file"):
            if not _is_there(out / target, metadata[path]["content_sha256"]):
                with atomic_file(out / target) as temporary:
                    shutil.copyfile(path, temporary)
                new += 1
    demonstrations = [folder for folder in folders if folder.name != FAILED_FOLDER]
    return Copied(
        {folder: len(list_episodes(folder)) for folder in demonstrations},
        {folder: len(list_failures(folder)) for folder in demonstrations},
        duplicates,
        new,
    )


def _is_there(path: Path, content_sha256: str) -> bool:
    """Return True if a file is there already.

    Raises:
        RequestError: it is another episode, or damaged.
    """
    if not path.exists():
        return False
    if read_metadata(path)["content_sha256"] != content_sha256:
        raise RequestError(f"'{path}' is another episode; remove it, or name another --out")
    return True


def _require_continuation(out: Path, record: Mapping[str, Any]) -> None:
    """Raise RequestError if a folder was made by another request."""
    if not (out / PROVENANCE).exists():
        return
    there = _provenance(out) or {}
    for name in ("operation", "options", "episodes"):
        if there.get(name) != record[name]:
            raise RequestError(
                f"--out {out}: holds episodes of another request ({name} differ); name another "
                "folder, or remove it"
            )


def _origin(source: Path) -> dict[str, Any] | None:
    """Return where the episodes of a source come from, if it was merged or split, too."""
    return _provenance(source) or (_provenance(source.parent) if source.name in PARTS else None)


def _provenance(folder: Path) -> dict[str, Any] | None:
    """Return the origin of a folder's episodes; None if it is no merged or split folder.

    Raises:
        RequestError: the file is damaged, or of another version.
    """
    path = folder / PROVENANCE
    if not path.is_file():
        return None
    content = read_json(path)
    if not isinstance(content, dict) or content.get("schema") != SCHEMA:
        raise RequestError(f"'{path}' is no file of {SCHEMA}; remove it, or name another folder")
    if content.get("schema_version") != SCHEMA_VERSION:
        raise RequestError(
            f"'{path}' has schema version {content.get('schema_version')}; this release reads "
            f"{SCHEMA_VERSION}"
        )
    return content


_KIND = FolderKind("merged or split episodes", lambda folder: _provenance(folder) is not None)
