"""Rows of two policies, worlds or releases are refused by everything that aggregates rows."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import pytest

from robo_manip_baselines.benchmark.statistics.analysis import analyze
from robo_manip_baselines.benchmark.statistics.outcomes import ResultRow, outcome_matrix
from robo_manip_baselines.envs.mujoco.tasks.registry import task_entry
from robo_manip_baselines.observation import ObservationSpec
from robo_manip_baselines.rollout.agreement import difference
from robo_manip_baselines.rollout.results import EpisodeResult, summarize
from robo_manip_baselines.runs.errors import RequestError

TASK = task_entry("FeedingEnv")

SETTINGS: dict[str, Any] = {
    "env_kwargs": {"face_motion": "episode"},
    "motion_sha256": "a" * 64,
    "prediction_sha256": None,
    "xml_hash": "b" * 64,
    "execution": {"temporal_ensemble": False, "execute": 1},
    "precision": "fp32",
    "device": "cpu",
    "training": "c" * 64,
}

ROW = EpisodeResult(
    env="FeedingEnv",
    seed=1000,
    is_success=False,
    is_success_strict=False,
    completion_time=None,
    steps=600,
    failure="never_grasped",
    motion_clip="clip",
    motion_subject="person",
    columns={**dict.fromkeys(column.name for column in TASK.columns), "face_force": 0.0},
    policy="Act",
    condition="current_pred_h2",
    observation=ObservationSpec("current_pred", cameras=()).to_json(),
    train_seed=0,
    checkpoint="d" * 64,
    versions={"python": "3.11.7", "mujoco": "3.17.0", "numpy": "2.4.6", "torch": "2.13.0"},
    settings=SETTINGS,
)


def make_rows(train_seeds: int = 2, conditions: Sequence[str] = ()) -> list[EpisodeResult]:
    return [
        replace(ROW, condition=name, train_seed=train_seed, seed=seed, checkpoint=str(train_seed))
        for name in conditions or [ROW.condition]
        for train_seed in range(train_seeds)
        for seed in (1000, 1001, 1002)
    ]


def as_summary(rows: Sequence[EpisodeResult]) -> object:
    return summarize(TASK, rows, new=0, seconds=0.0)


def numbered(rows: Sequence[EpisodeResult]) -> tuple[ResultRow, ...]:
    return tuple(ResultRow("results.jsonl", i, row) for i, row in enumerate(rows, start=1))


def as_matrix(rows: Sequence[EpisodeResult]) -> object:
    return outcome_matrix(numbered(rows))


def as_statistics(rows: Sequence[EpisodeResult]) -> object:
    return analyze(numbered(rows), task=TASK, resamples=50)


AGGREGATIONS: dict[str, Callable[[Sequence[EpisodeResult]], object]] = {
    "summary": as_summary,
    "outcome matrix": as_matrix,
    "statistics": as_statistics,
}

OTHER: dict[str, Mapping[str, Any]] = {
    "env is .* and OtherEnv": {"env": "OtherEnv"},
    "policy is Act .* and Mlp": {"policy": "Mlp"},
    "checkpoint is": {"checkpoint": "e" * 64},
    "observation horizon is 2 .* and 5": {
        "observation": ObservationSpec("current_pred", 5, cameras=()).to_json()
    },
    "observation is .* and None": {"observation": None},
    "versions mujoco is 3.17.0 .* and 3.17.1": {"versions": {**ROW.versions, "mujoco": "3.17.1"}},
    "versions numpy is": {"versions": {**ROW.versions, "numpy": "2.5.0"}},
    "versions torch is": {"versions": {**ROW.versions, "torch": "2.13.0+cu126"}},
    "versions robo_manip_baselines is None .* and 9": {
        "versions": {**ROW.versions, "robo_manip_baselines": "9"}
    },
    "env_kwargs face_motion is episode .* and after_lift": {
        "settings": {**SETTINGS, "env_kwargs": {"face_motion": "after_lift"}}
    },
    "env_kwargs clips is None .* and ": {
        "settings": {**SETTINGS, "env_kwargs": {"face_motion": "episode", "clips": ["clip"]}}
    },
    "motion_sha256 is a{12} .* and f{12}": {"settings": {**SETTINGS, "motion_sha256": "f" * 64}},
    "prediction_sha256 is None .* and f{12}": {
        "settings": {**SETTINGS, "prediction_sha256": "f" * 64}
    },
    "xml_hash is": {"settings": {**SETTINGS, "xml_hash": "f" * 64}},
    "execution execute is 1 .* and 10": {
        "settings": {**SETTINGS, "execution": {"temporal_ensemble": False, "execute": 10}}
    },
    "precision is fp32 .* and bf16": {"settings": {**SETTINGS, "precision": "bf16"}},
    "device is cpu .* and cuda": {"settings": {**SETTINGS, "device": "cuda"}},
    "training is c{12} .* and f{12}": {"settings": {**SETTINGS, "training": "f" * 64}},
    "settings is recorded .* and not recorded": {"settings": None},
}
"""Message -> changes of a row."""


@pytest.mark.parametrize("name", AGGREGATIONS)
@pytest.mark.parametrize("message", OTHER)
def test_rows_that_differ_are_refused(name: str, message: str) -> None:
    rows = make_rows(train_seeds=1)
    rows[-1] = replace(rows[-1], **OTHER[message])
    with pytest.raises(RequestError, match=f"do not belong together: .*{message}") as caught:
        AGGREGATIONS[name](rows)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("name", AGGREGATIONS)
def test_an_episode_counts_once(name: str) -> None:
    rows = make_rows(train_seeds=1)
    with pytest.raises(RequestError, match="seed 1001 is there twice"):
        AGGREGATIONS[name]([*rows, replace(rows[1], is_success=True, completion_time=3.0)])


@pytest.mark.parametrize("name", ["outcome matrix", "statistics"])
def test_training_runs_have_the_same_seeds(name: str) -> None:
    with pytest.raises(RequestError, match=r"seed 1002 has no counterpart in .* training seed 1"):
        AGGREGATIONS[name](make_rows()[:-1])


def test_conditions_have_the_same_seeds() -> None:
    rows = make_rows(conditions=["current", "baseline"])
    kept = [row for row in rows if (row.condition, row.seed) != ("baseline", 1000)]
    with pytest.raises(RequestError, match=r"'current'.* seed 1000 has no counter.*'baseline'"):
        as_statistics(kept)


@pytest.mark.parametrize("message", [m for m in OTHER if m.split()[0] in {
    "versions", "env_kwargs", "motion_sha256", "xml_hash", "precision", "device", "settings"
}])  # fmt: skip
def test_conditions_share_a_world(message: str) -> None:
    rows = make_rows(conditions=["current", "baseline"])
    changed = [replace(r, **OTHER[message]) if r.condition == "baseline" else r for r in rows]
    with pytest.raises(RequestError, match=f"do not belong together: {message}"):
        as_statistics(changed)


def test_training_runs_and_conditions_may_differ_in_what_they_are_about() -> None:
    as_matrix(make_rows(train_seeds=3))
    with pytest.raises(RequestError, match=r"train_seed|checkpoint"):
        as_summary([*make_rows(train_seeds=1), replace(ROW, seed=1003, train_seed=1)])
    rows = make_rows(conditions=["current", "baseline"])
    other = {"prediction_sha256": "f" * 64, "training": "f" * 64, "execution": {"execute": 5}}
    changes = {"policy": "Mlp", "settings": {**SETTINGS, **other}, "observation": None}
    as_statistics([replace(r, **changes) if r.condition == "baseline" else r for r in rows])
    # Another Python changes no episode.
    as_matrix([*make_rows(1), replace(ROW, seed=1003, checkpoint="0")][:3])
    versions = {**ROW.versions, "python": "3.12.1"}
    rows = make_rows(train_seeds=1)
    as_matrix([replace(rows[0], versions=versions), *rows[1:]])


def test_results_are_those_of_the_task() -> None:
    rows = [replace(row, env="OtherEnv") for row in make_rows()]
    with pytest.raises(RequestError, match="results of OtherEnv are no results of FeedingEnv"):
        as_statistics(rows)


def test_difference_names_the_place() -> None:
    assert difference({"a": {"b": 1}}, {"a": {"b": 1}}) is None
    assert difference({"a": {"b": 1, "c": 2}}, {"a": {"b": 1, "c": 3}}) == ("a c", 2, 3)
    assert difference({"a": 1}, {}) == ("a", 1, None)
