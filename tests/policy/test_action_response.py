"""``benchmarks/action_response.py``: the proportions of a policy that is known are found again."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from robo_manip_baselines.data import episode_path, write_episode
from robo_manip_baselines.data.example import make_arrays, make_attributes
from robo_manip_baselines.data.normalization import Normalization
from robo_manip_baselines.observation import ObservationSpec, State
from robo_manip_baselines.observation.arm import gripper_position, joints_at
from robo_manip_baselines.observation.corruption import Corruption
from robo_manip_baselines.observation.spec import ObservedNames
from robo_manip_baselines.runs.errors import RequestError

NAMES = ObservedNames(objects=("cube",))
WRIST = (0.1, 0.3, -0.2)
MOUTH = np.array([0.0, 0.55, 0.3])
STEPS = 12
LATE = Corruption(delay=4)
STAYING = Corruption(prediction="persistence")


@pytest.fixture(scope="module")
def script(load_script: Callable[[str], ModuleType]) -> ModuleType:
    return load_script("benchmarks/action_response.py")


class Known:
    """Sends the gripper a proportion of the way from where it is to the mouth."""

    n_obs_steps = 1
    sample_noise_size = 0

    def __init__(self, spec: ObservationSpec, proportion: float) -> None:
        self.spec, self.proportion = spec, proportion

    def predict(self, state: torch.Tensor, images: None, noise: None) -> torch.Tensor:
        vector = state[:, 0].numpy()
        mouth = self.spec.target_positions(vector)[:, -1]
        own = self.spec.slices(NAMES)["state"]
        joints = vector[:, own][:, :6].astype(np.float64)
        gripper = gripper_position("right", joints)
        goal = gripper + self.proportion * (mouth - gripper)
        reached = joints_at("right", goal, joints[:, 3:])
        action = np.concatenate([reached, np.zeros((len(reached), 1))], axis=-1)
        return torch.from_numpy(action.astype(np.float32))[:, None].repeat(1, 4, 1)


def checkpoint(spec: ObservationSpec, **changes: Any) -> SimpleNamespace:
    size = len(spec.vector_names(NAMES))
    zeros, ones = np.zeros(size, np.float32), np.ones(size, np.float32)
    same = Normalization(zeros, ones, zeros[:7], ones[:7])
    facts = {"folder": "a", "spec": spec, "normalization": same, "encoding": None}
    return SimpleNamespace(**{**facts, **changes})


def recorded(script: ModuleType) -> Any:
    """An episode near the mouth, which moves; each action leads to where the gripper is."""
    time = 0.02 * np.arange(STEPS)
    place = MOUTH + [0.07, 0.01, 0.0] + 0.05 * time[:, None]
    joints = joints_at("right", place, np.tile(WRIST, (STEPS, 1)))
    ahead = time[:, None] + np.arange(25) / 30
    target = MOUTH + 0.02 * np.sin(5 * ahead)[..., None]
    state = State(
        time=time,
        joint_position=joints[:, None],
        joint_velocity=np.zeros((STEPS, 1, 6)),
        gripper_position=np.full((STEPS, 1), 0.02),
        gripper_velocity=np.zeros((STEPS, 1)),
        end_effector_position=gripper_position("right", joints),
        target_position=target,
        object_position=place[:, None],
    )
    action = np.concatenate([joints, np.zeros((STEPS, 1))], axis=-1)
    return script.Recorded(state, action, 0, np.arange(STEPS))


@pytest.mark.parametrize("proportion", [0.0, 0.3, 1.0])
@pytest.mark.parametrize(
    "spec",
    [
        ObservationSpec("current", cameras=(), object_pose=True),
        ObservationSpec("current", cameras=(), corruption=LATE),
        ObservationSpec("history", cameras=()),
        ObservationSpec("current_pred", 8, cameras=(), relative=True, corruption=LATE),
    ],
    ids=lambda spec: spec.name,
)
def test_the_proportions_of_a_known_policy(
    script: ModuleType, spec: ObservationSpec, proportion: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(script, "load_model", lambda _: Known(spec, proportion))
    found = script.respond(checkpoint(spec), [recorded(script)], 4)
    assert found.mouth == pytest.approx(proportion, abs=1e-3)
    assert found.arm == pytest.approx(1.0 - proportion, abs=1e-3)
    assert found.held == pytest.approx(0.0, abs=1e-6)


def test_a_policy_that_copies_what_it_holds(
    script: ModuleType, monkeypatch: pytest.MonkeyPatch
) -> None:
    spec = ObservationSpec("current", cameras=(), object_pose=True)

    class Copycat(Known):
        def predict(self, state: torch.Tensor, images: None, noise: None) -> torch.Tensor:
            action = super().predict(state, images, noise)
            cube = state[:, 0, self.spec.slices(NAMES)["object_position"]].numpy()
            reached = joints_at("right", cube.astype(np.float64), np.tile(WRIST, (len(cube), 1)))
            action[..., :6] = torch.from_numpy(reached.astype(np.float32))[:, None]
            return action

    monkeypatch.setattr(script, "load_model", lambda _: Copycat(spec, 0.5))
    found = script.respond(checkpoint(spec), [recorded(script)], 4)
    assert (found.mouth, found.arm) == pytest.approx((0.0, 0.0), abs=1e-6)
    assert found.held == pytest.approx(1.0, abs=1e-3)


def test_the_error_is_that_of_a_policy_that_stays(
    script: ModuleType, monkeypatch: pytest.MonkeyPatch
) -> None:
    spec = ObservationSpec("current", cameras=())
    monkeypatch.setattr(script, "load_model", lambda _: Known(spec, 0.0))
    episode = recorded(script)
    # One action, which leads to where the gripper is now; then actions of later steps.
    assert script.respond(checkpoint(spec), [episode], 1).error < 1e-6
    moved = np.sqrt(3) * 0.05 * 0.02  # m, from a step to the next
    rows = np.arange(STEPS - 4)
    found = script.respond(checkpoint(spec), [episode._replace(rows=rows)], 4)
    assert found.error == pytest.approx(moved * np.mean([0, 1, 2, 3]), rel=1e-3)


@pytest.mark.parametrize(
    ("spec", "what"),
    [
        (ObservationSpec("baseline", cameras=(), object_pose=True), "does not observe the mouth"),
        (ObservationSpec("current"), "sees images"),
        (ObservationSpec("current", cameras=(), arms="both"), "acts with both arms"),
        (
            ObservationSpec("current_pred", cameras=(), corruption=STAYING),
            "observes a forecast with errors",
        ),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_other_policies_are_refused(
    script: ModuleType, spec: ObservationSpec, what: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(script, "load_model", lambda _: Known(spec, 0.0))
    with pytest.raises(RequestError, match=f"'a' {what}"):
        script.respond(checkpoint(spec), [recorded(script)], 4)


def test_steps_near_the_mouth_are_read(script: ModuleType, tmp_path: Path) -> None:
    for seed in range(3):
        arrays = make_arrays(30, seed)
        # From 0.29 m in front of the mouth to the mouth, 10 mm a step.
        away = 0.01 * np.arange(29, -1, -1)[:, None] * [1.0, 0.0, 0.0]
        arrays["end_effector_position"] = arrays["mouth_position"][:, 0] + away
        write_episode(episode_path(tmp_path, seed, success=True), arrays, {}, make_attributes(seed))
    first, second = script.read_episodes(tmp_path, 2)
    assert (first.seed, second.seed) == (0, 1)
    assert first.rows.tolist() == [18, 21, 24]  # 0.11, 0.08 and 0.05 m
    assert len(first.action) == len(first.state.time) == 30


def test_demonstrations_without_a_step_near_the_mouth_are_refused(
    script: ModuleType, monkeypatch: pytest.MonkeyPatch
) -> None:
    spec = ObservationSpec("current", cameras=())
    monkeypatch.setattr(script, "load_model", lambda _: Known(spec, 0.0))
    far = recorded(script)._replace(rows=np.arange(0))
    with pytest.raises(RequestError, match="no frame near the mouth"):
        script.respond(checkpoint(spec), [far], 4)


def test_trainings_of_a_condition_are_one_row(script: ModuleType) -> None:
    name, other = ("Mlp", "current", 1000), ("Mlp", "current", 6000)
    responses = {
        name: [script.Response(0.2, 0.1, 0.7, 0.009), script.Response(0.3, 0.1, 0.6, 0.011)],
        other: [script.Response(0.1, 0.05, 0.85, 0.004)],
    }
    last = script.table(responses).splitlines()[-2:]
    assert last == [
        "| Mlp | current | 1000 | 2 | 0.25 (0.20 to 0.30) | 0.10 | 0.65 (0.60 to 0.70) | "
        "10.0 (9.0 to 11.0) |",
        "| Mlp | current | 6000 | 1 | 0.10 | 0.05 | 0.85 | 4.0 |",
    ]
