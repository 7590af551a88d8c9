"""What many evaluation episodes came to: counts with intervals, times, kinds of failure."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from robo_manip_baselines.data import atomic_file
from robo_manip_baselines.evaluation.failure import APPROACH_LIMIT, FAILURES
from robo_manip_baselines.evaluation.result import EpisodeResult

SUMMARY = "summary.json"

CONFIDENCE = 0.95
"""of all intervals."""


@dataclass(frozen=True)
class Share:
    """How many of all, with the Wilson interval of the proportion.

    Attributes:
        count: of these.
        rate: share of all; None without any.
        low, high: ends of the 95 % interval; None without any.
    """

    count: int
    rate: float | None
    low: float | None
    high: float | None

    def __str__(self) -> str:
        if self.rate is None or self.low is None or self.high is None:
            return "-"
        return f"{self.rate:.1%} (95 % interval {self.low:.1%} to {self.high:.1%})"


@dataclass(frozen=True)
class Summary:
    """How an evaluation went.

    Attributes:
        episodes: how many there are.
        success, strict_success: shares of ``is_success`` and ``is_success_strict``.
        success_within_limit: share of successes within 6 s of the lift (Algorithm 1).
        completion_time_mean, completion_time_sd: s, over successes; None without enough of them.
        closest_distance_median: m, over episodes with a lift; None without any.
        face_force_max: N; None without episodes.
        failures: kind -> how many.
        failed_seeds: seeds of the episodes that failed.
        seconds: that this run took.
        episodes_per_second: of this run; None if nothing was left to do.
    """

    episodes: int
    success: Share
    strict_success: Share
    success_within_limit: Share
    completion_time_mean: float | None
    completion_time_sd: float | None
    closest_distance_median: float | None
    face_force_max: float | None
    failures: dict[str, int]
    failed_seeds: list[int]
    seconds: float
    episodes_per_second: float | None


def share(count: int, total: int) -> Share:
    """Return a count as a share of a total, with its Wilson interval."""
    if not total:
        return Share(count, None, None, None)
    from statsmodels.stats.proportion import proportion_confint  # slow to import

    ends: Any = proportion_confint(count, total, alpha=1.0 - CONFIDENCE, method="wilson")
    return Share(count, count / total, float(ends[0]), float(ends[1]))


def summarise(results: Sequence[EpisodeResult], *, new: int, seconds: float) -> Summary:
    """Sum up results.

    Args:
        results: of all episodes.
        new: how many of them this run made.
        seconds: that this run took.
    """
    total = len(results)
    times = [r.completion_time for r in results if r.completion_time is not None]
    distances = [r.closest_distance for r in results if r.closest_distance is not None]
    kinds = Counter(r.failure for r in results)
    return Summary(
        episodes=total,
        success=share(sum(r.is_success for r in results), total),
        strict_success=share(sum(r.is_success_strict for r in results), total),
        # Times are whole control steps; the limit itself is within.
        success_within_limit=share(sum(t <= APPROACH_LIMIT for t in times), total),
        completion_time_mean=float(np.mean(times)) if times else None,
        completion_time_sd=float(np.std(times, ddof=1)) if len(times) > 1 else None,
        closest_distance_median=float(np.median(distances)) if distances else None,
        face_force_max=max((r.face_force for r in results), default=None),
        failures={kind: kinds[kind] for kind in FAILURES},
        failed_seeds=[r.seed for r in results if not r.is_success],
        seconds=seconds,
        episodes_per_second=new / seconds if new else None,
    )


def write_summary(folder: Path, summary: Summary, facts: dict[str, Any]) -> None:
    """Write ``summary.json``: the facts, then the summary."""
    with atomic_file(folder / SUMMARY) as temporary:
        content = {**facts, **asdict(summary)}
        temporary.write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")


def table(summary: Summary, facts: dict[str, str]) -> str:
    """Lay out the closing table; further rows, ready to print, go below."""
    mean, spread = summary.completion_time_mean, summary.completion_time_sd
    total = summary.episodes
    failures = [f"{kind} {count}" for kind, count in summary.failures.items() if count]
    distance, force = summary.closest_distance_median, summary.face_force_max
    rate = summary.episodes_per_second
    rows = {
        "episodes": str(total),
        "success": _count(summary.success, total),
        "strict success": _count(summary.strict_success, total),
        f"success in {APPROACH_LIMIT:g} s": _count(summary.success_within_limit, total),
        "completion time": "-"
        if mean is None
        else f"{mean:.2f}" + (f" ± {spread:.2f} s" if spread is not None else " s"),
        "closest approach": "-" if distance is None else f"{1000 * distance:.1f} mm (median)",
        "largest face force": "-" if force is None else f"{force:.1f} N",
        "failures": ", ".join(failures) or "-",
        "speed": "-" if rate is None else f"{rate:.2f} episodes/s",
        **facts,
    }
    width = max(map(len, rows))
    return "\n".join(f"{name:<{width}}  {value}" for name, value in rows.items())


def _count(part: Share, total: int) -> str:
    return f"{part.count}/{total}  {part}"
