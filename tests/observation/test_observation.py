"""Observations of a policy, against slow and obvious oracles."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from robo_manip_baselines.observation import ObservationSpec, State
from robo_manip_baselines.runs.errors import RequestError

from .conftest import NAMES, observe, step_of

POINTS = ((3,), (25, 3), (1, 3))
"""Shapes of gripper, target and objects."""


def truth(shape: tuple[int, ...], arms: int, seed: int = 0) -> State:
    rng, by_arm = np.random.default_rng(seed), (*shape, arms)
    sizes = [shape, (*by_arm, 6), (*by_arm, 6), by_arm, by_arm, *((*shape, *n) for n in POINTS)]
    return State(*(np.asarray(rng.random(size)) for size in sizes))


def obvious(spec: ObservationSpec, true: State) -> dict[str, list[float]]:
    """One observation, number by number, as the tables of the docs say."""
    state: list[float] = []
    for arm in range(len(spec.arm_names)):
        state += [*true.joint_position[arm], *true.joint_velocity[arm]]
        state += [true.gripper_position[arm], true.gripper_velocity[arm]]
    shown = {"state": state}
    gripper = true.end_effector_position

    now = true.target_position[0]

    def distance(k: int) -> float:
        return float(sum((true.target_position[k] - gripper) ** 2) ** 0.5)

    def position(k: int) -> list[float]:
        return [*(true.target_position[k] - (now if spec.relative and k else 0.0))]

    if spec.obs in ("current", "history"):
        shown["mouth"] = [*position(0), distance(0)]
    if spec.obs == "history":  # a single step: nothing but the present was ever reported
        shown["history"] = 15 * [0.0] if spec.relative else 5 * [*now]
    if spec.obs == "current_pred":
        numbers: list[float] = []
        for k in range(spec.horizon + 1):
            numbers += [float(true.time) + k / 30, *position(k)]
        shown["prediction"] = numbers + [distance(k) for k in range(spec.horizon + 1)]
    if spec.object_pose:
        shown["object_position"] = [*true.object_position[0]]
    return shown


specs = st.builds(
    ObservationSpec,
    obs=st.sampled_from(["baseline", "current", "current_pred", "history"]),
    horizon=st.integers(1, 24),
    cameras=st.just(()),
    object_pose=st.booleans(),
    arms=st.sampled_from(["right", "both"]),
    relative=st.booleans(),
)


@given(specs, st.integers(0, 2**32 - 1))
def test_observe_is_what_the_tables_say(spec: ObservationSpec, seed: int) -> None:
    true = truth((), len(spec.arm_names), seed)
    shown, expected = observe(spec, true), obvious(spec, true)
    assert set(shown) == set(expected) == set(spec.components(NAMES))
    for key, value in shown.items():
        np.testing.assert_allclose(value, expected[key], rtol=1e-6)  # float32
        assert value.dtype == np.float32
        assert len(spec.components(NAMES)[key]) == value.shape[0]


@given(specs)
def test_a_batch_is_its_members(spec: ObservationSpec) -> None:
    batch = truth((3, 4), len(spec.arm_names))
    together = observe(spec, batch)
    for index in np.ndindex(3, 4):
        for key, alone in observe(spec, step_of(batch, index)).items():
            np.testing.assert_array_equal(alone, together[key][index])


@pytest.mark.parametrize(
    ("obs", "horizon", "sizes"),
    [
        ("baseline", 2, {"state": 14}),
        ("current", 2, {"state": 14, "mouth": 4}),
        ("current_pred", 1, {"state": 14, "prediction": 10}),
        ("current_pred", 2, {"state": 14, "prediction": 15}),
        ("current_pred", 5, {"state": 14, "prediction": 30}),
        ("current_pred", 24, {"state": 14, "prediction": 125}),
        ("history", 2, {"state": 14, "mouth": 4, "history": 15}),
    ],
)
def test_sizes_of_the_papers_presets(obs: str, horizon: int, sizes: dict[str, int]) -> None:
    components = ObservationSpec(obs=obs, horizon=horizon).components(NAMES)
    assert {key: len(names) for key, names in components.items()} == sizes


@pytest.mark.parametrize(
    "values",
    [
        {"obs": "all"},
        {"horizon": 0},
        {"horizon": 25},
        {"cameras": ("side",)},
        {"image_size": (480, 0)},
        {"image_size": (480, 5000)},
        {"arms": "none"},
    ],
)
def test_invalid_values_are_refused(values: dict[str, Any]) -> None:
    with pytest.raises(RequestError) as caught:
        ObservationSpec(**values)
    ((name, value),) = values.items()
    wrong = value[-1] if isinstance(value, tuple) else value
    assert str(wrong) in str(caught.value), name
