"""Whose a run folder is, and what is kept in it."""

from __future__ import annotations

import multiprocessing
from pathlib import Path

import pytest

from robo_manip_baselines.runs.checkpoints import list_checkpoints, step_folder
from robo_manip_baselines.runs.errors import RequestError
from robo_manip_baselines.training.run_folder import (
    locked,
    prune,
    read_config,
    require_same_config,
    start_anew,
    write_config,
)


def test_config_reads_back(tmp_path: Path) -> None:
    config = {"steps": 5, "cameras": ["top"], "out": None, "name": "ü: x", "rate": 1e-5}
    write_config(tmp_path, config)
    assert read_config(tmp_path / "config.yaml") == config


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"seed": 1, "steps": 6, "device": "cpu"}, "with steps 5, not 6"),
        ({"seed": 2, "steps": 6, "device": "cpu"}, "with seed 1, not 2"),
        ({"seed": 1, "steps": 5, "new": 3}, "with new None, not 3"),
        ({"seed": 1}, "with steps 5, not None"),
    ],
)
def test_the_first_difference_is_named(tmp_path: Path, given: dict, message: str) -> None:
    write_config(tmp_path, {"seed": 1, "steps": 5, "device": "cuda"})
    with pytest.raises(RequestError, match=message):
        require_same_config(tmp_path, given, frozenset({"device"}))


def test_what_may_differ(tmp_path: Path) -> None:
    write_config(tmp_path, {"seed": 1, "device": "cuda"})
    require_same_config(tmp_path, {"seed": 1, "device": "cpu"}, frozenset({"device"}))


def test_two_newest_checkpoints_are_kept(tmp_path: Path) -> None:
    for step in (5, 100, 20, 7):
        step_folder(tmp_path, step).mkdir(parents=True)
    prune(tmp_path)
    assert [step for step, _ in list_checkpoints(tmp_path)] == [20, 100]
    assert len(list((tmp_path / "checkpoints").iterdir())) == 2


def test_starting_anew_removes_what_a_killed_run_left(tmp_path: Path) -> None:
    (tmp_path / "tensorboard").mkdir()
    (tmp_path / "metrics.jsonl").write_text("{}\n")
    start_anew(tmp_path)
    assert not (tmp_path / "tensorboard").exists()
    assert not (tmp_path / "metrics.jsonl").exists()


def try_to_lock(run: str, answer: multiprocessing.SimpleQueue) -> None:
    try:
        with locked(Path(run)):
            answer.put("locked")
    except RequestError as error:
        answer.put(str(error))


@pytest.mark.long
def test_two_processes_do_not_write_to_one_folder(tmp_path: Path) -> None:
    context = multiprocessing.get_context("spawn")
    answer = context.SimpleQueue()
    answers = []
    with locked(tmp_path):
        process = context.Process(target=try_to_lock, args=(str(tmp_path), answer))
        process.start()
        answers.append(answer.get())
        process.join()
    try_to_lock(str(tmp_path), answer)
    answers.append(answer.get())
    assert "being written by another training process; choose another --out" in answers[0]
    assert answers[1] == "locked"


def test_a_file_in_the_way_is_one_line(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(RequestError, match="cannot write to"), locked(tmp_path / "file"):
        pass
