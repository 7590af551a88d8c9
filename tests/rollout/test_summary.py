"""Summary of many episodes, against figures worked out by hand."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import pytest

from robo_manip_baselines.envs.mujoco.tasks.registry import task_entry
from robo_manip_baselines.rollout.results import (
    EpisodeResult,
    EvaluationSummary,
    Proportion,
    summarize,
    summary_table,
)

TASK = task_entry("FeedingEnv")

HIT = EpisodeResult(
    env="FeedingEnv",
    seed=0,
    is_success=True,
    is_success_strict=True,
    completion_time=4.0,
    steps=500,
    failure="",
    motion_clip="clip",
    motion_subject="person",
    columns={
        "time_since_lift": 7.0,
        "closest_distance": 0.010,
        "closest_offset": (0.01, 0.0, 0.0),
        "cube_offset": (-0.002, 0.0, 0.0),
        "face_force": 0.0,
        "force_time_1": 0.0,
        "force_time_10": 0.0,
        "force_time_30": 0.0,
        "dwell": 0.0,
    },
)


def change(result: EpisodeResult, **columns: float | None) -> EpisodeResult:
    return replace(result, columns={**result.columns, **columns})


LOW = replace(
    change(HIT, closest_distance=0.030, face_force=2.5),
    is_success=False,
    is_success_strict=False,
    completion_time=None,
    failure="missed_low",
)
NEVER = replace(change(LOW, closest_distance=None, face_force=0.0), failure="never_grasped")
RESULTS = [
    replace(HIT, seed=0),
    replace(HIT, seed=1, completion_time=6.0, is_success_strict=False),
    change(replace(HIT, seed=2, completion_time=6.02), closest_distance=0.020),
    replace(LOW, seed=3),
    replace(NEVER, seed=4),
]


def wilson(count: int, total: int) -> tuple[float, float]:
    """The formula of Wilson (1927), z of 95 %."""
    z, p = 1.959963984540054, count / total
    centre = p + z * z / (2 * total)
    half = z * math.sqrt(p * (1 - p) / total + z * z / (4 * total * total))
    return (centre - half) / (1 + z * z / total), (centre + half) / (1 + z * z / total)


@pytest.mark.parametrize(("count", "total"), [(0, 1), (0, 50), (37, 50), (50, 50), (3, 5)])
def test_intervals_are_wilsons(count: int, total: int) -> None:
    found = Proportion.of(count, total)
    assert found.rate == count / total
    assert (found.low, found.high) == pytest.approx(wilson(count, total), abs=1e-12)


def test_no_interval_has_width_zero() -> None:
    low, high = Proportion.of(20, 20).low, Proportion.of(20, 20).high
    assert low is not None
    assert high is not None
    assert low < 0.9 < high
    assert str(Proportion.of(37, 50)) == "74.0% (95 % interval 60.4% to 84.1%)"


def summary_of(results: list[EpisodeResult], new: int, seconds: float) -> EvaluationSummary:
    return summarize(TASK, results, new=new, seconds=seconds)


def test_figures() -> None:
    summary = summary_of(RESULTS, new=4, seconds=8.0)
    assert (summary.episodes, summary.success.count, summary.strict_success.count) == (5, 3, 2)
    assert summary.success_within_limit is not None
    assert summary.success_within_limit.count == 2  # 6.0 s is within, 6.02 s is not
    assert summary.completion_time_mean == pytest.approx((4.0 + 6.0 + 6.02) / 3)
    assert summary.completion_time_sd == pytest.approx(1.16052, abs=1e-5)
    assert summary.columns["closest_distance"]["median"] == pytest.approx(0.015)
    assert summary.columns["face_force"]["max"] == 2.5
    assert summary.failures["missed_low"] == summary.failures["never_grasped"] == 1
    assert sum(summary.failures.values()) == 2
    assert summary.failed_seeds == [3, 4]
    assert summary.episodes_per_second == 0.5


def test_table() -> None:
    summary = summary_of(RESULTS, new=4, seconds=8.0)
    text = summary_table(TASK, summary, {"written to": "here"})
    rows = dict(line.split("  ", 1) for line in text.splitlines())
    cells = {name.strip(): value.strip() for name, value in rows.items()}
    assert cells["success"].startswith("3/5  60.0% (95 % interval 23.1% to 88.2%)")
    assert cells["success in 6 s"].startswith("2/5")
    assert cells["completion time"] == "5.34 ± 1.16 s (mean ± sd of 3 successes)"
    assert cells["closest distance"] == "0.015 (median), 0.03 (max)"
    assert cells["failures"] == "never_grasped 1, missed_low 1"
    assert cells["written to"] == "here"


def test_a_task_without_a_time_limit_has_no_row_for_it() -> None:
    task = replace(TASK, success_time_limit=None)
    summary = summarize(task, RESULTS, new=4, seconds=8.0)
    assert summary.success_within_limit is None
    assert "success in" not in summary_table(task, summary, {})


def test_nothing_done_and_nothing_succeeded() -> None:
    nothing = summary_of([], new=0, seconds=0.0)
    assert nothing.success == Proportion(0, None, None, None)
    table = summary_table(TASK, nothing, {}).replace("0/0  ", "")
    assert "success          -" in table
    failed = summary_of([LOW], new=0, seconds=0.0)
    assert (failed.completion_time_mean, failed.completion_time_sd) == (None, None)
    assert (failed.success.count, failed.episodes_per_second) == (0, None)
    json.dumps(failed.failures, allow_nan=False)
