"""Appearance of the face, to colour oracles and to MediaPipe's detector."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import mujoco
import numpy as np
import pytest

from robo_manip_baselines.envs.mujoco.cell.scene import MOUTH_BASE
from robo_manip_baselines.envs.mujoco.face import REST_OPENING, FaceModel, add_face
from robo_manip_baselines.envs.mujoco.face.mesh import head, paint

MOUTH = np.array(MOUTH_BASE)
UPRIGHT = np.array([1.0, 0.0, 0.0, 0.0])
ABOVE = np.array([0.0, 0.0, 0.03])


def test_the_compiled_texture_is_what_was_painted(bust) -> None:
    image = paint()
    np.testing.assert_array_equal(bust.model.tex_data.reshape(image.shape), image)


def test_the_cell_can_be_saved_as_xml() -> None:
    spec = mujoco.MjSpec()
    add_face(spec)
    spec.compile()
    text = spec.to_xml()
    for name in ("face/skin", "face/lip_9", 'site name="mouth"', "face/torso"):
        assert name in text


def test_the_head_is_one_closed_surface(face: FaceModel) -> None:
    whole = head(face)
    triangles = whole.triangles.tolist()
    directed = Counter(edge for a, b, c in triangles for edge in ((a, b), (b, c), (c, a)))
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
    model, data = bust.model, bust.data
    mujoco.mj_resetData(model, data)
    bust.place(MOUTH, UPRIGHT, REST_OPENING)
    camera = mujoco.MjvCamera()
    camera.lookat, camera.distance, camera.azimuth = MOUTH + ABOVE, 0.5, 180
    camera.elevation = 0
    with mujoco.Renderer(model, 480, 640) as renderer:
        renderer.update_scene(data, camera)
        image = renderer.render().astype(float)
    away = bust.skin_vertices() - (MOUTH + ABOVE + np.array([0.5, 0.0, 0.0]))
    focal = 240 / np.tan(np.deg2rad(model.vis.global_.fovy / 2))
    ahead = -away[:, 0]
    pixels = np.stack([320 + focal * away[:, 1] / ahead, 240 - focal * away[:, 2] / ahead], axis=1)
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


@pytest.fixture(scope="module")
def benchmark(load_script: Callable[[str], ModuleType]) -> ModuleType:
    return load_script("benchmarks/face_detection.py")


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
    missed = [view.clip for view, d in zip(views, distance, strict=True) if np.isnan(d)]
    assert not missed
    assert distance.max() < 10.0
    assert np.median(distance) < 3.0
