"""Which units there are, what tells them apart, and what they share."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from robo_manip_baselines.benchmark import work_item as unit_module
from robo_manip_baselines.benchmark.conditions import ARMS, ArmLine, read_arms
from robo_manip_baselines.benchmark.forecasts import write_library
from robo_manip_baselines.benchmark.plan import Plan, make_plan
from robo_manip_baselines.benchmark.presets import PRESETS, Preset
from robo_manip_baselines.benchmark.work_item import Unit
from robo_manip_baselines.observation.error_stats import DEFAULT_STATS
from robo_manip_baselines.rollout.results import EpisodeResult
from robo_manip_baselines.runs.errors import RequestError

PRESET = Preset("cpu", (), demonstrations=4, demonstration_block=2, num_episodes=6, episode_block=3)
CURRENT = ArmLine("current", obs="current")
AHEAD = ArmLine("current_pred_h2")


def plan(*arms: ArmLine, preset: Preset = PRESET, **files: Path) -> Plan:
    return make_plan("FeedingEnv", arms or (CURRENT, AHEAD), preset, **files)


def keys(made: Plan, kind: str) -> list[str]:
    return [unit.key for unit in made.units() if unit.kind == kind]


def option(unit: Unit, name: str) -> str:
    args = unit.settings["args"]
    return args[args.index(name) + 1]


def test_arms_share_demonstrations_and_nothing_else() -> None:
    other = ArmLine("aim", expert="anticipatory")
    frozen = ArmLine("frozen", prediction="persistence")
    made = plan(CURRENT, AHEAD, other, frozen)
    needs = {run.arm.name: [need.name for need in run.training.needs] for run in made.runs}
    assert needs["current"] == needs["current_pred_h2"] == ["reactive_000000", "reactive_000002"]
    assert needs["aim"] == ["anticipatory_000000", "anticipatory_000002"]
    assert needs["frozen"] == ["reactive_persistence_000000", "reactive_persistence_000002"]
    assert len(keys(made, "demonstrations")) == 6
    assert len(keys(made, "training")) == 4
    assert len(keys(made, "evaluation")) == 8


def test_two_arms_that_are_the_same_but_for_the_name_are_trained_twice() -> None:
    made = plan(AHEAD, replace(AHEAD, name="again"))
    first, second = (unit for unit in made.units() if unit.kind == "training")
    assert first.folder != second.folder


@settings(max_examples=30)
@given(st.integers(1, 40), st.integers(1, 12), st.integers(1, 30), st.integers(1, 9))
def test_every_seed_is_there_once(
    demonstrations: int, block: int, episodes: int, episode_block: int
) -> None:
    size = Preset("cpu", (), demonstrations, block, episodes, episode_block)
    made = plan(CURRENT, preset=size)
    for kind, first, count in (
        ("demonstrations", 0, demonstrations),
        ("evaluation", 1000, episodes),
    ):
        seeds: list[int] = []
        for unit in (u for u in made.units() if u.kind == kind):
            start = int(option(unit, "--seed"))
            seeds += range(start, start + int(option(unit, "--num_episodes")))
        assert seeds == list(range(first, first + count))


def test_whatever_changes_the_outcome_changes_the_key(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    base = plan(AHEAD)
    stats, library = tmp_path / "e.json", tmp_path / "l.npz"
    stats.write_bytes(DEFAULT_STATS.read_bytes() + b"\n")
    write_library(library, None, "persistence")
    other = tmp_path / "other" / "e.json"
    other.parent.mkdir()
    other.write_bytes(DEFAULT_STATS.read_bytes() + b"\n\n")
    changed = {
        "arm": plan(replace(AHEAD, horizon=3, name="b")),
        "error": plan(replace(AHEAD, error="uniform", name="b")),
        "stats": plan(replace(AHEAD, error="uniform", name="b"), error_stats=stats),
        "other stats": plan(replace(AHEAD, error="uniform", name="b"), error_stats=other),
        "expert": plan(replace(AHEAD, expert="anticipatory", name="b")),
        "forecast": plan(replace(AHEAD, prediction="persistence", name="b")),
        "library": plan(AHEAD, library=library),
        "policy": plan(replace(AHEAD, policy="Mlp", name="b")),
        "size": plan(AHEAD, preset=replace(PRESET, demonstrations=5)),
        "budget": plan(AHEAD, preset=replace(PRESET, train_args=("--steps", "7"))),
        "threads": plan(AHEAD, preset=replace(PRESET, threads=2)),
    }
    trainings = [keys(made, "training")[0] for made in (base, *changed.values())]
    assert len(set(trainings)) == len(trainings)
    monkeypatch.setattr(unit_module, "version", lambda name: "9.9")
    unit_module.versions.cache_clear()
    later = keys(plan(AHEAD), "training")[0]
    unit_module.versions.cache_clear()
    assert later not in trainings


def test_an_arm_without_drawn_errors_does_without_their_statistics(tmp_path: Path) -> None:
    stats = tmp_path / "e.json"
    stats.write_bytes(DEFAULT_STATS.read_bytes())
    assert keys(plan(AHEAD, error_stats=stats), "training") == keys(plan(AHEAD), "training")


def test_more_episodes_keep_those_that_there_are() -> None:
    few, many = (
        keys(plan(), "evaluation"),
        keys(plan(preset=replace(PRESET, num_episodes=9, train_seeds=2)), "evaluation"),
    )
    assert set(few) < set(many)
    assert len(many) == 2 * 2 * 3


@pytest.mark.parametrize("parts", [1, 2, 3, 5])
def test_shards_have_every_run_once_and_what_it_needs(parts: int) -> None:
    arms = [replace(AHEAD, name=f"arm{n}") for n in range(4)]
    made = plan(*arms, replace(AHEAD, name="b", expert="anticipatory"))
    shards = [made.units((number, parts)) for number in range(1, parts + 1)]
    for shard in shards:
        done: set[str] = set()
        for unit in shard:
            assert {need.key for need in unit.needs} <= done
            done.add(unit.key)
    for kind in ("training", "evaluation"):
        found = [u.key for shard in shards for u in shard if u.kind == kind]
        assert sorted(found) == sorted(keys(made, kind))


def test_an_arm_that_shows_a_predictor_needs_predictions(tmp_path: Path) -> None:
    library, bare = tmp_path / "l.npz", tmp_path / "bare.npz"
    write_library(library, None, "persistence")
    arm = ArmLine("m", error="model")
    assert plan(arm, library=library).runs
    _without_prediction(library, bare)
    with pytest.raises(RequestError, match=r"arm 'm'.*--motion_library.*without the arm"):
        plan(arm, library=bare)


def _without_prediction(source: Path, path: Path) -> None:
    import numpy as np

    with np.load(source) as archive:
        np.savez(path, **{k: archive[k] for k in archive.files if k != "predicted_mouth"})


def test_a_policy_without_the_presets_settings_is_refused_before_anything_runs() -> None:
    with pytest.raises(RequestError, match="paper"):
        plan(replace(AHEAD, policy="Mlp", name="b"), preset=PRESETS["paper"])


def test_the_shipped_benchmarks_can_be_planned(tmp_path: Path) -> None:
    library = tmp_path / "l.npz"
    write_library(library, None, "persistence")
    _, arms = read_arms(ARMS / "feeding.yaml")
    made = plan(*arms, preset=PRESETS["cpu"], library=library)
    assert {
        kind: len(keys(made, kind)) for kind in ("demonstrations", "training", "evaluation")
    } == {"demonstrations": 8, "training": 16, "evaluation": 32}
    names = [option(u, "--motion_library") for u in made.units() if u.kind == "demonstrations"]
    assert set(names) == {"motion_library.npz", "motion_forecast.npz"}


def test_a_video_acts_one_episode_of_a_training_out() -> None:
    made = plan()
    result = EpisodeResult(
        "FeedingEnv", 1004, True, True, 4.0, 9.0, 600, "", 0.01, None, None, 0.0, "c", "p"
    )
    video = made.video(made.runs[1], result)
    assert video.needs == (made.runs[1].training,)
    assert (option(video, "--seed"), option(video, "--num_episodes")) == ("1004", "1")
