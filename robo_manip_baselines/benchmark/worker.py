"""The process that does a unit of work: ``python -m robo_manip_baselines.benchmark.worker``.

It runs in the unit's folder, is told what to do on the first line of its standard input, and ends
when that is closed: whoever started it is gone then, and another may already be about to go on.
"""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import shutil
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

from robo_manip_baselines.benchmark.work_item import (
    MOUNTS,
    OUT,
    read_note,
    source_digest,
    versions,
    write_note,
)
from robo_manip_baselines.data.files import seed_of
from robo_manip_baselines.policy.registry import load_part
from robo_manip_baselines.runs.command import run_command
from robo_manip_baselines.runs.errors import RequestError

LIBRARY = "motion_library.npz"
"""of recorded motion, where it is not the one that ships with the package."""

FORECAST = "motion_forecast.npz"
"""The same with a forecast of `forecasts` in it."""

STATS = "error_stats.json"
"""Error statistics, where they are not those that ship with the package."""

SCRATCH = "--scratch"
"""Argument that says that the folder goes if whoever started this does."""

Work = Callable[[Mapping[str, Any]], int | None]


def main() -> int:
    """Do the unit that standard input names; leave it alone if it is done already."""
    # Without a buffer, whose lock a thread that reads must not hold when Python ends.
    with open(0, "rb", buffering=0, closefd=False) as stdin:
        line = stdin.readline()
    is_scratch = SCRATCH in sys.argv
    if not line:
        _end(is_scratch)
    document = json.loads(line)
    threading.Thread(target=_end_with_stdin, args=(is_scratch,), daemon=True).start()
    _require_same_software(document)
    folder = Path.cwd()
    with _locked(folder):
        if read_note(folder, document["key"]):
            return 0
        begin = time.perf_counter()
        work: Work = load_part(document["work"])
        if code := work(document["settings"]):
            return code
        _remove_inputs(folder)
        write_note(folder, document, _made(), time.perf_counter() - begin)
    return 0


def demonstrate(settings: Mapping[str, Any]) -> None:
    """Let the scripted expert record episodes; keep those that show how it is done."""
    from robo_manip_baselines.commands.rollout import EXAMPLE, RolloutOptions, rollout
    from robo_manip_baselines.runs.command import parse

    _write_forecast(settings)
    rollout(parse(RolloutOptions, EXAMPLE, args=settings["args"]))
    for path in Path(OUT).iterdir():
        if seed_of(path) is None:
            shutil.rmtree(path) if path.is_dir() else path.unlink()


def train(settings: Mapping[str, Any]) -> int | None:
    """Train a policy, or go on with it; keep what acting needs of the last checkpoint."""
    from robo_manip_baselines.training.requirements import prepare_pytorch

    prepare_pytorch()
    from robo_manip_baselines.commands.train import parse_config
    from robo_manip_baselines.policy.checkpoint import TRAINER, TRAINER_TENSORS
    from robo_manip_baselines.runs.checkpoints import list_checkpoints
    from robo_manip_baselines.training.trainer import train

    if code := train(parse_config(settings["args"]), resume=True):
        return code
    *earlier, (_, last) = list_checkpoints(Path(OUT))
    for _, folder in earlier:
        shutil.rmtree(folder)
    for name in (TRAINER, TRAINER_TENSORS):
        (last / name).unlink(missing_ok=True)
    return None


def evaluate(settings: Mapping[str, Any]) -> None:
    """Let a trained policy act."""
    from robo_manip_baselines.training.requirements import prepare_pytorch

    prepare_pytorch()
    from robo_manip_baselines.commands.rollout import EXAMPLE, RolloutOptions, rollout
    from robo_manip_baselines.runs.command import parse

    _write_forecast(settings)
    rollout(parse(RolloutOptions, EXAMPLE, args=settings["args"]))


@contextlib.contextmanager
def _locked(folder: Path) -> Iterator[None]:
    """Hold the unit's folder, waiting for whoever does the same unit at this moment."""
    descriptor = os.open(folder / ".lock", os.O_RDWR | os.O_CREAT, 0o644)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX)
        yield
    finally:
        os.close(descriptor)


def _write_forecast(settings: Mapping[str, Any]) -> None:
    from robo_manip_baselines.benchmark.forecasts import write_library

    if settings["prediction"] != "truth":
        source = Path(LIBRARY) if Path(LIBRARY).exists() else None
        write_library(Path(FORECAST), source, settings["prediction"])


def _end_with_stdin(is_scratch: bool) -> None:
    """Wait until standard input is closed, then end this process at once."""
    while os.read(0, 1):
        pass
    _end(is_scratch)


def _end(is_scratch: bool) -> None:
    if is_scratch:
        shutil.rmtree(Path.cwd(), ignore_errors=True)
    os.kill(os.getpid(), signal.SIGKILL)


def _made() -> list[str]:
    """List what is below ``out/``, hidden files apart."""
    paths = (path for path in Path(OUT).rglob("*") if path.is_file())
    return sorted(p.relative_to(OUT).as_posix() for p in paths if not p.name.startswith("."))


def _remove_inputs(folder: Path) -> None:
    """Remove links to, or copies of, what the unit has read."""
    for name in MOUNTS.values():
        shutil.rmtree(folder / name, ignore_errors=True)
    for name in (LIBRARY, FORECAST, STATS):
        (folder / name).unlink(missing_ok=True)


def _require_same_software(document: Mapping[str, Any]) -> None:
    here = versions()
    for name, number in document["versions"].items():
        if here[name] != number:
            raise RequestError(
                f"{name} is {here[name]} here and {number} where the benchmark was started; "
                "install the same versions everywhere"
            )
    if document["source"] != source_digest():
        raise RequestError(
            "the files of robo_manip_baselines are not those with which the benchmark was started; "
            "install the same everywhere, or, if they were just edited, start it again"
        )


if __name__ == "__main__":
    run_command(main)
