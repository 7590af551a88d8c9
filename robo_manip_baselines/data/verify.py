"""Finding damage in a folder of episodes that should belong together."""

from __future__ import annotations

import json
from collections import Counter, defaultdict
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from tqdm import tqdm

from robo_manip_baselines.data.episode import READ_ERRORS, EpisodeFileError, open_hdf5
from robo_manip_baselines.data.file_check import (
    Problem,
    readable_attributes,
    verify_file,
)
from robo_manip_baselines.data.files import FAILED_FOLDER, list_episodes, seed_of
from robo_manip_baselines.errors import RequestError

__all__ = ["Problem", "damage_summary", "verify_dataset", "verify_file"]

# What a folder's episodes must share for one policy to learn from them.
SHARED_ATTRIBUTES = (
    "env_id",
    "env_kwargs",
    "xml_hash",
    "cameras",
    "image_size",
    "control_period",
    "prediction_period",
    "action_names",
    "joint_names",
)


def verify_dataset(folder: str | Path, *, images: bool = True) -> list[Problem]:
    """Everything that is wrong with the episodes of a folder and its ``failed/``.

    Beyond `verify_file`: files of different kinds beside one another, a seed that is there twice,
    a name that does not fit the seed, a failure among the demonstrations, leftovers of killed
    runs.

    Raises:
        RequestError: if there is no such folder, or no episode in it.
    """
    folder = Path(folder)
    paths = list_episodes(folder)
    if (folder / FAILED_FOLDER).is_dir():
        paths += list_episodes(folder / FAILED_FOLDER)
    if not paths:
        raise RequestError(f"'{folder}' holds no episode_*.hdf5 file")
    problems: list[Problem] = []
    with ThreadPoolExecutor(max_workers=2) as pool:  # HDF5 is serial; decoding pictures is not
        found = pool.map(lambda path: verify_file(path, images=images), paths)
        for of_one_file in tqdm(found, total=len(paths), unit="file", disable=None):
            problems += of_one_file
    metadata = {path: _metadata(path) for path in paths}
    problems += _mixed(metadata) + _misplaced(metadata)
    for leftover in sorted(folder.glob("**/.*.partial")):
        problems.append(Problem(leftover, "left by a run that was killed; may be deleted", True))
    return problems


def _metadata(path: Path) -> dict[str, Any]:
    """What can be read of a file's attributes; its damage has been reported already."""
    try:
        with open_hdf5(path) as file:
            return readable_attributes(file)[0]
    except (EpisodeFileError, *READ_ERRORS):
        return {}


def _mixed(metadata: dict[Path, dict[str, Any]]) -> list[Problem]:
    """Files that differ from most others in what all of them should share."""
    problems: list[Problem] = []
    for name in SHARED_ATTRIBUTES:
        values = {
            path: json.dumps(attributes[name], sort_keys=True)
            for path, attributes in metadata.items()
            if name in attributes
        }
        counts = Counter(values.values()).most_common()
        if len(counts) > 1:
            usual, number = counts[0]
            problems += [
                Problem(path, f"{name} is {value}, but {usual} in {number} other files")
                for path, value in values.items()
                if value != usual
            ]
    return problems


def _misplaced(metadata: dict[Path, dict[str, Any]]) -> list[Problem]:
    problems: list[Problem] = []
    by_seed: dict[int, list[Path]] = defaultdict(list)
    for path, attributes in metadata.items():
        seed = attributes.get("seed", seed_of(path))
        by_seed[seed].append(path)
        if seed != seed_of(path):
            problems.append(Problem(path, f"holds seed {seed}, which its name does not say"))
        if attributes.get("is_success") is False and path.parent.name != FAILED_FOLDER:
            problems.append(Problem(path, f"is a failure; it belongs in {FAILED_FOLDER}/"))
    for seed, paths in by_seed.items():
        problems += [Problem(path, f"seed {seed} is also in {paths[0]}") for path in paths[1:]]
    return problems


def damage_summary(folder: Path, problems: Sequence[Problem]) -> str:
    """The closing line of a verification."""
    number = len(list_episodes(folder))
    failed = folder / FAILED_FOLDER
    kept = len(list_episodes(failed)) if failed.is_dir() else 0
    errors = [problem for problem in problems if not problem.is_warning]
    files = f"{number} demonstrations" + (f" and {kept} failures" if kept else "")
    warnings = len(problems) - len(errors)
    ending = f", {warnings} warnings" if warnings else ""
    if not errors:
        return f"{folder}: {files}, all whole{ending}"
    damaged = len({problem.path for problem in errors})
    return f"{folder}: {files}; {len(errors)} problems in {damaged} files{ending}"
