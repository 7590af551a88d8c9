"""Which units are done, and their files: folders below ``units/``, and nothing beside them.

A unit is done when its folder holds ``unit.json``, which is written last. A folder without it holds
what a stopped unit left, from which the same unit goes on.
"""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from robo_manip_baselines.benchmark.unit import MOUNTS, OUT, Unit
from robo_manip_baselines.data.files import atomic_file

DONE = "unit.json"
LOG = "log.txt"


class Store:
    """The units of a benchmark.

    Args:
        root: folder ``units/``; made when something is written.
    """

    def __init__(self, root: Path) -> None:
        self.root = root.resolve()

    def folder(self, unit: Unit) -> Path:
        """Return the folder of a unit."""
        return self.root / unit.folder

    def note(self, unit: Unit) -> dict[str, Any] | None:
        """Return what ``unit.json`` says; None where the unit is not done."""
        return read_note(self.folder(unit), unit.key)

    def is_done(self, unit: Unit) -> bool:
        """Whether everything that the unit makes is there."""
        return self.note(unit) is not None

    def files(self, unit: Unit) -> dict[str, Path]:
        """Return what a unit that is done has made: path below ``out/`` -> file."""
        note = self.note(unit)
        if note is None:
            raise FileNotFoundError(f"{unit.folder} is not done")
        return {name: self.folder(unit) / OUT / name for name in note["files"]}

    def inputs(self, unit: Unit) -> dict[str, Path]:
        """Return what a unit reads: path in its folder -> file. Its needs must be done."""
        found = {file.name: file.path for file in unit.files}
        for need in unit.needs:
            mount = MOUNTS[need.kind]
            found |= {f"{mount}/{name}": path for name, path in self.files(need).items()}
        return found

    def prepare(self, unit: Unit) -> Path:
        """Make a unit's folder, with links to what it reads; return it."""
        folder = self.folder(unit)
        folder.mkdir(parents=True, exist_ok=True)
        for name, path in self.inputs(unit).items():
            link = folder / name
            link.parent.mkdir(parents=True, exist_ok=True)
            temporary = link.with_name(f".{link.name}.{os.getpid()}.partial")
            temporary.unlink(missing_ok=True)
            temporary.symlink_to(path)
            temporary.replace(link)
        return folder

    def commit(self, unit: Unit, files: Mapping[str, bytes], seconds: float, log: str) -> None:
        """Write what a unit made elsewhere, then that it is done."""
        if self.is_done(unit):  # by somebody else in the meantime, who may be reading it
            return
        folder = self.folder(unit)
        shutil.rmtree(folder, ignore_errors=True)  # whatever was left of an earlier attempt here
        for name, content in files.items():
            with atomic_file(folder / OUT / name) as temporary:
                temporary.write_bytes(content)
        folder.mkdir(parents=True, exist_ok=True)
        (folder / LOG).write_text(log, encoding="utf-8")
        write_note(folder, unit.document(), sorted(files), seconds)


def read_note(folder: Path, key: str) -> dict[str, Any] | None:
    """Return what ``unit.json`` says; None unless it is of this key and its files are there."""
    try:
        note = json.loads((folder / DONE).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    is_whole = (
        isinstance(note, dict)
        and note.get("key") == key
        and all((folder / OUT / name).is_file() for name in note.get("files", [""]))
    )
    return note if is_whole else None


def write_note(folder: Path, document: Mapping[str, Any], files: list[str], seconds: float) -> None:
    """Write ``unit.json``: the unit is done."""
    note = {**document, "files": files, "seconds": round(seconds, 3)}
    with atomic_file(folder / DONE) as temporary:
        temporary.write_text(json.dumps(note, indent=2) + "\n", encoding="utf-8")
