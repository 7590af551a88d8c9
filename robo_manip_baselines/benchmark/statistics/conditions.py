"""Conditions of a benchmark as tables and figures name them: label, group and order."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import product, starmap

from robo_manip_baselines.observation import (
    ERRORS,
    PRESETS,
    Corruption,
    ObservationSpec,
)

WITH_ERROR = "uniform"
"""Error that labels call "with error": the paper's, uniform within its equations 6 and 7."""

GROUPS = ("Baseline", "Current only", "Current + prediction", "Further conditions")
"""Observation presets without a corruption or with the paper's error, then everything else."""

BASELINE, CURRENT, PREDICTION, FURTHER = GROUPS

MAX_HORIZON, MAX_DELAY = 5, 30
"""Frames of the longest horizon and of the latest condition that the rows of version 1 name."""


@dataclass(frozen=True)
class ConditionDescription:
    """Name and place of an experimental condition in tables and figures.

    Attributes:
        name: as in ``results.jsonl``.
        label: for readers.
        group: one of ``GROUPS``.
        horizon: frames of the forecast; 0 for the present position alone; None where the policy
            is not shown the target, or its past, or the observation is not known.
        error: error of the forecast; ``none`` without.
        delay: frames by which the observed target is late.

    Raises:
        ValueError: there is no such group.
    """

    name: str
    label: str
    group: str
    horizon: int | None = None
    error: str = "none"
    delay: int = 0

    def __post_init__(self) -> None:
        if self.group not in GROUPS:
            raise ValueError(f"group '{self.group}': must be one of {', '.join(GROUPS)}")


def describe_condition(
    name: str, spec: ObservationSpec | None = None, label: str = ""
) -> ConditionDescription:
    """Describe a condition by its observation spec.

    A condition with another name than its preset, error and delay make differs in something else
    too: it belongs to the last group, labelled with its name.

    Args:
        name: of the condition.
        spec: of what its policy is shown; None, as in rows of version 1, looks the name up.
        label: for readers; made from the spec if empty.
    """
    spec = spec or _specs_by_name().get(name)
    if spec is None:
        return ConditionDescription(name, label or name, FURTHER)
    error, delay = spec.corruption.error, spec.corruption.delay
    if _spec_with(spec.obs, spec.horizon, error, delay).name != name:
        return ConditionDescription(name, label or name, FURTHER)
    group = FURTHER if spec.past_frames else GROUPS[PRESETS.index(spec.obs)]
    horizon = spec.frames - 1 if spec.frames and not spec.past_frames else None
    made = f"Prediction, {_frames(spec.horizon)}" if group == PREDICTION else group
    if spec.past_frames:
        made = f"Current and {spec.past_frames} past frames"
    if error != "none":
        made += ", with error" if error == WITH_ERROR else f", {error} error"
    if delay:
        made += f", {_frames(delay)} late"
    if delay or error not in ("none", WITH_ERROR):
        group = FURTHER
    return ConditionDescription(name, label or made, group, horizon, error, delay)


def sort_conditions(
    conditions: Iterable[ConditionDescription], given: Sequence[str] = ()
) -> list[ConditionDescription]:
    """Sort conditions as the paper's table does, further ones last.

    Predictions are sorted by horizon, without error before with error; further conditions by their
    order in ``given``, then by horizon, error, delay and name.

    Args:
        conditions: in any order.
        given: names in the order of whoever declared them.
    """
    return sorted(
        conditions,
        key=lambda c: (
            GROUPS.index(c.group),
            given.index(c.name) if c.group == FURTHER and c.name in given else len(given),
            math.inf if c.horizon is None else c.horizon,
            *(c.error != "none", c.error, c.delay, c.name),
        ),
    )


@cache
def _specs_by_name() -> dict[str, ObservationSpec]:
    horizons, delays = range(1, MAX_HORIZON + 1), range(MAX_DELAY + 1)
    shown = [
        ("baseline", 1, "none", 0),
        *product(["current"], [1], ["none"], delays),
        *product(["current_pred"], horizons, ERRORS, delays),
    ]
    return {spec.name: spec for spec in starmap(_spec_with, shown)}


def _spec_with(obs: str, horizon: int, error: str, delay: int) -> ObservationSpec:
    return ObservationSpec(obs, horizon, corruption=Corruption(error=error, delay=delay))


def _frames(number: int) -> str:
    return f"{number} frame{'s' if number != 1 else ''}"
