"""``bin/Dataset.py`` as a user runs it."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from robo_manip_baselines.commands.dataset import dataset_info
from robo_manip_baselines.data import episode_path, write_episode
from robo_manip_baselines.data.example import make_arrays, make_attributes, make_images

SCRIPT = Path(__file__).parents[2] / "bin" / "Dataset.py"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for seed in range(4):
        attributes = make_attributes(seed) | {
            "is_success": seed != 2,
            "is_success_strict": seed == 0,
            "completion_time": float("nan") if seed == 2 else 3.0 + seed,
            "motion_subject": f"person {seed % 2}",
            "motion_clip": f"clip {seed % 3}",
        }
        path, steps = episode_path(tmp_path, seed, seed != 2), 10 + seed
        write_episode(path, make_arrays(steps, seed), make_images(steps), attributes)
    return tmp_path


def dataset(*args: object) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, str(SCRIPT), *map(str, args)]
    return subprocess.run(command, capture_output=True, text=True, check=False)


def test_whole_folder(folder: Path) -> None:
    done = dataset("verify", folder)
    assert done.returncode == 0
    assert done.stdout == f"{folder}: 3 demonstrations and 1 failures, all whole\n"


def test_damage_is_one_line_a_problem_and_a_closing_count(folder: Path) -> None:
    first, second = episode_path(folder, 1, True), episode_path(folder, 2, False)
    os.truncate(first, 1000)
    second.write_text("x")
    done = dataset("verify", folder)
    assert done.returncode == 1
    lines = done.stdout.splitlines()
    assert len(lines) == 3
    assert lines[0].startswith(f"{first}: no HDF5 file, or a damaged one: ")
    assert "truncated" in lines[0]
    assert lines[1].startswith(f"{second}: no HDF5 file, or a damaged one: ")
    assert lines[2].endswith("; 2 problems in 2 files")
    assert "Traceback" not in done.stderr


def test_info_counts_what_is_there(folder: Path) -> None:
    rows = dataset_info(folder)
    assert rows["demonstrations"] == "3"
    assert rows["kept apart"] == "1 in failed/"
    assert rows["environment"] == "robo_manip_baselines/FeedingEnv-v0"
    assert rows["success"] == "3 of 4 tried, 1 by the strict condition"
    # 10, 11, 12 and 13 steps of 0.02 s; their sample deviation is 0.02 · sqrt(5 / 3).
    assert rows["duration"] == "0.23 ± 0.03 s (mean ± sd of 4; 0.20 … 0.26); 0.9 s in all"
    assert rows["completion time"] == "4.33 ± 1.53 s (mean ± sd of 3; 3.00 … 6.00)"
    assert rows["people"] == "2, in 3 clips"
    assert rows["cameras"] == "front_close, top (24x32 jpeg 90)"
    done = dataset("info", folder)
    assert done.returncode == 0
    assert all(value in done.stdout for value in rows.values())


def test_info_takes_no_mean_over_a_mixture(folder: Path) -> None:
    path = episode_path(folder, 9, True)
    write_episode(path, make_arrays(10), make_images(10), make_attributes(9) | {"expert": "other"})
    rows = dataset_info(folder)
    for name in ("duration", "completion time"):
        assert "differ in expert: " in rows[name]
        assert "±" not in rows[name]


@pytest.mark.parametrize("command", ["verify", "info"])
def test_wrong_folder_is_one_line(command: str, tmp_path: Path) -> None:
    for folder in (tmp_path, tmp_path / "none"):
        done = dataset(command, folder)
        assert done.returncode == 2
        assert done.stdout == ""
        assert done.stderr.startswith(f"error: '{folder}' ")
        assert done.stderr.count("\n") == 1


def test_info_of_a_damaged_file_names_it(folder: Path) -> None:
    path = episode_path(folder, 1, True)
    os.truncate(path, 1000)
    done = dataset("info", folder)
    assert done.returncode == 2
    assert done.stderr.startswith(f"error: '{path}' is no HDF5 file, or a damaged one: ")
    assert done.stderr.count("\n") == 1


def test_plot_draws_every_curve_of_an_episode(folder: Path, tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    out, episode = tmp_path / "curves.svg", episode_path(folder, 1, True)
    done = dataset("plot", episode, "--out", out)
    assert (done.returncode, done.stdout) == (0, f"written to '{out}'\n")
    text = out.read_text()
    for name in (
        *make_attributes(1)["action_names"],
        "gripper x",
        "mouth z",
        "FeedingEnv-v0, seed 1",
    ):
        assert name in text
    before = out.read_bytes()
    again = dataset("plot", episode, "--out", out)
    assert again.returncode == 2
    assert again.stderr == f"error: '{out}': is there already; choose another file with --out\n"
    assert out.read_bytes() == before


def test_plot_refuses_what_it_cannot_draw_or_write(folder: Path, tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    missing, episode = tmp_path / "none.hdf5", episode_path(folder, 1, True)
    for arguments, message in (
        ((missing,), f"error: '{missing}' "),
        ((".",), "error: '.' is no file"),
        ((episode, "--out", tmp_path / "a.gif"), "error: unknown --out: image of type '.gif'"),
    ):
        done = dataset("plot", *arguments)
        assert done.returncode == 2
        assert done.stderr.startswith(message)
        assert done.stderr.count("\n") == 1
    assert not (tmp_path / "a.gif").exists()
