"""FeedingEnv: contacts, phases, info and the face."""

from __future__ import annotations

from collections.abc import Iterator

import mink
import numpy as np
import pytest

from robo_manip_baselines.envs.mujoco.cell.vx300s import FINGER_OPEN, HOME_QPOS
from robo_manip_baselines.envs.mujoco.face import REST_OPENING
from robo_manip_baselines.envs.mujoco.tasks.feeding.env import FeedingEnv
from robo_manip_baselines.envs.mujoco.tasks.registry import make_env

STAY_OPEN = np.array([*HOME_QPOS, FINGER_OPEN], dtype=np.float32)


@pytest.fixture
def world() -> Iterator[FeedingEnv]:
    env = make_env("FeedingEnv", cameras=())
    assert isinstance(env.unwrapped, FeedingEnv)
    env.unwrapped.reset(seed=2)
    yield env.unwrapped
    env.close()


def test_info_at_the_start(world: FeedingEnv) -> None:
    _, info = world.reset(seed=0)
    _, _, _, _, later = world.step(STAY_OPEN)
    for given in (info, later):
        for name in ("mouth_position", "gripper_position", "cube_offset"):
            assert given[name].shape == (3,)
        assert given["phase"] == "reach"
        assert given["time_since_lift"] is None
        assert given["face_force"] == 0.0


def put_cube_between_fingers(world: FeedingEnv, aside: float, finger: float) -> None:
    """Put the cube at the gripper's site, ``aside`` m towards the left finger, without weight."""
    gripper = mink.SO3(world.gripper_orientation)
    position = world.gripper_position + gripper.apply(np.array([0.0, aside, 0.0]))
    world.data.joint("cube").qpos = (*position, *world.gripper_orientation)
    world.data.joint("right/left_finger").qpos = finger
    world.data.joint("right/right_finger").qpos = -finger
    world.model.opt.gravity[:] = 0.0


@pytest.mark.parametrize(
    ("aside", "finger", "phase"),
    [
        (0.0, 0.057, "reach"),  # pads 72 mm apart, the 40 mm cube in the middle
        (0.0165, 0.057, "reach"),  # the left pad touches
        (-0.0165, 0.057, "reach"),  # the right one does
        (0.0, 0.0405, "carry"),  # both do, well above the table
    ],
)
def test_the_cube_is_held_by_two_fingers(
    world: FeedingEnv, aside: float, finger: float, phase: str
) -> None:
    put_cube_between_fingers(world, aside, finger)
    _, _, _, _, info = world.step(np.array([*HOME_QPOS, finger], dtype=np.float32))
    assert info["phase"] == phase


def test_the_mouth_stays_open_by_its_rest_and_what_was_recorded(world: FeedingEnv) -> None:
    for step in range(1, 41):
        world.step(STAY_OPEN)
        _, _, recorded = world.segment.at(step * 0.02)
        assert world.jaw_opening == pytest.approx(REST_OPENING + recorded, abs=1e-12)
        half_width, half_height = world.face.opening(world.jaw_opening)
        np.testing.assert_allclose(world.mouth_opening, [half_width, half_height], atol=1e-12)


def test_the_inside_of_the_mouth_starts_and_stays_where_the_mouth_is(world: FeedingEnv) -> None:
    cavity = world.data.body("face/cavity")
    np.testing.assert_allclose(cavity.xpos, world.mouth_track[0], atol=1e-9)
    for _ in range(100):
        world.step(STAY_OPEN)
        # It follows with a lag of 4 ms; recorded mouths move at less than 0.5 m/s.
        np.testing.assert_allclose(cavity.xpos, world.mouth_track[0], atol=0.5 * 0.004 * 2)


def test_force_on_the_face_is_in_the_info(world: FeedingEnv) -> None:
    """A head that comes too near is felt, and is not felt from afar."""
    _, _, _, _, info = world.step(STAY_OPEN)
    assert info["face_force"] == 0.0
    towards = world.gripper_position - world.mouth_track[0] + np.array([0.04, 0.0, 0.0])
    for positions, _ in world.replay.bodies.values():
        positions += towards
    forces = [world.step(STAY_OPEN)[4]["face_force"] for _ in range(5)]
    assert max(forces) > 1.0


def test_a_cube_off_the_table_ends_the_episode(world: FeedingEnv) -> None:
    world.data.joint("cube").qpos = (0.2, -0.2, -0.1, 1, 0, 0, 0)
    _, reward, terminated, truncated, info = world.step(STAY_OPEN)
    assert (reward, terminated, truncated, info["is_success"]) == (0.0, True, False, False)
