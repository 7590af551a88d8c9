"""Worker processes: answers, errors, and that none outlives the process that started it."""

from __future__ import annotations

import functools
import math
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from robo_manip_baselines.runs.errors import RequestError, WriteError
from robo_manip_baselines.runs.processes import (
    Worker,
    WorkerDiedError,
    answers,
    close_workers,
    wait_for,
)


def fail(kind: type[Exception]) -> None:
    raise kind("no camera")


@pytest.mark.long
def test_answers_and_errors_come_back() -> None:
    workers = [Worker(functools.partial, math.sqrt), Worker(functools.partial, fail)]
    try:
        workers[0].submit(9.0)
        workers[1].submit(RequestError)
        assert workers[0].receive() == 3.0
        with pytest.raises(RequestError, match=r"^no camera$"):
            workers[1].receive()
        workers[1].submit(WriteError)
        assert wait_for(workers) == [workers[1]]
        with pytest.raises(WriteError, match=r"^no camera$"):
            workers[1].receive()
        workers[0].submit("nine")
        with pytest.raises(RuntimeError, match=r"(?s)a worker process failed:.*TypeError"):
            workers[0].receive()
        workers[0].process.kill()
        workers[0].submit(9.0)
        with pytest.raises(WorkerDiedError, match="exit code -9"):
            workers[0].receive()
    finally:
        close_workers(workers)


@pytest.mark.long
def test_requests_are_answered_by_as_many_processes_as_they_need() -> None:
    polls: list[None] = []
    found = answers(
        functools.partial, (math.sqrt,), [4.0, 9.0, 16.0], 2, lambda: polls.append(None)
    )
    assert sorted(found) == [2.0, 3.0, 4.0]
    assert polls
    assert list(answers(functools.partial, (math.sqrt,), [], 2)) == []
    with pytest.raises(RequestError, match=r"^no camera$"):
        list(answers(functools.partial, (fail,), [RequestError], 9))
    with pytest.raises(
        RuntimeError, match=r"died \(exit code 3\); if it was killed for lack of mem"
    ):
        list(answers(functools.partial, (os._exit,), [3], 1))


@pytest.mark.long
def test_requests_that_are_not_waited_for_are_not_taken() -> None:
    waiting = iter(range(100))
    found = answers(functools.partial, (math.sqrt,), waiting, 2)
    next(found)
    found.close()
    assert next(waiting) <= 4


PARENT = """
import functools, time
from robo_manip_baselines.runs.command import run_command
from robo_manip_baselines.runs.processes import Worker, close_workers
def main():
    worker = Worker(functools.partial, time.sleep)
    try:
        worker.submit(0.0)
        worker.receive()
        worker.submit(60.0)
        print(worker.process.pid, flush=True)
        time.sleep(60.0)
    finally:
        close_workers([worker], at_once=True)
if __name__ == "__main__":
    run_command(main)
"""


def is_running(process: Path) -> bool:
    try:
        return "State:\tZ" not in (process / "status").read_text()
    except OSError:
        return False


@pytest.mark.long
@pytest.mark.skipif(sys.platform != "linux", reason="looks into /proc")
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP, signal.SIGKILL])
def test_no_worker_outlives_its_parent(number: signal.Signals, tmp_path: Path) -> None:
    script = tmp_path / "parent.py"
    script.write_text(PARENT)
    pipe = subprocess.PIPE
    with subprocess.Popen([sys.executable, script], stdout=pipe, stderr=pipe, text=True) as parent:
        assert parent.stdout is not None
        assert parent.stderr is not None
        worker = Path("/proc") / parent.stdout.readline().strip()
        assert worker.exists()
        parent.send_signal(number)
        code = parent.wait(30)
        assert code == (-9 if number == signal.SIGKILL else 130)
        assert parent.stderr.read() == ("" if number == signal.SIGKILL else "interrupted\n")
    end = time.monotonic() + 20.0
    while is_running(worker):
        assert time.monotonic() < end, "the worker lives on"
        time.sleep(0.05)
