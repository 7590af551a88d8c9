"""Safety of an episode: boundaries of everything that is counted."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from robo_manip_baselines.envs.mujoco.face.contact import FaceContact
from robo_manip_baselines.envs.mujoco.face.proximity import Proximity
from robo_manip_baselines.envs.mujoco.tasks.safety import (
    FORCE_TIERS,
    EpisodeSafety,
    SafetyMetrics,
    summarize_safety,
)

FAR = np.array([[-0.4, 0.5, 0.3], [0.6, 0.5, 0.3]])
MOUTH = np.array([0.0, 0.5, 0.35])


def step(
    *contacts: FaceContact,
    face: float | None = None,
    load: float | None = None,
    eye: float | None = None,
    refuses: bool | None = None,
    gripper: float = 0.6,
    success: bool = True,
) -> dict[str, Any]:
    """The ``info`` of a step; ``gripper`` is how far the right one is from the mouth, m."""
    grippers = FAR.copy()
    grippers[1] = MOUTH + np.array([gripper, 0.0, 0.0])
    return {
        "is_success": success,
        "face_contacts": contacts,
        "face_proximity": Proximity(face, load, eye, grippers, MOUTH),
        "is_refusing": refuses,
    }


def touch(force: float, region: str = "cheeks", *, is_food: bool = False) -> FaceContact:
    return FaceContact(region, "gripper", is_food, force, 0.02 * force, (0.05, 0.01, -0.02))


def safety(*steps: dict[str, Any]) -> EpisodeSafety:
    metrics = SafetyMetrics(0.02)
    for info in steps:
        metrics.update(info)
    return metrics.result(steps[-1])


@pytest.mark.parametrize("tier", FORCE_TIERS)
@pytest.mark.parametrize(("factor", "times"), [(0.999, 0), (1.0, 0), (1.001, 2)])
def test_tiers_count_what_is_above_them(tier: int, factor: float, times: int) -> None:
    hard, none = step(touch(factor * tier)), step()
    found = safety(hard, hard, none, hard, none)
    assert found.times_above[str(tier)] == times
    assert found.time_above[str(tier)] == (0.06 if times else 0.0)
    assert found.force == pytest.approx(factor * tier)


@pytest.mark.parametrize(
    ("steps", "is_safe"),
    [
        ([step()], True),
        ([step(success=False)], False),
        ([step(touch(10.0))], True),
        ([step(touch(10.001)), step()], False),
        ([step(touch(40.0, "lips", is_food=True))], True),
        ([step(touch(0.001, "eyes")), step()], False),
        ([step(eye=0.001)], True),  # a near miss is told, and is no touch
        ([step(success=False), step()], True),  # it is the end that counts
    ],
)
def test_a_safe_success(steps: list[dict[str, Any]], is_safe: bool) -> None:
    assert safety(*steps).success_safe is is_safe


def test_food_on_the_lips_is_no_push() -> None:
    found = safety(step(touch(40.0, "lips", is_food=True), touch(3.0, "lips")))
    assert (found.force, found.food_force) == (3.0, 40.0)
    assert found.time_above["30"] == 0.0
    assert {(t.region, t.is_food, t.force) for t in found.touched} == {
        ("lips", True, 40.0),
        ("lips", False, 3.0),
    }


def test_a_touched_region_adds_up() -> None:
    harder = touch(5.0)._replace(point=(0.1, 0.2, 0.3))
    (found,) = safety(step(touch(2.0)), step(harder), step(touch(1.0)), step()).touched
    assert found.force == 5.0
    assert found.point == (0.1, 0.2, 0.3)
    assert found.impulse == pytest.approx(0.02 * 8.0)
    assert found.time == pytest.approx(0.06)


@pytest.mark.parametrize(
    ("distances", "times", "least"),
    [
        ([None, 0.011, 0.010, 0.011], 0, 0.010),
        ([0.020, 0.0099, 0.005, 0.020, 0.009], 2, 0.005),
        ([None, None], 0, None),
        ([0.0, 0.0], 1, 0.0),
    ],
)
def test_near_misses_of_eyes(
    distances: list[float | None], times: int, least: float | None
) -> None:
    found = safety(*(step(eye=distance) for distance in distances))
    assert (found.eye_near_misses, found.eye_distance) == (times, least)
    assert found.eye_contacts == 0


def test_eye_contacts_are_counted_by_spells() -> None:
    at_eye = step(touch(0.5, "eyes"), touch(2.0, "nose"))
    found = safety(at_eye, at_eye, step(), at_eye)
    assert found.eye_contacts == 2
    assert found.force == 2.0


@pytest.mark.parametrize(
    ("distances", "speeds"),
    [
        ([0.055, 0.045, 0.044], [0.05]),  # the first step began outside
        ([0.05, 0.048, 0.049, 0.047], [0.1, 0.1]),  # going away is no approach
        ([0.02, None, 0.02], []),
        ([0.001, 0.0, 0.0, 0.0], [0.05]),  # and neither is pressing on
    ],
)
def test_approach_speed(distances: list[float | None], speeds: list[float]) -> None:
    found = safety(*(step(face=distance) for distance in distances))
    if not speeds:
        assert found.approach_speed is None
        assert found.approach_speed_p90 is None
    else:
        assert found.approach_speed == pytest.approx(max(speeds))
        assert found.approach_speed_p90 == pytest.approx(np.percentile(speeds, 90))


def test_a_load_that_is_taken_up_is_no_approach() -> None:
    found = safety(step(face=0.04), step(face=0.04, load=0.01), step(face=0.04, load=0.009))
    assert found.approach_speed == pytest.approx(0.05)


def refusal(way: list[float], after: int = 30, *contacts: FaceContact) -> EpisodeSafety:
    """A head turns away for the grace of 25 steps and then as many as ``way`` has places."""
    turned = [step(refuses=True, gripper=way[0]) for _ in range(25)]
    followed = [step(*contacts, refuses=True, gripper=place) for place in way]
    return safety(step(refuses=False), *turned, *followed, step(refuses=False))


@pytest.mark.parametrize(
    ("way", "count", "respected"),
    [
        ([0.20] * 20, 1, 1),  # it waits
        (np.linspace(0.20, 0.30, 20).tolist(), 1, 1),  # it withdraws
        (np.linspace(0.20, 0.181, 20).tolist(), 1, 1),  # 19 mm, out of inertia
        (np.linspace(0.20, 0.175, 20).tolist(), 1, 0),  # 25 mm: it follows
        (np.linspace(0.50, 0.40, 20).tolist(), 0, 0),  # too far to concern it
        ([], 0, 0),  # shorter than the grace
    ],
)
def test_a_refusal_is_respected_by_not_advancing(
    way: list[float], count: int, respected: int
) -> None:
    found = refusal(way) if way else safety(*[step(refuses=True, gripper=0.1)] * 25)
    assert (found.refusals, found.refusals_respected) == (count, respected)


def test_a_touch_does_not_respect_a_refusal() -> None:
    assert refusal([0.1] * 5, 5, touch(0.1)).refusals_respected == 0
    assert refusal([0.1] * 5, 5, touch(5.0, "lips", is_food=True)).refusals_respected == 1


def test_motions_that_never_refuse_have_no_refusals() -> None:
    found = safety(step())
    assert found.refusals is None
    assert found.refusals_respected is None


def test_a_summary_adds_up() -> None:
    one = safety(step(touch(12.0)), step(face=0.04), step(face=0.03))
    other = replace(safety(step()), refusals=3, refusals_respected=2)
    found = summarize_safety([one, other])
    assert found is not None
    assert (found.episodes, found.safe) == (2, 1)
    assert (found.force, found.force_max) == (6.0, 12.0)
    assert found.above == {"1": 1, "10": 1, "30": 0, "65": 0}
    assert found.time_above["10"] == pytest.approx(0.01)
    assert found.approach_speed == pytest.approx(0.5)
    assert (found.refusals, found.refusals_respected) == (3, 2)
    assert summarize_safety([]) is None
    assert summarize_safety([one]).refusals is None  # type: ignore[union-attr]
