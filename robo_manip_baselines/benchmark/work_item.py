"""A unit of work: a pure function from a specification and files to files.

A unit runs in a folder of its own. What it needs lies there under fixed names, and what it makes
lies below ``out/``: so nothing that it writes depends on where the folder is or on who runs it.
"""

from __future__ import annotations

import hashlib
import json
import os
import platform
import shutil
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache, cached_property
from importlib.metadata import version
from pathlib import Path
from typing import Any

from robo_manip_baselines.runs.files import atomic_file

OUT = "out"
"""Folder, in that of the unit, of what it makes."""

PACKAGE = Path(__file__).parents[1]
"""Folder of robo_manip_baselines."""

MOUNTS = {"demonstrations": "demonstrations", "training": "run"}
"""Kind of a unit -> folder in which units that need it find what it made."""


@dataclass(frozen=True)
class InputFile:
    """A file that comes from outside.

    Attributes:
        name: under which a unit finds it.
        path: where it is.
        sha256: of its bytes.
    """

    name: str
    path: Path
    sha256: str

    @classmethod
    def of(cls, name: str, path: Path) -> InputFile:
        """Note what the file holds now.

        Raises:
            OSError: it cannot be read.
        """
        return cls(name, path.resolve(), hashlib.sha256(path.read_bytes()).hexdigest())


@dataclass(frozen=True, eq=False)
class Unit:
    """What is to be done.

    Attributes:
        kind: ``demonstrations``, ``training``, ``evaluation`` or ``video``.
        name: tells units of a kind apart.
        work: ``module:function`` that does it, called with ``settings`` in the unit's folder.
        settings: everything that decides what comes out, ready for JSON.
        needs: units whose files it reads.
        files: files from outside that it reads.
        threads: CPU threads.
        gpus: share of a GPU, 0 for none.
        seconds: that it is expected to take.
    """

    kind: str
    name: str
    work: str
    settings: Mapping[str, Any]
    needs: tuple[Unit, ...] = ()
    files: tuple[InputFile, ...] = ()
    threads: int = 1
    gpus: float = 0.0
    seconds: float = 1.0

    @cached_property
    def key(self) -> str:
        """SHA-256 of everything that what comes out depends on, the versions of software too."""
        text = json.dumps(
            {
                "kind": self.kind,
                "name": self.name,  # arms that are the same but for it are trained apart
                "work": self.work,
                "settings": self.settings,
                "needs": sorted(unit.key for unit in self.needs),
                "files": {file.name: file.sha256 for file in self.files},
                "threads": self.threads,
                "versions": versions(),
            },
            sort_keys=True,
        )
        return hashlib.sha256(text.encode()).hexdigest()

    @property
    def folder(self) -> str:
        """Relative path of its folder: readable, and another one for other contents."""
        return f"{self.kind}/{self.name}_{self.key[:12]}"

    def document(self) -> dict[str, Any]:
        """Return what the process that does the work is told."""
        return {
            "key": self.key,
            "kind": self.kind,
            "name": self.name,
            "work": self.work,
            "settings": dict(self.settings),
            "threads": self.threads,
            "versions": versions(),
            "source": source_digest(),
        }


def is_of_other_source(note: Mapping[str, Any]) -> bool:
    """Say whether a unit's document is of a package whose files were others than now."""
    return note.get("source") != source_digest()


@cache
def source_digest() -> str:
    """SHA-256 of the package's files: its programs, models, recorded motion, statistics.

    It is no part of the key, or a comment that is mended would cost hours of training.
    """
    found = hashlib.sha256()
    for path in sorted(PACKAGE.rglob("*")):
        if path.is_file() and "__pycache__" not in path.parts:
            found.update(f"{path.relative_to(PACKAGE).as_posix()}\0".encode())
            found.update(hashlib.sha256(path.read_bytes()).digest())
    return found.hexdigest()


@cache
def versions() -> dict[str, str]:
    """Return the versions of what results depend on."""
    packages = ("h5py", "mujoco", "numpy", "robo_manip_baselines", "torch")
    return {"python": platform.python_version(), **{name: version(name) for name in packages}}


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
