"""Kinds of failure: every way of failing has one, at the boundaries too."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from robo_manip_baselines.envs.mujoco.tasks.feeding import ENTRY
from robo_manip_baselines.envs.mujoco.tasks.feeding.metrics import (
    FeedingMetrics,
    Offset,
    failure_kind,
)

BELOW = float(np.nextafter(0.06, 0.0))  # m, just at the face


@pytest.mark.parametrize(
    ("offset", "released", "kind"),
    [
        (None, False, "never_grasped"),
        # Not at the face, or in front of the mouth: is the cube still there?
        ((0.15, 0.0, 0.0), True, "dropped"),
        ((0.15, 0.0, 0.0), False, "too_late"),
        ((0.03, 0.0, 0.0), True, "dropped"),
        ((0.03, 0.0, 0.0), False, "too_late"),
        ((-0.03, 0.0, 0.0), False, "too_late"),
        ((0.06, 0.2, -0.3), False, "too_late"),
        ((-0.06, 0.2, -0.3), True, "dropped"),
        ((BELOW, 0.009, -0.009), True, "dropped"),
        ((BELOW, 0.009, -0.009), False, "too_late"),
        # At the face and beside the mouth: the larger part across; letting go there is a miss.
        ((BELOW, 0.0, 0.012), False, "missed_high"),
        ((BELOW, 0.0, 0.012), True, "missed_high"),
        ((-BELOW, 0.0, -0.012), True, "missed_low"),
        ((0.0, 0.012, 0.0), True, "missed_left"),
        ((0.0, -0.012, 0.0), False, "missed_right"),
        ((0.0, 0.011, 0.012), False, "missed_high"),
        ((0.0, 0.012, -0.011), False, "missed_left"),
        ((0.0, -0.012, 0.012), False, "missed_high"),  # a tie goes up or down
        ((0.0, 0.01, 0.0), False, "missed_left"),  # the tolerance itself is outside
        ((0.0, 0.0, -0.01), False, "missed_low"),
        # Within all tolerances, and yet no success: it was not held by both fingers.
        ((0.0, 0.009, 0.009), False, "dropped"),
        ((0.0, 0.0, 0.0), True, "dropped"),
    ],
)
def test_boundaries(offset: Offset | None, released: bool, kind: str) -> None:
    assert failure_kind(False, released, offset) == kind
    assert failure_kind(True, released, offset) == ""


def test_every_combination_of_facts_has_a_known_kind_and_every_kind_occurs() -> None:
    steps = (-0.2, -0.06, -0.03, -0.01, 0.0, 0.009, 0.01, 0.029, 0.03, 0.2)
    offsets: list[Offset | None] = [None, *itertools.product(steps, repeat=3)]
    kinds = {failure_kind(False, released, at) for released in (False, True) for at in offsets}
    assert kinds == set(ENTRY.failures)


def info(phase: str, gripper: tuple[float, float, float], **changes: object) -> dict[str, object]:
    """The mouth is at (0, 0.5, 0.35)."""
    return {
        "phase": phase,
        "utensil_position": np.array(gripper),
        "mouth_position": np.array([0.0, 0.5, 0.35]),
        "cube_offset": np.array(gripper) - [0.012, 0.5, 0.35],  # ahead of the gripper
        "face_force": 0.0,
        "is_success": False,
        "is_success_strict": False,
        "completion_time": None,
        "time_since_lift": None,
        **changes,
    }


def metrics_of(*infos: dict[str, object]) -> FeedingMetrics:
    metrics = FeedingMetrics()
    for one in infos:
        metrics.update(one)
    return metrics


def test_the_closest_approach_counts_only_while_the_cube_is_carried() -> None:
    at_mouth = (0.0, 0.5, 0.35)
    last = info("release", at_mouth, face_force=2.0, time_since_lift=0.1 + 0.2)
    metrics = metrics_of(
        info("reach", at_mouth),
        info("grasp", at_mouth, face_force=3.5),
        info("carry", (0.10, 0.5, 0.35)),
        info("carry", (0.02, 0.5, 0.33)),
        info("release", at_mouth),
        last,
    )
    failure, columns = metrics.result(last)
    assert columns["face_force"] == 3.5
    assert columns["time_since_lift"] == 0.3  # without what floating point adds
    assert columns["closest_distance"] == pytest.approx(np.hypot(0.02, 0.02))
    assert columns["closest_offset"] == pytest.approx((0.02, 0.0, -0.02))
    assert columns["cube_offset"] == pytest.approx((0.008, 0.0, -0.02))
    assert failure == "missed_low"


def test_times_above_a_force_and_within_the_tolerance() -> None:
    """Control steps of 0.02 s; limits themselves are outside, and only a held cube dwells."""
    at_mouth, edge = (0.0, 0.5, 0.35), (0.029, 0.509, 0.341)
    metrics = metrics_of(
        info("grasp", at_mouth, face_force=31.0),
        info("carry", at_mouth, face_force=30.0),
        info("carry", (0.031, 0.5, 0.35), face_force=10.5),
        info("deliver", edge, face_force=1.0),
        info("deliver", (0.0, 0.5, 0.361), face_force=1.1),
        info("release", at_mouth),
    )
    _, columns = metrics.result(info("release", at_mouth))
    assert [columns[f"force_time_{limit}"] for limit in (1, 10, 30)] == [0.08, 0.06, 0.02]
    assert columns["dwell"] == 0.04


def test_nearest_is_meant_in_units_of_the_tolerances() -> None:
    """2.9 cm out is nearer than 2 cm low: it is within the tolerance, the other is twice it."""
    metrics = metrics_of(info("carry", (0.029, 0.5, 0.35)), info("carry", (0.0, 0.5, 0.33)))
    _, columns = metrics.result(info("carry", (0.0, 0.5, 0.33)))
    assert columns["closest_offset"] == pytest.approx((0.029, 0.0, 0.0))
    assert columns["cube_offset"] == pytest.approx((0.017, 0.0, 0.0))
    assert columns["closest_distance"] == pytest.approx(0.02)


def test_without_a_lift_there_is_no_closest_approach() -> None:
    at_mouth = (0.0, 0.5, 0.35)
    failure, columns = metrics_of(info("grasp", at_mouth)).result(info("reach", at_mouth))
    assert (columns["closest_distance"], columns["closest_offset"]) == (None, None)
    assert columns["cube_offset"] is None
    assert failure == "never_grasped"


def test_a_success_has_no_kind_of_failure() -> None:
    last = info("deliver", (0.0, 0.5, 0.35), is_success=True, completion_time=4.3)
    failure, _ = metrics_of(last).result(last)
    assert failure == ""
