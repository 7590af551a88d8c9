"""What many episodes came to, against figures worked out by hand."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import pytest

from robo_manip_baselines.rollout.results import (
    EpisodeResult,
    Share,
    share,
    summarise,
    table,
    write_summary,
)

HIT = EpisodeResult(
    env="FeedingEnv",
    seed=0,
    is_success=True,
    is_success_strict=True,
    completion_time=4.0,
    time_since_lift=7.0,
    steps=500,
    failure="",
    closest_distance=0.010,
    closest_offset=(0.01, 0.0, 0.0),
    cube_offset=(-0.002, 0.0, 0.0),
    face_force=0.0,
    motion_clip="clip",
    motion_subject="person",
)
LOW = replace(
    HIT,
    is_success=False,
    is_success_strict=False,
    completion_time=None,
    failure="missed_low",
    closest_distance=0.030,
    face_force=2.5,
)
NEVER = replace(LOW, failure="never_grasped", closest_distance=None, face_force=0.0)
RESULTS = [
    replace(HIT, seed=0),
    replace(HIT, seed=1, completion_time=6.0, is_success_strict=False),
    replace(HIT, seed=2, completion_time=6.02, closest_distance=0.020),
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
    found = share(count, total)
    assert found.rate == count / total
    assert (found.low, found.high) == pytest.approx(wilson(count, total), abs=1e-12)


def test_no_interval_has_width_zero() -> None:
    low, high = share(20, 20).low, share(20, 20).high
    assert low is not None
    assert high is not None
    assert low < 0.9 < high
    assert str(share(37, 50)) == "74.0% (95 % interval 60.4% to 84.1%)"


def test_figures() -> None:
    summary = summarise(RESULTS, new=4, seconds=8.0)
    assert (summary.episodes, summary.success.count, summary.strict_success.count) == (5, 3, 2)
    assert summary.success_within_limit.count == 2  # 6.0 s is within, 6.02 s is not
    assert summary.completion_time_mean == pytest.approx((4.0 + 6.0 + 6.02) / 3)
    assert summary.completion_time_sd == pytest.approx(1.16052, abs=1e-5)
    assert summary.closest_distance_median == pytest.approx(0.015)
    assert summary.face_force_max == 2.5
    assert summary.failures["missed_low"] == summary.failures["never_grasped"] == 1
    assert sum(summary.failures.values()) == 2
    assert summary.failed_seeds == [3, 4]
    assert summary.episodes_per_second == 0.5


def test_table_and_file(tmp_path: Path) -> None:
    summary = summarise(RESULTS, new=4, seconds=8.0)
    rows = dict(line.split("  ", 1) for line in table(summary, {"written to": "here"}).splitlines())
    cells = {name.strip(): value.strip() for name, value in rows.items()}
    assert cells["success"].startswith("3/5  60.0% (95 % interval 23.1% to 88.2%)")
    assert cells["success in 6 s"].startswith("2/5")
    assert cells["completion time"] == "5.34 ± 1.16 s"
    assert cells["closest approach"] == "15.0 mm (median)"
    assert cells["failures"] == "never_grasped 1, missed_low 1"
    assert cells["written to"] == "here"
    write_summary(tmp_path, summary, {"arm": "current"})
    content = json.loads((tmp_path / "summary.json").read_text())
    assert content["arm"] == "current"
    assert Share(**content["success"]) == summary.success


def test_nothing_done_and_nothing_succeeded() -> None:
    nothing = summarise([], new=0, seconds=0.0)
    assert nothing.success == Share(0, None, None, None)
    assert "success             -" in table(nothing, {}).replace("0/0  ", "")
    failed = summarise([LOW], new=0, seconds=0.0)
    assert (failed.completion_time_mean, failed.completion_time_sd) == (None, None)
    assert (failed.success.count, failed.episodes_per_second) == (0, None)
    json.dumps(failed.failures, allow_nan=False)
