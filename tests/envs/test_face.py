"""The face: its surface file, and kinematics against oracles.

Oracles know nothing of `FaceModel`: they read the surface file themselves, turn vertices with SciPy
in the head frame, or let MuJoCo skin them. Legend: V = 468 vertices.
"""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import given, settings
from scipy.spatial.transform import Rotation

from robo_manip_baselines.envs.mujoco.cell.scene import MOUTH_BASE
from robo_manip_baselines.envs.mujoco.face import BODIES, MAX_OPENING, REST_OPENING, FaceModel
from robo_manip_baselines.envs.mujoco.face.mesh import face_oval
from robo_manip_baselines.envs.mujoco.face.model import SURFACE
from robo_manip_baselines.runs.errors import RequestError

MOUTH = np.array(MOUTH_BASE)
UPRIGHT = np.array([1.0, 0.0, 0.0, 0.0])
# The frame of the recorded motion: head x -> world y, head y -> world z, head z -> world x.
WORLD_FROM_CAMERA = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])


@pytest.fixture(scope="module")
def surface() -> dict[str, np.ndarray]:
    with np.load(SURFACE, allow_pickle=False) as file:
        return dict(file)


quaternions = st.integers(0, 2**32 - 1).map(
    lambda seed: Rotation.random(random_state=seed).as_quat()[[3, 0, 1, 2]]
)
openings = st.floats(0.0, MAX_OPENING)
mouths = st.tuples(*[st.floats(-1.0, 1.0)] * 3).map(np.array)


def test_surface_has_the_size_of_an_adult_face(surface: dict[str, np.ndarray]) -> None:
    vertices = surface["vertices"]
    assert vertices.shape == (468, 3)

    def apart(a: list[int], b: list[int]) -> float:
        return float(np.linalg.norm(vertices[a].mean(0) - vertices[b].mean(0)))

    pupils, face_width = apart([33, 133], [362, 263]), apart([234], [454])
    mouth_width, nose_to_chin = apart([61], [291]), apart([2], [152])
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
    triangles = surface["triangles"].tolist()
    directed = Counter(edge for a, b, c in triangles for edge in ((a, b), (b, c), (c, a)))
    assert max(directed.values()) == 1  # two neighbours run along an edge in opposite directions
    border = {frozenset(edge) for edge in directed if edge[::-1] not in directed}
    rings = {name: surface[name] for name in ("lips_inner", "eye_left", "eye_right")}
    rings["outline"] = face_oval(face)
    edges = [np.stack([ring, np.roll(ring, -1)], 1).tolist() for ring in rings.values()]
    assert border == {frozenset(edge) for ring in edges for edge in ring}
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
        (lambda path: path.unlink(), "no such file"),
        (lambda path: path.write_bytes(path.read_bytes()[:500]), "damaged or not"),
        (lambda path: np.savez(path, schema="face_surface", version=2), "reads 1"),
        (lambda path: np.savez(path, schema="recorded_face_motion", version=1), "face_surface"),
        (lambda path: np.savez(path, schema="face_surface", version=1), "'vertices' is missing"),
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
def test_mujoco_draws_the_lips_there(bust, orientation: np.ndarray, jaw: float) -> None:
    data = bust.data
    bust.place(MOUTH, orientation, jaw)
    drawn = bust.skin_vertices()
    face = FaceModel.load()
    # single precision in MuJoCo's scene
    np.testing.assert_allclose(drawn[face.lips].mean(axis=0), MOUTH, atol=1e-6)
    np.testing.assert_allclose(data.site("mouth").xpos, MOUTH, atol=1e-12)
    ring = drawn[face.rings["lips_inner"]] - MOUTH
    axes = data.site("mouth").xmat.reshape(3, 3)
    np.testing.assert_allclose((ring @ axes)[:, 1:], face.opening_polygon(jaw), atol=1e-6)


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
    data = bust.data
    quat = np.array([np.sqrt(0.5), *(np.sqrt(0.5) * np.array(axis))])
    bust.place(MOUTH, quat, REST_OPENING)
    axes = data.site("mouth").xmat.reshape(3, 3)
    np.testing.assert_allclose(axes[:, 0], normal, atol=1e-12)
    np.testing.assert_allclose(axes[:, 2], up, atol=1e-12)


def test_an_upright_face_looks_along_x(bust) -> None:
    data = bust.data
    bust.place(MOUTH, UPRIGHT, REST_OPENING)
    np.testing.assert_allclose(data.site("mouth").xmat.reshape(3, 3), np.eye(3), atol=1e-12)
    drawn = bust.skin_vertices()
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
