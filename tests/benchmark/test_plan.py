"""Work items of a plan: names, keys, and shared demonstrations."""

from __future__ import annotations

import json
import shutil
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from robo_manip_baselines.benchmark import plan as plan_module
from robo_manip_baselines.benchmark import work_item as item_module
from robo_manip_baselines.benchmark.conditions import (
    CONDITIONS,
    ConditionConfig,
    DrawnPeople,
    read_conditions,
)
from robo_manip_baselines.benchmark.plan import PRESETS, BenchmarkPreset, Plan, make_plan
from robo_manip_baselines.benchmark.work_item import ArtifactStore
from robo_manip_baselines.benchmark.worker import run_evaluation
from robo_manip_baselines.envs.mujoco.face.motion import DEFAULT_LIBRARY
from robo_manip_baselines.envs.mujoco.tasks.registry import task_entry
from robo_manip_baselines.observation.error_stats import DEFAULT_STATS
from robo_manip_baselines.policy.checkpoint import SHIPPED, read_checkpoint
from robo_manip_baselines.rollout.results import EpisodeResult, read_results
from robo_manip_baselines.runs.errors import RequestError

PRESET = BenchmarkPreset(
    "cpu", (), demonstrations=4, demonstration_block=2, num_episodes=6, episode_block=3
)
CURRENT = ConditionConfig.from_yaml({"name": "current", "obs": "current"})
AHEAD = ConditionConfig("current_pred_h2")


def changed(**values: object) -> ConditionConfig:
    """A condition that is not the paper's."""
    return ConditionConfig.from_yaml({"name": "b", **values})


def plan(*conditions: ConditionConfig, preset: BenchmarkPreset = PRESET, **given: Any) -> Plan:
    return make_plan("FeedingEnv", conditions or (CURRENT, AHEAD), preset, **given)


def keys(made: Plan, kind: str) -> list[str]:
    return [item.key for item in made.items() if item.kind == kind]


@pytest.mark.parametrize(("name", "size"), [("cpu_images", [240, 320]), ("paper", [480, 640])])
def test_the_preset_decides_the_size_of_recorded_images(name: str, size: list[int]) -> None:
    made = plan(preset=PRESETS[name])
    recorded = next(item for item in made.items() if item.kind == "demonstrations")
    assert json.loads(json.dumps(recorded.settings))["config"]["env_kwargs"]["image_size"] == size


def test_conditions_share_demonstrations_and_nothing_else() -> None:
    other = changed(name="aim", expert="anticipatory")
    frozen = changed(name="frozen", prediction="persistence")
    late = changed(name="late", prediction="kalman", delay=4, motion="sway")
    made = plan(CURRENT, AHEAD, other, frozen, late)
    needs = {run.condition.name: [need.name for need in run.training.needs] for run in made.runs}
    assert needs["current"] == needs["current_pred_h2"] == ["reactive_000000", "reactive_000002"]
    assert needs["aim"] == ["anticipatory_000000", "anticipatory_000002"]
    assert needs["frozen"] == needs["current"]  # forecasts are made when they are read
    assert needs["late"] == ["reactive_sway_000000", "reactive_sway_000002"]
    assert len(keys(made, "demonstrations")) == 6
    assert len(keys(made, "training")) == 5
    assert len(keys(made, "evaluation")) == 10


def test_a_motion_has_demonstrations_of_its_own_in_which_evaluations_act() -> None:
    swaying = changed(name="sway", motion={"name": "sway", "amplitude": 0.03})
    made = plan(AHEAD, swaying)
    plain, moved = (run.training.needs[0] for run in made.runs)
    assert "motion" not in plain.settings["config"]["env_kwargs"]
    assert moved.settings["config"]["env_kwargs"]["motion"] == "sway:amplitude=0.03"
    assert moved.name == "reactive_sway-amplitude-0.03_000000"
    # The checkpoint knows the environment of its demonstrations, and evaluations take it over.
    assert made.runs[1].evaluations[0].settings["config"]["env_kwargs"] == {}


def test_people_of_demonstrations_and_evaluation(tmp_path: Path) -> None:
    swaying = changed(name="sway", motion="sway")
    apart = make_plan(
        "FeedingEnv", (changed(name="a"), swaying), PRESET, people=DrawnPeople("train", "test")
    )
    for run in apart.runs:
        (needed, *_), (evaluation, *_) = run.training.needs, run.evaluations
        assert needed.settings["config"]["env_kwargs"]["people"] == "train"
        assert "_train_" in needed.name
        assert evaluation.settings["config"]["env_kwargs"] == {"people": "test"}
    together = make_plan("FeedingEnv", (changed(name="a"), swaying), PRESET, headline="success")
    assert not {*(i.key for i in apart.items())} & {*(i.key for i in together.items())}
    for item in together.items():
        assert "people" not in json.dumps(item.settings)
    alone = tmp_path / "alone.npz"
    content = {**dict(np.load(DEFAULT_LIBRARY)), "run_subject": np.array(["me"] * 9)}
    for name in ("run_start", "run_length", "run_clip", "run_subject"):
        content[name] = content[name][1:2]  # one run, too short for two
    np.savez(alone, **content)
    for condition, is_possible in ((changed(name="a"), False), (swaying, True)):
        given = {"library": alone, "people": DrawnPeople("train", "test")}
        with nullcontext() if is_possible else pytest.raises(RequestError, match="halves are too"):
            make_plan("FeedingEnv", (condition,), PRESET, **given)


def test_two_conditions_that_are_the_same_but_for_the_name_are_trained_twice() -> None:
    made = plan(AHEAD, replace(AHEAD, name="again"))
    first, second = (item for item in made.items() if item.kind == "training")
    assert first.folder != second.folder


@settings(max_examples=12)
@given(st.integers(1, 40), st.integers(1, 12), st.integers(1, 30), st.integers(1, 9))
def test_every_seed_is_there_once(
    demonstrations: int, block: int, episodes: int, episode_block: int
) -> None:
    size = BenchmarkPreset("cpu", (), demonstrations, block, episodes, episode_block)
    made = plan(CURRENT, preset=size)
    for kind, first, count in (
        ("demonstrations", 0, demonstrations),
        ("evaluation", 1000, episodes),
    ):
        seeds: list[int] = []
        for item in (u for u in made.items() if u.kind == kind):
            seeds += range(*item.settings["config"]["seeds"])
        assert seeds == list(range(first, first + count))


def test_whatever_changes_the_outcome_changes_the_key(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    base = plan(AHEAD)
    stats, library = tmp_path / "e.json", tmp_path / "l.npz"
    stats.write_bytes(DEFAULT_STATS.read_bytes() + b"\n")
    shutil.copy(DEFAULT_LIBRARY, library)
    other = tmp_path / "other" / "e.json"
    other.parent.mkdir()
    other.write_bytes(DEFAULT_STATS.read_bytes() + b"\n\n")
    variants = {
        "horizon": plan(changed(horizon=3)),
        "error": plan(changed(error="uniform")),
        "stats": plan(changed(error="uniform"), error_stats=stats),
        "other stats": plan(changed(error="uniform"), error_stats=other),
        "expert": plan(changed(expert="anticipatory")),
        "forecast": plan(changed(prediction="persistence")),
        "model": plan(changed(prediction="model")),
        "library": plan(AHEAD, library=library),
        "motion": plan(changed(motion="sway")),
        "policy": plan(changed(policy="Mlp")),
        "size": plan(AHEAD, preset=replace(PRESET, demonstrations=5)),
        "budget": plan(AHEAD, preset=replace(PRESET, train_settings={"steps": 7})),
        "threads": plan(AHEAD, preset=replace(PRESET, threads=2)),
    }
    trainings = [keys(made, "training")[0] for made in (base, *variants.values())]
    assert len(set(trainings)) == len(trainings)
    monkeypatch.setattr(item_module, "item_versions", lambda: {"torch": "9.9"})
    later = keys(plan(AHEAD), "training")[0]
    assert later not in trainings


def test_a_condition_without_drawn_errors_does_without_their_statistics(tmp_path: Path) -> None:
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
    conditions = [replace(AHEAD, name=f"condition{n}") for n in range(4)]
    made = plan(*conditions, changed(expert="anticipatory"))
    shards = [made.items((number, parts)) for number in range(1, parts + 1)]
    for shard in shards:
        done: set[str] = set()
        for item in shard:
            assert {need.key for need in item.needs} <= done
            done.add(item.key)
    for kind in ("training", "evaluation"):
        found = [u.key for shard in shards for u in shard if u.kind == kind]
        assert sorted(found) == sorted(keys(made, kind))


def test_a_condition_that_shows_a_predictor_needs_predictions(tmp_path: Path) -> None:
    bare = tmp_path / "bare.npz"
    condition = changed(name="m", error="model")
    assert plan(condition, library=DEFAULT_LIBRARY).runs
    _without_prediction(DEFAULT_LIBRARY, bare)
    with pytest.raises(
        RequestError, match=r"condition 'm'.*--motion_library.*leave the condition out"
    ):
        plan(condition, library=bare)


def _without_prediction(source: Path, path: Path) -> None:
    import numpy as np

    with np.load(source) as archive:
        np.savez(path, **{k: archive[k] for k in archive.files if k != "predicted_mouth"})


def test_a_policy_without_the_presets_settings_is_refused_before_anything_runs() -> None:
    with pytest.raises(RequestError, match="paper"):
        plan(changed(policy="Mlp"), preset=PRESETS["paper"]).items()


def test_the_shipped_benchmarks_can_be_planned() -> None:
    conditions = read_conditions(CONDITIONS / "feeding.yaml").conditions
    made = plan(*conditions, preset=PRESETS["cpu"], library=DEFAULT_LIBRARY)
    assert {
        kind: len(keys(made, kind)) for kind in ("demonstrations", "training", "evaluation")
    } == {"demonstrations": 4, "training": 16, "evaluation": 32}
    names = [
        item.settings["config"]["env_kwargs"]["motion_library"]
        for item in made.items()
        if item.kind == "demonstrations"
    ]
    assert set(names) == {"motion_library.npz"}
    file = read_conditions(CONDITIONS / "foresight_policies.yaml")
    made = make_plan(
        file.env, file.conditions, PRESETS["cpu"], headline=file.headline, people=file.people
    )
    assert {
        kind: len(keys(made, kind)) for kind in ("demonstrations", "training", "evaluation")
    } == {"demonstrations": 6, "training": 37, "evaluation": 74}


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"horizon": 24}, ""),
        ({"horizon": 24, "prediction": "persistence"}, ""),
        ({"horizon": 24, "prediction": "kalman", "motion": "sway"}, ""),
        ({"horizon": 24, "error": "uniform"}, ""),
        ({"horizon": 5, "prediction": "model"}, ""),
        ({"horizon": 6, "prediction": "model"}, r"'far' .* predicts the mouth 5 frames ahead"),
        ({"horizon": 5, "error": "model"}, ""),
        ({"horizon": 6, "error": "model"}, r"'far' .* predicts the mouth 5 frames ahead, not 6"),
    ],
)
def test_horizons_beyond_what_was_measured_are_refused(
    changes: dict[str, Any], message: str, tmp_path: Path
) -> None:
    with np.load(DEFAULT_LIBRARY) as shipped:
        arrays = dict(shipped)
    arrays["predicted_mouth"] = arrays["predicted_mouth"][:, :5]
    library = tmp_path / "library.npz"
    np.savez(library, **arrays)
    condition = changed(name="far", **changes)
    if not message:
        assert plan(condition, library=library).runs
        return
    with pytest.raises(RequestError, match=message) as caught:
        plan(condition, library=library)
    assert "\n" not in str(caught.value)


def test_a_video_acts_one_episode_of_a_training_out() -> None:
    made = plan()
    name = made.runs[1].condition.name
    result = EpisodeResult("FeedingEnv", 1004, True, True, 4.0, 600, "", "c", "p", condition=name)
    video = made.video(result)
    assert video.needs == (made.runs[1].training,)
    config = video.settings["config"]
    assert (config["seeds"], config["videos"]) == ([1004, 1005], 1)
    assert config == {
        **made.runs[1].evaluations[0].settings["config"],
        "seeds": [1004, 1005],
        "videos": 1,
    }


DEMO = read_conditions(CONDITIONS / "demo.yaml")


def trained(name: str = "shipped", **values: object) -> ConditionConfig:
    """A condition whose policy is trained already."""
    return ConditionConfig.from_yaml({"name": name, "checkpoint": "shipped:current", **values})


def test_the_demo_only_evaluates_and_on_motion_of_other_people() -> None:
    size = replace(PRESETS["cpu"], num_episodes=20)
    made = make_plan(DEMO.env, DEMO.conditions, size, people=DEMO.people, headline=DEMO.headline)
    assert [item.kind for item in made.items()] == ["evaluation"] * 3
    assert [run.training for run in made.runs] == [None] * 3
    for run in made.runs:
        (item,) = run.evaluations
        config = item.settings["config"]
        assert config["env_kwargs"] == {"people": "test", "motion": "dyskinetic"}
        assert (config["checkpoint"], config["seeds"]) == ("run", [1000, 1020])
        assert item.needs == ()
        assert {path.parent.name for path in item.files.values()} == {
            run.condition.checkpoint.removeprefix("shipped:")
        }
    assert [run.condition.spec.corruption.delay for run in made.runs] == [0, 4, 4]
    assert DEMO.headline == "success_strict"


def test_a_trained_policy_stands_beside_one_that_is_trained() -> None:
    made = plan(CURRENT, trained(), people=DEMO.people)
    kinds = [item.kind for item in made.items()]
    assert {kind: kinds.count(kind) for kind in kinds} == {
        "demonstrations": 2,
        "training": 1,
        "evaluation": 4,
    }
    # Work of earlier benchmarks keeps its keys.
    assert keys(made, "evaluation")[:2] == keys(plan(CURRENT, people=DEMO.people), "evaluation")
    assert made.items((2, 2)) == made.runs[1].evaluations
    result = EpisodeResult("FeedingEnv", 1004, True, True, 4.0, 600, "", "c", "p")
    video = made.video(replace(result, condition="shipped", train_seed=0))
    assert video.files == made.runs[1].evaluations[0].files
    assert video.name == "shipped_seed0_1004"


def test_other_weights_make_another_item(tmp_path: Path) -> None:
    source = SHIPPED / "current"
    shutil.copytree(source, tmp_path / "copy")
    same = plan(trained(checkpoint=str(tmp_path / "copy")), people=DEMO.people)
    assert keys(same, "evaluation") == keys(plan(trained(), people=DEMO.people), "evaluation")
    other = plan(trained(checkpoint="shipped:baseline"), people=DEMO.people)
    assert not {*keys(other, "evaluation")} & {*keys(same, "evaluation")}
    swaying = plan(trained(motion="sway"), people=DEMO.people)
    assert keys(swaying, "evaluation") != keys(same, "evaluation")


def test_the_motion_of_a_trained_policy_is_that_of_its_demonstrations() -> None:
    assert trained().motion == "dyskinetic"
    assert trained(motion="recorded").motion == "recorded"
    assert trained().spec == read_checkpoint("shipped:current").spec


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"obs": "current"}, "'obs' is what a policy is trained with.*name, checkpoint, motion"),
        ({"policy": "Act"}, "'policy' is what"),
        ({"delay": 3}, "'delay' is what"),
        ({"checkpoint": "shipped:curent"}, "did you mean 'current'"),
        ({"checkpoint": "no/where"}, "checkpoint 'no/where' does not exist"),
        ({"checkpoint": 3}, "checkpoint: must be text"),
        ({"motion": "swai"}, "did you mean 'sway'"),
    ],
)
def test_what_does_not_go_with_a_checkpoint_is_refused(
    values: dict[str, Any], message: str
) -> None:
    with pytest.raises(RequestError, match=message):
        trained(**values)


def test_a_checkpoint_is_of_one_task_and_not_of_the_paper() -> None:
    with pytest.raises(RequestError, match="of the paper"):
        plan(trained(name="current", motion="recorded"), people=DEMO.people)
    other = replace(task_entry("FeedingEnv"), name="OtherEnv")
    with pytest.raises(RequestError, match="was trained in FeedingEnv, not in OtherEnv"):
        trained().for_task(other)


def test_a_trained_policy_brings_no_people_and_no_face_that_were_not_declared(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    with pytest.raises(RequestError, match=r"people 'test'.*say people: \{demonstrations: train"):
        plan(trained())
    checkpoint = replace(
        read_checkpoint("shipped:current"), dataset={"env_kwargs": {"face": "physical"}}
    )
    monkeypatch.setattr(plan_module, "read_checkpoint", lambda _: checkpoint)
    with pytest.raises(RequestError, match=r"from a physical face.*say face: physical"):
        plan(trained())
    assert plan(trained(), face="physical").runs


@pytest.mark.long
def test_the_item_of_a_trained_policy_acts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    size = replace(PRESET, num_episodes=1)
    (item,) = plan(trained(), preset=size, people=DEMO.people).items()
    folder = ArtifactStore(tmp_path).prepare(item)
    settings = json.loads(json.dumps(item.settings))
    settings["config"]["env_kwargs"]["max_episode_steps"] = 20
    monkeypatch.chdir(folder)
    run_evaluation(settings)
    (result,) = read_results(folder / "out")
    assert result.checkpoint == read_checkpoint("shipped:current").content_hash
