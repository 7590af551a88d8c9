"""The arms of a benchmark: what their names say, how a reader calls them, in which order."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

PAPER_ERROR = "uniform"
"""Error kind that is the paper's "with error": uniform within the bounds of its equations 6, 7."""

PAPER_HORIZONS = range(1, 6)
"""Frames of 1/30 s, Tables IV and V."""

GROUPS = ("Baseline", "Current only", "Current + prediction", "Further arms")
"""The paper's observation types (Table IV), then everything that the paper does not have."""

BASELINE, CURRENT, PREDICTION, FURTHER = GROUPS

_NAME = re.compile(
    r"(?P<obs>baseline|current_pred|current)(?:_h(?P<horizon>\d+))?"
    r"(?:_(?P<error>uniform|gaussian|empirical|model))?(?:_delay(?P<delay>\d+))?"
)


@dataclass(frozen=True)
class Arm:
    """An experimental arm.

    Attributes:
        name: as in ``results.jsonl``.
        label: what a reader is shown.
        group: one of ``GROUPS``.
        horizon: frames of the forecast; 0 shows the present mouth only; None shows no mouth, or it
            cannot be told.
        error: kind of error in what the policy is shown; ``none`` without.
        delay: frames by which all that the policy is told of the mouth is late.
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


def arm_of(name: str) -> Arm:
    """Describe an arm by its name, for example ``current_pred_h2_uniform``.

    A name of another form is an arm of the last group, called by its name.
    """
    found = _NAME.fullmatch(name)
    if found is None or (found["obs"] == "current_pred") != (found["horizon"] is not None):
        return Arm(name, name, FURTHER)
    error, delay = found["error"] or "none", int(found["delay"] or 0)
    horizon = {"baseline": None, "current": 0}.get(found["obs"], int(found["horizon"] or 0))
    group = {"baseline": BASELINE, "current": CURRENT}.get(found["obs"], PREDICTION)
    label = group
    if group == PREDICTION:
        label = f"Prediction, {horizon} frame{'s' if horizon != 1 else ''}"
    if error != "none":
        label += ", with error" if error == PAPER_ERROR else f", {error} error"
    if delay:
        label += f", {delay} frame{'s' if delay != 1 else ''} late"
    is_paper = not delay and (
        error == "none" if group != PREDICTION else error in ("none", PAPER_ERROR)
    )
    return Arm(name, label, group if is_paper else FURTHER, horizon, error, delay)


def in_order(names: Iterable[str], described: Mapping[str, Arm] | None = None) -> tuple[Arm, ...]:
    """Describe arms and put them in the order of the paper's table, further arms last.

    Within the forecasts: by horizon, without error before with error. Within the further arms: as
    they are described, then by horizon, error, delay and name.

    Args:
        names: of arms, in any order, repeated or not.
        described: arms whose names do not say enough; may name others too.
    """
    described = described or {}
    given = {name: place for place, name in enumerate(described)}

    def place(arm: Arm) -> tuple[int, int, float, bool, str, int, str]:
        return (
            GROUPS.index(arm.group),
            given.get(arm.name, len(given)) if arm.group == FURTHER else 0,
            math.inf if arm.horizon is None else arm.horizon,
            arm.error != "none",
            arm.error,
            arm.delay,
            arm.name,
        )

    return tuple(sorted((described.get(name) or arm_of(name) for name in set(names)), key=place))
