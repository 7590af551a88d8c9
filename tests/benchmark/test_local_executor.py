"""Items in processes, with the stub's work: same bytes however many, stopped wherever."""

from __future__ import annotations

import fcntl
import os
import random
import re
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest

from robo_manip_baselines.benchmark import worker
from robo_manip_baselines.benchmark.plan import Plan
from robo_manip_baselines.benchmark.scheduler import (
    GridProgress,
    ItemsFailedError,
    LocalExecutor,
    WorkResult,
    run_items,
)
from robo_manip_baselines.benchmark.work_item import ArtifactStore, write_manifest

from .conftest import contents, do

pytestmark = pytest.mark.long

TIMEOUT = 60.0  # seconds; hangs fail, slow machines do not


@pytest.mark.slow
def test_two_workers_in_another_order_come_to_the_same_bytes(
    stub_plan: Plan, reference: dict[str, bytes], tmp_path: Path
) -> None:
    items = list(stub_plan.items())
    random.Random(1).shuffle(items)
    items.sort(key=lambda item: ("demonstrations", "training", "evaluation").index(item.kind))
    do(stub_plan, tmp_path / "two", 2, items)
    assert contents(tmp_path / "two") == reference
    lines = reference["results.jsonl"].decode().splitlines()
    assert len(lines) == 3 * 6
    assert {"report.html", "versions.json", "configs.json", "tables/success.md"} <= set(reference)
    assert "Prediction, late" in reference["tables/success.md"].decode()


def test_items_leave_nothing_but_what_they_made(stub_plan: Plan, reference_folder: Path) -> None:
    store = ArtifactStore(reference_folder / "items")
    training = stub_plan.runs[0].training
    names = {path.name for path in store.folder(training).iterdir()}
    assert names == {"out", "item.json", "log.txt", ".lock"}
    assert set(store.outputs(training)) == {"state.json"}
    assert oct(store.outputs(training)["state.json"].stat().st_mode & 0o444) == oct(0o444)


DRIVER = """
import sys
from pathlib import Path
from robo_manip_baselines.benchmark import plan as plan_module
plan_module._FUNCTIONS = "stub_work"
sys.path.insert(0, {tests!r})
from conftest import CONDITIONS, PRESET, do
do(plan_module.make_plan("FeedingEnv", CONDITIONS, PRESET), Path({out!r}), 2)
"""


def start_driver(out: Path) -> subprocess.Popen[bytes]:
    program = DRIVER.format(tests=str(Path(__file__).parent), out=str(out))
    environment = {**os.environ, "STUB_PAUSE": "0.2"}
    return subprocess.Popen(
        [sys.executable, "-c", program], env=environment, start_new_session=True
    )


def wait_for(pattern: str, out: Path, driver: subprocess.Popen[bytes], holds: str) -> Path:
    end = time.monotonic() + TIMEOUT
    while True:
        for path in out.glob(pattern):
            if holds in path.read_text() and not (path.parents[1] / "item.json").exists():
                return path
        assert driver.poll() is None, "it ended before it could be killed"
        assert time.monotonic() < end
        time.sleep(0.02)


@pytest.mark.slow
def test_killed_in_a_training_and_in_an_evaluation_it_comes_to_the_same(
    stub_plan: Plan, reference: dict[str, bytes], tmp_path: Path
) -> None:
    out = tmp_path / "killed"
    for pattern, holds in (
        ("items/training/*/out/state.json", ", 3]"),
        ("items/evaluation/*/out/results.jsonl", "\n"),
    ):
        driver = start_driver(out)
        begun = wait_for(pattern, out, driver, holds)
        driver.send_signal(signal.SIGKILL)
        driver.wait()
        kept = begun.read_text()
    do(stub_plan, out, 2)  # kept: an evaluation of which only some lines were there
    assert contents(out) == reference
    assert begun.read_text().startswith(kept)
    logs = [path.read_text() for path in out.glob("items/training/*/log.txt")]
    assert sum("goes on at" in log for log in logs) >= 1


def test_workers_end_with_whoever_started_them(stub_plan: Plan, tmp_path: Path) -> None:
    out = tmp_path / "orphans"
    driver = start_driver(out)
    state = wait_for("items/training/*/out/state.json", out, driver, ", 2]")
    driver.kill()
    driver.wait()
    end = time.monotonic() + TIMEOUT
    before = None
    while before != (before := state.read_text()):
        assert time.monotonic() < end
        time.sleep(0.5)  # more than two steps
    assert not before.endswith(", 10]")


def test_the_last_words_of_a_unit_that_fails_are_passed_on(
    stub_plan: Plan,
    tmp_path: Path,
    caplog: pytest.LogCaptureFixture,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("STUB_FAIL", "delay")
    items = stub_plan.items()
    store = ArtifactStore(tmp_path)
    executor = LocalExecutor(store, 2)
    with pytest.raises(ItemsFailedError, match=r"1 work items failed.*training late_seed0"):
        run_items(items, store, executor, GridProgress(items, 2, bar=False))
    assert re.search(r"RuntimeError: the stub fails; .*\(all of it: ", caplog.text)
    missing = {item.name for item in items if not store.is_done(item)}
    assert missing == {"late_seed0", "late_seed0_001000", "late_seed0_001003"}


@pytest.mark.parametrize(
    ("code", "log", "words"),
    [
        (1, "step 3\nerror: no room\n\n", "no room"),
        (1, "", "exit code 1"),
        (-9, "device: cpu\n", "killed by signal 9, perhaps for lack of memory"),
    ],
)
def test_a_worker_that_was_killed_has_no_last_words(code: int, log: str, words: str) -> None:
    assert worker.failure(code, log).startswith(words)


@pytest.mark.parametrize(
    ("other", "words"),
    [
        ({"versions": {"mujoco": "1.2.3"}}, "here and 1.2.3 where the benchmark was started"),
        ({"source": "ab" * 32}, "are not those with which the benchmark was started"),
    ],
)
def test_other_software_is_refused(
    stub_plan: Plan,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    other: dict[str, Any],
    words: str,
) -> None:
    store = ArtifactStore(tmp_path)
    item = stub_plan.items()[0]
    request = {**item.to_json(), **other}
    monkeypatch.setitem(item.__dict__, "to_json", lambda: request)
    executor = LocalExecutor(store, 1)
    executor.start(item)
    (ended,) = wait(executor)
    assert ended.code == 2
    assert words in ended.problem


def test_a_unit_that_another_process_does_is_waited_for(stub_plan: Plan, tmp_path: Path) -> None:
    store, item = ArtifactStore(tmp_path), stub_plan.items()[0]
    folder = store.prepare(item)
    executor = LocalExecutor(store, 1)
    with (folder / ".lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        executor.start(item)
        time.sleep(3.0)  # long enough to do it, if it did not wait
        assert not (folder / "out").exists()
        write_manifest(folder, item.to_json(), [], 1.0)
    assert wait(executor) == [WorkResult(item)]
    assert not (folder / "out").exists()  # found done


def test_a_scratch_folder_goes_with_whoever_started_the_unit(
    stub_plan: Plan, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("STUB_PAUSE", "100")
    folder = tmp_path / "scratch"
    (folder / "demonstrations").mkdir(parents=True)
    process = worker.start_worker(stub_plan.runs[0].training.to_json(), folder, is_scratch=True)
    end = time.monotonic() + TIMEOUT
    while not (folder / "out" / "state.json").exists():
        assert time.monotonic() < end
        time.sleep(0.05)
    assert process.stdin
    process.stdin.close()
    assert process.wait(TIMEOUT) == -signal.SIGKILL
    assert not folder.exists()


def test_a_worker_that_is_never_told_what_to_do_ends_and_cleans_up(tmp_path: Path) -> None:
    process = subprocess.Popen(
        [sys.executable, "-m", worker.__name__, worker.SCRATCH],
        cwd=tmp_path,
        stdin=subprocess.DEVNULL,
    )
    assert process.wait(TIMEOUT) == -signal.SIGKILL
    assert not tmp_path.exists()


def test_ctrl_c_ends_everything_and_the_rest_is_done_later(
    stub_plan: Plan, reference: dict[str, bytes], tmp_path: Path
) -> None:
    driver = start_driver(tmp_path)
    state = wait_for("items/training/*/out/state.json", tmp_path, driver, ", 2]")
    os.killpg(driver.pid, signal.SIGINT)  # a terminal sends it to all of them
    assert driver.wait(TIMEOUT) != 0
    kept = state.read_text()
    do(stub_plan, tmp_path, 2)
    assert contents(tmp_path) == reference
    log = (state.parents[1] / "log.txt").read_text()
    assert f"goes on at {kept.rpartition(', ')[2].rstrip(']')}" in log


def wait(executor: LocalExecutor) -> list[WorkResult]:
    while not (ended := list(executor.wait())):
        pass
    return ended
