"""Camera images: right picture, right camera, one context, clear words where there is no OpenGL."""

from __future__ import annotations

import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import mujoco
import numpy as np
import pytest

from robo_manip_baselines.envs.mujoco.cell import rendering
from robo_manip_baselines.envs.mujoco.cell.rendering import CameraRenderer, project, project_points
from robo_manip_baselines.envs.mujoco.cell.scene import build_cell
from robo_manip_baselines.runs.errors import RequestError

# Two cameras with nothing in common, and a red ball of 2 cm as the only thing that is red.
BALL = (0.12, -0.05, 0.3)
XML = f"""
<mujoco>
  <visual><global offwidth="64" offheight="48"/></visual>
  <asset><material name="red" rgba="1 0 0 1" emission="1"/></asset>
  <worldbody>
    <light pos="1 1 4"/>
    <geom type="plane" size="2 2 0.1" rgba="0.2 0.6 0.3 1"/>
    <geom type="box" size="0.1 0.1 0.1" pos="-0.3 0.2 0.1" rgba="0.2 0.3 0.8 1"/>
    <geom size="0.02" pos="{BALL[0]} {BALL[1]} {BALL[2]}" material="red"/>
    <camera name="above" pos="0.1 0.05 1.1" euler="10 -5 30" fovy="40"/>
    <camera name="aside" pos="0.9 -0.4 0.5" xyaxes="0.35 0.93 0 -0.3 0.1 0.95" fovy="55"/>
  </worldbody>
</mujoco>
"""
CAMERAS = ("above", "aside")


@pytest.fixture(scope="module")
def model() -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(XML)


@pytest.fixture(scope="module")
def data(model: mujoco.MjModel) -> mujoco.MjData:
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return data


def run_python(code: str, **environment: str | None) -> subprocess.CompletedProcess[str]:
    """Run code in a fresh interpreter; None takes a variable away."""
    merged = {**os.environ, **environment}
    kept = {key: value for key, value in merged.items() if value is not None}
    command = [sys.executable, "-c", code]
    return subprocess.run(command, env=kept, capture_output=True, text=True, timeout=120)


# -- projection: no OpenGL ------------------------------------------------------------------------

LOOKING_DOWN = np.eye(3)  # camera x right, y up, view along -z
LOOKING_ALONG_Y = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])


@pytest.mark.parametrize(
    ("point", "orientation", "pixel"),
    [
        ((0, 0, -1), LOOKING_DOWN, (320, 240)),  # straight ahead is the image's centre
        ((0, 1, -1), LOOKING_DOWN, (320, 0)),  # 90 degrees of view: 45 degrees up is the top
        ((0, -1, -1), LOOKING_DOWN, (320, 480)),
        ((1, 0, -1), LOOKING_DOWN, (560, 240)),  # square pixels
        ((2, 0, -2), LOOKING_DOWN, (560, 240)),  # same ray, same pixel
        ((0, 0, 1), LOOKING_DOWN, (np.nan, np.nan)),  # behind
        ((0, 0, 0), LOOKING_DOWN, (np.nan, np.nan)),  # in the camera's centre
        ((0, 1, 0), LOOKING_ALONG_Y, (320, 240)),
        ((0.5, 1, 0.5), LOOKING_ALONG_Y, (440, 120)),
    ],
)
def test_project_points_table(
    point: tuple[float, ...], orientation: np.ndarray, pixel: tuple[float, float]
) -> None:
    found = project_points(point, (0, 0, 0), orientation, 90.0, 480, 640)
    np.testing.assert_allclose(found, pixel, atol=1e-9)
    moved = project_points(np.add(point, (3, 4, 5)), (3, 4, 5), orientation, 90.0, 480, 640)
    np.testing.assert_allclose(moved, pixel, atol=1e-9)


def test_project_keeps_leading_axes(model: mujoco.MjModel, data: mujoco.MjData) -> None:
    points = np.random.default_rng(0).uniform(-0.1, 0.1, (4, 5, 3))
    pixels = project(model, data, "above", points, (480, 640))
    assert pixels.shape == (4, 5, 2)
    alone = project(model, data, "above", points[2, 3], (480, 640))
    np.testing.assert_array_equal(pixels[2, 3], alone)


# -- images ---------------------------------------------------------------------------------------


@pytest.mark.gl
@pytest.mark.parametrize("camera", CAMERAS)
def test_a_ball_is_drawn_where_its_centre_projects_to(
    model: mujoco.MjModel, data: mujoco.MjData, camera: str
) -> None:
    with CameraRenderer(model, 480, 640) as renderer:
        image = renderer.render(data, [camera])[camera]
    assert image.shape == (480, 640, 3)
    assert image.dtype == np.uint8
    red, green, blue = np.moveaxis(image.astype(int), -1, 0)
    rows, columns = np.nonzero((red > 2 * green + 20) & (red > 2 * blue + 20))
    assert len(rows) > 50
    found = (columns.mean() + 0.5, rows.mean() + 0.5)
    # A ball's outline is an ellipse whose middle is off its centre by well under a pixel here.
    np.testing.assert_allclose(found, project(model, data, camera, BALL, (480, 640)), atol=0.5)


@pytest.mark.gl
def test_drawing_cameras_together_gives_the_pixels_of_drawing_them_one_by_one(
    model: mujoco.MjModel, data: mujoco.MjData
) -> None:
    with CameraRenderer(model, 96, 128) as renderer:
        together = renderer.render(data, CAMERAS)
        for camera in reversed(CAMERAS):
            np.testing.assert_array_equal(renderer.render(data, [camera])[camera], together[camera])
    assert list(together) == list(CAMERAS)
    assert np.any(together["above"] != together["aside"])


@pytest.mark.gl
def test_images_agree_with_mujocos_own_renderer() -> None:
    model = build_cell().compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    cameras = [model.camera(i).name for i in range(model.ncam)]
    with mujoco.Renderer(model, 240, 320) as reference, CameraRenderer(model, 240, 320) as renderer:
        images = renderer.render(data, cameras)
        for camera in cameras:
            reference.update_scene(data, camera)
            reference.scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = False
            np.testing.assert_array_equal(images[camera], reference.render())


@pytest.mark.gl
def test_images_are_not_overwritten_by_the_next_ones(
    model: mujoco.MjModel, data: mujoco.MjData
) -> None:
    with CameraRenderer(model, 48, 64) as renderer:
        first = renderer.render(data, ["above"])["above"]
        kept = first.copy()
        second = renderer.render(data, ["aside"])["aside"]
    np.testing.assert_array_equal(first, kept)
    assert first.flags.c_contiguous
    assert not np.shares_memory(first, second)


@pytest.mark.gl
def test_a_size_beyond_the_models_own_buffer_is_drawn_and_the_model_left_as_it_was(
    model: mujoco.MjModel, data: mujoco.MjData
) -> None:
    with CameraRenderer(model, 720, 1280, shadows=True, multisamples=4) as renderer:
        image = renderer.render(data, ["above"])["above"]
    assert image.shape == (720, 1280, 3)
    assert len(np.unique(image[-1])) > 1  # drawn down to the last row
    assert (model.vis.global_.offwidth, model.vis.global_.offheight) == (64, 48)
    assert model.vis.quality.offsamples == 4  # MuJoCo's default
    assert model.vis.quality.shadowsize == 4096


@pytest.mark.gl
def test_shadows_and_multisampling_change_the_picture_only_when_asked_for(
    model: mujoco.MjModel, data: mujoco.MjData
) -> None:
    def image(**options: object) -> np.ndarray:
        with CameraRenderer(model, 240, 320, **options) as renderer:  # type: ignore[arg-type]
            return renderer.render(data, ["aside"])["aside"].astype(int)

    plain = image()
    np.testing.assert_array_equal(plain, image(shadows=False, multisamples=0))
    darkened = (plain - image(shadows=True)).max(axis=-1) > 20
    assert 0.001 < darkened.mean() < 0.2
    smooth = image(multisamples=4)
    # Smooth edges mix colours, on edges only.
    many, few = (len(np.unique(view.reshape(-1, 3), axis=0)) for view in (smooth, plain))
    assert many > few
    assert np.mean(smooth != plain) < 0.2


@pytest.mark.gl
def test_one_context_however_many_images_and_a_new_one_after_closing(
    model: mujoco.MjModel, data: mujoco.MjData, monkeypatch: pytest.MonkeyPatch
) -> None:
    made: list[int] = []
    make = rendering._make_context

    def counted(*arguments: object) -> object:
        made.append(1)
        return make(*arguments)  # type: ignore[arg-type]

    monkeypatch.setattr(rendering, "_make_context", counted)
    renderer = CameraRenderer(model, 48, 64)
    assert renderer.render(data, []) == {}
    assert made == []
    first = renderer.render(data, CAMERAS)["above"]
    renderer.render(data, ["aside"])
    assert len(made) == 1
    renderer.close()
    renderer.close()
    np.testing.assert_array_equal(renderer.render(data, ["above"])["above"], first)
    assert len(made) == 2
    renderer.close()


@pytest.mark.gl
def test_two_renderers_may_take_turns(model: mujoco.MjModel, data: mujoco.MjData) -> None:
    with CameraRenderer(model, 48, 64) as small, CameraRenderer(model, 96, 128) as large:
        alone = small.render(data, ["above"])["above"]
        large.render(data, ["above"])
        np.testing.assert_array_equal(small.render(data, ["above"])["above"], alone)
        assert large.render(data, ["aside"])["aside"].shape == (96, 128, 3)
    with CameraRenderer(model, 48, 64) as again:
        np.testing.assert_array_equal(again.render(data, ["above"])["above"], alone)


@pytest.mark.gl
def test_threads_may_take_turns(model: mujoco.MjModel, data: mujoco.MjData) -> None:
    with CameraRenderer(model, 48, 64) as renderer:
        here = renderer.render(data, ["above"])["above"]
        with ThreadPoolExecutor(1) as pool:
            there = pool.submit(renderer.render, data, ["above"]).result()["above"]
        np.testing.assert_array_equal(here, there)
        np.testing.assert_array_equal(here, renderer.render(data, ["above"])["above"])


# -- bad requests and machines without OpenGL -----------------------------------------------------


def test_unknown_camera_is_told_the_valid_ones(model: mujoco.MjModel, data: mujoco.MjData) -> None:
    message = r"'abvoe' \(did you mean 'above'\?\); valid: above, aside"
    with pytest.raises(RequestError, match=message):
        CameraRenderer(model, 48, 64).render(data, ["above", "abvoe"])
    with pytest.raises(RequestError, match="valid: above, aside"):
        project(model, data, "below", (0, 0, 0), (48, 64))


@pytest.mark.parametrize(
    ("height", "width", "multisamples"), [(0, 64, 0), (48, -1, 0), (48, 64, -4)]
)
def test_bad_sizes_are_refused(
    model: mujoco.MjModel, height: int, width: int, multisamples: int
) -> None:
    with pytest.raises(RequestError, match="not valid"):
        CameraRenderer(model, height, width, multisamples=multisamples)


NO_CONTEXT = """
import mujoco
from robo_manip_baselines.envs.mujoco.cell.rendering import CameraRenderer
from robo_manip_baselines.runs.errors import RequestError
xml = "<mujoco><worldbody><camera name='eye'/></worldbody></mujoco>"
model = mujoco.MjModel.from_xml_string(xml)
data = mujoco.MjData(model)
mujoco.mj_forward(model, data)
renderer = CameraRenderer(model, 8, 8)
assert renderer.render(data, []) == {}
try:
    renderer.render(data, ["eye"])
except RequestError as error:
    print(error)
"""


@pytest.mark.parametrize("backend", ["disabled", "off"])
def test_a_backend_that_draws_nothing_is_one_clear_line(backend: str) -> None:
    result = run_python(NO_CONTEXT, MUJOCO_GL=backend)
    assert result.returncode == 0, result.stderr
    assert result.stdout.count("\n") == 1
    assert f"MUJOCO_GL={backend}" in result.stdout
    assert "egl" in result.stdout
    assert "--cameras none" in result.stdout


def test_a_device_that_is_not_there_is_one_clear_line() -> None:
    result = run_python(NO_CONTEXT, MUJOCO_GL="egl", MUJOCO_EGL_DEVICE_ID="99")
    assert result.returncode == 0, result.stderr
    assert result.stdout.count("\n") == 1
    assert "MUJOCO_EGL_DEVICE_ID=99: there is no such EGL device" in result.stdout
    assert "apt-get" not in result.stdout
    assert "--cameras none" in result.stdout


def test_import_needs_no_opengl_and_leaves_the_environment_alone() -> None:
    result = run_python(
        "import os, sys; before = dict(os.environ);"
        "import robo_manip_baselines.envs.mujoco.cell.rendering;"
        "assert 'OpenGL' not in sys.modules and 'mujoco.egl' not in sys.modules;"
        "assert os.environ.get('MUJOCO_GL') == before.get('MUJOCO_GL')",
        MUJOCO_GL=None,
    )
    assert result.returncode == 0, result.stderr


@pytest.mark.gl
@pytest.mark.parametrize("backend", [None, "egl"])
@pytest.mark.parametrize("ending", ["", "renderer.close()", "del renderer", "raise SystemExit(0)"])
def test_exit_is_silent_whatever_was_left_open(backend: str | None, ending: str) -> None:
    # Without MUJOCO_GL, mujoco has settled on another backend by the time we ask for EGL.
    result = run_python(NO_CONTEXT + ending, MUJOCO_GL=backend, DISPLAY=None)
    assert (result.returncode, result.stdout) == (0, "")
    assert result.stderr == ""


@pytest.mark.gl
def test_a_forked_worker_is_told_to_open_its_own(
    model: mujoco.MjModel, data: mujoco.MjData, monkeypatch: pytest.MonkeyPatch
) -> None:
    with CameraRenderer(model, 48, 64) as renderer:
        renderer.render(data, ["above"])
        with monkeypatch.context() as patched:
            patched.setattr(os, "getpid", lambda: -1)
            with pytest.raises(RuntimeError, match="in each worker"):
                renderer.render(data, ["above"])


def test_the_benchmark_says_how_to_get_what_it_compares_with(
    repository: Path, tmp_path: Path
) -> None:
    command = [sys.executable, "benchmarks/render_cameras.py", "--gym_aloha", str(tmp_path)]
    result = subprocess.run(command, cwd=repository, capture_output=True, text=True, timeout=120)
    assert result.returncode == 2
    assert result.stdout == ""
    assert result.stderr.count("\n") == 1
    assert "pip install --no-deps --target /tmp/gym-aloha gym-aloha==0.1.5" in result.stderr
