"""The cell: options, contact bits and cameras."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from robo_manip_baselines.envs.mujoco.cell.rendering import project
from robo_manip_baselines.envs.mujoco.cell.scene import (
    ARM_BASES,
    FACE,
    MOUTH,
    SOLID,
    look_at,
    require_mujoco,
)
from robo_manip_baselines.observation import CAMERAS
from robo_manip_baselines.observation.spec import ARM_JOINTS
from robo_manip_baselines.runs.errors import RequestError


@pytest.mark.parametrize("version", ["3.17.0", "3.17.1", "3.18.0", "4.0.1", "4.1.0", "5.0.0"])
def test_releases_that_work_are_accepted(version: str) -> None:
    require_mujoco(version)


@pytest.mark.parametrize("version", ["2.3.7", "3.2.0", "3.16.4", "4.0.0"])
def test_releases_that_do_not_are_refused_with_what_to_do(version: str) -> None:
    with pytest.raises(RequestError, match=rf"^MuJoCo {version} .*pip install.*$"):
        require_mujoco(version)


def test_every_option_that_releases_have_changed_is_what_the_cell_was_tuned_with(
    model: mujoco.MjModel,
) -> None:
    disabled = mujoco.mjtDisableBit
    tuned = {
        "timestep": 0.002,
        "integrator": mujoco.mjtIntegrator.mjINT_IMPLICITFAST,
        "cone": mujoco.mjtCone.mjCONE_ELLIPTIC,
        "impratio": 10.0,
        "solver": mujoco.mjtSolver.mjSOL_NEWTON,
        "jacobian": mujoco.mjtJacobian.mjJAC_DENSE,
        "iterations": 100,
        "tolerance": 1e-8,
        "ls_iterations": 50,
        "ls_tolerance": 0.01,
        "noslip_iterations": 0,
        "ccd_iterations": 35,
        "ccd_tolerance": 1e-6,
        "enableflags": 0,
        "disableflags": disabled.mjDSBL_MULTICCD
        | disabled.mjDSBL_ISLAND
        | disabled.mjDSBL_AUTORESET,
    }
    assert {name: getattr(model.opt, name) for name in tuned} == tuned


def test_names_that_scripts_lean_on(model: mujoco.MjModel) -> None:
    actuators = [model.actuator(i).name for i in range(model.nu)]
    servos = (*ARM_JOINTS, "gripper")
    assert actuators == [f"{arm}/{j}" for arm in ("left", "right") for j in servos]
    for arm in ("left", "right"):
        for joint in (*ARM_JOINTS, "left_finger", "right_finger"):
            model.joint(f"{arm}/{joint}")
        model.site(f"{arm}/gripper")
    assert [model.camera(i).name for i in range(model.ncam)] == list(CAMERAS)
    assert not np.any(model.dof_frictionloss)  # dry friction makes a servo creep


def test_nothing_is_drawn_that_costs_a_cpu_much(model: mujoco.MjModel) -> None:
    # Measured: textures and reflections cost per pixel, lights and cylinders per vertex.
    assert model.ntex == 0
    assert not np.any(model.mat_reflectance)
    assert model.nlight <= 2
    drawn = model.geom_group < 3  # the groups that a camera shows
    assert not np.any(model.geom_type[drawn] == mujoco.mjtGeom.mjGEOM_CYLINDER)
    assert np.all(model.geom_rgba[drawn, 3] == 1)
    assert model.nmeshface < 2500


def touches(a: tuple[int, int], b: tuple[int, int]) -> bool:
    """MuJoCo's rule for two geoms' (contype, conaffinity)."""
    return bool(a[0] & b[1] or b[0] & a[1])


def test_contact_bits(model: mujoco.MjModel) -> None:
    def bits(geom: int) -> tuple[int, int]:
        return int(model.geom_contype[geom]), int(model.geom_conaffinity[geom])

    table, cube = bits(model.geom("table").id), bits(model.geom("cube").id)
    owners = [model.body(body).name.partition("/")[0] for body in model.geom_bodyid]
    robot_geoms = {bits(geom) for geom, owner in enumerate(owners) if owner in ARM_BASES}
    assert robot_geoms == {(0, 0), (1, 3)}  # drawn, or solid
    robot = (1, 3)
    face, inside = (FACE, 0), (MOUTH, 0)
    assert (SOLID, FACE, MOUTH) == (1, 2, 4)
    assert all(touches(robot, other) for other in (robot, table, cube, face))
    assert all(touches(cube, other) for other in (table, robot, inside))
    assert not touches(cube, face)  # soft lips give way
    assert not touches(robot, inside)
    assert not touches(table, face)
    assert not touches(table, inside)


def test_look_at_points_the_camera_and_keeps_it_upright() -> None:
    rotation = np.empty(9)
    views = ((1, 2, 3), (0, 0, 0)), ((0, 0, 1), (0, 0, 0)), ((0, 1, 0), (0, 0, 2))
    for position, target in views:
        mujoco.mju_quat2Mat(rotation, look_at(position, target))
        right, up, back = rotation.reshape(3, 3).T
        away = np.subtract(position, target)
        np.testing.assert_allclose(back, away / np.linalg.norm(away), atol=1e-12)
        assert right[2] == pytest.approx(0, abs=1e-12)
        assert up[2] >= -1e-12


@pytest.mark.parametrize("camera", ["top", "angle"])
def test_overviews_see_the_cubes_area_the_gripper_and_the_head(
    model: mujoco.MjModel, data: mujoco.MjData, camera: str
) -> None:
    cubes = [(x, y, z) for x in (-0.02, 0.27) for y in (0.33, 0.67) for z in (0.0, 0.04)]
    head = [(x, y, z) for x in (-0.2, 0.1) for y in (0.4, 0.6) for z in (0.25, 0.55)]
    points = [*cubes, *head, data.site("right/gripper").xpos]
    pixels = project(model, data, camera, points, (480, 640))
    assert np.all((pixels > 0) & (pixels < (640, 480)))


def test_front_close_has_the_mouth_in_its_middle_from_about_half_a_metre(
    model: mujoco.MjModel, data: mujoco.MjData
) -> None:
    mouth = (0.0, 0.5, 0.35)
    camera = model.camera("front_close")
    pixel = project(model, data, "front_close", mouth, (480, 640))
    np.testing.assert_allclose(pixel, (320, 240), atol=1)
    assert np.linalg.norm(data.cam("front_close").xpos - mouth) == pytest.approx(0.55, abs=0.05)
    assert camera.fovy[0] == 47.0
