"""Distances between robot and face beside a slow measurement of all pairs of geoms."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing

import mujoco
import numpy as np
import pytest

from robo_manip_baselines.envs.mujoco.face.contact import region_of, toucher_of
from robo_manip_baselines.envs.mujoco.face.proximity import RANGE
from robo_manip_baselines.envs.mujoco.tasks.face_env import FaceEnv, world_of
from robo_manip_baselines.envs.mujoco.tasks.registry import make_env

SURFACE = {"forehead", "eyes", "nose", "cheeks", "lips", "chin", "head"}


@pytest.fixture(scope="module", params=["visual", "physical"])
def world(request: pytest.FixtureRequest) -> Iterator[FaceEnv]:
    with closing(make_env("FeedingEnv", cameras=(), face=request.param)) as env:
        yield world_of(env)


def slowly(world: FaceEnv, *, holds_cube: bool) -> tuple[float | None, float | None, float | None]:
    """Distances of hand, load and eye: every pair of geoms, one by one."""
    model, data = world.model, world.data
    nearest = {"hand": RANGE, "load": RANGE, "eye": RANGE}
    for face in range(model.ngeom):
        name = model.geom(face).name
        touchable = bool(model.geom_contype[face] | model.geom_conaffinity[face])
        is_eye = name in ("face/eye_left", "face/eye_right")
        is_surface = name.startswith("face/") and touchable and region_of(name) in SURFACE
        if not (is_eye or is_surface):
            continue
        for part in range(model.ngeom):
            kind = toucher_of(model, part, ("cube",))
            if kind == "other" or not model.geom_contype[part] | model.geom_conaffinity[part]:
                continue
            if model.body_weldid[model.geom_bodyid[part]] == 0 or (
                kind == "cube" and not holds_cube
            ):
                continue
            distance = max(mujoco.mj_geomDistance(model, data, part, face, RANGE, None), 0.0)
            if is_eye:
                nearest["eye"] = min(nearest["eye"], distance)
            if is_surface and kind != "arm":
                place = "load" if kind == "cube" else "hand"
                nearest[place] = min(nearest[place], distance)
    hand, load, eye = (None if found >= RANGE else found for found in nearest.values())
    return hand, load, eye


def test_distances_are_those_of_all_pairs(world: FaceEnv) -> None:
    """At poses of the right arm around the face, with the cube in the gripper and without."""
    rng = np.random.default_rng(0)
    world.reset(seed=3)
    joints = [world.model.joint(f"right/{name}").qposadr[0] for name in ("waist", "shoulder")]
    elbow = world.model.joint("right/elbow").qposadr[0]
    cube = int(world.model.joint("cube").qposadr[0])
    found = set[bool]()
    for number in range(24):
        data = world.data
        data.qpos[joints] = rng.normal(0.0, 0.25), rng.uniform(-0.9, 0.5)
        data.qpos[elbow] = rng.uniform(-0.2, 1.2)
        mujoco.mj_kinematics(world.model, data)
        data.qpos[cube : cube + 3] = world.gripper_position + rng.normal(0.0, 0.02, 3)
        mujoco.mj_kinematics(world.model, data)
        finger = int(world.model.body("right/left_finger_link").geomadr[0])
        holds_cube = bool(number % 2)
        world.touch.pairs = [[finger, world.model.geom("cube").id]] if holds_cube else []
        near = world.proximity()
        wanted = slowly(world, holds_cube=holds_cube)
        for given, slow in zip((near.hand, near.load, near.eye), wanted, strict=True):
            found.add(given is None)
            assert given == (None if slow is None else pytest.approx(slow, abs=1e-9))
    assert found == {True, False}
