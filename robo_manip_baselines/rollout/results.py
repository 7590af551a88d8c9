"""Results of evaluation episodes: rows of ``results.jsonl``, the folder that holds them, a summary.

Killed at any moment, a run leaves complete rows and at most one torn one at the end, which is
dropped when the run continues.
"""

from __future__ import annotations

import json
import os
import types
import typing
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Any, TextIO

import numpy as np

from robo_manip_baselines.envs.mujoco.tasks.registry import ResultColumn, TaskEntry, task_entry
from robo_manip_baselines.runs.errors import RequestError
from robo_manip_baselines.runs.files import prepare_folder, read_json, write_json, write_text
from robo_manip_baselines.runs.progress import closing_table

ROW_VERSION = 2
"""of a row; version 1 named the condition ``arm`` and did not hold the observation spec."""

SCHEMA = "robo_manip_baselines/evaluation"
SCHEMA_VERSION = 1

RESULTS = "results.jsonl"
MANIFEST = "evaluation.json"
SUMMARY = "summary.json"

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
        motion_clip: recorded clip whose motion the face replayed
        motion_subject: person in that clip
        columns: columns of the task, see its entry
        policy: name of the policy
        condition: name of the experimental condition, for example current_pred_h2
        observation: spec of what the policy was shown, as JSON; null in rows of version 1
        train_seed: seed of the training run; null for a policy that was not trained
        checkpoint: hash of the checkpoint's contents
        versions: of the software
    """

    env: str
    seed: int
    is_success: bool
    is_success_strict: bool
    completion_time: float | None
    steps: int
    failure: str
    motion_clip: str
    motion_subject: str
    columns: dict[str, Any] = field(default_factory=dict)
    policy: str = ""
    condition: str = ""
    observation: dict[str, Any] | None = None
    train_seed: int | None = None
    checkpoint: str = ""
    versions: dict[str, str] = field(default_factory=dict)

    def to_line(self) -> str:
        """Return the row as one line of JSON, without the line's end."""
        values = asdict(self)
        columns = values.pop("columns")
        return json.dumps({"version": ROW_VERSION, **values, **columns}, allow_nan=False)

    @classmethod
    def from_line(cls, line: str) -> EpisodeResult:
        """Read a row of this version or of version 1.

        Raises:
            ValueError: it is no such row; the message says what is wrong with it.
        """
        values = json.loads(line)
        if not isinstance(values, dict):
            raise ValueError("it is no JSON object")
        version = values.pop("version", 1)
        if version == 1:
            values.setdefault("observation", None)
            if "arm" in values:
                values["condition"] = values.pop("arm")
        elif version != ROW_VERSION:
            raise ValueError(f"'version' is {version}; this release reads 1 and {ROW_VERSION}")
        hints = typing.get_type_hints(cls)
        hints.pop("columns")
        given = {name: _checked(values, name, hint) for name, hint in hints.items()}
        task = task_entry(given["env"])
        columns = {c.name: _checked(values, c.name, _hint_of(c)) for c in task.columns}
        if unknown := sorted(set(values) - set(given) - set(columns)):
            raise ValueError(f"'{unknown[0]}' is unknown")
        if given["failure"] and given["failure"] not in task.failures:
            raise ValueError(f"'failure' is {json.dumps(given['failure'])}")
        return cls(**given, columns={k: _with_tuples(v) for k, v in columns.items()})


Vector = tuple[float, float, float]


def _hint_of(column: ResultColumn) -> Any:
    kind: Any = Vector if column.kind == "vector" else float
    return kind | None if column.is_optional else kind


def _checked(values: dict[str, Any], name: str, hint: Any) -> Any:
    if name not in values:
        raise ValueError(f"'{name}' is missing")
    if not _fits(values[name], hint):
        raise ValueError(f"'{name}' is {json.dumps(values[name])}")
    return values[name]


def _fits(value: Any, hint: Any) -> bool:
    """Return whether a JSON value is of the declared type."""
    if isinstance(hint, types.UnionType) or typing.get_origin(hint) is typing.Union:
        return any(_fits(value, part) for part in typing.get_args(hint))
    if hint is float:
        return isinstance(value, float | int) and not isinstance(value, bool)
    if hint is int:
        return isinstance(value, int) and not isinstance(value, bool)
    if hint == Vector:
        return isinstance(value, list) and len(value) == 3 and all(_fits(v, float) for v in value)
    if typing.get_origin(hint) is dict:
        is_text = typing.get_args(hint)[1] is str
        return isinstance(value, dict) and all(
            isinstance(v, str) or not is_text for v in value.values()
        )
    return isinstance(value, hint)


def _with_tuples(value: Any) -> Any:
    return tuple(value) if isinstance(value, list) else value


def read_rows(path: Path) -> list[EpisodeResult]:
    """Read the rows of a results file in their order; a torn last row is left out.

    Raises:
        RequestError: the file cannot be read, or a row is damaged.
    """
    try:
        text = path.read_text(encoding="utf-8", errors="replace")
    except OSError as error:
        raise RequestError(
            f"'{path}' cannot be read: {error.strerror}; name a results.jsonl file"
        ) from error
    rows = []
    for number, line in enumerate(text[: text.rfind("\n") + 1].splitlines(), start=1):
        try:
            rows.append(EpisodeResult.from_line(line))
        except ValueError as error:
            raise RequestError(
                f"'{path}', line {number} is damaged: {error}; remove that line, and its episode "
                "is done again"
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
    """Results of one evaluation, appended as episodes end. Use as a context manager.

    Args:
        folder: created if need be.
        settings: what all episodes of the folder must share, ready for JSON.
        facts: further facts to record, ready for JSON.

    Attributes:
        done: results that the folder already holds, by seed.

    Raises:
        RequestError: the folder holds results of other settings, is damaged, or cannot be written.
    """

    def __init__(self, folder: Path, settings: dict[str, Any], facts: dict[str, Any]) -> None:
        self._path = folder / RESULTS
        _refuse_other_settings(folder, settings)
        self.done = {r.seed: r for r in read_results(folder)} if self._path.exists() else {}
        prepare_folder(folder)
        if not (folder / MANIFEST).exists():
            content = {"schema": SCHEMA, "version": SCHEMA_VERSION, "settings": settings, **facts}
            write_json(folder / MANIFEST, content)
        self._file: TextIO | None = None

    def __enter__(self) -> ResultsFile:
        _drop_torn_line(self._path)
        self._file = self._path.open("a", encoding="utf-8")
        return self

    def __exit__(
        self,
        exc_type: type[BaseException] | None,
        exc: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if self._file:
            self._file.close()
            self._file = None
        if exc_type is None:
            rows = self.of(sorted(self.done))
            write_text(self._path, "".join(f"{row.to_line()}\n" for row in rows))

    def append(self, result: EpisodeResult) -> None:
        """Write a row; it is on the disk when this returns."""
        if self._file is None:
            raise ValueError("open it with a with statement before appending")
        self._file.write(result.to_line() + "\n")
        self._file.flush()
        os.fsync(self._file.fileno())
        self.done[result.seed] = result

    def of(self, seeds: Sequence[int]) -> list[EpisodeResult]:
        """Return the results of these seeds, as far as they are there."""
        return [self.done[seed] for seed in seeds if seed in self.done]


def _refuse_other_settings(folder: Path, settings: dict[str, Any]) -> None:
    path = folder / MANIFEST
    if not path.exists():
        if (folder / RESULTS).exists():
            raise RequestError(f"'{folder}' holds {RESULTS} without {MANIFEST}; give another --out")
        return
    try:
        content = read_json(path)
        schema, version, there = content["schema"], content["version"], content["settings"]
    except (RequestError, KeyError) as error:
        raise RequestError(f"'{path}' is damaged; give another --out") from error
    if (schema, version) != (SCHEMA, SCHEMA_VERSION):
        raise RequestError(
            f"'{path}' is of {schema} version {version}, not {SCHEMA} version {SCHEMA_VERSION}; "
            "give another --out"
        )
    # As JSON would give them back: tuples become lists.
    wanted = json.loads(json.dumps(settings))
    for name in sorted({*wanted, *there}):
        if there.get(name) != wanted.get(name):
            raise RequestError(
                f"'{folder}' holds results with {name} {there.get(name)}, not {wanted.get(name)}; "
                "give another --out or remove that folder"
            )


def _drop_torn_line(path: Path) -> None:
    if not path.exists():
        return
    content = path.read_bytes()
    whole = content.rfind(b"\n") + 1
    if whole < len(content):
        os.truncate(path, whole)


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
    """Summarize the results of all episodes.

    Args:
        task: that they are of.
        results: of all episodes.
        new: number of them that this run made.
        seconds: of this run.
    """
    total, limit = len(results), task.success_time_limit
    times = [r.completion_time for r in results if r.completion_time is not None]
    kinds = Counter(r.failure for r in results)
    columns = {}
    for column in task.columns:
        values = [r.columns[column.name] for r in results]
        found = [value for value in values if value is not None]
        if column.kind == "float" and found:
            columns[column.name] = {"median": float(np.median(found)), "max": max(found)}
    return EvaluationSummary(
        episodes=total,
        success=Proportion.of(sum(r.is_success for r in results), total),
        strict_success=Proportion.of(sum(r.is_success_strict for r in results), total),
        # Times are whole control steps; the limit itself is within.
        success_within_limit=None
        if limit is None
        else Proportion.of(sum(t <= limit for t in times), total),
        completion_time_mean=float(np.mean(times)) if times else None,
        completion_time_sd=float(np.std(times, ddof=1)) if len(times) > 1 else None,
        columns=columns,
        failures={kind: kinds[kind] for kind in task.failures},
        failed_seeds=[r.seed for r in results if not r.is_success],
        seconds=seconds,
        episodes_per_second=new / seconds if new else None,
    )


def summary_table(task: TaskEntry, summary: EvaluationSummary, facts: dict[str, str]) -> str:
    """Lay out the closing table; ``facts`` are further rows at its end."""
    total, limit = summary.episodes, summary.success_within_limit
    failures = [f"{kind} {count}" for kind, count in summary.failures.items() if count]
    rate = summary.episodes_per_second

    def proportion(part: Proportion) -> str:
        return f"{part.count}/{total}  {part}"

    rows = {
        "episodes": str(total),
        "success": proportion(summary.success),
        "strict success": proportion(summary.strict_success),
    }
    if limit:
        rows[f"success in {task.success_time_limit:g} s"] = proportion(limit)
    rows["completion time"] = mean_and_sd(summary.completion_time_mean, summary.completion_time_sd)
    for name, values in summary.columns.items():
        label = name.replace("_", " ")
        rows[label] = f"{values['median']:.4g} (median), {values['max']:.4g} (max)"
    rows |= {
        "failures": ", ".join(failures) or "-",
        "speed": "-" if rate is None else f"{rate:.2f} episodes/s",
        **facts,
    }
    return closing_table(rows)


def mean_and_sd(mean: float | None, sd: float | None) -> str:
    """Format a mean time with its standard deviation: ``5.69 ± 0.96 s``."""
    if mean is None:
        return "-"
    return f"{mean:.2f}" + (f" ± {sd:.2f} s" if sd is not None else " s")
