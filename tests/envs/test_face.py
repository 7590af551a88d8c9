"""The face: its surface file, kinematics against oracles, contact, colours, and detection.

Oracles know nothing of `FaceModel`: they read the surface file themselves, turn vertices with SciPy
in the head frame, or let MuJoCo skin them. Legend: V = 468 vertices.
"""

from __future__ import annotations

import importlib.util
import sys
from collections import Counter
from pathlib import Path
from types import ModuleType

import hypothesis.strategies as st
import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from scipy.spatial.transform import Rotation

from robo_manip_baselines.envs.mujoco.face import (
    BODIES,
    MAX_OPENING,
    REST_OPENING,
    FaceModel,
    add_face,
)
from robo_manip_baselines.envs.mujoco.face.mesh import face_oval, head
from robo_manip_baselines.envs.mujoco.face.model import SURFACE
from robo_manip_baselines.envs.mujoco.face.texture import encode_png, paint
from robo_manip_baselines.envs.mujoco.motion import MotionLibrary
from robo_manip_baselines.errors import RequestError

MOUTH = np.array([0.0, 0.5, 0.35])
ABOVE = np.array([0.0, 0.0, 0.03])
UPRIGHT = np.array([1.0, 0.0, 0.0, 0.0])
# The frame of the recorded motion: head x -> world y, head y -> world z, head z -> world x.
WORLD_FROM_CAMERA = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])


@pytest.fixture(scope="module")
def surface() -> dict[str, np.ndarray]:
    with np.load(SURFACE, allow_pickle=False) as file:
        return dict(file)


@pytest.fixture(scope="module")
def face() -> FaceModel:
    return FaceModel.load()


@pytest.fixture(scope="module")
def bust() -> tuple[mujoco.MjModel, mujoco.MjData]:
    """The face alone, and a cube and a probe (a robot's contact bits) that float."""
    spec = mujoco.MjSpec.from_string(
        """<mujoco><option timestep="0.002"/>
        <visual><headlight ambient=".4 .4 .4" diffuse=".5 .5 .5"/></visual>
        <worldbody><light pos="1 0.5 1"/>
        <body name="cube" pos="0 0 5"><freejoint/>
          <geom type="box" size=".02 .02 .02" mass=".04" conaffinity="5"/></body>
        <body name="probe" pos="0 1 5"><freejoint/>
          <geom name="probe" type="box" size=".03 .012 .008" mass=".1" conaffinity="3"/></body>
        </worldbody></mujoco>"""
    )
    add_face(spec)
    model = spec.compile()
    return model, mujoco.MjData(model)


def place(
    model: mujoco.MjModel, data: mujoco.MjData, mouth: np.ndarray, turn: np.ndarray, jaw: float
) -> None:
    for name, (at, quat) in FaceModel.load().body_poses(mouth, turn, jaw).items():
        body = model.body(name).mocapid[0]
        data.mocap_pos[body], data.mocap_quat[body] = at, quat
        if name == "face/mouth":
            data.joint("face/cavity").qpos[:] = [*at, *quat]
    mujoco.mj_forward(model, data)


def skin_vertices(model: mujoco.MjModel, data: mujoco.MjData) -> np.ndarray:
    """World positions (V, 3) of the measured face, skinned by MuJoCo."""
    scene = mujoco.MjvScene(model, 300)
    mujoco.mjv_updateScene(
        model, data, mujoco.MjvOption(), None, mujoco.MjvCamera(),
        mujoco.mjtCatBit.mjCAT_ALL.value, scene,
    )  # fmt: skip
    start = model.skin_vertadr[mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_SKIN, "face/skin")]
    return np.array(scene.skinvert).reshape(-1, 3)[start : start + 468].astype(float)


quaternions = st.integers(0, 2**32 - 1).map(
    lambda seed: Rotation.random(random_state=seed).as_quat()[[3, 0, 1, 2]]
)
openings = st.floats(0.0, MAX_OPENING)
mouths = st.tuples(*[st.floats(-1.0, 1.0)] * 3).map(np.array)


# -- the surface file ---------------------------------------------------------------------------


def test_surface_has_the_size_of_an_adult_face(surface: dict[str, np.ndarray]) -> None:
    vertices = surface["vertices"]
    assert vertices.shape == (468, 3)

    def apart(*pairs: tuple[tuple[int, ...], tuple[int, ...]]) -> list[float]:
        return [
            float(np.linalg.norm(vertices[list(a)].mean(0) - vertices[list(b)].mean(0)))
            for a, b in pairs
        ]

    pupils, face_width, mouth_width, nose_to_chin = apart(
        ((33, 133), (362, 263)), ((234,), (454,)), ((61,), (291,)), ((2,), (152,))
    )
    # Farkas 1994, adults of both sexes, mean +- about three standard deviations
    assert 0.055 < pupils < 0.072
    assert 0.125 < face_width < 0.165
    assert 0.042 < mouth_width < 0.062
    assert 0.055 < nose_to_chin < 0.085
    # not flattened: the nose stands out before the eyes' corners as on a real face
    assert 0.025 < vertices[1, 2] - vertices[[33, 263], 2].mean() < 0.055


def test_triangles_are_consistent_and_leave_mouth_and_eyes_open(
    surface: dict[str, np.ndarray], face: FaceModel
) -> None:
    directed = Counter(
        edge for a, b, c in surface["triangles"].tolist() for edge in ((a, b), (b, c), (c, a))
    )
    assert max(directed.values()) == 1  # two neighbours run along an edge in opposite directions
    border = {frozenset(edge) for edge in directed if edge[::-1] not in directed}
    rings = {name: surface[name] for name in ("lips_inner", "eye_left", "eye_right")}
    rings["outline"] = face_oval(face)
    holes = {
        frozenset((int(a), int(b)))
        for ring in rings.values()
        for a, b in zip(ring, np.roll(ring, -1), strict=True)
    }
    assert border == holes
    corners = surface["vertices"][surface["triangles"]]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert np.linalg.norm(normals, axis=1).min() > 0
    assert (normals[:, 2] > 0).mean() > 0.9  # all but the flanks of nose and jaw look forward


def test_surface_is_symmetric_and_closed(surface: dict[str, np.ndarray]) -> None:
    vertices = surface["vertices"]
    gap = np.linalg.norm(vertices[:, None] * (-1, 1, 1) - vertices, axis=-1).min(axis=1)
    assert gap.max() < 1e-6
    upper, lower = [191, 80, 81, 82, 13, 312, 311, 310, 415], [95, 88, 178, 87, 14, 317, 402, 318]
    lower.append(324)
    # the lips touch: the paired landmarks of the inner edges lie within a millimetre
    assert np.linalg.norm(vertices[upper] - vertices[lower], axis=1).max() < 1e-3


def test_jaw_weights(surface: dict[str, np.ndarray]) -> None:
    weight = surface["jaw_weight"]
    assert weight.shape == (468,)
    assert weight.min() >= 0
    assert weight.max() <= 1
    assert weight[[13, 0, 1, 4, 10, 33, 263]].max() < 0.02  # upper lip, nose, forehead, eyes
    assert weight[[14, 17, 152, 175]].min() > 0.95  # lower lip and chin
    assert ((weight[[61, 291, 78, 308]] > 0.2) & (weight[[61, 291, 78, 308]] < 0.8)).all()
    edges = np.concatenate([surface["triangles"][:, [i, (i + 1) % 3]] for i in range(3)])
    inner = set(surface["lips_inner"].tolist())
    across = np.array([a in inner and b in inner for a, b in edges])
    # smooth: nowhere from one vertex to the next from still to moving
    assert np.abs(np.diff(weight[edges[~across]], axis=1)).max() < 0.6


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda path: path.unlink(), "cannot be read"),
        (lambda path: path.write_bytes(path.read_bytes()[:500]), "cannot be read"),
        (lambda path: np.savez(path, schema="face_surface", version=2), "version 1"),
        (lambda path: np.savez(path, schema="recorded_face_motion", version=1), "face_surface"),
        (lambda path: np.savez(path, schema="face_surface", version=1), "cannot be read"),
    ],
)
def test_a_bad_surface_file_gets_one_line(damage, message: str, tmp_path: Path) -> None:
    path = tmp_path / "face_surface.npz"
    path.write_bytes(SURFACE.read_bytes())
    damage(path)
    with pytest.raises(RequestError, match=message) as caught:
        FaceModel.load(path)
    assert "export-surface" in str(caught.value)
    assert "\n" not in str(caught.value)


# -- kinematics ---------------------------------------------------------------------------------


@given(mouths, quaternions, openings)
def test_lip_centre_is_where_it_was_asked_for(
    mouth: np.ndarray, orientation: np.ndarray, jaw: float
) -> None:
    model = FaceModel.load()
    poses = model.body_poses(mouth, orientation, jaw)
    with np.load(SURFACE, allow_pickle=False) as file:
        vertices, weight, hinge = file["vertices"], file["jaw_weight"], file["jaw_hinge"]
        lips = np.concatenate([file["lips_outer"], file["lips_inner"]])
    # bones carry the vertices, in the head's axes, through the bodies' own axes
    carried = []
    for name, origin in (("face/head", np.zeros(3)), ("face/jaw", hinge)):
        at, quat = poses[name]
        turn = Rotation.from_quat(quat[[1, 2, 3, 0]]).as_matrix()
        carried.append((vertices - origin) @ WORLD_FROM_CAMERA.T @ turn.T + at)
    world = (1 - weight[:, None]) * carried[0] + weight[:, None] * carried[1]
    np.testing.assert_allclose(world[lips].mean(axis=0), mouth, atol=1e-9)
    np.testing.assert_allclose(poses["face/mouth"][0], mouth, atol=1e-12)
    # a table of 1024 angles, linearly interpolated; lips that overlap by 0.4 mm when closed
    assert abs(np.linalg.norm(world[13] - world[14]) - jaw) < 5e-4
    turn = WORLD_FROM_CAMERA @ Rotation.from_quat(orientation[[1, 2, 3, 0]]).as_matrix()
    for name in ("face/head", "face/mouth"):
        axes = Rotation.from_quat(poses[name][1][[1, 2, 3, 0]]).as_matrix()
        np.testing.assert_allclose(axes, turn @ WORLD_FROM_CAMERA.T, atol=1e-9)


@settings(max_examples=25)
@given(quaternions, openings)
def test_mujoco_draws_the_lips_there(orientation: np.ndarray, jaw: float) -> None:
    model, data = _compiled()
    place(model, data, MOUTH, orientation, jaw)
    drawn = skin_vertices(model, data)
    face = FaceModel.load()
    # single precision in MuJoCo's scene
    np.testing.assert_allclose(drawn[face.lips].mean(axis=0), MOUTH, atol=1e-6)
    np.testing.assert_allclose(data.site("mouth").xpos, MOUTH, atol=1e-12)
    ring = drawn[face.rings["lips_inner"]] - MOUTH
    axes = data.site("mouth").xmat.reshape(3, 3)
    np.testing.assert_allclose((ring @ axes)[:, 1:], face.opening_polygon(jaw), atol=1e-6)


_cache: list[tuple[mujoco.MjModel, mujoco.MjData]] = []


def _compiled() -> tuple[mujoco.MjModel, mujoco.MjData]:
    if not _cache:
        spec = mujoco.MjSpec()
        add_face(spec)
        model = spec.compile()
        _cache.append((model, mujoco.MjData(model)))
    return _cache[0]


@pytest.mark.parametrize(
    ("axis", "normal", "up"),
    [
        # camera frame: x right in the image, y up, z toward the camera; a quarter turn about each
        ((0, 1, 0), (0, 1, 0), (0, 0, 1)),  # turns to the viewer's right: world +y
        ((1, 0, 0), (0, 0, -1), (1, 0, 0)),  # looks down
        ((0, 0, 1), (1, 0, 0), (0, -1, 0)),  # tilts its crown to the viewer's left
    ],
)
def test_directions_in_the_world(axis, normal, up, bust) -> None:
    model, data = bust
    quat = np.array([np.sqrt(0.5), *(np.sqrt(0.5) * np.array(axis))])
    place(model, data, MOUTH, quat, REST_OPENING)
    axes = data.site("mouth").xmat.reshape(3, 3)
    np.testing.assert_allclose(axes[:, 0], normal, atol=1e-12)
    np.testing.assert_allclose(axes[:, 2], up, atol=1e-12)


def test_an_upright_face_looks_along_x(bust) -> None:
    model, data = bust
    place(model, data, MOUTH, UPRIGHT, REST_OPENING)
    np.testing.assert_allclose(data.site("mouth").xmat.reshape(3, 3), np.eye(3), atol=1e-12)
    drawn = skin_vertices(model, data)
    assert drawn[1, 0] > drawn[[33, 263], 0].max()  # nose before eyes
    assert drawn[10, 2] > MOUTH[2] > drawn[152, 2]  # forehead above, chin below
    assert drawn[263, 1] > drawn[33, 1]  # the subject's left eye at the viewer's right


def test_poses_of_many_are_the_poses_of_each(face: FaceModel) -> None:
    rng = np.random.default_rng(0)
    mouth, jaw = rng.normal(size=(4, 5, 3)), rng.uniform(0, 0.05, (4, 5))
    turn = Rotation.random(20, random_state=rng).as_quat().reshape(4, 5, 4)
    together = face.body_poses(mouth, turn, jaw)
    assert tuple(together) == BODIES
    for index in np.ndindex(4, 5):
        alone = face.body_poses(mouth[index], turn[index], jaw[index])
        for name in BODIES[:3]:
            for a, b in zip(together[name], alone[name], strict=True):
                np.testing.assert_allclose(a[index], b, atol=1e-12)
    at, quat = together["face/torso"]
    np.testing.assert_allclose(at, np.broadcast_to(mouth.mean(axis=(0, 1)), (4, 5, 3)))
    np.testing.assert_allclose(quat, np.broadcast_to(UPRIGHT, (4, 5, 4)))
    assert all(a.flags.writeable for pose in together.values() for a in pose)


def test_opening_grows_with_the_jaw_and_stops(face: FaceModel) -> None:
    jaw = np.linspace(0.0, MAX_OPENING, 40)
    width, height = face.opening(jaw)
    assert (np.diff(height) > 0).all()
    assert height[0] < 0.0015
    # the lips are as wide as the measured mouth, whatever the jaw does
    np.testing.assert_allclose(width, 0.0225, atol=0.003)
    for beyond, at in ((-0.01, 0.0), (0.2, MAX_OPENING)):
        np.testing.assert_array_equal(face.opening(beyond), face.opening(at))
    # a 4 cm cube fits with lips that give way by no more than 7 mm above and below
    assert face.opening(REST_OPENING)[1] > 0.013


# -- contact ------------------------------------------------------------------------------------


def test_contact_bits(bust) -> None:
    model, _ = bust
    cavity = {"tongue_floor", "cheek_left", "cheek_right", "throat", "palate"}
    outside = {"skull", "cheeks", "nose", "chin", "neck", "shoulders", "chest"}
    outside |= {f"lip_{i}" for i in range(10)}
    for index in range(model.ngeom):
        geom = model.geom(index)
        if not geom.name.startswith("face/"):
            continue
        name = geom.name.removeprefix("face/")
        bits = 4 if name in cavity else 2 if name in outside else 0
        assert (geom.contype[0], geom.conaffinity[0]) == (bits, 0), name
        if bits:
            assert geom.group[0] == 3, name  # not drawn
    owner = {i: model.body(model.geom(f"face/lip_{i}").bodyid[0]).name for i in range(10)}
    assert [owner[i] for i in range(10)] == ["face/head"] * 5 + ["face/jaw"] * 5
    assert model.geom("face/tongue_floor").bodyid[0] == model.body("face/cavity").id


@pytest.mark.parametrize(
    ("offset", "touches"),
    [
        ((0.010, 0.0, 0.0), False),  # well aimed, the probe's front 2 cm behind the lips
        ((0.010, 0.003, 0.0), False),
        ((0.010, 0.0, 0.002), False),
        ((0.010, 0.0, 0.018), True),  # against the upper lip
        ((0.010, 0.0, -0.018), True),
        ((0.010, 0.028, 0.0), True),  # against a corner
        ((0.080, 0.0, 0.018), False),  # still ahead of the face
    ],
)
def test_lips_leave_the_opening_free(offset, touches: bool, bust) -> None:
    model, data = bust
    mujoco.mj_resetData(model, data)
    data.body("probe").xpos[:] = 0
    adr = model.body("probe").jntadr[0]
    start = model.jnt_qposadr[adr]
    data.qpos[start : start + 3] = MOUTH + offset
    place(model, data, MOUTH, UPRIGHT, REST_OPENING)
    touched = {
        model.geom(geom).name
        for contact in data.contact
        for geom in contact.geom
        if model.geom(geom).name.startswith("face/")
    }
    assert bool(touched) == touches, touched


@pytest.mark.parametrize("depth", [0.010, 0.020, 0.030])
@pytest.mark.parametrize(
    ("side", "up", "euler"),
    [
        (0.0, 0.0, (0, 0, 0)),
        (0.01, 0.01, (10, -10, 5)),
        (-0.01, -0.01, (-20, 8, -8)),
        (0.0, 0.01, (0, 12, 0)),  # the head bows
    ],
)
def test_a_released_cube_stays_in_the_mouth(depth, side, up, euler, bust) -> None:
    model, data = bust
    mujoco.mj_resetData(model, data)
    start = model.jnt_qposadr[model.body("cube").jntadr[0]]
    data.qpos[start : start + 3] = MOUTH + np.array([-depth, side, up])
    turn = Rotation.from_euler("YXZ", euler, degrees=True).as_quat()[[3, 0, 1, 2]]
    place(model, data, MOUTH, turn, REST_OPENING)
    for _ in range(1000):  # two seconds
        mujoco.mj_step(model, data)
    site = data.site("mouth")
    out, across, above = (data.body("cube").xpos - site.xpos) @ site.xmat.reshape(3, 3)
    assert -0.06 < out < 0.0
    assert abs(across) < 0.02
    assert abs(above) < 0.02
    assert np.linalg.norm(data.body("cube").cvel) < 0.02


@pytest.mark.parametrize("clip", ["clm_cap12", "latentsync_demo2", "us_gov_whitehouse2021"])
def test_the_inside_of_the_mouth_goes_along_and_carries_the_cube(clip: str, bust) -> None:
    model, data = bust
    rng = np.random.default_rng(5)
    segment = MotionLibrary.load().draw(rng, clips=[clip])
    times = np.arange(0.0, 4.0, model.opt.timestep)
    moved, turn, jaw = segment.at(times)
    poses = FaceModel.load().body_poses(MOUTH + moved, turn, jaw + REST_OPENING)
    mujoco.mj_resetData(model, data)
    start = model.jnt_qposadr[model.body("cube").jntadr[0]]
    place(model, data, MOUTH + moved[0], turn[0], jaw[0] + REST_OPENING)
    data.qpos[start : start + 3] = data.site("mouth").xpos + data.site("mouth").xmat.reshape(
        3, 3
    ) @ (-0.015, 0.0, 0.0)
    mocap = {name: model.body(name).mocapid[0] for name in BODIES}
    behind = []
    for step in range(len(times)):
        for name, body in mocap.items():
            data.mocap_pos[body] = poses[name][0][step]
            data.mocap_quat[body] = poses[name][1][step]
        mujoco.mj_step(model, data)
        behind.append(
            np.linalg.norm(data.joint("face/cavity").qpos[:3] - poses["face/mouth"][0][step])
        )
    # the weld's time constant of 4 ms at the fastest recorded 0.3 m/s, twice over
    assert max(behind) < 0.003
    site = data.site("mouth")
    out, across, above = (data.body("cube").xpos - site.xpos) @ site.xmat.reshape(3, 3)
    assert -0.06 < out < 0.005
    assert abs(across) < 0.025
    assert abs(above) < 0.02


# -- looks --------------------------------------------------------------------------------------


def test_texture_is_a_png_that_says_the_same(tmp_path: Path) -> None:
    import cv2

    image = paint()
    path = tmp_path / "face.png"
    path.write_bytes(encode_png(image))
    np.testing.assert_array_equal(cv2.imread(str(path))[..., ::-1], image)


def test_the_cell_can_be_saved_as_xml() -> None:
    spec = mujoco.MjSpec()
    add_face(spec)
    spec.compile()
    text = spec.to_xml()
    for name in ("face/skin", "face/lip_9", 'site name="mouth"', "face/torso"):
        assert name in text


def test_the_head_is_one_closed_surface(face: FaceModel) -> None:
    whole = head(face)
    directed = Counter(
        edge for a, b, c in whole.triangles.tolist() for edge in ((a, b), (b, c), (c, a))
    )
    assert max(directed.values()) == 1
    border = {edge for edge in directed if edge[::-1] not in directed}
    # what is open: mouth (20), two eyes (16 each), and the point at the back (36 equal vertices)
    assert len(border) == 20 + 2 * 16 + 36
    back = np.unique([edge for edge in border if min(edge) >= 468])
    assert np.ptp(whole.vertices[back], axis=0).max() < 1e-9
    assert ((whole.weight >= 0) & (whole.weight <= 1)).all()


@pytest.fixture(scope="module")
def portrait(bust) -> tuple[np.ndarray, np.ndarray]:
    """The face from straight ahead, 640 x 480, and the pixels (V, 2) of its vertices."""
    model, data = bust
    mujoco.mj_resetData(model, data)
    place(model, data, MOUTH, UPRIGHT, REST_OPENING)
    camera = mujoco.MjvCamera()
    camera.lookat, camera.distance, camera.azimuth = MOUTH + ABOVE, 0.5, 180
    camera.elevation = 0
    with mujoco.Renderer(model, 480, 640) as renderer:
        renderer.update_scene(data, camera)
        image = renderer.render().astype(float)
    away = skin_vertices(model, data) - (MOUTH + ABOVE + np.array([0.5, 0.0, 0.0]))
    focal = 240 / np.tan(np.deg2rad(model.vis.global_.fovy / 2))
    pixels = np.stack(
        [320 + focal * away[:, 1] / -away[:, 0], 240 - focal * away[:, 2] / -away[:, 0]], axis=1
    )
    return image, pixels


def colour(portrait: tuple[np.ndarray, np.ndarray], *vertices: int) -> np.ndarray:
    """Mean RGB in the 3 x 3 pixels about the middle of some vertices."""
    image, pixels = portrait
    column, row = pixels[list(vertices)].mean(axis=0).round().astype(int)
    return image[row - 1 : row + 2, column - 1 : column + 2].reshape(-1, 3).mean(axis=0)


@pytest.mark.gl
def test_eyes_lips_skin_and_mouth_differ_by_colour(portrait) -> None:
    cheek, forehead = colour(portrait, 205, 50), colour(portrait, 151)
    lower_lip, upper_lip = colour(portrait, 14, 17), colour(portrait, 0, 13)
    for skin in (cheek, forehead):
        assert skin[0] > skin[1] > skin[2]  # skin is warm
        for lip in (lower_lip, upper_lip):
            # lips are redder: more of their light is red
            assert lip[0] / lip.sum() > skin[0] / skin.sum() + 0.06
            assert lip.sum() < skin.sum()
    inside = colour(portrait, 78, 13, 14)  # beside the tongue
    assert inside.max() < 90  # dark, lit by no more than a third
    for corner in ((33, 160, 144), (263, 387, 373)):
        white = colour(portrait, *corner)
        assert white.min() > 120
        assert np.ptp(white) < 0.25 * white.max()  # without colour, or nearly
    pupil = colour(portrait, 159, 145)
    assert pupil.max() < 90
    brow = colour(portrait, 105, 52)
    assert brow.sum() < 0.7 * forehead.sum()


# -- MediaPipe's detector -----------------------------------------------------------------------


@pytest.fixture(scope="module")
def benchmark(repository: Path) -> ModuleType:
    spec = importlib.util.spec_from_file_location(
        "face_detection", repository / "benchmarks/face_detection.py"
    )
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["face_detection"] = module  # dataclasses look their module up
    spec.loader.exec_module(module)
    return module


@pytest.mark.gl
@pytest.mark.shared
def test_mediapipe_finds_the_face_and_its_mouth(benchmark: ModuleType, shared_dir: Path) -> None:
    pytest.importorskip("mediapipe", reason="the extra face_prediction is not installed")
    model = shared_dir / "faces" / "face_landmarker.task"
    if not model.is_file():
        pytest.skip(f"the detector's model is not there: {model}")
    views = list(benchmark.recorded_views(64, seed=1))
    assert len({view.clip for view in views}) >= 5
    distance = np.linalg.norm(benchmark.mouth_errors(views, model), axis=1)
    assert np.isfinite(distance).all(), [
        v.clip for v, d in zip(views, distance, strict=True) if np.isnan(d)
    ]
    assert distance.max() < 10.0
    assert np.median(distance) < 3.0
