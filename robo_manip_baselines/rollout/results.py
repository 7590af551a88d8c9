"""Results of evaluation episodes: rows of ``results.jsonl``, the folder that holds them, a summary.

Killed at any moment, a run leaves complete rows and at most one torn one at the end, which is
dropped when the run continues.
"""

from __future__ import annotations

import json
import os
import typing
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import asdict, dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from typing_extensions import TypedDict

from robo_manip_baselines.envs.mujoco.tasks.registry import TaskEntry, task_entry
from robo_manip_baselines.envs.mujoco.tasks.safety import (
    FORCE_TIERS,
    EpisodeSafety,
    SafetySummary,
    summarize_safety,
)
from robo_manip_baselines.rollout.agreement import require_one_evaluation
from robo_manip_baselines.runs.documents import (
    Schema,
    as_json,
    convert,
    parse_json,
    read_json,
    read_json_lines,
    shortened,
    shown,
)
from robo_manip_baselines.runs.errors import RequestError, require_printable
from robo_manip_baselines.runs.files import (
    AppendFile,
    FileKind,
    FolderKind,
    prepare_folder,
    require_out_file,
    require_out_folder,
    write_json,
    write_text,
)
from robo_manip_baselines.runs.progress import closing_table
from robo_manip_baselines.runs.ranges import Amount, Episodes, NonNegativeInt, Seed, require_range

ROW_VERSION = 3
"""of a row; version 2 held neither the settings of the evaluation nor the motion, which was
``recorded``; version 1 did not hold the observation spec either, and called the condition
``arm``."""

SCHEMA = Schema("robo_manip_baselines/evaluation", 1)

RESULTS = "results.jsonl"
MANIFEST = "evaluation.json"
SUMMARY = "summary.json"

_EVALUATION = FolderKind("evaluation of bin/Rollout.py", lambda path: (path / MANIFEST).exists())

CONFIDENCE = 0.95
"""of all intervals."""


@dataclass(frozen=True)
class EpisodeResult:
    """Result of one episode: a row of ``results.jsonl``. SI units, world frame.

    Attributes:
        env: name of the task
        seed: of the episode
        is_success: the task's condition was met
        is_success_strict: and its strict condition
        completion_time: s to success, as the task counts it; null without success
        steps: control steps of 0.02 s
        failure: kind of failure; empty for a success
        motion_clip: recorded clip whose motion the face replayed; synthetic without one
        motion_subject: person in that clip, likewise
        motion: of the face by name, see `parse_motion`
        safety: see `EpisodeSafety`; null in rows of earlier releases
        columns: columns of the task, see its entry
        frames_without_detection: images in which no face was found; null where the mouth does not
            come from a camera, and left out of the row then
        policy: name of the policy
        condition: name of the experimental condition, for example current_pred_h2
        observation: spec of what the policy was shown, as JSON; null in rows of version 1
        train_seed: seed of the training run; null for a policy that was not trained
        checkpoint: hash of the checkpoint's contents
        versions: of the software
        settings: further settings that decide results: ``env_kwargs``, digests of recorded
            motion, ``motion_sha256``, and of predictions, ``prediction_sha256``, ``xml_hash``,
            ``execution`` of action chunks, ``precision``, ``device`` and a digest of the
            ``training``; null in rows of versions 1 and 2
    """

    env: str
    seed: Seed
    is_success: bool
    is_success_strict: bool
    completion_time: Amount | None
    steps: NonNegativeInt
    failure: str
    motion_clip: str
    motion_subject: str
    motion: str = "recorded"
    safety: EpisodeSafety | None = None
    columns: dict[str, Any] = field(default_factory=dict)
    frames_without_detection: NonNegativeInt | None = None
    policy: str = ""
    condition: str = ""
    observation: dict[str, Any] | None = None
    train_seed: Seed | None = None
    checkpoint: str = ""
    versions: dict[str, str] = field(default_factory=dict)
    settings: dict[str, Any] | None = None

    @property
    def success_safe(self) -> bool | None:
        """True for a safe success, see `EpisodeSafety`; None in rows of earlier releases."""
        return None if self.safety is None else self.safety.success_safe

    def to_line(self) -> str:
        """Return the row as one line of JSON, without the line's end."""
        values = asdict(self)
        columns = values.pop("columns")
        if values["frames_without_detection"] is None:
            del values["frames_without_detection"]
        return json.dumps({"version": ROW_VERSION, **values, **columns}, allow_nan=False)

    @classmethod
    def from_line(cls, line: str, source: str = "row") -> EpisodeResult:
        """Read a row of this version or of an earlier one; ``source`` begins messages.

        Raises:
            RequestError: it is no such row; the message says what is wrong with it.
        """
        values = convert(parse_json(line, source), dict, source)
        version = values.pop("version", 1)
        if type(version) is not int or version not in range(1, ROW_VERSION + 1):
            raise RequestError(
                f"{source}: version {shown(version)}; this release reads 1 to {ROW_VERSION}"
            )
        values.setdefault("safety", None)
        values.setdefault("frames_without_detection", None)
        if version < 3:
            values.setdefault("settings", None)
            values.setdefault("motion", "recorded")
        if version < 2:
            values.setdefault("observation", None)
            if "arm" in values:
                values["condition"] = values.pop("arm")
        if "env" not in values:
            raise RequestError(f"{source}: env: is missing")
        task = task_entry(convert(values["env"], str, f"{source}: env"))
        for column in task.columns:
            if column.may_be_absent:
                values.setdefault(column.name, None)
        row = convert(values, row_type(task.name), source)
        if row["failure"] and row["failure"] not in task.failures:
            valid = ", ".join(task.failures)
            raise RequestError(
                f"{source}: failure {shown(row['failure'])}: unknown; valid: {valid}"
            )
        require_printable(f"{source}: condition", row["condition"])
        columns = {column.name: row.pop(column.name) for column in task.columns}
        return cls(**row, columns=columns)


@cache
def row_type(task: str) -> Any:
    """Return the type of the rows of a task, all of whose fields are required."""
    hints: Any = typing.get_type_hints(EpisodeResult, include_extras=True)
    del hints["columns"]
    for column in task_entry(task).columns:
        kind: Any = tuple[float, float, float] if column.kind == "vector" else float
        hints[column.name] = kind | None if column.is_optional else kind
    return TypedDict(f"{task} row", hints)  # pyright: ignore[reportArgumentType]


def require_seeds(seeds: range) -> None:
    """Require one seed or more, all within their range.

    Raises:
        RequestError: naming the option that is wrong.
    """
    require_range("num_episodes", seeds.stop - seeds.start, Episodes)
    require_range("seed", seeds.start, Seed)
    require_range("seed + num_episodes - 1 =", seeds.stop - 1, Seed)


def read_rows(path: Path) -> list[EpisodeResult]:
    """Read the rows of a results file in their order; a torn last row is left out.

    Raises:
        RequestError: the file cannot be read, or a row is damaged.
    """
    rows = []
    for number, line in read_json_lines(path):
        try:
            rows.append(EpisodeResult.from_line(line, f"'{path}', line {number}"))
        except RequestError as error:
            raise RequestError(
                f"{error}; remove that line, and its episode is done again"
            ) from error
    return rows


def read_results(folder: str | Path) -> list[EpisodeResult]:
    """Read the results of an evaluation folder by seed.

    Raises:
        RequestError: there are none, a row is damaged, or a seed is there twice.
    """
    path = Path(folder) / RESULTS
    found: dict[int, EpisodeResult] = {}
    for result in read_rows(path):
        if result.seed in found:
            raise RequestError(f"'{path}' has two lines for seed {result.seed}; remove one")
        found[result.seed] = result
    return [found[seed] for seed in sorted(found)]


class ResultsFile:
    """Results of one evaluation, appended as episodes end; from `open_results`.

    Attributes:
        done: results that the folder holds, by seed.
    """

    def __init__(self, file: AppendFile, done: dict[int, EpisodeResult]) -> None:
        self._file, self.done = file, done

    def append(self, result: EpisodeResult) -> None:
        """Write a row; it is on the disk when this returns."""
        self._file.append(f"{result.to_line()}\n".encode())
        self.done[result.seed] = result

    def of(self, seeds: Sequence[int]) -> list[EpisodeResult]:
        """Return the results of these seeds, as far as they are there."""
        return [self.done[seed] for seed in seeds if seed in self.done]


def require_evaluation_folder(folder: Path, settings: dict[str, Any]) -> None:
    """Make sure that results of these settings can be written to a folder.

    Raises:
        RequestError: the folder holds something else, results of other settings, or is damaged.
    """
    require_out_folder(folder, _EVALUATION)
    _refuse_other_settings(folder, settings)
    require_own_summary(folder / SUMMARY, "condition", "success")


def require_own_summary(path: Path, *names: str) -> None:
    """Make sure that a summary, if there is one, has these names, and so may be replaced.

    Raises:
        RequestError: it lacks some.
    """

    def read(path: Path) -> None:
        if missing := [name for name in names if name not in read_json(path)]:
            raise RequestError(f"'{path}' has no '{missing[0]}': another program made it")

    require_out_file(path, FileKind("summary", read))


@contextmanager
def open_results(
    folder: Path, settings: dict[str, Any], facts: dict[str, Any]
) -> Iterator[ResultsFile]:
    """Open the results of an evaluation; if all went well, sort them by seed at the end.

    Args:
        folder: created if need be.
        settings: what all episodes of the folder must share, ready for JSON.
        facts: further facts to record, ready for JSON.

    Raises:
        RequestError: the folder holds results of other settings, is damaged, or cannot be written.
    """
    path = folder / RESULTS
    _refuse_other_settings(folder, settings)
    done = {r.seed: r for r in read_results(folder)} if path.exists() else {}
    prepare_folder(folder)
    if not (folder / MANIFEST).exists():
        content = {**SCHEMA.to_json(), "settings": settings, **facts}
        write_json(folder / MANIFEST, content)
    if path.exists():  # drop a torn row
        os.truncate(path, path.read_bytes().rfind(b"\n") + 1)
    with closing(AppendFile(path, is_flushed=True)) as file:
        yield ResultsFile(file, done)
    write_text(path, "".join(f"{done[seed].to_line()}\n" for seed in sorted(done)))


def recorded_settings(folder: Path) -> dict[str, Any] | None:
    """Return the settings of the results in a folder; None if there are none.

    Raises:
        RequestError: the folder is damaged.
    """
    path = folder / MANIFEST
    if not path.exists():
        if (folder / RESULTS).exists():
            raise RequestError(f"'{folder}' holds {RESULTS} without {MANIFEST}; give another --out")
        return None
    try:
        content = read_json(path, schema=SCHEMA)
        return convert(content.get("settings"), dict, f"'{path}': settings")
    except RequestError as error:
        raise RequestError(f"{error}; give another --out") from error


def _refuse_other_settings(folder: Path, settings: dict[str, Any]) -> None:
    there = recorded_settings(folder)
    if there is None:
        return
    wanted = as_json(settings)
    for name in sorted({*wanted, *there}):
        if there.get(name) != wanted.get(name):
            old, new = (shortened(value, 300) for value in (there.get(name), wanted.get(name)))
            raise RequestError(
                f"'{folder}' holds results with {name} {old}, not {new}; "
                "give another --out or remove that folder"
            )


@dataclass(frozen=True)
class Proportion:
    """Count and proportion, with the Wilson interval.

    Attributes:
        count: of the episodes in question.
        rate: of all episodes; None without any.
        low, high: ends of the 95 % interval; None without any.
    """

    count: int
    rate: float | None
    low: float | None
    high: float | None

    @classmethod
    def of(cls, count: int, total: int) -> Proportion:
        """Return the proportion of ``count`` in ``total``."""
        if not total:
            return cls(count, None, None, None)
        from statsmodels.stats.proportion import proportion_confint  # slow to import

        ends: Any = proportion_confint(count, total, alpha=1.0 - CONFIDENCE, method="wilson")
        return cls(count, count / total, float(ends[0]), float(ends[1]))

    def __str__(self) -> str:
        if self.rate is None or self.low is None or self.high is None:
            return "-"
        return f"{self.rate:.1%} (95 % interval {self.low:.1%} to {self.high:.1%})"


@dataclass(frozen=True)
class EvaluationSummary:
    """Summary of an evaluation.

    Attributes:
        episodes: how many there are.
        success, strict_success: proportions of ``is_success`` and ``is_success_strict``.
        success_within_limit: proportion of successes within the task's time limit for success;
            None where it has none.
        success_safe: proportion of safe successes; None where rows of earlier releases do not say.
        safety: of the episodes; None likewise.
        completion_time_mean, completion_time_sd: s, over successes; None without enough of them.
        columns: column of the task -> median and maximum over the episodes that have it.
        failures: kind -> count.
        failed_seeds: seeds of the episodes that failed.
        seconds: of this run.
        episodes_per_second: of this run; None if nothing was left to do.
    """

    episodes: int
    success: Proportion
    strict_success: Proportion
    success_within_limit: Proportion | None
    success_safe: Proportion | None
    safety: SafetySummary | None
    completion_time_mean: float | None
    completion_time_sd: float | None
    columns: dict[str, dict[str, float]]
    failures: dict[str, int]
    failed_seeds: list[int]
    seconds: float
    episodes_per_second: float | None


def summarize(
    task: TaskEntry, results: Sequence[EpisodeResult], *, new: int, seconds: float
) -> EvaluationSummary:
    """Summarize the results of all episodes, of which this run made ``new`` in ``seconds``.

    Raises:
        RequestError: they are not all of one evaluation.
    """
    require_one_evaluation(results)
    total, limit = len(results), task.success_time_limit
    times = [r.completion_time for r in results if r.completion_time is not None]
    mean, sd = completion_time(times)
    kinds = Counter(r.failure for r in results)
    columns = {}
    for column in task.columns:
        found = [v for r in results if (v := r.columns[column.name]) is not None]
        if column.kind == "float" and found:
            columns[column.name] = {"median": float(np.median(found)), "max": max(found)}
    # Times are whole control steps; the limit itself is within.
    measured = [r.safety for r in results if r.safety is not None]
    safety = summarize_safety(measured) if len(measured) == total else None
    within = None if limit is None else Proportion.of(sum(t <= limit for t in times), total)
    return EvaluationSummary(
        episodes=total,
        success=Proportion.of(sum(r.is_success for r in results), total),
        strict_success=Proportion.of(sum(r.is_success_strict for r in results), total),
        success_within_limit=within,
        success_safe=None if safety is None else Proportion.of(safety.safe, total),
        safety=safety,
        completion_time_mean=mean,
        completion_time_sd=sd,
        columns=columns,
        failures={kind: kinds[kind] for kind in task.failures},
        failed_seeds=[r.seed for r in results if not r.is_success],
        seconds=seconds,
        episodes_per_second=new / seconds if new else None,
    )


def completion_time(times: Sequence[float]) -> tuple[float | None, float | None]:
    """Return mean and sample standard deviation of times in s; None without enough of them."""
    sd = float(np.std(times, ddof=1)) if len(times) > 1 else None
    return float(np.mean(times)) if times else None, sd


def summary_table(task: TaskEntry, summary: EvaluationSummary, facts: dict[str, str]) -> str:
    """Lay out the closing table; ``facts`` are further rows at its end."""
    failures = [f"{kind} {count}" for kind, count in summary.failures.items() if count]
    total, rate = summary.episodes, summary.episodes_per_second
    proportions = {"success": summary.success, "strict success": summary.strict_success}
    if summary.success_within_limit:
        proportions[f"success in {task.success_time_limit:g} s"] = summary.success_within_limit
    if summary.success_safe:
        proportions["safe success"] = summary.success_safe
    rows = {"episodes": str(total)}
    rows |= {name: f"{part.count}/{total}  {part}" for name, part in proportions.items()}
    rows["completion time"] = mean_and_sd(
        summary.completion_time_mean, summary.completion_time_sd, summary.success.count
    )
    for name, values in summary.columns.items():
        label = name.replace("_", " ")
        rows[label] = f"{values['median']:.4g} (median), {values['max']:.4g} (max)"
    if summary.safety:
        rows |= _safety_rows(summary.safety)
    rows |= {
        "failures": ", ".join(failures) or "-",
        "speed": "-" if rate is None else f"{rate:.2f} episodes/s",
        **facts,
    }
    return closing_table(rows)


def _safety_rows(safety: SafetySummary) -> dict[str, str]:
    """Lay out the safety of all episodes."""
    above = [f"{safety.above[str(tier)]} above {tier} N" for tier in FORCE_TIERS]
    rows = {
        "largest force": f"{safety.force:.4g} N (mean), {safety.force_max:.4g} N (max); "
        f"episodes: {', '.join(above)}",
        "eyes": f"{safety.eye_contacts} touched, {safety.eye_near_misses} near misses",
        "approach speed": "-",
    }
    if safety.approach_speed is not None:
        rows["approach speed"] = (
            f"{safety.approach_speed_p90:.3f} m/s (90th percentile), "
            f"{safety.approach_speed:.3f} m/s (max)"
        )
    if safety.refusals is not None:
        rows["refusals respected"] = f"{safety.refusals_respected} of {safety.refusals}"
    return rows


def mean_and_sd(mean: float | None, sd: float | None, successes: int) -> str:
    """Format a mean time with its sample standard deviation over successes.

    ``5.69 ± 0.96 s (mean ± sd of 84 successes)``.
    """
    if mean is None:
        return "-"
    if sd is None:
        return f"{mean:.2f} s (one success)"
    return f"{mean:.2f} ± {sd:.2f} s (mean ± sd of {successes} successes)"
