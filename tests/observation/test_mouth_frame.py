"""Gripper relative to the mouth: what a shift of the whole scene leaves as it is."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from robo_manip_baselines.envs.mujoco.cell.scene import ARM_BASES
from robo_manip_baselines.envs.mujoco.expert.kinematics import ArmKinematics
from robo_manip_baselines.observation import Corruption, ObservationSpec, State
from robo_manip_baselines.observation.arm import BASES, gripper_position, joints_at
from robo_manip_baselines.runs.errors import RequestError

from .conftest import NAMES, observe, wandering_truth

SHIFT = np.array([0.03, -0.05, 0.02])
KEY = "gripper_from_mouth"


@pytest.mark.parametrize("arm", ["left", "right"])
def test_the_gripper_is_where_the_simulator_has_it(arm: str) -> None:
    slow, rng = ArmKinematics(arm), np.random.default_rng(0)
    (x, y, _), _ = ARM_BASES[arm]
    assert BASES[arm][:2] == (x, y)
    for joints in rng.uniform(-1.2, 1.2, (20, 6)):
        found = gripper_position(arm, joints)
        np.testing.assert_allclose(found, slow.forward(joints).translation(), atol=1e-9)


@pytest.mark.parametrize("arm", ["left", "right"])
def test_joints_are_found_again(arm: str) -> None:
    rng = np.random.default_rng(1)
    # Elbow above the line from shoulder to wrist, gripper in front of the waist.
    low, high = [-1.5, -0.7, -0.1, -3.0, -1.0, -3.0], [1.5, 0.2, 1.0, 3.0, 1.0, 3.0]
    joints = rng.uniform(low, high, (5, 200, 6))
    again = joints_at(arm, gripper_position(arm, joints), joints[..., 3:])
    np.testing.assert_allclose(again, joints, atol=1e-12)


def test_out_of_reach_is_as_near_as_the_arm_gets() -> None:
    wrist = np.array([0.0, -0.3, 0.0])
    joints = joints_at("right", [-3.0, 0.5, 0.4], wrist)
    reached = gripper_position("right", joints)
    longest = gripper_position("right", joints_at("right", [-2.0, 0.5, 0.4 - 0.066], wrist))
    assert np.isfinite(joints).all()
    assert reached[0] == pytest.approx(longest[0], abs=0.02)
    assert reached[1] == pytest.approx(0.5, abs=1e-9)


def shifted(true: State) -> State:
    """The same scene elsewhere; postures stay."""
    names = ("end_effector_position", "target_position", "object_position")
    return replace(true, **{name: getattr(true, name) + SHIFT for name in names})


@pytest.mark.parametrize("delay", [0, 3])
@pytest.mark.parametrize(
    "settings",
    [
        {"obs": "current"},
        {"obs": "history"},
        {"obs": "current_pred", "horizon": 5},
        {"obs": "current_pred", "horizon": 5, "relative": True},
        {"obs": "current_pred", "horizon": 5, "mouth_time": "forecast"},
    ],
)
def test_a_shift_of_the_scene_changes_nothing(settings: dict[str, Any], delay: int) -> None:
    """With images or without; and the raw positions do change."""
    spec = ObservationSpec(
        **settings, cameras=(), mouth_frame="gripper", corruption=Corruption(delay=delay)
    )
    pipeline, true = spec.make_pipeline(), wandering_truth(60, seed=1)
    packed = []
    for scene in (true, shifted(true)):
        target = pipeline.observe_episode(scene, 0) if pipeline else None
        packed.append(spec.split(spec.pack(scene, target), NAMES))
    here, there = (parts[KEY] for parts in packed)
    frames = spec.frames if spec.mouth_time == "forecast" else 1
    assert here.shape == (60, 3 * frames)
    np.testing.assert_allclose(here, there, atol=1e-6)  # float32
    assert (packed[0]["state"] == packed[1]["state"]).all()
    positions = next(key for key in ("mouth", "prediction") if key in packed[0])
    assert np.abs(packed[0][positions] - packed[1][positions]).max() > 0.01
    with_images = replace(spec, cameras=("top",), image_size=(48, 64))
    target = pipeline.observe_episode(true, 0) if pipeline else None
    np.testing.assert_array_equal(with_images.pack(true, target), spec.pack(true, target))


def test_it_is_the_gripper_less_the_mouth_of_each_frame() -> None:
    spec = ObservationSpec(
        "current_pred", 4, cameras=(), mouth_frame="both", mouth_time="forecast", object_pose=True
    )
    true = wandering_truth(7)
    shown = observe(spec, true)
    for step in range(7):
        for k in range(5):
            away = true.end_effector_position[step] - true.target_position[step, k]
            np.testing.assert_allclose(shown[KEY][step, 3 * k : 3 * k + 3], away, rtol=1e-6)
    assert spec.components(NAMES)[KEY][3] == "gripper from mouth x_1"
    np.testing.assert_allclose(shown["object_position"], true.object_position[:, 0], rtol=1e-6)


def test_target_positions_are_found_for_many_at_once() -> None:
    spec = ObservationSpec("current_pred", 4, cameras=(), mouth_frame="both", relative=True)
    true = wandering_truth(7)
    found = spec.target_positions(spec.pack(true))
    np.testing.assert_allclose(found, true.target_position[:, :5], atol=1e-6)


def test_the_spec_says_so_everywhere() -> None:
    spec = ObservationSpec("current_pred", 8, cameras=(), mouth_frame="both", mouth_time="forecast")
    assert ObservationSpec.from_json(spec.to_json()) == spec
    assert spec.name == "current_pred_h8_mouth_both_forecast"
    assert {"mouth_frame", "mouth_time"} <= spec.env_kwargs().keys()
    plain = ObservationSpec("current", cameras=(), mouth_time="forecast")
    assert not {"mouth_frame", "mouth_time"} & plain.to_json().keys()


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        (
            {"obs": "current", "mouth_frame": "face"},
            "mouth frame 'face'.*actions, both, gripper, none",
        ),
        ({"obs": "baseline", "mouth_frame": "both"}, "'baseline' shows no mouth; choose current"),
        (
            {"obs": "current", "mouth_frame": "actions", "mouth_time": "forecast"},
            "'current' shows no forecast; choose current_pred",
        ),
    ],
)
def test_what_cannot_be_is_refused(settings: dict[str, Any], message: str) -> None:
    with pytest.raises(RequestError, match=message):
        ObservationSpec(**settings)
