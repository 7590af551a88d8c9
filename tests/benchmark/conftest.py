"""A benchmark whose units cost nothing: work of a stub module that processes can import."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import closing
from pathlib import Path

import pytest

from robo_manip_baselines.benchmark import plan as plan_module
from robo_manip_baselines.benchmark.aggregation import write_outcome, write_results
from robo_manip_baselines.benchmark.conditions import ArmLine
from robo_manip_baselines.benchmark.local import LocalExecutor
from robo_manip_baselines.benchmark.plan import Plan, make_plan
from robo_manip_baselines.benchmark.presets import Preset
from robo_manip_baselines.benchmark.scheduler import Progress, run_units
from robo_manip_baselines.benchmark.work_item import Store, Unit

STUB = '''
"""Work that is done in an instant, or in as many steps as a test wants to look at."""

import hashlib
import json
import os
import time
from pathlib import Path

OUT = Path("out")
PAUSE = float(os.environ.get("STUB_PAUSE", "0"))


def option(settings, name):
    args = settings["args"]
    return args[args.index(name) + 1]


def digest(*parts):
    return hashlib.sha256("|".join(map(str, parts)).encode()).hexdigest()


def demonstrate(settings):
    OUT.mkdir(exist_ok=True)
    first = int(option(settings, "--seed"))
    for seed in range(first, first + int(option(settings, "--num_episodes"))):
        text = digest(option(settings, "--expert"), seed)
        (OUT / f"episode_{seed:06d}.hdf5").write_text(text)


def train(settings):
    """Ten steps, each saved: who goes on must not begin again."""
    shown = [path.read_text() for path in sorted(Path("demonstrations").glob("*.hdf5"))]
    state, step = digest(*shown, *settings["args"]), 0
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
    if os.environ.get("STUB_FAIL") in settings["args"]:
        raise RuntimeError("the stub fails")


def evaluate(settings):
    """A line for each seed; those that are there already are not done again."""
    from robo_manip_baselines.rollout.results import EpisodeResult

    state, _ = json.loads(Path("run/state.json").read_text())
    OUT.mkdir(exist_ok=True)
    path = OUT / "results.jsonl"
    done = path.read_text().count("\\n") if path.exists() else 0
    first, count = (int(option(settings, name)) for name in ("--seed", "--num_episodes"))
    with path.open("a") as file:
        for seed in range(first + done, first + count):
            chance = int(digest(state, seed)[:8], 16)
            ok = chance % 3 > 0
            result = EpisodeResult(
                env="FeedingEnv", seed=seed, is_success=ok, is_success_strict=chance % 5 == 0,
                completion_time=4.0 + chance % 100 / 50 if ok else None, time_since_lift=9.0,
                steps=600, failure="" if ok else "missed_low", closest_distance=0.02,
                closest_offset=(0.01, 0.002, -0.004), cube_offset=None, face_force=1.0,
                motion_clip="clip", motion_subject="person", policy="Act", arm="stub",
                train_seed=0, checkpoint=state, versions={"stub": "1"},
            )
            file.write(result.to_line() + "\\n")
            file.flush()
            time.sleep(PAUSE)
'''

ARMS = (
    ArmLine("current", obs="current"),
    ArmLine("late", delay=3, title="Prediction, late"),
    ArmLine("ahead", expert="anticipatory"),
)

PRESET = Preset(
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
    """Let units do the stub's work, here and in processes that are started from here."""
    folder = tmp_path_factory.mktemp("stub")
    (folder / "stub_work.py").write_text(STUB)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PYTHONPATH", str(folder))
        patch.setattr(plan_module, "_WORK", "stub_work")
        yield folder


@pytest.fixture(scope="module")
def stub_plan(stub: Path) -> Plan:
    """Four arms, a training each, six episodes."""
    return make_plan("FeedingEnv", ARMS, PRESET)


def do(plan: Plan, out: Path, workers: int, units: Sequence[Unit] | None = None) -> None:
    """Do a plan in processes and write what it comes to."""
    store = Store(out / "units")
    todo = plan.units() if units is None else units
    with closing(LocalExecutor(store, workers)) as executor:
        run_units(todo, store, executor, Progress(todo, workers, bar=False))
    study = write_results(plan, store, out)
    write_outcome(plan, store, study, out, {}, "the command")


def outcome(out: Path) -> dict[str, bytes]:
    """Read everything that a benchmark came to."""
    files = [p for p in out.rglob("*") if p.is_file() and "units" not in p.relative_to(out).parts]
    return {p.relative_to(out).as_posix(): p.read_bytes() for p in files}


@pytest.fixture(scope="module")
def reference_folder(stub_plan: Plan, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What one worker leaves."""
    out = tmp_path_factory.mktemp("reference")
    do(stub_plan, out, 1)
    return out


@pytest.fixture(scope="module")
def reference(reference_folder: Path) -> dict[str, bytes]:
    """What one worker comes to."""
    return outcome(reference_folder)
