"""A unit of work: a pure function from a specification and files to files.

A unit runs in a folder of its own. What it needs lies there under fixed names, and what it makes
lies below ``out/``: so nothing that it writes depends on where the folder is or on who runs it.
"""

from __future__ import annotations

import hashlib
import json
import platform
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache, cached_property
from importlib.metadata import version
from pathlib import Path
from typing import Any

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
