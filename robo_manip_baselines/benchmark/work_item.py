"""Work items, pure functions from settings and files to files, and the store of what they make.

A work item runs in a folder of its own. Its inputs lie there under fixed names, and its outputs lie
below ``out/``: nothing that it writes depends on where the folder is or on which process runs it.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache, cached_property
from pathlib import Path, PurePosixPath
from typing import Any

from typing_extensions import TypedDict

from robo_manip_baselines.runs.documents import read_json
from robo_manip_baselines.runs.errors import RequestError
from robo_manip_baselines.runs.files import (
    atomic_file,
    file_digest,
    write_json,
    write_text,
)
from robo_manip_baselines.runs.ranges import Amount, Count
from robo_manip_baselines.runs.versions import software_versions, source_digest

ITEMS = "items"
"""Folder, in that of a benchmark, of its work items."""

KINDS = ("demonstrations", "training", "evaluation", "video")
"""Kinds of work items, folders in ``ITEMS``."""

OUT = "out"
"""Folder, in that of a work item, of its outputs."""

LOG = "log.txt"
MANIFEST = "item.json"

MOUNTS = {"demonstrations": "demonstrations", "training": "run"}
"""Kind of a work item -> folder in which items that need it find its outputs."""


@cache
def item_versions() -> dict[str, str]:
    """Return the versions of the software that outputs depend on."""
    return software_versions("h5py", "mujoco", "numpy", "robo_manip_baselines", "torch")


@dataclass(frozen=True, eq=False)
class WorkItem:
    """Part of a benchmark that one process does.

    Attributes:
        kind: one of ``KINDS``.
        name: unique within its kind.
        function: ``module:name`` of the function that is called with ``settings`` in the item's
            folder.
        settings: everything that decides the outputs, ready for JSON.
        needs: items whose outputs it reads.
        files: name in the item's folder -> file of the user that it reads.
        threads: CPU threads.
        gpus: share of a GPU, 0 for none.
        seconds: expected duration.
    """

    kind: str
    name: str
    function: str
    settings: Mapping[str, Any]
    needs: tuple[WorkItem, ...] = ()
    files: Mapping[str, Path] = field(default_factory=dict)
    threads: int = 1
    gpus: float = 0.0
    seconds: float = 1.0

    def __str__(self) -> str:
        return f"{self.kind} {self.name}"

    @cached_property
    def content(self) -> dict[str, Any]:
        """Everything that the outputs depend on, ready for JSON."""
        return {
            "kind": self.kind,
            "name": self.name,  # conditions that are equal but for it are trained separately
            "function": self.function,
            "settings": dict(self.settings),
            "needs": sorted(need.key for need in self.needs),
            "inputs": {name: file_digest(path) for name, path in self.files.items()},
            "threads": self.threads,
            "versions": item_versions(),
        }

    @cached_property
    def key(self) -> str:
        """SHA-256 of the content."""
        return hashlib.sha256(json.dumps(self.content, sort_keys=True).encode()).hexdigest()

    @property
    def folder(self) -> str:
        """Relative path of its folder: readable, and another one for other contents."""
        return f"{self.kind}/{self.name}_{self.key[:12]}"

    def to_json(self) -> dict[str, Any]:
        """Return the request to the process that does the work.

        The digest of the package's files is no part of the key: a corrected comment would cost
        hours of training.
        """
        return {"key": self.key, **self.content, "source": source_digest()}


class ArtifactStore:
    """Folders of work items, by their keys.

    Args:
        root: made when something is written.
    """

    def __init__(self, root: Path) -> None:
        self.root = root.resolve()

    def folder(self, item: WorkItem) -> Path:
        """Return the folder of an item."""
        return self.root / item.folder

    def manifest(self, item: WorkItem) -> ItemManifest | None:
        """Return the manifest of an item; None where it is not done."""
        return read_manifest(self.folder(item), item.key)

    def is_done(self, item: WorkItem) -> bool:
        """Return whether all outputs of an item exist."""
        return self.manifest(item) is not None

    def outputs(self, item: WorkItem) -> dict[str, Path]:
        """Return the outputs of an item that is done: path below ``out/`` -> file."""
        manifest = self.manifest(item)
        if manifest is None:
            raise FileNotFoundError(f"{item.folder} is not done")
        return {name: self.folder(item) / OUT / name for name in manifest["files"]}

    def prepare(self, item: WorkItem) -> Path:
        """Make and return the folder of an item, with links to its inputs; its needs are done."""
        folder = self.folder(item)
        folder.mkdir(parents=True, exist_ok=True)
        inputs = dict(item.files)
        for need in item.needs:
            outputs = self.outputs(need).items()
            inputs |= {f"{MOUNTS[need.kind]}/{name}": path for name, path in outputs}
        for name, path in inputs.items():
            link = folder / name
            link.parent.mkdir(parents=True, exist_ok=True)
            temporary = link.with_name(f".{link.name}.{os.getpid()}.partial")
            temporary.unlink(missing_ok=True)
            temporary.symlink_to(path)
            temporary.replace(link)
        return folder

    def commit(self, item: WorkItem, files: Mapping[str, bytes], seconds: float, log: str) -> None:
        """Write outputs that were made elsewhere, then the manifest."""
        if self.is_done(item):  # by another process meanwhile, which may be reading it
            return
        folder = self.folder(item)
        shutil.rmtree(folder, ignore_errors=True)  # left by an interrupted attempt
        for name, content in files.items():
            with atomic_file(folder / OUT / name) as temporary:
                temporary.write_bytes(content)
        write_text(folder / LOG, log)
        write_manifest(folder, item.to_json(), sorted(files), seconds)


class ItemManifest(TypedDict):
    """Content of ``item.json``: the request to the process, see `WorkItem`, and what it made.

    Attributes:
        source: digest of the package's files.
        files: outputs, paths below ``out/``.
        seconds: that it took.
    """

    key: str
    kind: str
    name: str
    function: str
    settings: dict[str, Any]
    needs: list[str]
    inputs: dict[str, str]
    threads: Count
    versions: dict[str, str]
    source: str
    files: list[str]
    seconds: Amount


def read_manifest(folder: Path, key: str) -> ItemManifest | None:
    """Read the manifest of a folder; None unless it is of this key and its files are there."""
    try:
        manifest = read_json(folder / MANIFEST, ItemManifest)
    except RequestError:
        return None
    names = [PurePosixPath(name) for name in manifest["files"]]
    is_whole = manifest["key"] == key and all(
        ".." not in name.parts and not name.is_absolute() and (folder / OUT / name).is_file()
        for name in names
    )
    return manifest if is_whole else None


def write_manifest(
    folder: Path, request: Mapping[str, Any], files: Sequence[str], seconds: float
) -> None:
    """Write the manifest, last of all files: the item is done."""
    write_json(folder / MANIFEST, {**request, "files": files, "seconds": round(seconds, 3)})
