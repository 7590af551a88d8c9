"""Scaling vectors: what is measured, that it can be undone, and that it survives a JSON file."""

from __future__ import annotations

import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from robo_manip_baselines.data.normalization import (
    METHODS,
    SMALLEST_STD,
    Normalization,
    mean_std,
)
from robo_manip_baselines.runs.errors import RequestError

FINITE = st.floats(width=32, allow_nan=False, allow_infinity=False)
POSITIVE = st.floats(min_value=2.0**-126, width=32, allow_infinity=False)


def measured(rows: int = 40, seed: int = 0) -> tuple[Normalization, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    state = rng.normal([5.0, -2.0, 0.0], [0.5, 3.0, 1.0], (rows, 3)).astype(np.float32)
    action = rng.uniform(-1.0, 1.0, (rows, 2)).astype(np.float32)
    return mean_std(state, action), state, action


def test_training_rows_come_out_with_mean_0_and_deviation_1() -> None:
    normalization, state, action = measured()
    for scaled in (normalization.normalize_state(state), normalization.normalize_action(action)):
        assert scaled.dtype == np.float32
        # float32 arithmetic on numbers of a few units: 1e-6 relative.
        np.testing.assert_allclose(scaled.mean(axis=0), 0.0, atol=1e-5)
        np.testing.assert_allclose(scaled.std(axis=0), 1.0, atol=1e-5)


def test_actions_alone_are_scaled_to_the_range() -> None:
    _, state, action = measured()
    scaled = METHODS["action_min_max"](state, action)
    parts = [METHODS[name](state, action) for name in ("mean_std", "min_max")]
    np.testing.assert_array_equal(scaled.normalize_state(state), parts[0].normalize_state(state))
    np.testing.assert_array_equal(
        scaled.normalize_action(action), parts[1].normalize_action(action)
    )
    ends = scaled.normalize_action(action)
    np.testing.assert_allclose([ends.min(0), ends.max(0)], [[-1, -1], [1, 1]], atol=1e-6)


def test_actions_come_back() -> None:
    normalization, _, action = measured()
    back = normalization.unnormalize_action(normalization.normalize_action(action))
    np.testing.assert_allclose(back, action, atol=1e-6)


def test_sums_do_not_lose_small_motion_on_a_large_offset() -> None:
    # float32 holds 1000.3 to 6e-5; summed up in float32, the mean would be off by 0.3.
    state = (1000.3 + 0.01 * np.tile([[-1.0] * 2, [1.0] * 2], (50_000, 1))).astype(np.float32)
    normalization = mean_std(state, state)
    np.testing.assert_allclose(normalization.state_std, 0.01, rtol=1e-2)


def test_nearly_constant_elements_are_not_blown_up() -> None:
    state = np.full((10, 2), 0.3, np.float32)
    state[0, 1] += 1e-5
    normalization = mean_std(state, state)
    np.testing.assert_array_equal(normalization.state_std, np.float32(SMALLEST_STD))
    assert np.abs(normalization.normalize_state(state)).max() < 0.02


@given(st.lists(st.tuples(FINITE, POSITIVE), min_size=1, max_size=6))
def test_a_json_file_keeps_every_bit(columns: list[tuple[float, float]]) -> None:
    mean, std = np.array(columns, dtype=np.float32).T
    given = Normalization(mean, std, mean[:1], std[:1])
    read = Normalization.from_json(json.loads(json.dumps(given.to_json(), allow_nan=False)))
    for name in ("state_mean", "state_std", "action_mean", "action_std"):
        np.testing.assert_array_equal(getattr(read, name), getattr(given, name), strict=True)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda d: d.pop("action_std"), "action_std: is missing"),
        (lambda d: d.update(state_mean=3.0), "state_mean: must be a list, not 3.0"),
        (
            lambda d: d.update(state_mean=["1", "2", "3"]),
            r"state_mean\[0\]: must be a number, not '1'",
        ),
        (
            lambda d: d.update(state_mean=[True, 0.0, 0.0]),
            r"state_mean\[0\]: must be a number, not true",
        ),
        (lambda d: d.update(state_mean=[1.0, 2.0]), "2 of 'state_mean', 3 of its std"),
        (lambda d: d.update(state_std=[1.0, 0.0, 1.0]), r"state_std\[1\] 0.0: must be"),
        (lambda d: d.update(action_std=[1.0, -1.0]), r"action_std\[1\] -1.0: must be"),
        (
            lambda d: d.update(action_mean=[1.0, float("nan")]),
            r"action_mean\[1\]: must be a finite number",
        ),
        (
            lambda d: d.update(action_std=[1.0, float("inf")]),
            r"action_std\[1\]: must be a finite number",
        ),
    ],
)
def test_what_is_no_normalisation_is_refused(change: object, message: str) -> None:
    data = measured()[0].to_json()
    change(data)  # type: ignore[operator]
    with pytest.raises(RequestError, match=message):
        Normalization.from_json(data)


def test_something_else_altogether_is_refused() -> None:
    with pytest.raises(RequestError, match="must be an object, not a list of 2"):
        Normalization.from_json([1, 2])
