"""Units as tasks of a Ray cluster. Nothing but this module imports Ray.

Files travel by value, as bytes in Ray's object store: nodes and driver need no folder in common.
"""

from __future__ import annotations

import logging
import shutil
import socket
import subprocess
import tempfile
import time
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from robo_manip_baselines.benchmark.local import last_line, start_worker
from robo_manip_baselines.benchmark.scheduler import Outcome
from robo_manip_baselines.benchmark.work_item import LOG, MOUNTS, OUT, Store, Unit, read_note
from robo_manip_baselines.runs.errors import RequestError

logger = logging.getLogger(__name__)

RETRIES = 5
"""How often a unit is started anew whose worker or node is lost."""

WAIT = 0.5
"""s to wait for results before the bar is drawn anew."""

PATIENCE = 10.0
"""s that the head of a cluster may take to answer."""

Files = dict[str, bytes]
"""Path -> content."""


class RayExecutor:
    """Makes a task of each unit; Ray finds the place for it.

    Args:
        store: where the driver keeps what comes back.
        address: of the cluster, or ``auto``; None starts one of this machine alone.

    Raises:
        RequestError: Ray is not installed, or there is no cluster.
    """

    def __init__(self, store: Store, address: str | None) -> None:
        try:
            import ray
            from ray import exceptions
        except ImportError as error:
            raise RequestError(
                f"--executor ray needs Ray ({error}); pip install 'robo_manip_baselines[ray]'"
            ) from None
        self._ray = ray
        self._exceptions = exceptions
        self._store = store
        self._is_ours = not ray.is_initialized()
        if self._is_ours:
            _join(ray, address)
        self._task: Any = ray.remote(do_unit)
        self._running: dict[Any, Unit] = {}
        self._attempts: dict[str, int] = {}
        self._made: dict[str, Any] = {}

    def has_room(self, unit: Unit) -> bool:
        """Say yes: what there is no room for waits in Ray's queue.

        Raises:
            RequestError: no node of the cluster could ever run the unit.
        """
        nodes = [node["Resources"] for node in self._ray.nodes() if node["Alive"]]
        if not any(
            node.get("CPU", 0.0) >= unit.threads and node.get("GPU", 0.0) >= unit.gpus
            for node in nodes
        ):
            raise RequestError(
                f"{unit.kind} {unit.name} wants {unit.threads} CPUs and {unit.gpus:g} GPUs, which "
                "no node of the Ray cluster has; choose another --preset, or add a node"
            )
        return True

    def workers(self, threads: int, gpus: float) -> int:
        """Return how many units that need so much the cluster carries at once."""
        there = self._ray.cluster_resources()
        room = [there.get("CPU", 0.0) / threads]
        room += [there.get("GPU", 0.0) / gpus] if gpus else []
        return max(int(min(room)), 1)

    def start(self, unit: Unit) -> None:
        """Hand a unit to Ray, with what it reads."""
        given = [
            self._ray.put({file.name: file.path.read_bytes() for file in unit.files}),
            *(self._of(need) for need in unit.needs),
        ]
        task = self._task.options(
            num_cpus=unit.threads, num_gpus=unit.gpus, max_retries=RETRIES, name=unit.folder
        )
        self._running[task.remote(unit.document(), *given)] = unit
        self._attempts[unit.key] = self._attempts.get(unit.key, 0) + 1

    def wait(self) -> Iterable[Outcome]:
        """Wait until tasks have ended, for half a second at most."""
        if not self._running:
            return []
        ready, _ = self._ray.wait(list(self._running), timeout=WAIT)
        outcomes = [self._outcome(reference) for reference in ready]
        return [outcome for outcome in outcomes if outcome]

    def close(self) -> None:
        """Cancel what is running; leave the cluster if we have joined it."""
        for reference in self._running:
            self._ray.cancel(reference, force=True)
        self._running = {}
        if self._is_ours:
            self._ray.shutdown()

    def _of(self, unit: Unit) -> Any:
        """Put what a unit has made into the object store, once."""
        if unit.key not in self._made:
            mount = MOUNTS[unit.kind]
            files = self._store.files(unit)
            content = {f"{mount}/{name}": path.read_bytes() for name, path in files.items()}
            self._made[unit.key] = self._ray.put(content)
        return self._made[unit.key]

    def _outcome(self, reference: Any) -> Outcome | None:
        unit = self._running.pop(reference)
        try:
            code, files, seconds, log = self._ray.get(reference)
        except self._exceptions.RayTaskError as error:
            return Outcome(unit, f"{type(error.cause).__name__}: {error.cause}", 1)
        except self._exceptions.RayError as error:
            if self._attempts[unit.key] > RETRIES:
                return Outcome(unit, f"its worker was lost {RETRIES} times: {error}", 1)
            logger.warning("%s: its worker was lost, trying again", unit.folder)
            self.start(unit)
            return None
        if code:
            return Outcome(unit, last_line(log) or f"exit code {code}", code)
        self._store.commit(unit, files, seconds, log)
        return Outcome(unit)


def _join(ray: Any, address: str | None) -> None:
    """Connect to a cluster, or start one of this machine alone.

    Raises:
        RequestError: there is no such cluster.
    """
    try:
        # Ray itself tries for minutes where nobody listens.
        host, _, port = (address or "").removeprefix("ray://").rpartition(":")
        if port.isdecimal():
            socket.create_connection((host, int(port)), PATIENCE).close()
        ray.init(address, log_to_driver=False, logging_level=logging.WARNING)
    except (OSError, ValueError) as error:  # ConnectionError is an OSError
        raise RequestError(
            f"no Ray cluster at '{address}' ({error}); start one with 'ray start --head', or leave "
            "--address out"
        ) from error


def do_unit(
    document: Mapping[str, Any], *given: Mapping[str, bytes]
) -> tuple[int, Files, float, str]:
    """Do a unit in a folder of its own on whichever node this runs.

    Args:
        document: what to do, see ``Unit.document``; made where the benchmark was started, so that
            the node can tell whether it has the same software.
        given: files that it reads.

    Returns:
        Exit code, what it has made (path below ``out/`` -> content), seconds, log.
    """
    begin = time.perf_counter()
    folder = Path(tempfile.mkdtemp(prefix="robo_manip_baselines_"))
    try:
        for files in given:
            for name, content in files.items():
                (folder / name).parent.mkdir(parents=True, exist_ok=True)
                (folder / name).write_bytes(content)
        # In a process of its own, as everywhere: threads are chosen before PyTorch is imported.
        process = start_worker(document, folder, is_scratch=True)
        try:
            code = process.wait()
        finally:
            _end(process)
        log = (folder / LOG).read_text(encoding="utf-8", errors="replace")
        note = read_note(folder, document["key"])
        if code == 0 and note is None:
            code = 1
        names = note["files"] if note and code == 0 else []
        made = {name: (folder / OUT / name).read_bytes() for name in names}
        return code, made, time.perf_counter() - begin, log
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def _end(process: subprocess.Popen[bytes]) -> None:
    if process.stdin:
        process.stdin.close()
    process.kill()
    process.wait()
