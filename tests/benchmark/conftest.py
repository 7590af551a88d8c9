"""A benchmark whose items cost nothing: work of a stub module that processes can import."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import closing
from pathlib import Path

import pytest

from robo_manip_baselines.benchmark import plan as plan_module
from robo_manip_baselines.benchmark.aggregation import aggregate_results, write_aggregation
from robo_manip_baselines.benchmark.conditions import ConditionConfig
from robo_manip_baselines.benchmark.plan import BenchmarkPreset, Plan, make_plan
from robo_manip_baselines.benchmark.scheduler import GridProgress, LocalExecutor, run_items
from robo_manip_baselines.benchmark.work_item import ArtifactStore, WorkItem

STUB = '''
"""Work that is done in an instant, or in as many steps as a test wants to look at."""

import hashlib
import json
import os
import time
from pathlib import Path

OUT = Path("out")
PAUSE = float(os.environ.get("STUB_PAUSE", "0"))


def digest(*parts):
    return hashlib.sha256("|".join(map(str, parts)).encode()).hexdigest()


def run_demonstrations(settings):
    OUT.mkdir(exist_ok=True)
    config = settings["config"]
    for seed in range(*config["seeds"]):
        text = digest(config["expert"], seed)
        (OUT / f"episode_{seed:06d}.hdf5").write_text(text)


def run_training(settings):
    """Ten steps, each saved: who goes on must not begin again."""
    shown = [path.read_text() for path in sorted(Path("demonstrations").glob("*.hdf5"))]
    state, step = digest(*shown, json.dumps(settings["config"])), 0
    saved = OUT / "state.json"
    OUT.mkdir(exist_ok=True)
    if saved.exists():
        state, step = json.loads(saved.read_text())
        print(f"goes on at {step}", flush=True)
    while step < 10:
        state, step = digest(state), step + 1
        temporary = OUT / ".state.partial"
        temporary.write_text(json.dumps([state, step]))
        temporary.replace(saved)
        time.sleep(PAUSE)
    if settings["config"].get(os.environ.get("STUB_FAIL")):
        raise RuntimeError("the stub fails")


def run_evaluation(settings):
    """A line for each seed; those that are there already are not done again."""
    from robo_manip_baselines.rollout.results import EpisodeResult

    state, _ = json.loads(Path("run/state.json").read_text())
    OUT.mkdir(exist_ok=True)
    path = OUT / "results.jsonl"
    done = path.read_text().count("\\n") if path.exists() else 0
    first, end = settings["config"]["seeds"]
    with path.open("a") as file:
        for seed in range(first + done, end):
            chance = int(digest(state, seed)[:8], 16)
            ok = chance % 3 > 0
            result = EpisodeResult(
                env="FeedingEnv", seed=seed, is_success=ok, is_success_strict=chance % 5 == 0,
                completion_time=4.0 + chance % 100 / 50 if ok else None, steps=600,
                failure="" if ok else "missed_low", motion_clip="clip", motion_subject="person",
                columns=dict(
                    time_since_lift=9.0, closest_distance=0.02, cube_offset=None, face_force=1.0,
                    closest_offset=(0.01, 0.002, -0.004),
                ),
                policy="Act", condition="stub", train_seed=0, checkpoint=state,
                versions={"stub": "1"},
            )
            file.write(result.to_line() + "\\n")
            file.flush()
            time.sleep(PAUSE)
'''

CONDITIONS = tuple(
    map(
        ConditionConfig.from_yaml,
        (
            {"name": "current", "obs": "current"},
            {"name": "late", "delay": 3, "title": "Prediction, late"},
            {"name": "ahead", "expert": "anticipatory"},
        ),
    )
)

PRESET = BenchmarkPreset(
    train_preset="cpu",
    cameras=(),
    demonstrations=4,
    demonstration_block=2,
    num_episodes=6,
    episode_block=3,
    has_videos=False,
)


@pytest.fixture(scope="module")
def stub(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """Let items do the stub's work, here and in processes that are started from here."""
    folder = tmp_path_factory.mktemp("stub")
    (folder / "stub_work.py").write_text(STUB)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PYTHONPATH", str(folder))
        patch.setattr(plan_module, "_FUNCTIONS", "stub_work")
        yield folder


@pytest.fixture(scope="module")
def stub_plan(stub: Path) -> Plan:
    """Three conditions, a training each, six episodes."""
    return make_plan("FeedingEnv", CONDITIONS, PRESET)


def do(plan: Plan, out: Path, workers: int, items: Sequence[WorkItem] | None = None) -> None:
    """Do a plan in processes and write what it comes to."""
    store = ArtifactStore(out / "items")
    todo = plan.items() if items is None else items
    with closing(LocalExecutor(store, workers)) as executor:
        run_items(todo, store, executor, GridProgress(todo, workers, bar=False))
    statistics = aggregate_results(plan, store, out)
    write_aggregation(plan, store, statistics, out, {}, "the command")


def contents(out: Path) -> dict[str, bytes]:
    """Read everything that a benchmark came to."""
    files = [p for p in out.rglob("*") if p.is_file() and "items" not in p.relative_to(out).parts]
    return {p.relative_to(out).as_posix(): p.read_bytes() for p in files}


@pytest.fixture(scope="module")
def reference_folder(stub_plan: Plan, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Output folder of a run with one worker."""
    out = tmp_path_factory.mktemp("reference")
    do(stub_plan, out, 1)
    return out


@pytest.fixture(scope="module")
def reference(reference_folder: Path) -> dict[str, bytes]:
    """Contents of `reference_folder`."""
    return contents(reference_folder)
