"""What one evaluation episode came to: a line of ``results.jsonl``."""

from __future__ import annotations

import json
import os
import types
import typing
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from types import TracebackType
from typing import Any, TextIO

import numpy as np

from robo_manip_baselines.envs.mujoco.tasks.feeding.failure import APPROACH_LIMIT, FAILURES
from robo_manip_baselines.runs.errors import RequestError
from robo_manip_baselines.runs.files import atomic_file, prepare_folder

Offset = tuple[float, float, float]


@dataclass(frozen=True)
class EpisodeResult:
    """One episode, SI units, world frame.

    Attributes:
        env: name of the environment
        seed: of the episode
        is_success: the gripper brought the cube within 0.03, 0.01 and 0.01 m of the mouth
        is_success_strict: and let go of it inside the mouth, without touching the face
        completion_time: s from the lift to success; null without success
        time_since_lift: s from the lift to the end of the episode; null without a lift
        steps: control steps of 0.02 s
        failure: kind of failure; empty for a success
        closest_distance: m, smallest distance gripper-mouth while the lifted cube was held; null
            without a lift
        closest_offset: m, x, y, z of gripper minus mouth at the closest approach with the cube,
            nearest in units of the tolerances; null without a lift
        cube_offset: m, cube minus mouth in the face's axes (out, across to the person's left, up)
            where the lifted cube was held and its centre nearest to the mouth; null without a lift
        face_force: N, largest normal force between robot and face
        motion_clip: recorded clip whose motion the face replayed
        motion_subject: person in that clip
        policy: name of the policy
        arm: experimental arm: what the policy was shown, for example current_pred_h2
        train_seed: seed of the training run; null for a policy that was not trained
        checkpoint: hash of the checkpoint's contents
        versions: of the software
    """

    env: str
    seed: int
    is_success: bool
    is_success_strict: bool
    completion_time: float | None
    time_since_lift: float | None
    steps: int
    failure: str
    closest_distance: float | None
    closest_offset: Offset | None
    cube_offset: Offset | None
    face_force: float
    motion_clip: str
    motion_subject: str
    policy: str = ""
    arm: str = ""
    train_seed: int | None = None
    checkpoint: str = ""
    versions: dict[str, str] = field(default_factory=dict)

    def to_line(self) -> str:
        """Return it as one line of JSON, without the line's end."""
        return json.dumps(asdict(self), allow_nan=False)

    @classmethod
    def from_line(cls, line: str) -> EpisodeResult:
        """Read what ``to_line`` wrote.

        Raises:
            ValueError: it is no such line; the message says what is wrong with it.
        """
        values = json.loads(line)
        if not isinstance(values, dict):
            raise ValueError("it is no JSON object")
        hints = typing.get_type_hints(cls)
        names = [item.name for item in fields(cls)]
        for name in names:
            if name not in values:
                raise ValueError(f"'{name}' is missing")
            if not _fits(values[name], hints[name]):
                raise ValueError(f"'{name}' is {json.dumps(values[name])}")
        if unknown := sorted(set(values) - set(names)):
            raise ValueError(f"'{unknown[0]}' is unknown")
        if values["failure"] and values["failure"] not in FAILURES:
            raise ValueError(f"'failure' is {json.dumps(values['failure'])}")
        for name in ("closest_offset", "cube_offset"):
            if values[name] is not None:
                values[name] = tuple(values[name])
        return cls(**values)


def _fits(value: Any, hint: Any) -> bool:
    """Whether a JSON value is of the declared type."""
    if isinstance(hint, types.UnionType) or typing.get_origin(hint) is typing.Union:
        return any(_fits(value, part) for part in typing.get_args(hint))
    if hint is float:
        return isinstance(value, float | int) and not isinstance(value, bool)
    if hint is int:
        return isinstance(value, int) and not isinstance(value, bool)
    if hint == Offset:
        return isinstance(value, list) and len(value) == 3 and all(_fits(v, float) for v in value)
    if typing.get_origin(hint) is dict:
        return isinstance(value, dict) and all(isinstance(v, str) for v in value.values())
    return isinstance(value, hint)


SCHEMA = "robo_manip_baselines/evaluation"
SCHEMA_VERSION = 1

RESULTS = "results.jsonl"
MANIFEST = "evaluation.json"


def read_results(folder: str | Path) -> list[EpisodeResult]:
    """Read the results of a folder by seed; a torn last line is left out.

    Raises:
        RequestError: there are none, or a line is damaged.
    """
    path = Path(folder) / RESULTS
    try:
        text = path.read_text(encoding="utf-8", errors="replace")
    except OSError as error:
        raise RequestError(
            f"'{path}' cannot be read: {error.strerror}; name a folder that Rollout.py wrote"
        ) from error
    found: dict[int, EpisodeResult] = {}
    for number, line in enumerate(text[: text.rfind("\n") + 1].splitlines(), start=1):
        try:
            result = EpisodeResult.from_line(line)
        except ValueError as error:
            raise RequestError(
                f"'{path}', line {number} is damaged: {error}; remove that line, and its episode "
                "is done again"
            ) from error
        if result.seed in found:
            raise RequestError(f"'{path}' has two lines for seed {result.seed}; remove one")
        found[result.seed] = result
    return [found[seed] for seed in sorted(found)]


class ResultsFile:
    """Results of one evaluation, appended as episodes end. Use as a context manager.

    Args:
        folder: made if need be.
        settings: what must be the same for all episodes of the folder, ready for JSON.
        facts: what else to note, ready for JSON.

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
            _write(folder / MANIFEST, json.dumps(content, indent=2) + "\n")
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
            _write(self._path, "".join(f"{r.to_line()}\n" for r in self.of(sorted(self.done))))

    def append(self, result: EpisodeResult) -> None:
        """Write a line; it is on the disk when this returns."""
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
        content = json.loads(path.read_text(encoding="utf-8"))
        schema, version, there = content["schema"], content["version"], content["settings"]
    except (OSError, ValueError, KeyError, TypeError) as error:
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
    """Cut off what follows the last end of a line."""
    if not path.exists():
        return
    content = path.read_bytes()
    whole = content.rfind(b"\n") + 1
    if whole < len(content):
        os.truncate(path, whole)


def _write(path: Path, text: str) -> None:
    with atomic_file(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


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
