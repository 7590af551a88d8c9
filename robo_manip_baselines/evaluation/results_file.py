"""A folder of results: ``results.jsonl``, a line for each episode, and what all of them share.

Killed at any moment, a run leaves whole lines and at most one torn one at the end, which is dropped
when the run goes on.
"""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, TextIO

from robo_manip_baselines.data import atomic_file, prepare_folder
from robo_manip_baselines.errors import RequestError
from robo_manip_baselines.evaluation.result import EpisodeResult

SCHEMA = "robo_manip_baselines/evaluation"
SCHEMA_VERSION = 1

RESULTS = "results.jsonl"
MANIFEST = "evaluation.json"


def read_results(folder: str | Path) -> list[EpisodeResult]:
    """Read the results of a folder by seed; a torn last line is left out.

    Raises:
        RequestError: there are none, or a line is damaged.
    """
    path = Path(folder) / RESULTS
    try:
        text = path.read_text(encoding="utf-8", errors="replace")
    except OSError as error:
        raise RequestError(
            f"'{path}' cannot be read: {error.strerror}; name a folder that Rollout.py wrote"
        ) from error
    found: dict[int, EpisodeResult] = {}
    for number, line in enumerate(text[: text.rfind("\n") + 1].splitlines(), start=1):
        try:
            result = EpisodeResult.from_line(line)
        except ValueError as error:
            raise RequestError(
                f"'{path}', line {number} is damaged: {error}; remove that line, and its episode "
                "is done again"
            ) from error
        if result.seed in found:
            raise RequestError(f"'{path}' has two lines for seed {result.seed}; remove one")
        found[result.seed] = result
    return [found[seed] for seed in sorted(found)]


class ResultsFile:
    """Results of one evaluation, appended as episodes end. Use as a context manager.

    Args:
        folder: made if need be.
        settings: what must be the same for all episodes of the folder, ready for JSON.
        facts: what else to note, ready for JSON.

    Attributes:
        done: results that the folder already holds, by seed.

    Raises:
        RequestError: the folder holds results of other settings, is damaged, or cannot be written.
    """

    def __init__(self, folder: Path, settings: dict[str, Any], facts: dict[str, Any]) -> None:
        self._path = folder / RESULTS
        _refuse_other_settings(folder, settings)
        self.done = {r.seed: r for r in read_results(folder)} if self._path.exists() else {}
        prepare_folder(folder)
        if not (folder / MANIFEST).exists():
            content = {"schema": SCHEMA, "version": SCHEMA_VERSION, "settings": settings, **facts}
            _write(folder / MANIFEST, json.dumps(content, indent=2) + "\n")
        self._file: TextIO | None = None

    def __enter__(self) -> ResultsFile:
        _drop_torn_line(self._path)
        self._file = self._path.open("a", encoding="utf-8")
        return self

    def __exit__(
        self,
        exc_type: type[BaseException] | None,
        exc: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if self._file:
            self._file.close()
            self._file = None
        if exc_type is None:
            _write(self._path, "".join(f"{r.to_line()}\n" for r in self.of(sorted(self.done))))

    def append(self, result: EpisodeResult) -> None:
        """Write a line; it is on the disk when this returns."""
        if self._file is None:
            raise ValueError("open it with a with statement before appending")
        self._file.write(result.to_line() + "\n")
        self._file.flush()
        os.fsync(self._file.fileno())
        self.done[result.seed] = result

    def of(self, seeds: Sequence[int]) -> list[EpisodeResult]:
        """Return the results of these seeds, as far as they are there."""
        return [self.done[seed] for seed in seeds if seed in self.done]


def _refuse_other_settings(folder: Path, settings: dict[str, Any]) -> None:
    path = folder / MANIFEST
    if not path.exists():
        if (folder / RESULTS).exists():
            raise RequestError(f"'{folder}' holds {RESULTS} without {MANIFEST}; give another --out")
        return
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        schema, version, there = content["schema"], content["version"], content["settings"]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise RequestError(f"'{path}' is damaged; give another --out") from error
    if (schema, version) != (SCHEMA, SCHEMA_VERSION):
        raise RequestError(
            f"'{path}' is of {schema} version {version}, not {SCHEMA} version {SCHEMA_VERSION}; "
            "give another --out"
        )
    # As JSON would give them back: tuples become lists.
    wanted = json.loads(json.dumps(settings))
    for name in sorted({*wanted, *there}):
        if there.get(name) != wanted.get(name):
            raise RequestError(
                f"'{folder}' holds results with {name} {there.get(name)}, not {wanted.get(name)}; "
                "give another --out or remove that folder"
            )


def _drop_torn_line(path: Path) -> None:
    """Cut off what follows the last end of a line."""
    if not path.exists():
        return
    content = path.read_bytes()
    whole = content.rfind(b"\n") + 1
    if whole < len(content):
        os.truncate(path, whole)


def _write(path: Path, text: str) -> None:
    with atomic_file(path) as temporary:
        temporary.write_text(text, encoding="utf-8")
