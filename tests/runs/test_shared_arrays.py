"""Arrays that processes hold together."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
import pytest

from robo_manip_baselines.runs.shared_arrays import Bytes, shared_array

SHAPE = (4, 3)

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="needs /proc")

HOLDER = """
import sys, time
import numpy as np
from robo_manip_baselines.runs.shared_arrays import shared_array
def fill(array):
    print("filling", flush=True)
    time.sleep(float(sys.argv[1]))
    array[:] = 7
held = shared_array("key", (4, 3), fill, 100)
print(int(held.array.sum()), flush=True)
sys.stdin.read()
"""


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    monkeypatch.setattr(tempfile, "tempdir", None)
    return tmp_path


def hold(delay: float = 0.0) -> subprocess.Popen[str]:
    command = [sys.executable, "-c", HOLDER, str(delay)]
    pipe = subprocess.PIPE
    return subprocess.Popen(command, stdin=pipe, stdout=pipe, text=True, env={**os.environ})


def line(process: subprocess.Popen[str]) -> str:
    assert process.stdout
    return process.stdout.readline().strip()


def end(process: subprocess.Popen[str], *, kill: bool = False) -> None:
    if kill:
        process.send_signal(signal.SIGKILL)
    process.communicate()


def fill(array: Bytes) -> None:
    array[:] = 9


def never(array: Bytes) -> None:
    raise AssertionError("another process has it")


def test_one_process_fills_and_the_other_waits() -> None:
    first, second = hold(0.5), None
    try:
        assert line(first) == "filling"
        second = hold()
        assert line(first) == line(second) == str(7 * 12)
    finally:
        end(first)
        if second:
            end(second)


@pytest.mark.parametrize("kill", [False, True])
def test_the_memory_lives_as_long_as_anybody_holds_it(kill: bool) -> None:
    process = hold()
    assert [line(process), line(process)] == ["filling", str(7 * 12)]
    # It counts towards no budget of those who find it.
    held = shared_array("key", SHAPE, never, 0)
    assert held is not None
    end(process, kill=kill)
    np.testing.assert_array_equal(held.array, np.full(SHAPE, 7, np.uint8))
    again = shared_array("key", SHAPE, never, 0)
    assert again is not None
    with pytest.raises(ValueError, match="read-only"):
        again.array[0] = 1
    held.close()
    again.close()
    again.close()
    new = shared_array("key", SHAPE, fill, 100)
    assert new is not None
    assert (new.array == 9).all()
    assert (again.array == 7).all()
    new.close()


def test_a_process_killed_while_it_fills_holds_nothing() -> None:
    process = hold(60.0)
    assert line(process) == "filling"
    end(process, kill=True)
    held = shared_array("key", SHAPE, fill, 100)
    assert held is not None
    assert (held.array == 9).all()
    held.close()


def test_what_is_too_large_is_not_made() -> None:
    assert shared_array("key", SHAPE, never, 11) is None
    assert shared_array("key", (0, 3), never, 11) is None


def test_a_number_that_is_used_again_is_another_file(folder: Path) -> None:
    first = shared_array("key", SHAPE, fill, 100)
    assert first is not None
    descriptor = first._descriptor
    first.close()
    other = os.memfd_create("another")
    os.ftruncate(other, 12)
    try:
        assert other == descriptor
        filled: list[int] = []
        again = shared_array("key", SHAPE, lambda array: filled.append(1), 100)
        assert again is not None
        assert filled
        again.close()
    finally:
        os.close(other)


def test_a_folder_that_others_can_read_is_not_used(folder: Path) -> None:
    (folder / f"robo_manip_baselines-{os.getuid()}").mkdir(mode=0o755)
    assert shared_array("key", SHAPE, never, 100) is None


def test_an_error_while_filling_leaves_nothing() -> None:
    def fail(array: Bytes) -> None:
        raise OSError("damaged")

    with pytest.raises(OSError, match="damaged"):
        shared_array("key", SHAPE, fail, 100)
    held = shared_array("key", SHAPE, fill, 100)
    assert held is not None
    held.close()
