"""Process that does one work item, ``python -m robo_manip_baselines.benchmark.worker``.

It runs in the item's folder, reads the request on the first line of its standard input, and ends
when that is closed: the process that started it is gone then, and another may continue the item.
`start_worker` starts it.
"""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path
from pkgutil import resolve_name
from typing import Any

from robo_manip_baselines.benchmark.work_item import (
    LOG,
    MOUNTS,
    OUT,
    item_versions,
    read_manifest,
    write_manifest,
)
from robo_manip_baselines.data.files import seed_of
from robo_manip_baselines.runs.command import run_command
from robo_manip_baselines.runs.documents import parse_json
from robo_manip_baselines.runs.errors import RequestError
from robo_manip_baselines.runs.files import file_digest, locked
from robo_manip_baselines.runs.versions import source_digest

LIBRARY = "motion_library.npz"
"""Recorded motion of the user."""

STATS = "error_stats.json"
"""Error statistics of the user."""

SCRATCH = "--scratch"
"""Argument: remove the folder if the process that started this one ends."""

Function = Callable[[Mapping[str, Any]], int | None]


def start_worker(
    request: Mapping[str, Any], folder: Path, *, is_scratch: bool = False
) -> subprocess.Popen[bytes]:
    """Start the process of a work item; it ends with this one.

    Args:
        request: see `WorkItem.to_json`.
        folder: of the item, with its inputs.
        is_scratch: remove the folder if this process ends before the item.
    """
    # In a process of its own: the number of threads is fixed when PyTorch is imported.
    threads = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS")
    environment = dict.fromkeys(threads, str(request["threads"]))
    with (folder / LOG).open("ab") as log:
        process = subprocess.Popen(
            [
                sys.executable,
                "-m",
                "robo_manip_baselines.benchmark.worker",
                *([SCRATCH] if is_scratch else []),
            ],
            cwd=folder,
            env={**os.environ, **environment},
            stdin=subprocess.PIPE,
            stdout=log,
            stderr=subprocess.STDOUT,
        )
    if process.stdin:
        with suppress(BrokenPipeError):  # it has failed already, with an exit code
            process.stdin.write(json.dumps(request).encode() + b"\n")
            process.stdin.flush()
    return process


def end_worker(process: subprocess.Popen[bytes]) -> None:
    """End the process of a work item, if it has not ended, and free what belongs to it."""
    if process.stdin:
        with suppress(BrokenPipeError):
            process.stdin.close()
    process.kill()
    process.wait()


def failure(code: int, log: str) -> str:
    """Return why a worker ended with an exit code: in its last words, where it had any."""
    if code < 0:  # no words of its own: the last line is of earlier work
        return f"killed by signal {-code}, perhaps for lack of memory; fewer workers need less"
    lines = [line.strip() for line in log.splitlines() if line.strip()]
    return lines[-1].removeprefix("error: ") if lines else f"exit code {code}"


def run_demonstrations(settings: Mapping[str, Any]) -> None:
    """Record demonstrations; keep the successful ones."""
    from robo_manip_baselines.rollout.demonstrate import Collection, collect

    collect(Collection.from_json(settings["config"]))
    for path in Path(OUT).iterdir():
        if seed_of(path) is None:
            shutil.rmtree(path) if path.is_dir() else path.unlink()


def run_training(settings: Mapping[str, Any]) -> int:
    """Train a policy, or continue; of the checkpoints keep the last, without the optimiser."""
    from robo_manip_baselines.training.requirements import prepare_pytorch

    prepare_pytorch()
    from robo_manip_baselines.policy.checkpoint import TRAINER, TRAINER_TENSORS
    from robo_manip_baselines.runs.checkpoints import list_checkpoints
    from robo_manip_baselines.training.config import TrainConfig
    from robo_manip_baselines.training.trainer import train

    code = train(TrainConfig.from_json(settings["config"]), resume=True)
    if not code:
        *earlier, (_, last) = list_checkpoints(Path(OUT))
        for _, folder in earlier:
            shutil.rmtree(folder)
        for name in (TRAINER, TRAINER_TENSORS):
            (last / name).unlink(missing_ok=True)
    return code


def run_evaluation(settings: Mapping[str, Any]) -> None:
    """Evaluate a policy."""
    from robo_manip_baselines.rollout.evaluation import EvaluationConfig, evaluate

    evaluate(EvaluationConfig.from_json(settings["config"]))


def main() -> int:
    """Do the work item that is requested on standard input, unless it is done already."""
    # Without a buffer, whose lock a thread that reads must not hold when Python ends.
    with open(0, "rb", buffering=0, closefd=False) as stdin:
        line = stdin.readline()
    if not line:
        _end()
    request = parse_json(line.decode(), "request")
    threading.Thread(target=_end_with_stdin, daemon=True).start()
    _require_same_software(request)
    folder = Path.cwd()
    with locked(folder, wait=True):
        if read_manifest(folder, request["key"]):
            return 0
        for name, digest in request["inputs"].items():
            if file_digest(folder / name) != digest:
                raise RequestError(f"{name} was changed since the benchmark began; start it again")
        begin = time.perf_counter()
        function: Function = resolve_name(request["function"])
        if code := function(request["settings"]):
            return code
        for name in MOUNTS.values():
            shutil.rmtree(folder / name, ignore_errors=True)
        for name in (LIBRARY, STATS):
            (folder / name).unlink(missing_ok=True)
        made = (p for p in Path(OUT).rglob("*") if p.is_file() and not p.name.startswith("."))
        files = sorted(path.relative_to(OUT).as_posix() for path in made)
        write_manifest(folder, request, files, time.perf_counter() - begin)
    return 0


def _end_with_stdin() -> None:
    while os.read(0, 1):
        pass
    _end()


def _end() -> None:
    if SCRATCH in sys.argv:
        shutil.rmtree(Path.cwd(), ignore_errors=True)
    os.kill(os.getpid(), signal.SIGKILL)


def _require_same_software(request: Mapping[str, Any]) -> None:
    here = item_versions()
    for name, version in request["versions"].items():
        if here[name] != version:
            raise RequestError(
                f"{name} is {here[name]} here and {version} where the benchmark was started; "
                "install the same versions everywhere"
            )
    if request["source"] != source_digest():
        raise RequestError(
            "the files of robo_manip_baselines are not those with which the benchmark was started; "
            "install the same everywhere, or, if they were just edited, start it again"
        )


if __name__ == "__main__":
    run_command(main)
