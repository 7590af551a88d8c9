"""Agreement of viser's scene with MuJoCo: surfaces, colours, poses, skins."""

from __future__ import annotations

from contextlib import closing
from dataclasses import dataclass, field
from typing import Any, cast

import mujoco
import numpy as np
import pytest

from robo_manip_baselines.envs.mujoco.cell.viser_scene import (
    Mesh,
    ViserScene,
    colour_patches,
    geom_colour,
    geom_mesh,
    skin_mesh,
)
from robo_manip_baselines.envs.mujoco.tasks.face_env import FaceEnv, world_of
from robo_manip_baselines.envs.mujoco.tasks.registry import make_env

SHAPES = """
<mujoco>
  <asset>
    <material name="blue" rgba="0 0 1 1"/>
    <mesh name="wedge" vertex="0 0 0  1 0 0  0 1 0  0 0 1"/>
  </asset>
  <worldbody>
    <geom name="box" type="box" size=".1 .2 .3" material="blue"/>
    <geom name="sphere" type="sphere" size=".2" rgba="1 0 0 .5" material="blue"/>
    <geom name="ellipsoid" type="ellipsoid" size=".1 .2 .3"/>
    <geom name="capsule" type="capsule" size=".1 .3"/>
    <geom name="cylinder" type="cylinder" size=".1 .3"/>
    <geom name="wedge" type="mesh" mesh="wedge"/>
    <geom name="ground" type="plane" size="1 1 1"/>
    <geom name="unseen" type="box" size="1 1 1" group="3"/>
    <geom name="clear" type="box" size="1 1 1" rgba="1 1 1 0"/>
  </worldbody>
</mujoco>"""


@dataclass
class FakeNode:
    name: str
    arguments: dict[str, Any] = field(default_factory=dict)
    position: Any = (0.0, 0.0, 0.0)
    wxyz: Any = (1.0, 0.0, 0.0, 0.0)
    scale: Any = (1.0, 1.0, 1.0)
    visible: bool = True
    bones: tuple[FakeNode, ...] = ()
    is_removed: bool = False

    def remove(self) -> None:
        self.is_removed = True


class FakeScene:
    """Keeps what it was asked to draw."""

    def __init__(self) -> None:
        self.nodes: dict[str, FakeNode] = {}

    def add_frame(self, name: str, **arguments: Any) -> FakeNode:
        return self._add(FakeNode(name, arguments))

    def add_mesh_simple(self, name: str, vertices: Any, faces: Any, **arguments: Any) -> FakeNode:
        return self._add(FakeNode(name, {**arguments, "mesh": Mesh(vertices, faces)}))

    def add_mesh_skinned(self, name: str, vertices: Any, faces: Any, **given: Any) -> FakeNode:
        poses = zip(given["bone_positions"], given["bone_wxyzs"], strict=True)
        bones = tuple(FakeNode(name, {}, position, wxyz) for position, wxyz in poses)
        node = FakeNode(name, {**given, "mesh": Mesh(vertices, faces)}, bones=bones)
        return self._add(node)

    def _add(self, node: FakeNode) -> FakeNode:
        assert node.name not in self.nodes
        self.nodes[node.name] = node
        return node


def volume(mesh: Mesh) -> float:
    """m³ within a closed surface whose triangles run anticlockwise seen from outside."""
    a, b, c = (mesh.vertices[mesh.faces[:, i]] for i in range(3))
    return float((a * np.cross(b, c)).sum() / 6)


@pytest.fixture(scope="module")
def shapes() -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(SHAPES)


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("box", 0.2 * 0.4 * 0.6),
        ("sphere", 4 / 3 * np.pi * 0.2**3),
        ("ellipsoid", 4 / 3 * np.pi * 0.1 * 0.2 * 0.3),
        ("capsule", np.pi * 0.1**2 * (0.6 + 4 / 3 * 0.1)),
        ("cylinder", np.pi * 0.1**2 * 0.6),
        ("wedge", 1 / 6),
    ],
)
def test_surfaces_are_closed_and_face_outwards(
    shapes: mujoco.MjModel, name: str, expected: float
) -> None:
    mesh = geom_mesh(shapes, shapes.geom(name).id)
    # 24 sides of a circle have 1.1 % less area, and 12 of a half circle somewhat less again.
    assert volume(mesh) == pytest.approx(expected, rel=0.03)
    assert volume(mesh) <= expected * (1 + 1e-6)


def test_a_plane_is_a_square_that_faces_up(shapes: mujoco.MjModel) -> None:
    mesh = geom_mesh(shapes, shapes.geom("ground").id)
    a, b, c = mesh.vertices[mesh.faces[0]]
    assert np.cross(b - a, c - a) == pytest.approx([0, 0, 4])


def test_colours_come_from_materials_unless_geoms_have_their_own(shapes: mujoco.MjModel) -> None:
    assert geom_colour(shapes, shapes.geom("box").id) == pytest.approx([0, 0, 1, 1])
    assert geom_colour(shapes, shapes.geom("sphere").id) == pytest.approx([1, 0, 0, 0.5])


def test_what_mujoco_does_not_draw_is_left_out(shapes: mujoco.MjModel) -> None:
    scene: Any = FakeScene()
    ViserScene(scene, shapes, hidden=("gro",))
    drawn = [node.arguments["mesh"] for node in scene.nodes.values() if "mesh" in node.arguments]
    vertices = np.concatenate([mesh.vertices for mesh in drawn])
    assert vertices.min() > -0.9  # what is hidden reaches from -1 to 1 m


@pytest.fixture(scope="module")
def world() -> FaceEnv:
    env = make_env("FeedingEnv", cameras=())
    env.reset(seed=3)
    for _ in range(20):
        env.step(env.action_space.sample())
    return world_of(env)


def test_bodies_stand_where_the_simulator_has_them(world: FaceEnv) -> None:
    scene: Any = FakeScene()
    drawn = ViserScene(scene, world.model)
    drawn.update(world.data)
    for body in range(world.model.nbody):
        if node := scene.nodes.get(f"/cell/body_{body}"):
            assert np.asarray(node.position) == pytest.approx(world.data.xpos[body], abs=2e-6)
            assert np.asarray(node.wxyz) == pytest.approx(world.data.xquat[body], abs=2e-6)
    cube = f"/cell/body_{world.model.body('cube').id}"
    colours = [node.arguments["color"] for name, node in scene.nodes.items() if cube + "/" in name]
    assert colours == [(217, 26, 20)]
    drawn.remove()
    assert scene.nodes["/cell"].is_removed


@pytest.mark.parametrize("task", ["DrinkingEnv", "FaceWipingEnv"])
def test_what_tasks_change_in_their_model_is_followed(task: str) -> None:
    """Liquid and residue: where MuJoCo draws them, as large, and gone when they are gone."""
    with closing(make_env(task, cameras=())) as env:
        env.reset(seed=3)
        world = world_of(env)
        model, scene = world.model, FakeScene()
        drawn = ViserScene(cast(Any, scene), model, varying=world.varying_geoms)
        if task == "DrinkingEnv":
            kind, indices = (
                "geom",
                [geom for geom in range(model.ngeom) if "cup/slice" in model.geom(geom).name],
            )
            before = model.geom_size.copy()
            cup = model.joint("cup").qposadr[0]
            world.data.qpos[cup + 3 : cup + 7] = (np.cos(0.5), 0.0, np.sin(0.5), 0.0)
            world.show_row({"liquid": np.array([0.4, 0.2])})
            assert not np.array_equal(model.geom_size, before)
        else:
            kind, indices = (
                "site",
                [site for site in range(model.nsite) if "spot" in model.site(site).name],
            )
            model.site_rgba[indices[::2], 3] = 0.0
        drawn.update(world.data)
        for place, index in enumerate(indices):
            body = getattr(model, f"{kind}_bodyid")[index]
            node = scene.nodes[f"/cell/body_{body}/{kind}_{index}"]
            for name, found in (("pos", node.position), ("quat", node.wxyz), ("size", node.scale)):
                wanted = getattr(model, f"{kind}_{name}")[index]
                np.testing.assert_allclose(found, wanted, atol=2e-6, err_msg=f"{name}, {index}")
            assert node.visible == (kind == "geom" or place % 2 == 1)
            extent = np.abs(node.arguments["mesh"].vertices).max(axis=0)
            np.testing.assert_allclose(extent, 1.0, rtol=0.02)  # 24 sides of a circle


def test_skins_deform_as_mujoco_deforms_them(world: FaceEnv) -> None:
    scene: Any = FakeScene()
    ViserScene(scene, world.model).update(world.data)
    visual = mujoco.MjvScene(world.model, 2000)
    camera, option = mujoco.MjvCamera(), mujoco.MjvOption()
    every = mujoco.mjtCatBit.mjCAT_ALL.value
    mujoco.mjv_updateScene(world.model, world.data, option, None, camera, every, visual)
    for skin in range(world.model.nskin):
        first = 3 * visual.skinvertadr[skin]
        count = world.model.skin_vertnum[skin]
        expected = visual.skinvert[first : first + 3 * count].reshape(-1, 3)
        patches = [n for name, n in scene.nodes.items() if name.startswith(f"/cell/skin_{skin}_")]
        triangles = sum(len(node.arguments["mesh"].faces) for node in patches)
        assert triangles == world.model.skin_facenum[skin]
        for node in patches:
            deformed = blended(node)
            distance = np.linalg.norm(deformed[:, None] - expected[None], axis=2).min(axis=1)
            assert distance.max() < 1e-5  # float32 of MuJoCo's vertices
    assert world.model.nskin == 3


def blended(node: FakeNode) -> np.ndarray:
    """(V, 3) m, world: linear blend skinning, as browsers do it."""
    vertices, weights = node.arguments["mesh"].vertices, node.arguments["skin_weights"]
    result = np.zeros_like(vertices)
    for column, bone in enumerate(node.bones):
        bound, turned = np.empty(9), np.empty(9)
        mujoco.mju_quat2Mat(bound, node.arguments["bone_wxyzs"][column].astype(np.float64))
        mujoco.mju_quat2Mat(turned, np.asarray(bone.wxyz, np.float64))
        local = (vertices - node.arguments["bone_positions"][column]) @ bound.reshape(3, 3)
        result += weights[:, [column]] * (local @ turned.reshape(3, 3).T + bone.position)
    return result


def test_patches_are_colours_that_are_there() -> None:
    colours = np.array([[250.0, 0, 0]] * 5 + [[0.0, 0, 250]] * 3 + [[0.0, 250, 0]])
    found = dict(colour_patches(colours))
    assert {colour: list(t) for colour, t in found.items()} == {
        (250, 0, 0): [0, 1, 2, 3, 4],
        (0, 0, 250): [5, 6, 7],
        (0, 250, 0): [8],
    }
    assert len(colour_patches(colours, number=2)) == 2


def test_lips_and_brows_have_colours_of_their_own(world: FaceEnv) -> None:
    scene: Any = FakeScene()
    ViserScene(scene, world.model)
    head = world.model.skin("face/skin").id
    patches = [n for name, n in scene.nodes.items() if name.startswith(f"/cell/skin_{head}_")]
    assert 3 <= len(patches) <= 6
    assert len(skin_mesh(world.model, head).faces) > 500
