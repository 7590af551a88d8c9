"""Agreement of result rows: what rows have in common before anything is computed from them.

A rate, a mean or an interval over rows of two policies, two worlds or two releases is a number
about neither. Everything that aggregates rows calls one of the functions here first.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from robo_manip_baselines.runs.errors import RequestError

if TYPE_CHECKING:
    from robo_manip_baselines.rollout.results import EpisodeResult

VERSIONS = ("mujoco", "numpy", "robo_manip_baselines", "torch")
"""Software that decides how an episode goes; another Python does not."""

WORLD = ("env_kwargs", "motion_sha256", "xml_hash", "device", "precision")
"""Settings that all conditions of a comparison share; the others may be what they differ in."""

_ADVICE = "evaluate them alike, into folders of their own"


def require_one_evaluation(rows: Sequence[EpisodeResult]) -> None:
    """Require that rows are of one policy in one world, each of another seed.

    Raises:
        RequestError: naming the first difference with both values, or the seed.
    """
    _require_each_once(rows)
    _require_same(rows, lambda row: {**_world(row), **_condition(row), **_training_run(row)})


def require_one_condition(rows: Sequence[EpisodeResult]) -> None:
    """Require that rows are of one experimental condition.

    Its training runs may be several; each has one checkpoint, and all have the same seeds.

    Raises:
        RequestError: naming the first difference with both values, or the seed.
    """
    _require_each_once(rows)
    _require_same(rows, lambda row: {**_world(row), **_condition(row)})
    runs: dict[Any, list[EpisodeResult]] = {}
    for row in rows:
        runs.setdefault(row.train_seed, []).append(row)
    for own in runs.values():
        _require_same(own, _training_run)
    _require_same_seeds(runs.values())


def require_one_comparison(rows: Sequence[EpisodeResult]) -> None:
    """Require that the conditions of rows were evaluated in one world, on the same seeds.

    Raises:
        RequestError: naming the first difference with both values, or the seed.
    """
    conditions: dict[str, list[EpisodeResult]] = {}
    for row in rows:
        conditions.setdefault(row.condition, []).append(row)
    for own in conditions.values():
        require_one_condition(own)
    _require_same(rows, _world)
    _require_same_seeds(conditions.values())


def require_continuation(
    folder: Path, rows: Iterable[EpisodeResult], origin: Mapping[str, Any]
) -> None:
    """Require that the rows of a folder are of the evaluation that is to add to them.

    Args:
        folder: for the message.
        rows: that the folder holds.
        origin: fields of the rows that the evaluation will add.

    Raises:
        RequestError: naming the first difference with both values.
    """
    for row in rows:
        there, here = (
            {**_world(row), **_condition(row), **_training_run(row)}
            for row in (row, replace(row, **origin))
        )
        if found := difference(there, here):
            name, old, new = found
            raise RequestError(
                f"'{folder}' holds results with {name} {_text(old)} (seed {row.seed}), not "
                f"{_text(new)}; give another --out or remove that folder"
            )


def difference(one: Mapping[str, Any], other: Mapping[str, Any]) -> tuple[str, Any, Any] | None:
    """Return the first name with two values, and both; None where the mappings are equal.

    Mappings within are looked into: the name is then ``observation horizon``.
    """
    for name in dict.fromkeys([*one, *other]):
        a, b = one.get(name), other.get(name)
        if isinstance(a, Mapping) and isinstance(b, Mapping):
            if found := difference(a, b):
                return f"{name} {found[0]}", *found[1:]
        elif a != b:
            return name, a, b
    return None


def _world(row: EpisodeResult) -> dict[str, Any]:
    settings = row.settings or {}
    versions = {name: row.versions.get(name) for name in VERSIONS}
    return {
        "env": row.env,
        "versions": versions,
        "settings": "not recorded, by an earlier release" if row.settings is None else "recorded",
        **{name: settings.get(name) for name in WORLD},
    }


def _condition(row: EpisodeResult) -> dict[str, Any]:
    other = {name: value for name, value in (row.settings or {}).items() if name not in WORLD}
    names = {
        "condition": row.condition,
        "policy": row.policy,
        "observation": row.observation,
        "motion": row.motion,
    }
    return names | other


def _training_run(row: EpisodeResult) -> dict[str, Any]:
    return {"train_seed": row.train_seed, "checkpoint": row.checkpoint}


def _require_same(
    rows: Sequence[EpisodeResult], facts_of: Callable[[EpisodeResult], dict[str, Any]]
) -> None:
    """Raise RequestError if the facts of two rows differ."""
    first = facts_of(rows[0]) if rows else {}
    for row in rows[1:]:
        if (facts := facts_of(row)) != first and (found := difference(first, facts)):
            name, ours, theirs = found
            raise RequestError(
                f"results do not belong together: {name} is {_text(ours)} in {_place(rows[0])} and "
                f"{_text(theirs)} in {_place(row)}; {_ADVICE}"
            )


def _require_each_once(rows: Iterable[EpisodeResult]) -> None:
    """Raise RequestError if an episode is there twice."""
    seen: set[tuple[str, int | None, int]] = set()
    for row in rows:
        key = row.condition, row.train_seed, row.seed
        if key in seen:
            raise RequestError(
                f"results do not belong together: {_place(row)} is there twice; leave one of them"
            )
        seen.add(key)


def _require_same_seeds(groups: Iterable[Sequence[EpisodeResult]]) -> None:
    """Raise RequestError if two groups of rows are of different evaluation seeds."""
    first, *others = groups
    seeds = {row.seed for row in first}
    for group in others:
        own = {row.seed for row in group}
        if lacking := sorted(seeds ^ own):
            with_it, without = (first, group) if lacking[0] in seeds else (group, first)
            place = _place(next(row for row in with_it if row.seed == lacking[0]))
            raise RequestError(
                f"results do not belong together: {place} has no counterpart in condition "
                f"'{without[0].condition}', training seed {without[0].train_seed}; evaluate all on "
                "the same seeds"
            )


def _place(row: EpisodeResult) -> str:
    return f"condition '{row.condition}', training seed {row.train_seed}, seed {row.seed}"


def _text(value: Any) -> str:
    """Format a value in short; digests by their first digits."""
    text = str(value)
    return text if len(text) < 64 or " " in text else text[:12]
