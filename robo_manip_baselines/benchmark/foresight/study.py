"""Run of a study of foresight: its folder, the rows in it, workers, resumption."""

from __future__ import annotations

import os
from collections import defaultdict
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

from robo_manip_baselines.benchmark.foresight.episodes import (
    Cell,
    EpisodePlayer,
    ForesightRow,
    Request,
    open_world,
)
from robo_manip_baselines.benchmark.foresight.forecasters import residual_horizon
from robo_manip_baselines.runs.documents import Schema, as_json, convert, read_json, read_json_lines
from robo_manip_baselines.runs.errors import RequestError
from robo_manip_baselines.runs.files import AppendFile, FolderKind, write_json, write_text
from robo_manip_baselines.runs.processes import answers
from robo_manip_baselines.runs.versions import software_versions, source_digest

SCHEMA = Schema("robo_manip_baselines/foresight", 1)

MANIFEST = "foresight.json"
ROWS = "foresight.jsonl"

FOLDER = FolderKind("study of bin/Benchmark.py foresight", lambda path: (path / MANIFEST).exists())

Key = tuple[Cell, int]


def possible_cells(cells: Iterable[Cell], motion_library: Path | None = None) -> tuple[Cell, ...]:
    """Return the cells whose forecasts a motion library has.

    A trained predictor has none beyond its horizon.

    Raises:
        RequestError: a motion or the library cannot be used.
    """
    found, horizons = [], dict[str, int]()
    for cell in cells:
        if cell.forecaster == "residual":
            if cell.motion not in horizons:
                horizons[cell.motion] = residual_horizon(open_world(cell.motion, motion_library))
            if cell.lead > horizons[cell.motion]:
                continue
        found.append(cell)
    return tuple(found)


def study_settings(motion_library: Path | None = None) -> dict[str, Any]:
    """Return what all rows of a folder must share, ready for JSON."""
    world = open_world("recorded", motion_library)
    return {
        "motion_sha256": world.library.sha256,
        "xml_hash": world.xml_hash,
        **software_versions("mink", "mujoco", "numpy", "robo_manip_baselines", "scipy"),
    }


def prepare_study(folder: Path, settings: dict[str, Any]) -> bool:
    """Write the manifest of a folder that has none, and drop a torn row.

    Returns:
        False if the folder was begun by other code of the package.

    Raises:
        RequestError: the folder holds rows of other settings.
    """
    require_settings(folder, settings)
    path = folder / MANIFEST
    if not path.exists():
        content = {"settings": settings, "source": source_digest()}
        write_json(path, {**SCHEMA.to_json(), **content})
    rows = folder / ROWS
    if rows.exists():
        os.truncate(rows, rows.read_bytes().rfind(b"\n") + 1)
    return read_json(path, schema=SCHEMA).get("source") == source_digest()


def require_settings(folder: Path, settings: dict[str, Any]) -> None:
    """Make sure that rows of these settings can be added to a folder.

    Raises:
        RequestError: naming the first setting that differs.
    """
    path = folder / MANIFEST
    if not path.exists():
        return
    there = convert(read_json(path, schema=SCHEMA).get("settings"), dict, f"'{path}': settings")
    for name, value in as_json(settings).items():
        if there.get(name) != value:
            raise RequestError(
                f"'{folder}' holds episodes with {name} {there.get(name)}, not {value}; give "
                "another --out or remove that folder"
            )


def read_study(folder: Path) -> dict[Key, ForesightRow]:
    """Read the rows of a folder by cell and seed; a torn last row is left out.

    Raises:
        RequestError: a row is damaged, or there twice.
    """
    path, rows = folder / ROWS, dict[Key, ForesightRow]()
    for number, line in read_json_lines(path) if path.exists() else ():
        source = f"'{path}', line {number}"
        try:
            row = ForesightRow.from_line(line, source)
        except RequestError as error:
            problem = f"{error}; remove that line, and its episode is done again"
            raise RequestError(problem) from error
        if row.key in rows:
            raise RequestError(f"{source}: the episode is there twice; remove one of them")
        rows[row.key] = row
    return rows


def requests(
    cells: Sequence[Cell], seeds: Iterable[int], done: Collection[Key] = ()
) -> list[Request]:
    """Return the episodes that are not done, seed by seed and motion by motion."""
    of_motion = defaultdict[str, list[Cell]](list)
    for cell in cells:
        of_motion[cell.motion].append(cell)
    found = []
    for seed in seeds:
        for motion, own in of_motion.items():
            left = tuple(cell for cell in own if (cell, seed) not in done)
            if left:
                found.append(Request(motion, seed, left))
    return found


def run_study(
    folder: Path,
    todo: Sequence[Request],
    *,
    motion_library: Path | None = None,
    num_workers: int = 1,
    on_rows: Callable[[Sequence[ForesightRow]], None] = lambda rows: None,
) -> None:
    """Do requests and append their rows to the folder, each request's as it ends.

    At the end the rows are sorted: the file does not depend on who did what when.

    Args:
        folder: prepared by `prepare_study`, and held by this process.
        todo: requests, none of whose episodes are done.
        motion_library: file of recorded motion; the one that ships with the package if None.
        num_workers: processes; 1 works in this one.
        on_rows: called with the rows of each request.
    """
    with closing(AppendFile(folder / ROWS, is_flushed=True)) as file:
        for rows in _answers(todo, motion_library, num_workers):
            file.append("".join(f"{row.to_line()}\n" for row in rows).encode())
            on_rows(rows)
    found = read_study(folder)
    write_text(folder / ROWS, "".join(f"{found[key].to_line()}\n" for key in sorted(found)))


def _answers(
    todo: Sequence[Request], motion_library: Path | None, num_workers: int
) -> Iterator[list[ForesightRow]]:
    """Yield the rows of requests as they end."""
    if num_workers == 1:
        yield from map(EpisodePlayer(motion_library), todo)
        return
    yield from answers(EpisodePlayer, (motion_library,), todo, num_workers)
