"""Recording of demonstrations that is stopped, and folders that hold something else."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from robo_manip_baselines.commands.rollout import main
from robo_manip_baselines.data import list_episodes
from robo_manip_baselines.data.verify import verify_dataset
from robo_manip_baselines.runs.errors import RequestError
from robo_manip_baselines.runs.files import locked

pytestmark = pytest.mark.long

ROOT = Path(__file__).resolve().parents[2]
ARGUMENTS = ["FeedingEnv", "--scripted", "--cameras", "none", "--preview", "0"]


def children(process: int) -> list[Path]:
    """Processes, in /proc, that a process has started and that are running."""
    found = []
    for path in Path("/proc").glob("[0-9]*"):
        if (stat := status(path)) and stat[1] == str(process) and stat[0] != "Z":
            found.append(path)
    return found


def status(process: Path) -> list[str]:
    """State and parent of a process; nothing if there is none."""
    try:
        return (process / "stat").read_text().rsplit(")", 1)[1].split()[:2]
    except OSError:
        return []


@pytest.mark.skipif(sys.platform != "linux", reason="looks into /proc")
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGKILL])
def test_workers_end_with_the_command(number: signal.Signals, tmp_path: Path) -> None:
    command = [sys.executable, str(ROOT / "bin" / "Rollout.py"), *ARGUMENTS, "--out", tmp_path]
    command += ["--num_episodes", "99", "--workers", "2"]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as process:
        while not list_episodes(tmp_path):
            assert process.poll() is None
            time.sleep(0.1)
        workers = children(process.pid)
        assert len(workers) >= 2
        process.send_signal(number)
        assert process.wait(60) == (-9 if number == signal.SIGKILL else 130)
        assert process.stderr is not None
        assert "Traceback" not in process.stderr.read()
    end = time.monotonic() + 20.0
    while any(status(worker)[:1] not in ([], ["Z"]) for worker in workers):
        assert time.monotonic() < end, "a worker lives on"
        time.sleep(0.05)
    problems = verify_dataset(tmp_path)
    if number == signal.SIGKILL:  # it may have hit a write, whose temporary file is then left
        problems = [problem for problem in problems if not problem.is_warning]
    assert problems == []
    if number != signal.SIGKILL:
        assert not list(tmp_path.rglob("*.partial"))


@pytest.mark.parametrize("name", ["summary.json", "preview.mp4", "notes.txt", "failed"])
def test_files_of_others_stay(name: str, tmp_path: Path) -> None:
    (tmp_path / name).write_text("mine")
    with pytest.raises(RequestError, match="and no demonstrations; name another folder"):
        main([*ARGUMENTS, "--num_episodes", "1", "--out", str(tmp_path)])
    assert [path.name for path in tmp_path.iterdir()] == [name]
    assert (tmp_path / name).read_text() == "mine"


def test_one_folder_has_one_writer(tmp_path: Path) -> None:
    with locked(tmp_path), pytest.raises(RequestError, match="by another process"):
        main([*ARGUMENTS, "--num_episodes", "1", "--out", str(tmp_path)])
    assert os.listdir(tmp_path) == [".lock"]  # noqa: PTH208
