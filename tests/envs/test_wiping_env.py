"""FaceWipingEnv: the cheek, the residue, the pad and its force, and the expert."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
from scipy.spatial import ConvexHull

from robo_manip_baselines.envs.mujoco.cell.vx300s import HOME_QPOS
from robo_manip_baselines.envs.mujoco.face import REST_OPENING, FaceModel
from robo_manip_baselines.envs.mujoco.tasks.registry import make_env, task_entry
from robo_manip_baselines.envs.mujoco.tasks.wiping.env import FaceWipingEnv
from robo_manip_baselines.envs.mujoco.tasks.wiping.model import (
    HALF_SIDE,
    HANDLE_FINGER,
    PAD_RADIUS,
    PAD_STIFFNESS,
    SPOTS,
    Cheek,
)

STAY = np.array([*HOME_QPOS, HANDLE_FINGER], dtype=np.float32)


@pytest.fixture
def world() -> Iterator[FaceWipingEnv]:
    env = make_env("FaceWipingEnv", cameras=())
    assert isinstance(env.unwrapped, FaceWipingEnv)
    env.unwrapped.reset(seed=2)
    yield env.unwrapped
    env.close()


def grid() -> np.ndarray:
    """Return places all over the residue, (25, 2) m."""
    ticks = np.linspace(-HALF_SIDE, HALF_SIDE, 5)
    return np.stack(np.meshgrid(ticks, ticks), axis=-1).reshape(-1, 2)


# -- cheek ----------------------------------------------------------------------------------------


def test_the_cheek_is_the_surface_of_the_face() -> None:
    cheek, face = Cheek.load(), FaceModel.load()
    vertices = face.deform(face.jaw_angle(REST_OPENING))
    at_vertices = 0
    for place in vertices:
        plane = place[1:] - cheek.center
        if np.abs(plane).max() < HALF_SIDE and place[0] > 0.0:
            np.testing.assert_allclose(cheek.at(plane)[0], place, atol=1e-9)
            at_vertices += 1
    assert at_vertices >= 4
    for plane in grid():
        point, normal = cheek.at(plane)
        np.testing.assert_allclose(point[1:], cheek.center + plane, atol=1e-9)
        assert np.linalg.norm(normal) == pytest.approx(1.0)
        assert normal[0] > 0.5  # out of the face
        assert normal[1] < 0.1  # and to the person's right
    with pytest.raises(ValueError, match="not on the cheek"):
        cheek.at((0.0, 0.5))


def test_what_is_touched_is_what_is_seen() -> None:
    cheek = Cheek.load()
    planes = ConvexHull(cheek.patch).equations  # a x + b y + c z + d = 0, (a, b, c) pointing out
    front = planes[planes[:, 0] > 1e-6]
    for place in grid():
        point, _ = cheek.at(place)
        hull = -(front[:, 1:3] @ point[1:] + front[:, 3]) / front[:, 0]
        # Measured 1.2 mm at most, beside the nostril; the pad's own radius is 15 mm.
        assert hull.min() == pytest.approx(point[0], abs=1.5e-3)


def test_a_spot_is_in_each_cell_and_they_differ_between_seeds(world: FaceWipingEnv) -> None:
    draws = []
    for seed in (0, 1):
        world.reset(seed=seed)
        plane = world.spots[:, 1:] - world.cheek.center
        cells = np.floor((plane + HALF_SIDE) / (2 * HALF_SIDE / 6)).astype(int)
        assert {tuple(cell) for cell in cells} == {(a, b) for a in range(6) for b in range(6)}
        draws.append(plane)
    assert (np.abs(draws[1] - draws[0]).max(axis=0) > 1e-3).all()


def test_the_residue_is_shown_on_the_skin(world: FaceWipingEnv) -> None:
    head = world.data.body("face/head")
    for number in (0, SPOTS - 1):
        site = world.data.site(f"wiping/spot_{number}")
        place = (site.xpos - head.xpos) @ head.xmat.reshape(3, 3)
        np.testing.assert_allclose(place, world.spots[number], atol=1e-9)
        _, normal = world.cheek.at(place[1:] - world.cheek.center)
        flat = head.xmat.reshape(3, 3).T @ site.xmat.reshape(3, 3)[:, 2]
        np.testing.assert_allclose(flat, normal, atol=1e-6)


def test_the_head_ahead_is_where_it_will_be(world: FaceWipingEnv) -> None:
    lead = 0.1
    position, _ = world.head_pose(lead)
    landmark = world.landmark_track(205)[3]  # 3 frames of 1/30 s
    for _ in range(5):
        world.step(STAY)
    np.testing.assert_allclose(position, world.data.body("face/head").xpos, atol=1e-9)
    np.testing.assert_allclose(world.head_pose()[0], position, atol=1e-9)
    np.testing.assert_allclose(landmark, world.landmark_track(205)[0], atol=1e-9)


# -- residue --------------------------------------------------------------------------------------


def visible(world: FaceWipingEnv) -> np.ndarray:
    """Return which spots are drawn, (S,)."""
    return np.array([world.model.site(f"wiping/spot_{n}").rgba[3] > 0.0 for n in range(SPOTS)])


def press(world: FaceWipingEnv, depth: float, steps: int = 20) -> None:
    """Hold the middle of the cheek against the waiting pad, ``depth`` m deep along the gripper.

    The head comes to the pad and stands still, so that nothing but the foam moves.
    """
    position, orientation = world.replay.bodies["face/head"]
    point, normal = world.cheek.at((0.0, 0.0))
    orientation[:] = (1.0, 0.0, 0.0, 0.0)
    forward = world.data.site("right/gripper").xmat.reshape(3, 3)[:, 0]
    position[:] = world.pad_position - depth * forward - (point + PAD_RADIUS * normal)
    for _ in range(steps):
        world.step(STAY)


@pytest.mark.parametrize(
    ("depth", "is_wiped"), [(-0.002, False), (0.002, False), (0.009, True), (0.017, False)]
)
def test_the_pad_wipes_where_it_presses_within_the_range(
    world: FaceWipingEnv, depth: float, is_wiped: bool
) -> None:
    press(world, depth)
    wiped = world.progress.wiped
    if depth < 0.0:
        assert world.pad_force == world.info()["face_force"] == 0.0
    assert world.progress.is_success is False
    far = np.linalg.norm(world.spots - world.cheek.at((0.0, 0.0))[0], axis=-1) > 0.016
    assert not wiped & set(np.flatnonzero(far).tolist())
    assert (len(wiped) >= 4) is is_wiped
    assert (len(wiped) == 0) is not is_wiped
    np.testing.assert_array_equal(np.flatnonzero(~visible(world)), sorted(wiped))
    np.testing.assert_array_equal(world.task_row()["residue"], visible(world))


def test_the_force_is_that_of_the_foam(world: FaceWipingEnv) -> None:
    press(world, 0.008, steps=40)
    foam = float(world.data.joint("wiping/foam").qpos[0])
    assert 0.004 < foam < 0.012
    head = world.data.body("face/head").xmat.reshape(3, 3)
    normal = head @ world.cheek.at((0.0, 0.0))[1]
    forward = world.data.site("right/gripper").xmat.reshape(3, 3)[:, 0]
    along = -float(normal @ forward)  # the share of the normal force that the foam holds
    # Friction, of 0.3 at most, holds or frees the rest along the skin.
    slack = 0.3 * np.sqrt(1.0 - along**2)
    spring = PAD_STIFFNESS * foam
    assert spring / (along + slack) < world.pad_force * 1.05
    assert world.pad_force < 1.05 * spring / (along - slack)
    assert world.info()["face_force"] == pytest.approx(world.pad_force, rel=0.05)  # one contact


def test_a_reset_brings_the_residue_back(world: FaceWipingEnv) -> None:
    press(world, 0.009)
    assert not visible(world).all()
    _, info = world.reset(seed=2)
    assert visible(world).all()
    assert info["wiped_share"] == 0.0
    assert world.task_row()["residue"].sum() == SPOTS


def test_the_residue_has_no_part_in_the_physics(world: FaceWipingEnv) -> None:
    ends = []
    for is_hidden in (False, True):
        world.reset(seed=3)
        if is_hidden:
            world.model.site_rgba[:, 3] = 0.0
            world.model.site_pos[-SPOTS:] = 0.0
        for step in range(20):
            world.step(STAY + np.float32(0.01 * step))
        ends.append(np.concatenate([world.data.qpos, world.data.qvel]))
    np.testing.assert_array_equal(*ends)


def test_an_eye_that_is_touched_is_seen(world: FaceWipingEnv) -> None:
    position, orientation = world.replay.bodies["face/head"]
    orientation[:] = (1.0, 0.0, 0.0, 0.0)
    position[:] = world.pad_position - world.cheek.eyes[1]
    world.step(STAY)
    assert world.progress.touched_eye


@pytest.mark.gl
def test_cameras_see_the_residue_vanish() -> None:
    env = make_env("FaceWipingEnv", cameras="front_close", image_size=(120, 160))
    world = env.unwrapped
    assert isinstance(world, FaceWipingEnv)
    red = []
    env.reset(seed=0)
    for spots in (frozenset(), frozenset(range(18)), frozenset(range(SPOTS))):
        world._sites.hide(world.model, spots)
        image = world.observe()["images/front_close"].astype(int)
        red.append(int(((image[..., 0] > 60) & (image[..., 0] > 3 * image[..., 2])).sum()))
    env.close()
    assert red[0] > red[1] > red[2]
    assert red[0] - red[2] > 20  # pixels, of 12 by 12 or so


# -- expert ---------------------------------------------------------------------------------------


@pytest.mark.long
@pytest.mark.parametrize("name", list(task_entry("FaceWipingEnv").experts))
def test_the_experts_wipe(world: FaceWipingEnv, name: str) -> None:
    expert = task_entry("FaceWipingEnv").make_expert(name, world)
    _, info = world.reset(seed=0)
    expert.reset()
    terminated, rewards, forces = False, 0.0, []
    while not terminated and world.time < 12.0:
        action = expert.act()
        assert action[-1] == np.float32(HANDLE_FINGER)
        _, reward, terminated, _, info = world.step(action)
        rewards += reward
        forces.append(info["pad_force"])
    assert info["is_success"]
    assert info["is_success_strict"]
    assert info["wiped_share"] == pytest.approx(rewards)
    assert 0.0 < info["completion_time"] < world.time
    assert np.median([force for force in forces if force > 0.0]) == pytest.approx(2.0, abs=0.3)
