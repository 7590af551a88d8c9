"""Real demonstrations, trainings, evaluations: killed in the middle, and with files of a user."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
import time
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import pytest

from robo_manip_baselines.benchmark.aggregation import aggregate_results
from robo_manip_baselines.benchmark.conditions import ConditionConfig
from robo_manip_baselines.benchmark.plan import BenchmarkPreset, make_plan
from robo_manip_baselines.benchmark.scheduler import GridProgress, LocalExecutor, run_items
from robo_manip_baselines.benchmark.work_item import ArtifactStore
from robo_manip_baselines.envs.mujoco.face.motion import DEFAULT_LIBRARY
from robo_manip_baselines.observation import Corruption
from robo_manip_baselines.observation.error_stats import DEFAULT_STATS
from robo_manip_baselines.policy.checkpoint import read_checkpoint

pytestmark = pytest.mark.slow

# Slow enough to be killed on the way: many layers, saved often.
TRAINING = {
    **{"steps": 200, "checkpoint_every": 40, "log_every": 5, "batch_size": 4},
    **{"hidden_layers": 9, "dropout": 0.3},
}
PRESET = BenchmarkPreset(
    train_preset="cpu",
    cameras=(),
    demonstrations=2,
    demonstration_block=1,
    num_episodes=3,
    episode_block=3,
    train_settings=TRAINING,
    num_envs=1,
)
CONDITIONS = (
    ConditionConfig.from_yaml(
        {"name": "a", "policy": "Mlp", "horizon": 3, "error": "uniform", "delay": 1}
    ),
)
TIMEOUT = 300.0  # seconds; hangs fail, slow machines do not


def do(out: Path, workers: int) -> None:
    plan, store = make_plan("FeedingEnv", CONDITIONS, PRESET), ArtifactStore(out / "items")
    items = plan.items()
    with closing(LocalExecutor(store, workers)) as executor:
        run_items(items, store, executor, GridProgress(items, workers, bar=False))
    aggregate_results(plan, store, out)


DRIVER = """
import sys
from pathlib import Path
sys.path.insert(0, {tests!r})
from test_real_items import do
do(Path({out!r}), 2)
"""


def test_it_comes_to_the_same_as_without(tmp_path: Path) -> None:
    whole, killed = tmp_path / "whole", tmp_path / "killed"
    do(whole, 1)
    program = DRIVER.format(tests=str(Path(__file__).parent), out=str(killed))
    for pattern, lines in (
        ("items/training/*/out/metrics.jsonl", 15),
        ("items/evaluation/*/out/results.jsonl", 1),
    ):
        driver = subprocess.Popen([sys.executable, "-c", program])
        end = time.monotonic() + TIMEOUT
        while not any(p.read_text().count("\n") >= lines for p in killed.glob(pattern)):
            assert driver.poll() is None, "it ended before it could be killed"
            assert time.monotonic() < end
            time.sleep(0.02)
        driver.kill()
        driver.wait()
        time.sleep(1.0)  # the workers notice, and end
        assert not list(killed.glob(f"{Path(pattern).parents[1]}/item.json"))
    do(killed, 2)
    assert (killed / "results.jsonl").read_bytes() == (whole / "results.jsonl").read_bytes()
    (log,) = killed.glob("items/training/*/log.txt")
    _, killed_run, resumed_run = log.read_text().split("run folder: out")
    assert "resumed" not in killed_run
    step = re.search(r"resumed at step (\d+)", resumed_run)
    assert step
    assert int(step[1]) >= TRAINING["checkpoint_every"]


def test_files_from_outside_and_forecasts_reach_the_policy(tmp_path: Path) -> None:
    stats, library = tmp_path / "my stats.json", tmp_path / "mine.npz"
    stats.write_bytes(DEFAULT_STATS.read_bytes())
    shutil.copy(DEFAULT_LIBRARY, library)
    size = replace(
        PRESET, num_episodes=1, episode_block=1, train_settings={"steps": 3, "batch_size": 4}
    )
    conditions = (
        ConditionConfig.from_yaml({"name": "erring", "policy": "Mlp", "error": "gaussian"}),
        ConditionConfig.from_yaml({"name": "shuffled", "policy": "Mlp", "prediction": "shuffled"}),
    )
    plan = make_plan("FeedingEnv", conditions, size, library=library, error_stats=stats)
    store, items = ArtifactStore(tmp_path / "items"), plan.items()
    with closing(LocalExecutor(store, 2)) as executor:
        run_items(items, store, executor, GridProgress(items, 2, bar=False))
    statistics = aggregate_results(plan, store, tmp_path)
    assert [c.condition.name for c in statistics.conditions] == ["erring", "shuffled"]
    erring, shuffled = (read_checkpoint(store.folder(run.training) / "out") for run in plan.runs)
    assert erring.spec.corruption
    assert erring.spec.corruption.error_stats == "error_stats.json"
    assert erring.dataset["env_kwargs"]["motion_library"] == "motion_library.npz"
    assert shuffled.spec.corruption == Corruption(prediction="shuffled")
    assert shuffled.dataset == erring.dataset
    left = {path.name for item in items for path in store.folder(item).iterdir()}
    assert left == {"out", "item.json", "log.txt", ".lock"}
