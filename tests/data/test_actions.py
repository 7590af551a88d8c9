"""Actions relative to mouth or posture: there and back, and against loops."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from robo_manip_baselines.data.actions import ARM_LAG, ActionEncoding
from robo_manip_baselines.observation import Corruption, ObservationSpec, ObservedNames
from robo_manip_baselines.observation.arm import gripper_position, joints_at
from robo_manip_baselines.runs.errors import RequestError

COUNT, CHUNK, STEP = 4, 9, 0.02
MOUTH = ObservationSpec("current_pred", 6, cameras=(), mouth_frame="actions")


def specs() -> list[ObservationSpec]:
    settings: list[dict[str, Any]] = [
        {"obs": "current", "mouth_frame": "actions"},
        {"obs": "history", "mouth_frame": "both", "arms": "both"},
        {"obs": "current_pred", "horizon": 6, "mouth_frame": "both", "relative": True},
        {"obs": "current_pred", "horizon": 6, "mouth_frame": "actions", "mouth_time": "forecast"},
        {
            **{"obs": "current_pred", "horizon": 6, "mouth_frame": "both", "relative": True},
            **{"mouth_time": "forecast", "arms": "both", "corruption": Corruption(delay=2)},
        },
    ]
    return [ObservationSpec(cameras=(), **values) for values in settings]


def chunks(spec: ObservationSpec) -> NDArray[np.float64]:
    """(b, K, A) regular postures."""
    rng, arms = np.random.default_rng(0), len(spec.arm_names)
    low = [-1.0, -0.8, 0.0, -3.0, -1.0, -3.0, 0.02]
    high = [1.0, 0.2, 1.2, 3.0, 1.0, 3.0, 0.06]
    return rng.uniform(low * arms, high * arms, (COUNT, CHUNK, 7 * arms))


def vectors(spec: ObservationSpec) -> NDArray[np.float32]:
    """(b, S)."""
    size = len(spec.vector_names(ObservedNames()))
    return np.random.default_rng(1).normal(size=(COUNT, size)).astype(np.float32)


@pytest.mark.parametrize("spec", specs(), ids=lambda spec: spec.name)
def test_what_is_encoded_is_decoded(spec: ObservationSpec) -> None:
    encoding, action, vector = ActionEncoding(spec, STEP), chunks(spec), vectors(spec)
    encoded = encoding.encode(action, vector)
    assert encoding
    assert np.abs(encoded - action).max() > 0.1
    np.testing.assert_allclose(encoding.decode(encoded, vector), action, atol=1e-12)
    encoding.require_round_trip(action)


def test_relative_actions_are_decoded() -> None:
    spec = ObservationSpec("current", cameras=(), arms="both")
    encoding, action, vector = ActionEncoding(spec, STEP, True), chunks(spec), vectors(spec)
    encoded = encoding.encode(action, vector)
    names = spec.vector_names(ObservedNames())
    elbow = vector[1, names.index("right/elbow position")]
    assert encoded[1, 4, 9] == pytest.approx(action[1, 4, 9] - elbow)
    np.testing.assert_array_equal(encoded[..., 13], action[..., 13])  # a gripper's target stays
    np.testing.assert_allclose(encoding.decode(encoded, vector), action, atol=1e-12)


@pytest.mark.parametrize("time", ["now", "forecast"])
def test_the_reference_is_the_mouth_when_the_arm_is_there(time: str) -> None:
    delay, skip = 1, 3
    spec = ObservationSpec(
        *("current_pred", 6),
        cameras=(),
        mouth_frame="actions",
        mouth_time=time,
        corruption=Corruption(delay=delay),
    )
    vector = vectors(spec)
    reference = ActionEncoding(spec, skip * STEP).reference(vector, CHUNK)
    for row in range(COUNT):
        track = spec.target_positions(vector[row])  # (F, 3)
        for k in range(CHUNK):
            frame = 0.0 if time == "now" else delay + ARM_LAG + k * skip * STEP * 30.0
            mouth = [np.interp(frame, np.arange(7), track[:, axis]) for axis in range(3)]
            np.testing.assert_allclose(reference[row, k, :3], mouth, atol=1e-6)  # float32
            np.testing.assert_array_equal(reference[row, k, 3:], 0.0)


def test_a_shift_of_the_scene_changes_nothing() -> None:
    """Mouth and gripper elsewhere, with the wrist as it is: the same action."""
    shift = np.array([-0.03, 0.05, 0.02])
    encoding, action, vector = ActionEncoding(MOUTH, STEP), chunks(MOUTH), vectors(MOUTH)
    place = gripper_position("right", action[..., :6]) + shift
    moved = action.copy()
    moved[..., :6] = joints_at("right", place, action[..., 3:6])
    start = MOUTH.vector_names(ObservedNames()).index("x_0")
    elsewhere = vector.copy()
    for k in range(7):
        elsewhere[:, start + 4 * k : start + 4 * k + 3] += shift.astype(np.float32)
    reachable = np.abs(gripper_position("right", moved[..., :6]) - place).max(-1) < 1e-9
    assert reachable.mean() > 0.9
    one, other = encoding.encode(action, vector), encoding.encode(moved, elsewhere)
    np.testing.assert_allclose(one[reachable], other[reachable], atol=1e-6)  # float32


def test_nothing_is_encoded_without_an_option() -> None:
    spec = ObservationSpec("current", cameras=(), mouth_frame="gripper")
    assert not ActionEncoding(spec, STEP)


def test_what_cannot_be_decoded_is_refused() -> None:
    action = chunks(MOUTH)
    action[0, 0, 2] = -1.7  # the elbow, past the stretched arm
    with pytest.raises(RequestError, match="stretched past its longest reach"):
        ActionEncoding(MOUTH, STEP).require_round_trip(action)
    with pytest.raises(RequestError, match="relative to one thing"):
        ActionEncoding(MOUTH, STEP, is_relative=True)
