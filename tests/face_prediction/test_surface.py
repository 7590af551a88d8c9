"""The face surface: lifting against an independent projection, recovery of a known face, the file.

Legend: T frames, V = 468 vertices. The known face is the surface that ships with the package.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from pathlib import Path

import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import given, settings
from scipy.spatial.transform import Rotation

from face_prediction.commands import export_surface as surface_command
from face_prediction.commands.export_surface import ExportSurfaceOptions, run_export_surface
from face_prediction.motion.surface import (
    CANONICAL_MEAN,
    Topology,
    align,
    align_subjects,
    closed_mean,
    facing_out,
    fit_jaw,
    measure,
    mediapipe_topology,
    metric_landmarks,
    mirror_partners,
    opening_velocity,
    ordered_loops,
    symmetric,
)
from face_prediction.tracking.tracks import FaceTrack, save_track
from robo_manip_baselines.runs.errors import RequestError

ROOT = Path(__file__).resolve().parents[2]
SHIPPED = ROOT / "robo_manip_baselines/envs/mujoco/face/assets/face_surface.npz"
GROUPS = ("lips_outer", "lips_inner", "eye_left", "eye_right", "eyebrow_left", "eyebrow_right")
SIZE = (640, 480)


@pytest.fixture(scope="module")
def shipped() -> dict[str, np.ndarray]:
    with np.load(SHIPPED, allow_pickle=False) as file:
        return dict(file)


@pytest.fixture(scope="module")
def topology(shipped: dict[str, np.ndarray]) -> Topology:
    return Topology(shipped["triangles"], {name: shipped[name] for name in GROUPS})


def project(faces: np.ndarray, pose: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """The oracle: what MediaPipe would report of faces (T, V, 3) m, one point at a time in spirit.

    A pinhole of 63 degrees; z relative to the mean distance of the face, on the scale of x.
    """
    width, height = size
    focal = height / 2 / np.tan(np.deg2rad(31.5))
    points = np.einsum("tij,tvj->tvi", pose[:, :3, :3], faces) + pose[:, None, :3, 3]
    depth = -points[..., 2]
    far = depth.mean(axis=1, keepdims=True)
    return np.stack(
        [
            (width / 2 + focal * points[..., 0] / depth) / width,
            (height / 2 - focal * points[..., 1] / depth) / height,
            (depth - far) / far * focal / width,
        ],
        axis=-1,
    )


def poses(rng: np.random.Generator, count: int) -> np.ndarray:
    pose = np.tile(np.eye(4), (count, 1, 1))
    turn = Rotation.from_euler("YXZ", rng.uniform(-25, 25, (count, 3)), degrees=True)
    pose[:, :3, :3] = turn.as_matrix()
    pose[:, :3, 3] = rng.uniform((-0.1, -0.1, -0.8), (0.1, 0.1, -0.4), (count, 3))
    return pose


def opened(shipped: dict[str, np.ndarray], angle: np.ndarray) -> np.ndarray:
    """The shipped face (T, V, 3) with the jaw turned by ``angle`` (T,) rad."""
    vertices, weight = shipped["vertices"], shipped["jaw_weight"][:, None]
    turns = Rotation.from_rotvec(np.multiply.outer(angle, (1.0, 0.0, 0.0))).as_matrix()
    turned = np.einsum("tij,vj->tvi", turns, vertices - shipped["jaw_hinge"])
    return (1 - weight) * vertices + weight * (turned + shipped["jaw_hinge"])


@given(st.integers(0, 2**32 - 1), st.sampled_from([(640, 480), (400, 300), (1080, 1920)]))
def test_lifting_undoes_an_independent_projection(seed: int, size: tuple[int, int]) -> None:
    rng = np.random.default_rng(seed)
    faces = rng.normal(0, 0.04, (3, 468, 3))
    faces += CANONICAL_MEAN - faces.mean(axis=1, keepdims=True)
    pose = poses(rng, 3)
    lifted = metric_landmarks(project(faces, pose, size), pose, size)
    np.testing.assert_allclose(lifted, faces, atol=1e-9)


def test_a_face_whose_mean_lies_elsewhere_is_only_scaled(shipped: dict[str, np.ndarray]) -> None:
    faces = opened(shipped, np.zeros(4))
    pose = poses(np.random.default_rng(0), 4)
    lifted = metric_landmarks(project(faces, pose, SIZE), pose, SIZE)
    # the mean of this face is 2 mm from the canonical one's: at 0.4 m, half a percent of size,
    # and the face (0.1 m deep) seen from the pose's origin, so half a percent of that
    scale = np.ptp(lifted, axis=1) / np.ptp(faces, axis=1)
    np.testing.assert_allclose(scale, 1.0, atol=0.01)


@given(st.integers(0, 2**32 - 1))
def test_alignment_finds_the_rigid_motion_and_no_scale(seed: int) -> None:
    rng = np.random.default_rng(seed)
    reference = rng.normal(0, 0.05, (40, 3))
    turn = Rotation.random(5, random_state=rng).as_matrix()
    moved = np.einsum("tij,vj->tvi", turn, reference) + rng.normal(0, 0.3, (5, 1, 3))
    still = np.arange(20)
    np.testing.assert_allclose(
        align(moved, reference, still), np.tile(reference, (5, 1, 1)), atol=1e-9
    )
    larger = align(1.1 * moved, reference, still)
    spread = np.linalg.norm(larger - larger.mean(axis=1, keepdims=True), axis=-1)
    expected = 1.1 * np.linalg.norm(reference - reference.mean(axis=0), axis=-1)
    np.testing.assert_allclose(spread, np.tile(expected, (5, 1)), atol=1e-9)


def test_every_subject_counts_once(shipped: dict[str, np.ndarray]) -> None:
    one = opened(shipped, np.linspace(0, 0.1, 10))
    # an odd face: no turn brings it onto the other, so the mean decides how both are turned
    other = one @ (np.eye(3) + np.random.default_rng(1).normal(0, 0.1, (3, 3)))
    few, many = align_subjects([one, other]), align_subjects([np.repeat(one, 5, axis=0), other])
    for a, b in zip(few, many, strict=True):
        np.testing.assert_allclose(a.mean(axis=0), b.mean(axis=0), atol=1e-9)
    still = np.zeros((468, 3))
    halfway = (few[0].mean(axis=0) + few[1].mean(axis=0)) / 2
    np.testing.assert_allclose(closed_mean(many, still), halfway, atol=1e-9)


def test_a_known_face_and_its_jaw_are_found_again(
    shipped: dict[str, np.ndarray], topology: Topology
) -> None:
    rng = np.random.default_rng(7)
    subjects = []
    for _ in range(6):
        build = 1 + rng.normal(0, 0.02, 3) * (1, 1, 0.5)
        faces = opened(shipped, rng.uniform(0, 0.35, 60)) * build
        pose = poses(rng, 60)
        noise = rng.normal(0, 0.0003, faces.shape)
        subjects.append(metric_landmarks(project(faces + noise, pose, SIZE), pose, SIZE))
    vertices, jaw = measure(subjects, topology)
    # six people of 2 % different build, and 60 frames each with 0.3 mm of noise
    error = np.linalg.norm(vertices - shipped["vertices"], axis=1)
    assert np.sqrt(np.mean(error**2)) < 0.002
    # a line fitted to an arc of 0.35 rad: the hinge comes out within 1.5 cm, the weights within 0.2
    np.testing.assert_allclose(jaw.hinge, shipped["jaw_hinge"], atol=0.015)
    assert jaw.hinge[0] == 0
    assert np.abs(jaw.weight - shipped["jaw_weight"]).max() < 0.2
    assert np.corrcoef(jaw.weight, shipped["jaw_weight"])[0, 1] > 0.98


def test_a_smile_is_not_taken_for_an_opening(shipped: dict[str, np.ndarray]) -> None:
    rng = np.random.default_rng(3)
    opening, smile = rng.uniform(0, 0.2, 400), rng.uniform(0, 0.2, 400)
    smile += opening  # whoever opens the mouth also smiles
    faces = opened(shipped, opening)
    faces[:, [78, 61]] += smile[:, None, None] * (-0.02, 0.0, 0.0)
    faces[:, [308, 291]] += smile[:, None, None] * (0.02, 0.0, 0.0)
    velocity = opening_velocity([faces])
    # only what the corners do with the opening itself is left: they hardly move sideways
    assert np.abs(velocity[[61, 291], 0]).max() < 0.03


def test_no_opening_mouth_is_an_error(shipped: dict[str, np.ndarray], topology: Topology) -> None:
    with pytest.raises(RequestError, match="no mouth opens"):
        measure([opened(shipped, np.zeros(20))], topology)


def test_weights_obey_their_anchors(shipped: dict[str, np.ndarray], topology: Topology) -> None:
    noise = np.random.default_rng(0).normal(0, 0.5, (468, 3))
    noise[[14, 17, 87, 317]] = (0.0, -0.8, -0.3)
    weight = fit_jaw(shipped["vertices"], noise, topology.edges).weight
    assert weight.min() >= 0
    assert weight.max() <= 1
    np.testing.assert_allclose(weight[[13, 0, 1, 10, 168]], 0.0, atol=0.02)
    np.testing.assert_allclose(weight[[14, 17, 152]], 1.0, atol=0.02)


def test_mirroring(shipped: dict[str, np.ndarray]) -> None:
    vertices = shipped["vertices"]
    partner = mirror_partners(vertices + np.random.default_rng(0).normal(0, 0.0003, (468, 3)))
    assert partner[[33, 61, 78, 234, 10, 13]].tolist() == [263, 291, 308, 454, 10, 13]
    np.testing.assert_allclose(symmetric(vertices, partner), vertices, atol=1e-12)


def test_ordered_loops() -> None:
    square = [(1, 2), (4, 3), (2, 3), (4, 1)]
    triangle = [(10, 12), (11, 12), (11, 10)]
    loops = ordered_loops(np.array(square + triangle))
    assert sorted(map(sorted, loops)) == [[1, 2, 3, 4], [10, 11, 12]]
    sides = [{a, b} for a, b in zip(loops[0], loops[0][1:] + loops[0][:1], strict=True)]
    assert all(set(edge) in sides for edge in square)


@settings(max_examples=10)
@given(st.integers(0, 2**32 - 1))
def test_triangles_are_turned_to_face_outward(seed: int) -> None:
    with np.load(SHIPPED, allow_pickle=False) as file:
        triangles, vertices = file["triangles"], file["vertices"]
    flipped = triangles.copy()
    some = np.random.default_rng(seed).random(len(triangles)) < 0.5
    flipped[some] = flipped[some][:, [0, 2, 1]]

    def rolled(rows: np.ndarray) -> list[tuple[int, ...]]:
        return [tuple(np.roll(row, -row.argmin()).tolist()) for row in rows]

    assert rolled(facing_out(flipped, vertices)) == rolled(triangles)


def test_mediapipe_knows_the_shipped_mesh(shipped: dict[str, np.ndarray]) -> None:
    pytest.importorskip("mediapipe", reason="the extra face_prediction is not installed")
    found = mediapipe_topology()
    assert found.triangles.shape == (852, 3)
    assert {frozenset(t) for t in found.triangles.tolist()} == {
        frozenset(t) for t in shipped["triangles"].tolist()
    }
    for name in GROUPS:
        assert found.groups[name].tolist() == shipped[name].tolist()


# -- the command --------------------------------------------------------------------------------


@pytest.fixture
def known_mesh(topology: Topology, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """The mesh without MediaPipe, which a fast test must not need."""
    monkeypatch.setattr(surface_command, "mediapipe_topology", lambda: topology)
    return


@pytest.fixture
def write_track(
    tmp_path: Path, shipped: dict[str, np.ndarray], make_track: Callable[..., FaceTrack]
) -> Callable[..., Path]:
    def write(name: str, frames: int = 40, width: float = 1.0) -> Path:
        rng = np.random.default_rng(frames)
        faces = opened(shipped, rng.uniform(0, 0.3, frames)) * (width, 1.0, 1.0)
        pose = poses(rng, frames)
        track = make_track(np.zeros((frames, 3)) - (0, 0, 0.5), name=f"{name}.mp4")
        fields = dict(vars(track))
        fields["landmarks"] = project(faces, pose, SIZE).astype(np.float32)
        fields["head_pose"] = pose
        path = tmp_path / "tracks" / f"{name}.npz"
        save_track(path, FaceTrack(**fields))
        return path

    return write


def test_export_keeps_to_the_schema(
    tmp_path: Path, known_mesh: None, write_track: Callable[..., Path]
) -> None:
    write_track("a"), write_track("b", 50), write_track("withheld", width=3.0)
    table = tmp_path / "clips.csv"
    table.write_text(
        "clip,subject,ship,licence,source\n"
        "a.mp4,one,yes,MIT,here\nb.mp4,one,yes,MIT,there\nwithheld.mp4,two,no,none,nowhere\n"
    )
    out = tmp_path / "face_surface.npz"
    options = ExportSurfaceOptions((tmp_path / "tracks",), out=out, attribution=table)
    run_export_surface(options)
    with np.load(out, allow_pickle=False) as file:
        made = dict(file)
    with np.load(SHIPPED, allow_pickle=False) as file:
        assert {k: (v.shape, v.dtype.kind) for k, v in made.items()} == {
            k: (v.shape, v.dtype.kind) for k, v in file.items()
        }
        # the withheld face is three times as wide: it would show
        np.testing.assert_allclose(made["vertices"], file["vertices"], atol=0.004)
    about = json.loads(str(made["metadata"]))
    assert (about["clips"], about["subjects"], about["frames"]) == (2, 1, 90)
    assert sorted(about["attribution"]) == ["a", "b"]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"min_frames": 100}, "no clip with ship=yes and 100 valid frames"),
        ({"max_frames": 0}, "--max_frames 0"),
        ({"min_frames": 1}, "--min_frames 1"),
        ({"tracks": (Path("nowhere"),)}, "nowhere: no such file"),
        ({"attribution": Path("absent.csv")}, "absent.csv: cannot be read"),
        ({"out": Path(__file__).parent}, "is a folder"),
    ],
)
def test_bad_requests_leave_nothing_behind(
    change: dict[str, object],
    message: str,
    tmp_path: Path,
    known_mesh: None,
    write_track: Callable[..., Path],
) -> None:
    write_track("a")
    options = {"tracks": (tmp_path / "tracks",), "out": tmp_path / "s.npz", **change}
    with pytest.raises(RequestError, match=message) as caught:
        run_export_surface(ExportSurfaceOptions(**options))
    assert "\n" not in str(caught.value)
    assert not (tmp_path / "s.npz").exists()


def test_without_mediapipe_it_says_what_to_do(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "mediapipe.tasks.python.vision", None)
    with pytest.raises(RequestError, match=r"pip install .*\[face-prediction\]'"):
        mediapipe_topology()
