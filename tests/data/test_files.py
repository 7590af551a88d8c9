"""Names of episode files, and runs that are killed."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from robo_manip_baselines.data import (
    episode_path,
    finished_seeds,
    list_episodes,
    remove_partial_episodes,
)
from robo_manip_baselines.data.files import seed_of
from robo_manip_baselines.data.verify import verify_dataset
from robo_manip_baselines.runs.errors import RequestError
from robo_manip_baselines.runs.files import atomic_file, prepare_folder


@pytest.mark.parametrize(
    ("seed", "success", "name"),
    [
        (0, True, "episode_000000.hdf5"),
        (12, True, "episode_000012.hdf5"),
        (12, False, "failed/episode_000012.hdf5"),
        (1234567, True, "episode_1234567.hdf5"),
    ],
)
def test_names_come_from_seeds_and_back(seed: int, success: bool, name: str) -> None:
    path = episode_path("data", seed, success)
    assert path == Path("data") / name
    assert seed_of(path) == seed


def test_negative_seed_is_refused() -> None:
    with pytest.raises(RequestError, match="0 or more, not -1"):
        episode_path("data", -1, True)


def test_listing_is_by_seed_and_skips_everything_else(tmp_path: Path) -> None:
    names = ["episode_000010.hdf5", "episode_1000000.hdf5", "episode_000002.hdf5"]
    others = [".episode_000003.hdf5.77.partial", "summary.json", "episode_3.hdf5", "preview.mp4"]
    (tmp_path / "failed").mkdir()
    for name in [*names, *others, "failed/episode_000005.hdf5"]:
        (tmp_path / name).touch()
    assert [path.name for path in list_episodes(tmp_path)] == [names[2], names[0], names[1]]
    assert finished_seeds(tmp_path) == {2, 5, 10, 1000000}
    assert finished_seeds(tmp_path / "not there") == set()
    with pytest.raises(RequestError, match=r"'.*not there' is no folder"):
        list_episodes(tmp_path / "not there")


def test_atomic_file_is_whole_or_not_there(tmp_path: Path) -> None:
    path = tmp_path / "new" / "summary.json"
    with atomic_file(path) as temporary:
        temporary.write_text("{}")
        assert temporary.parent == path.parent
        assert not path.exists()
    assert path.read_text() == "{}"
    with pytest.raises(KeyboardInterrupt), atomic_file(path) as temporary:  # noqa: PT012
        temporary.write_text("half")
        raise KeyboardInterrupt
    assert path.read_text() == "{}"
    assert [child.name for child in path.parent.iterdir()] == ["summary.json"]


def test_only_leftovers_of_dead_processes_are_removed(tmp_path: Path) -> None:
    with subprocess.Popen([sys.executable, "-c", ""]) as ended:
        ended.wait()
    dead = tmp_path / f".episode_000001.hdf5.{ended.pid}.partial"
    alive = tmp_path / f".episode_000002.hdf5.{os.getppid()}.partial"
    failed = tmp_path / "failed" / f".episode_000003.hdf5.{os.getpid()}.partial"
    other = tmp_path / ".hidden"
    failed.parent.mkdir()
    for path in (dead, alive, failed, other):
        path.touch()
    assert remove_partial_episodes(tmp_path) == [dead, failed]
    assert sorted(path for path in tmp_path.rglob("*") if path.is_file()) == [alive, other]


def test_folder_that_cannot_be_written_is_a_wrong_request(tmp_path: Path) -> None:
    assert prepare_folder(tmp_path / "a" / "b").is_dir()
    assert list((tmp_path / "a" / "b").iterdir()) == []
    (tmp_path / "file").touch()
    with pytest.raises(RequestError, match=r"cannot write to '.*file/x': Not a directory"):
        prepare_folder(tmp_path / "file" / "x")
    with pytest.raises(RequestError, match="cannot write to '/proc/x'"):
        prepare_folder("/proc/x")


_COLLECT = """
import sys
from robo_manip_baselines.data import *
from robo_manip_baselines.data.example import make_arrays, make_attributes, make_images
folder = sys.argv[1]
remove_partial_episodes(folder)
images = make_images(40)
for seed in range(int(sys.argv[2])):
    if seed not in finished_seeds(folder):
        path = episode_path(folder, seed, success=seed % 5 != 4)
        attributes = make_attributes(seed) | {"is_success": seed % 5 != 4}
        write_episode(path, make_arrays(40, seed), images, attributes)
        print("written", flush=True)
"""


def test_killed_run_leaves_whole_files_and_is_carried_on(tmp_path: Path) -> None:
    number, rng = 120, np.random.default_rng(0)
    kept: set[int] = set()
    for _ in range(4):
        command = [sys.executable, "-c", _COLLECT, str(tmp_path), str(number)]
        with subprocess.Popen(command, stdout=subprocess.PIPE) as process:
            assert process.stdout is not None
            process.stdout.readline()
            time.sleep(rng.uniform(0.01, 0.15))  # into the writing of a later one, at any moment
            process.send_signal(signal.SIGKILL)
        now = finished_seeds(tmp_path)
        assert kept <= now
        kept = now
    assert len(kept) > 0
    problems = verify_dataset(tmp_path) if list_episodes(tmp_path) else []
    assert [problem for problem in problems if not problem.is_warning] == []

    times = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*.hdf5")}
    number = max(kept) + 5
    command = [sys.executable, "-c", _COLLECT, str(tmp_path), str(number)]
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    assert finished_seeds(tmp_path) == set(range(number))
    assert verify_dataset(tmp_path) == []  # not even a leftover
    assert {path: path.stat().st_mtime_ns for path in times} == times
