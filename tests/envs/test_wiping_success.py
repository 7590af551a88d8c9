"""Success of wiping at its boundaries, its metrics, and every kind of failure."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from robo_manip_baselines.envs.mujoco.tasks.face_force import FaceForce
from robo_manip_baselines.envs.mujoco.tasks.registry import FORCE_COLUMNS
from robo_manip_baselines.envs.mujoco.tasks.wiping import ENTRY
from robo_manip_baselines.envs.mujoco.tasks.wiping.metrics import WipingMetrics, failure_kind
from robo_manip_baselines.envs.mujoco.tasks.wiping.success import (
    CLEAR_DISTANCE,
    EYE_RADIUS,
    PUSH_FORCE,
    WIPE_RADIUS,
    Phase,
    StepMeasurements,
    WipingProgress,
    is_in_range,
    is_on_eye,
    reached_spots,
)

EPSILON = 1e-6
"""m and N, far above rounding and far below any bound."""

CONTACT = np.array([0.04, -0.03, 0.01])


@pytest.mark.parametrize(
    ("force", "expected"),
    [(0.0, False), (1.0 - EPSILON, False), (1.0, True), (3.0, True), (3.0 + EPSILON, False)],
)
def test_the_pad_wipes_with_1_to_3_newtons(force: float, expected: bool) -> None:
    assert is_in_range(force) is expected
    assert reached_spots(CONTACT[None], CONTACT, force) == (frozenset({0} if expected else ()))


def test_it_wipes_near_the_point_of_contact_and_nowhere_without() -> None:
    reach = np.array([0.0, WIPE_RADIUS - EPSILON, WIPE_RADIUS + EPSILON, 0.03])
    way = np.array([0.0, 0.6, -0.8])
    spots = CONTACT + reach[:, None] * way
    assert reached_spots(spots, CONTACT, 2.0) == {0, 1}
    assert reached_spots(spots, None, 0.0) == frozenset()


@pytest.mark.parametrize(
    ("away", "expected"), [(0.0, True), (EYE_RADIUS - EPSILON, True), (EYE_RADIUS, False)]
)
def test_an_eye_is_touched_near_the_middle_of_its_lids(away: float, expected: bool) -> None:
    eyes = np.array([[0.03, 0.032, 0.03], [0.03, -0.032, 0.03]])
    for eye in eyes:
        assert is_on_eye(eye - np.array([0.0, 0.0, away]), eyes) is expected


STEP = StepMeasurements(
    time=1.0,
    pad_force=2.0,
    face_force=2.5,
    reached=frozenset(),
    touches_eye=False,
    pad_distance=0.02,
)
WIPED = replace(STEP, reached=frozenset(range(8)), time=2.0)
AWAY = replace(STEP, pad_force=0.0, face_force=0.0, pad_distance=CLEAR_DISTANCE, time=3.0)


def run(*steps: StepMeasurements, spots: int = 10) -> WipingProgress:
    """Take in steps, one after another."""
    progress = WipingProgress(spots=spots)
    for step in steps:
        progress = progress.advance(step)
    return progress


@pytest.mark.parametrize(("wiped", "expected"), [(0, False), (7, False), (8, True), (10, True)])
def test_success_is_four_fifths_of_the_residue(wiped: int, expected: bool) -> None:
    progress = run(STEP, replace(STEP, reached=frozenset(range(wiped)), time=2.0))
    assert progress.is_success is expected
    assert progress.success_time == (2.0 if expected else None)
    assert progress.wiped_share == wiped / 10


def test_spots_stay_wiped_and_count_once() -> None:
    progress = run(*(replace(STEP, reached=frozenset({n, n + 1})) for n in (0, 1, 1, 4)))
    assert progress.wiped == {0, 1, 2, 4, 5}
    assert not progress.is_success


def test_phases_go_from_the_first_contact_to_success() -> None:
    assert run().phase is Phase.APPROACH
    assert run(AWAY).phase is Phase.APPROACH
    assert run(STEP).phase is Phase.WIPE
    assert run(STEP, AWAY).phase is Phase.WIPE
    assert run(WIPED).phase is Phase.FINISH


@pytest.mark.parametrize(
    ("steps", "expected"),
    [
        ((WIPED, AWAY), True),
        ((WIPED,), True),
        ((STEP, AWAY), False),  # not wiped
        # 7 of 10 steps in contact with 1 to 3 N, and 6.
        ((*[STEP] * 6, WIPED, *[replace(STEP, pad_force=0.5)] * 3, AWAY), True),
        ((*[STEP] * 5, WIPED, *[replace(STEP, pad_force=3.5)] * 4, AWAY), False),
        ((replace(STEP, face_force=PUSH_FORCE), WIPED, AWAY), True),
        ((replace(STEP, face_force=PUSH_FORCE + EPSILON), WIPED, AWAY), False),
        ((WIPED, replace(STEP, face_force=PUSH_FORCE + EPSILON), AWAY), False),
        ((replace(STEP, touches_eye=True), WIPED, AWAY), False),
    ],
)
def test_strict_success(steps: tuple[StepMeasurements, ...], expected: bool) -> None:
    progress = run(*steps)
    assert progress.is_success_strict is expected


@pytest.mark.parametrize(
    ("steps", "expected"),
    [
        ((WIPED, AWAY), True),
        ((WIPED, AWAY, STEP), True),
        ((WIPED,), False),
        ((WIPED, replace(AWAY, pad_distance=CLEAR_DISTANCE - EPSILON)), False),
        ((AWAY, WIPED), False),  # away before, not after
        ((STEP, AWAY), False),  # not wiped
    ],
)
def test_the_pad_withdraws_after_success(
    steps: tuple[StepMeasurements, ...], expected: bool
) -> None:
    assert run(*steps).is_clear is expected


@pytest.mark.parametrize(
    ("below", "within", "above", "kind"),
    [
        (0, 0, 0, "no_contact"),
        (0, 1, 0, "missed"),
        (1, 2, 1, "missed"),
        (1, 2, 2, "too_hard"),
        (2, 2, 1, "too_light"),
        (1, 0, 1, "too_light"),
        (0, 0, 1, "too_hard"),
    ],
)
def test_kinds_of_failure(below: int, within: int, above: int, kind: str) -> None:
    assert failure_kind(False, below, within, above) == kind
    assert kind in ENTRY.failures
    assert failure_kind(True, below, within, above) == ""


def test_every_kind_of_failure_occurs() -> None:
    counts = [(b, w, a) for b in range(3) for w in range(3) for a in range(3)]
    assert {failure_kind(False, *count) for count in counts} == set(ENTRY.failures)


def info(pad: float, face: float, **more: Any) -> Mapping[str, Any]:
    """Make the info of a step with these forces."""
    return {"is_success": False, "wiped_share": 0.25, "pad_force": pad, "face_force": face, **more}


def test_metrics_of_an_episode() -> None:
    metrics = WipingMetrics()
    for step in ((0.0, 0.0), (0.5, 0.8), (2.0, 2.4), (2.0, 30.0), (5.5, 30.5), (0.0, 12.0)):
        metrics.update(info(*step))
    kind, columns = metrics.result(info(0.0, 0.0))
    assert kind == "missed"
    assert columns == {
        "wiped_share": 0.25,
        "pad_force_mean": 2.5,
        "contact_time": 0.08,
        "range_share": 0.5,
        "face_force": 30.5,
        "force_time_1": 0.08,
        "force_time_10": 0.06,
        "force_time_30": 0.02,
    }


def test_metrics_without_contact_are_null() -> None:
    metrics = WipingMetrics()
    metrics.update(info(0.0, 0.0))
    kind, columns = metrics.result(info(0.0, 0.0))
    assert kind == "no_contact"
    assert (columns["pad_force_mean"], columns["range_share"]) == (None, None)
    assert columns["contact_time"] == 0.0
    null = {column.name for column in ENTRY.columns if column.is_optional}
    assert {name for name, value in columns.items() if value is None} <= null


def test_force_columns_are_those_of_force_times() -> None:
    assert list(FaceForce().columns()) == [column.name for column in FORCE_COLUMNS]
