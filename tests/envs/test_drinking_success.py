"""Places where liquid counts as drunk, and the order in which things may happen."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest

from robo_manip_baselines.envs.mujoco.tasks.drinking import ENTRY
from robo_manip_baselines.envs.mujoco.tasks.drinking.liquid import SERVING, Liquid, jet_at
from robo_manip_baselines.envs.mujoco.tasks.drinking.metrics import DrinkingMetrics, failure_kind
from robo_manip_baselines.envs.mujoco.tasks.drinking.success import (
    CLEAR_DISTANCE,
    DELIVERED_SHARE,
    DELIVERY_DISTANCE,
    GENTLE_FORCE,
    LIFT_HEIGHT,
    SPILLED_SHARE,
    DrinkingProgress,
    Mouth,
    Phase,
    StepMeasurements,
    is_drunk,
    time_to_lips,
)
from robo_manip_baselines.envs.mujoco.tasks.mouth import CAVITY_DEPTH, LIP_DEPTH

EPSILON = 1e-5
"""m, far above rounding and far below the size of a mouth."""

TURN = 0.6
"""rad about z, of the second face."""

FACES = {
    "straight": np.eye(3),
    "turned": np.array(
        [[np.cos(TURN), -np.sin(TURN), 0.0], [np.sin(TURN), np.cos(TURN), 0.0], [0.0, 0.0, 1.0]]
    ),
}


@pytest.fixture(params=FACES)
def mouth(request: pytest.FixtureRequest) -> Mouth:
    axes = FACES[str(request.param)]
    return Mouth(np.array([0.02, 0.48, 0.36]), axes, half_width=0.022, half_height=0.013)


def place(mouth: Mouth, offset: tuple[float, float, float]) -> np.ndarray:
    """(3,) m, world: a point that is so far out, across and up from the mouth."""
    return mouth.centre + mouth.axes @ np.array(offset)


@pytest.mark.parametrize(
    ("offset", "expected"),
    [
        ((0.0, 0.0, 0.0), True),
        ((LIP_DEPTH - EPSILON, 0.0, 0.0), True),
        ((-DELIVERY_DISTANCE + EPSILON, 0.0, 0.0), True),
        ((-DELIVERY_DISTANCE - EPSILON, 0.0, 0.0), False),  # in the mouth, and 3 cm are what counts
        ((0.0, 0.022 - EPSILON, 0.0), True),
        ((0.0, 0.022 + EPSILON, 0.0), False),
        ((0.0, 0.0, 0.013 - EPSILON), True),
        ((0.0, 0.0, 0.013 + EPSILON), False),
        ((0.0, 0.0, -0.013 + EPSILON), True),
        ((0.0, 0.0, -0.013 - EPSILON), False),
        ((0.0, 0.016, 0.010), False),  # a corner outside the ellipse
        ((0.0, 0.012, 0.010), True),
        ((LIP_DEPTH + EPSILON, 0.0, 0.0), True),  # what drips there is a hundredth of a mm short
    ],
)
def test_a_dripping_spout(mouth: Mouth, offset: tuple[float, float, float], expected: bool) -> None:
    slow = -0.01 * mouth.axes[:, 0]  # m/s, inwards
    assert is_drunk(place(mouth, offset), slow, mouth) is expected


def test_the_throat_is_beyond_what_is_delivered() -> None:
    assert CAVITY_DEPTH > DELIVERY_DISTANCE


@pytest.mark.parametrize(
    ("out", "speed", "up", "expected"),
    [
        (0.025, 1.0, 0.0, True),  # 15 mm to the lips in 15 ms: a fall of 1 mm
        (0.025, 0.4, 0.0, True),  # 37 ms: 7 mm
        (0.025, 0.25, 0.0, False),  # 60 ms: 18 mm, onto the chin
        (0.025, 0.25, 0.3, True),  # the same, aimed upwards: 18 - 18 mm
        (0.025, 1.0, 1.5, False),  # over the lip: 22 - 1 mm
        (0.025, -1.0, 0.0, False),  # away from the face
        (0.025, 0.0, 0.0, False),
        (0.031, 1.0, 0.0, False),  # it would enter, from more than 3 cm away
        (0.005, 0.0, 0.0, True),  # past the front of the lips
        (0.005, -1.0, 0.0, True),
    ],
)
def test_a_jet_from_before_the_lips(
    mouth: Mouth, out: float, speed: float, up: float, expected: bool
) -> None:
    velocity = -speed * mouth.axes[:, 0] + up * mouth.axes[:, 2]
    assert is_drunk(place(mouth, (out, 0.0, 0.0)), velocity, mouth) is expected


def test_a_jet_meets_the_plane_of_the_lips(mouth: Mouth) -> None:
    tip = place(mouth, (0.022, 0.004, 0.003))
    velocity = -0.5 * mouth.axes[:, 0] + 0.1 * mouth.axes[:, 1]
    flight = time_to_lips(tip, velocity, mouth)
    assert flight is not None
    out = (jet_at(flight, tip, velocity) - mouth.centre) @ mouth.axes[:, 0]
    assert out == pytest.approx(LIP_DEPTH, abs=2e-6)
    assert time_to_lips(tip, -velocity, mouth) is None
    assert time_to_lips(place(mouth, (0.0, 0.0, 0.0)), velocity, mouth) is None


def shares(delivered: float, spilled: float = 0.0) -> Liquid:
    return Liquid((1.0 - delivered - spilled) * SERVING, delivered * SERVING, spilled * SERVING)


START = StepMeasurements(
    time=0.02,
    is_held=False,
    lift=0.0,
    liquid=Liquid(),
    face_force=0.0,
    spout_distance=0.3,
    is_upright=True,
)
HELD = replace(START, time=2.0, is_held=True)
LIFTED = replace(HELD, time=3.0, lift=LIFT_HEIGHT)
POURING = replace(
    LIFTED, time=5.0, liquid=shares(0.3), spout_distance=0.004, is_upright=False, face_force=2.0
)
DRUNK = replace(POURING, time=7.0, liquid=shares(DELIVERED_SHARE))
AWAY = replace(DRUNK, time=8.0, spout_distance=CLEAR_DISTANCE, is_upright=True)


def run(*steps: StepMeasurements) -> DrinkingProgress:
    progress = DrinkingProgress()
    for step in steps:
        progress = progress.advance(step)
    return progress


def test_phases_in_order() -> None:
    steps = (START, HELD, START, HELD, LIFTED, POURING, DRUNK, AWAY)
    phases = [run(*steps[:n]).phase for n in range(1, len(steps) + 1)]
    reach, grasp, carry, pour, withdraw = Phase
    assert phases == [reach, grasp, reach, grasp, carry, pour, pour, withdraw]


def test_a_whole_episode() -> None:
    progress = run(START, HELD, LIFTED, POURING, DRUNK, AWAY)
    assert (progress.is_success, progress.is_success_strict, progress.is_clear) == (
        True,
        True,
        True,
    )
    assert (progress.lift_time, progress.success_time) == (3.0, 7.0)
    assert progress.completion_time == pytest.approx(4.0)
    assert progress.time_since_lift(8.0) == pytest.approx(5.0)


@pytest.mark.parametrize(
    ("changes", "success", "strict"),
    [
        ({}, True, True),
        ({"liquid": shares(DELIVERED_SHARE - 1e-6)}, False, False),
        ({"liquid": shares(0.9, SPILLED_SHARE - 1e-9)}, True, True),
        ({"liquid": shares(0.9, SPILLED_SHARE + 1e-6)}, True, False),
        ({"face_force": GENTLE_FORCE}, True, True),
        ({"face_force": GENTLE_FORCE + 1e-6}, True, False),
    ],
)
def test_success_at_its_bounds(changes: dict[str, object], success: bool, strict: bool) -> None:
    progress = run(LIFTED, POURING, replace(DRUNK, **changes))
    assert (progress.is_success, progress.is_success_strict) == (success, strict)


def test_what_is_spilled_or_pressed_later_counts_too() -> None:
    done = run(LIFTED, POURING, DRUNK)
    assert done.is_success_strict
    assert not done.advance(replace(AWAY, liquid=shares(0.8, 0.2))).is_success_strict
    pressed = done.advance(replace(DRUNK, face_force=30.0))
    assert not pressed.is_success_strict
    assert not pressed.advance(AWAY).is_success_strict


@pytest.mark.parametrize(
    ("last", "is_clear"),
    [
        (AWAY, True),
        (replace(AWAY, spout_distance=CLEAR_DISTANCE - EPSILON), False),
        (replace(AWAY, is_upright=False), False),
        (replace(AWAY, liquid=shares(0.5)), True),  # it was enough before
    ],
)
def test_taken_away(last: StepMeasurements, is_clear: bool) -> None:
    assert run(LIFTED, DRUNK, last).is_clear is is_clear


def test_nothing_counts_without_a_lift() -> None:
    low = {"lift": LIFT_HEIGHT - EPSILON}
    progress = run(replace(LIFTED, **low), replace(DRUNK, **low), replace(AWAY, **low))
    assert (progress.is_success, progress.is_clear, progress.lift_time) == (False, False, None)
    assert run(replace(LIFTED, is_held=False)).lift_time is None


@pytest.mark.parametrize(
    ("lifted", "dropped", "spilled", "inside", "kind"),
    [
        (False, False, 0.0, False, "never_grasped"),
        (False, False, 1.0, False, "never_grasped"),  # knocked over
        (True, True, 1.0, True, "dropped"),
        (True, False, 0.25 + EPSILON, True, "spilled"),
        (True, False, 0.25, True, "too_late"),
        (True, False, 0.0, False, "missed"),
    ],
)
def test_kinds_of_failure(
    lifted: bool, dropped: bool, spilled: float, inside: bool, kind: str
) -> None:
    facts = {"was_lifted": lifted, "was_dropped": dropped, "was_inside": inside}
    assert failure_kind(is_success=False, spilled=spilled, **facts) == kind
    assert failure_kind(is_success=True, spilled=spilled, **facts) == ""


def test_every_combination_of_facts_has_a_known_kind_and_every_kind_occurs() -> None:
    kinds = {
        failure_kind(
            is_success=False, was_lifted=lift, was_dropped=drop, spilled=spill, was_inside=inside
        )
        for lift, drop, inside in itertools.product((False, True), repeat=3)
        for spill in (0.0, 0.25, 0.26, 1.0)
    }
    assert kinds == set(ENTRY.failures)


def test_columns_of_an_episode() -> None:
    metrics = DrinkingMetrics()
    info = {
        "is_success": False,
        "mouth_position": np.zeros(3),
        "spout_position": np.array([0.03, 0.0, 0.04]),
        "is_spout_inside": False,
        "is_touched": True,
        "delivered": 0.0,
        "spilled": 0.0,
        "time_since_lift": None,
        "face_force": 0.0,
    }
    lifted = {**info, "time_since_lift": 1.0}
    inside = {**lifted, "is_spout_inside": True, "face_force": 12.0, "delivered": 0.4}
    inside["spout_position"] = np.array([0.003, 0.0, 0.004])
    last = {**lifted, "time_since_lift": 0.1 + 0.2, "delivered": 0.4, "spilled": 0.1}
    for step in (info, lifted, inside, inside, last):
        metrics.update(step)
    assert metrics.result(last) == (
        "too_late",
        {
            "time_since_lift": 0.3,
            "delivered": 0.4,
            "spilled": 0.1,
            "closest_distance": pytest.approx(0.005),
            "face_force": 12.0,
            "force_time_1": 0.04,
            "force_time_10": 0.04,
            "force_time_30": 0.0,
            "dwell": 0.04,
        },
    )
    metrics.update({**last, "is_touched": False})
    assert metrics.result(last)[0] == "dropped"
