"""Work items as tasks of a Ray cluster. No other module imports Ray.

Files travel by value, as bytes in Ray's object store: nodes and driver need no common folder.
"""

from __future__ import annotations

import logging
import shutil
import socket
import tempfile
import time
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from robo_manip_baselines.benchmark.scheduler import WAIT, WorkResult
from robo_manip_baselines.benchmark.work_item import (
    LOG,
    MOUNTS,
    OUT,
    ArtifactStore,
    WorkItem,
    read_manifest,
)
from robo_manip_baselines.benchmark.worker import end_worker, failure, start_worker
from robo_manip_baselines.runs.errors import RequestError
from robo_manip_baselines.runs.extras import install_command

logger = logging.getLogger(__name__)

RETRIES = 5
"""Restarts of an item whose worker or node is lost."""

CONNECT_TIMEOUT = 10.0
"""s that the head of a cluster may take to answer."""


class RayExecutor:
    """Makes a task of each item; Ray places it.

    Args:
        store: keeps the outputs on the driver.
        address: of the cluster, or ``auto``; None starts one of this machine alone.

    Raises:
        RequestError: Ray is not installed, or there is no cluster.
    """

    def __init__(self, store: ArtifactStore, address: str | None) -> None:
        place = "on this machine" if address is None else f"cluster at {address}"
        logger.info("connecting to Ray: %s", place)
        try:
            import ray
            from ray import exceptions
        except ImportError as error:
            raise RequestError(
                f"--executor ray needs Ray ({error}); run: {install_command('ray')}"
            ) from None
        self._ray, self._exceptions, self._store = ray, exceptions, store
        self._is_ours = not ray.is_initialized()
        if self._is_ours:
            _join(ray, address)
        self._task: Any = ray.remote(do_item)
        self._running: dict[Any, WorkItem] = {}
        self._attempts: dict[str, int] = {}
        self._outputs: dict[str, Any] = {}

    def has_room(self, item: WorkItem) -> bool:
        """Return true: items wait in Ray's queue.

        Raises:
            RequestError: no node of the cluster could ever run the item.
        """
        nodes = [node["Resources"] for node in self._ray.nodes() if node["Alive"]]
        if not any(
            node.get("CPU", 0.0) >= item.threads and node.get("GPU", 0.0) >= item.gpus
            for node in nodes
        ):
            raise RequestError(
                f"{item} wants {item.threads} CPUs and {item.gpus:g} GPUs, which no node of the "
                "Ray cluster has; choose another --preset, or add a node"
            )
        return True

    def workers(self, threads: int, gpus: float) -> int:
        """Return how many items that need so much the cluster runs at once."""
        there = self._ray.cluster_resources()
        room = [there.get("CPU", 0.0) / threads]
        room += [there.get("GPU", 0.0) / gpus] if gpus else []
        return max(int(min(room)), 1)

    def start(self, item: WorkItem) -> None:
        """Hand an item to Ray, with its inputs."""
        inputs = [
            self._ray.put({name: path.read_bytes() for name, path in item.files.items()}),
            *map(self._put_outputs, item.needs),
        ]
        task = self._task.options(
            num_cpus=item.threads, num_gpus=item.gpus, max_retries=RETRIES, name=item.folder
        )
        self._running[task.remote(item.to_json(), *inputs)] = item
        self._attempts[item.key] = self._attempts.get(item.key, 0) + 1

    def wait(self) -> Iterable[WorkResult]:
        """Wait until tasks have ended, for half a second at most."""
        if not self._running:
            return []
        ready, _ = self._ray.wait(list(self._running), timeout=WAIT)
        results = [self._result(reference) for reference in ready]
        return [result for result in results if result]

    def close(self) -> None:
        """Cancel running tasks, and leave the cluster if this object has joined it."""
        for reference in self._running:
            self._ray.cancel(reference, force=True)
        self._running = {}
        if self._is_ours:
            self._ray.shutdown()

    def _put_outputs(self, item: WorkItem) -> Any:
        """Put the outputs of an item into the object store, once."""
        if item.key not in self._outputs:
            outputs = self._store.outputs(item).items()
            content = {f"{MOUNTS[item.kind]}/{name}": path.read_bytes() for name, path in outputs}
            self._outputs[item.key] = self._ray.put(content)
        return self._outputs[item.key]

    def _result(self, reference: Any) -> WorkResult | None:
        item = self._running.pop(reference)
        try:
            code, files, seconds, log = self._ray.get(reference)
        except self._exceptions.RayTaskError as error:
            return WorkResult(item, f"{type(error.cause).__name__}: {error.cause}", 1)
        except self._exceptions.RayError as error:
            if self._attempts[item.key] > RETRIES:
                return WorkResult(item, f"its worker was lost {RETRIES} times: {error}", 1)
            logger.warning("%s: its worker was lost, trying again", item)
            self.start(item)
            return None
        if code:
            return WorkResult(item, failure(code, log), code)
        self._store.commit(item, files, seconds, log)
        return WorkResult(item)


def _join(ray: Any, address: str | None) -> None:
    """Connect to a cluster, or start one of this machine alone.

    Raises:
        RequestError: there is no such cluster.
    """
    try:
        # Ray itself tries for minutes where nobody listens.
        host, _, port = (address or "").removeprefix("ray://").rpartition(":")
        if port.isdecimal():
            socket.create_connection((host, int(port)), CONNECT_TIMEOUT).close()
        ray.init(address, log_to_driver=False, logging_level=logging.WARNING)
    except (OSError, ValueError) as error:  # ConnectionError is an OSError
        raise RequestError(
            f"no Ray cluster at '{address}' ({error}); start one with 'ray start --head', or leave "
            "--address out"
        ) from error


def do_item(
    request: Mapping[str, Any], *inputs: Mapping[str, bytes]
) -> tuple[int, dict[str, bytes], float, str]:
    """Do a work item in a folder of its own on the node where this runs.

    Args:
        request: see `WorkItem.to_json`; from the driver, whose software the node must have.
        inputs: path in the item's folder -> content.

    Returns:
        Exit code, outputs (path below ``out/`` -> content), seconds, log.
    """
    begin = time.perf_counter()
    folder = Path(tempfile.mkdtemp(prefix="robo_manip_baselines_"))
    try:
        for files in inputs:
            for name, content in files.items():
                (folder / name).parent.mkdir(parents=True, exist_ok=True)
                (folder / name).write_bytes(content)
        process = start_worker(request, folder, is_scratch=True)
        try:
            code = process.wait()
        finally:
            end_worker(process)
        log = (folder / LOG).read_text(encoding="utf-8", errors="replace")
        manifest = read_manifest(folder, request["key"]) if code == 0 else None
        if manifest is None:
            return code or 1, {}, time.perf_counter() - begin, log
        outputs = {name: (folder / OUT / name).read_bytes() for name in manifest["files"]}
        return 0, outputs, time.perf_counter() - begin, log
    finally:
        shutil.rmtree(folder, ignore_errors=True)
