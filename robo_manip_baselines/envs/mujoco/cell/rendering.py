"""Camera images of a MuJoCo state: one OpenGL context, made when the first image is asked for.

Importing this module, and building a `CameraRenderer`, need no OpenGL. The backend is
``$MUJOCO_GL`` where that is set, else EGL, which needs no display; it is chosen here and not by
the order in which ``mujoco`` was imported, and the environment is left as it was.

Threads and processes: an OpenGL context belongs to one thread at a time, so `CameraRenderer.render`
lets go of it before it returns, and threads may take turns (not draw at once) with one renderer. A
context does not survive a fork: give every worker process a renderer of its own.
"""

from __future__ import annotations

import atexit
import contextlib
import importlib
import math
import os
import platform
import sys
import weakref
from collections.abc import Iterator, Sequence
from typing import Any, Final

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from robo_manip_baselines.envs.mujoco.cell.opengl import (
    APT_PACKAGES,
    backend_in_use,
    explain_failure,
)
from robo_manip_baselines.runs.errors import RequestError, require_choice

_MAX_GEOMS: Final = 2000
"""Room in the scene for geoms and their decorations; a cell has a few hundred."""

MAX_MULTISAMPLES: Final = 64
"""Most samples per pixel that are accepted; drivers offer 4 to 32, and use what they have."""

MODEL_CHANGES: Final = (
    *("geom_pos", "geom_size"),  # of liquid
    *("site_pos", "site_quat", "site_rgba", "site_sameframe"),  # of residue
)
"""Arrays of a model that a task changes in an episode to show something; a copy of the model that
is drawn needs them, too."""

_open_renderers: weakref.WeakSet[CameraRenderer] = weakref.WeakSet()


class CameraRenderer:
    """Draws a model's cameras off screen, only those that are asked for.

    Args:
        model: the model whose states will be drawn. Its own buffer sizes and sample counts do not
            matter: the renderer's apply.
        height: image height, pixels.
        width: image width, pixels.
        shadows: draw the lights' shadows. Costs several times the image itself on a CPU.
        multisamples: samples per pixel for smooth edges; 0 is off. Costs likewise.

    Raises:
        RequestError: the size is not positive, or ``multisamples`` is negative.

    Use it as a context manager, or call `close`.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        height: int,
        width: int,
        *,
        shadows: bool = False,
        multisamples: int = 0,
    ) -> None:
        if height < 1 or width < 1:
            raise RequestError(f"image size {height}x{width} is not valid; both must be positive")
        if not 0 <= multisamples <= MAX_MULTISAMPLES:
            raise RequestError(
                f"multisamples {multisamples} is not valid; 0 (off) to {MAX_MULTISAMPLES}"
            )
        self.model = model
        self.height, self.width = height, width
        self.shadows, self.multisamples = shadows, multisamples
        self._cameras = {model.camera(i).name: i for i in range(model.ncam)}
        self._target: _Target | None = None

    def render(self, data: mujoco.MjData, cameras: Sequence[str]) -> dict[str, NDArray[np.uint8]]:
        """Return the views of ``cameras`` at the state ``data``.

        The scene is updated once and seen by every camera. ``data`` must have been through
        ``mj_forward`` or ``mj_step`` (for the poses: ``mj_kinematics`` and ``mj_camlight``).

        Returns:
            camera name → (H, W, 3) uint8 RGB, a new contiguous array each.

        Raises:
            RequestError: the model has no such camera, or there is no OpenGL here.
        """
        numbers = [self._cameras[require_choice("camera", c, self._cameras)] for c in cameras]
        if not numbers:
            return {}
        if self._target is None:
            self._target = _Target(self)
            _open_renderers.add(self)
        with self._target.current():
            images = self._target.draw(self.model, data, numbers)
        return dict(zip(cameras, images, strict=True))

    def render_depth(self, data: mujoco.MjData, camera: str) -> NDArray[np.float32]:
        """Return the distances (H, W) m, along the view, of what ``camera`` sees.

        See `render`.
        """
        number = self._cameras[require_choice("camera", camera, self._cameras)]
        if self._target is None:
            self._target = _Target(self)
            _open_renderers.add(self)
        with self._target.current():
            return self._target.draw_depth(self.model, data, number)

    def close(self) -> None:
        """Free the OpenGL context, if there is one. Rendering again would make a new one."""
        if self._target is not None:
            self._target.free()
            self._target = None

    def __getstate__(self) -> dict[str, Any]:
        """Return what a copy needs: it makes an OpenGL context of its own when it first draws."""
        return {**self.__dict__, "_target": None}

    def __enter__(self) -> CameraRenderer:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __del__(self) -> None:
        # After a failed __init__ there may be no such attribute.
        if getattr(self, "_target", None) is not None:
            self.close()


class _Target:
    """Context, buffers and scene, while there is an OpenGL context."""

    def __init__(self, settings: CameraRenderer) -> None:
        self._process = os.getpid()
        model, height, width = settings.model, settings.height, settings.width
        with _quality(settings):
            self._gl, self._context = _make_context(model, height, width)
        with self.current():
            mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN.value, self._context)
        # Now, and not earlier: exit handlers run last in, first out, and this one has to come
        # before the backend's own, which ends its display.
        atexit.register(_close_all)
        self._rect = mujoco.MjrRect(0, 0, width, height)
        self._scene = mujoco.MjvScene(model=model, maxgeom=_MAX_GEOMS)
        flags = self._scene.flags
        flags[mujoco.mjtRndFlag.mjRND_SHADOW] = settings.shadows
        # Each of these draws the scene, or a backdrop, once more.
        for name in ("REFLECTION", "SKYBOX", "HAZE", "FOG"):
            flags[getattr(mujoco.mjtRndFlag, f"mjRND_{name}")] = False
        self._option = mujoco.MjvOption()
        self._camera = mujoco.MjvCamera()
        self._camera.type = mujoco.mjtCamera.mjCAMERA_FIXED.value
        self._upside_down = np.empty((height, width, 3), np.uint8)

    @contextlib.contextmanager
    def current(self) -> Iterator[None]:
        """Make the context this thread's, and let go of it afterwards."""
        if os.getpid() != self._process:
            raise RuntimeError("renderer opened before the process forked; open one in each worker")
        self._gl.make_current()
        try:
            yield
        finally:
            _let_go()

    def draw(
        self, model: mujoco.MjModel, data: mujoco.MjData, cameras: Sequence[int]
    ) -> list[NDArray[np.uint8]]:
        """Return an (H, W, 3) image for each camera number."""
        images = []
        for i, number in enumerate(cameras):
            self._camera.fixedcamid = number
            if i == 0:
                scene = (self._camera, mujoco.mjtCatBit.mjCAT_ALL.value, self._scene)
                mujoco.mjv_updateScene(model, data, self._option, None, *scene)
            else:
                mujoco.mjv_updateCamera(model, data, self._camera, self._scene)
                mujoco.mjv_makeLights(model, data, self._scene)  # the headlight is the camera's
            mujoco.mjr_render(self._rect, self._scene, self._context)
            mujoco.mjr_readPixels(self._upside_down, None, self._rect, self._context)
            images.append(self._upside_down[::-1].copy())  # OpenGL's first row is the lowest
        return images

    def draw_depth(
        self, model: mujoco.MjModel, data: mujoco.MjData, camera: int
    ) -> NDArray[np.float32]:
        """Return the distances (H, W) m along the view of a camera number."""
        self._camera.fixedcamid = camera
        scene = (self._camera, mujoco.mjtCatBit.mjCAT_ALL.value, self._scene)
        mujoco.mjv_updateScene(model, data, self._option, None, *scene)
        mujoco.mjr_render(self._rect, self._scene, self._context)
        height, width, _ = self._upside_down.shape
        buffer = np.empty((height, width), np.float32)
        mujoco.mjr_readPixels(None, buffer, self._rect, self._context)
        near, far = model.stat.extent * np.array([model.vis.map.znear, model.vis.map.zfar])
        # The buffer goes from 0 at the near plane to 1 at the far one, linear in 1 / distance.
        return (near / (1.0 - buffer[::-1] * (1.0 - near / far))).astype(np.float32)

    def free(self) -> None:
        """Free the OpenGL resources, unless they are those of the process we were forked from."""
        if os.getpid() != self._process:
            return
        with self.current():
            self._context.free()
        self._gl.free()


@contextlib.contextmanager
def _quality(settings: CameraRenderer) -> Iterator[None]:
    """Give the model the renderer's buffer sizes and samples while a context reads them."""
    size, quality = settings.model.vis.global_, settings.model.vis.quality
    before = size.offwidth, size.offheight, quality.offsamples, quality.shadowsize
    size.offwidth, size.offheight = settings.width, settings.height
    quality.offsamples = settings.multisamples
    quality.shadowsize = quality.shadowsize if settings.shadows else 0
    try:
        yield
    finally:
        size.offwidth, size.offheight, quality.offsamples, quality.shadowsize = before


def _make_context(model: mujoco.MjModel, height: int, width: int) -> tuple[Any, mujoco.MjrContext]:
    """Return an OpenGL context, current in this thread, and MuJoCo's resources in it.

    Raises:
        RequestError: OpenGL is not there, with what to install.
    """
    backend = backend_in_use()
    if platform.system() != "Linux":
        backend = "cgl" if platform.system() == "Darwin" else "glfw"
    elif backend not in APT_PACKAGES:
        raise RequestError(
            f"MUJOCO_GL={backend} draws no images; valid: {', '.join(APT_PACKAGES)} "
            "(or ask for no images: --cameras none)"
        )
    try:
        gl = importlib.import_module(f"mujoco.{backend}").GLContext(width, height)
        gl.make_current()
        return gl, mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_50.value)
    except Exception as error:  # each backend fails in a way of its own, down to AttributeError
        reason = (str(error).strip().splitlines() or [type(error).__name__])[0]
        problem = f"no OpenGL to draw cameras with ({backend}: {reason})"
        if backend in APT_PACKAGES:
            problem = explain_failure(backend, reason)
        raise RequestError(f"{problem} (--cameras none needs no OpenGL)") from error


def _let_go() -> None:
    """Leave this thread without an OpenGL context, where the backend has a way to."""
    if backend := sys.modules.get("mujoco.egl"):
        egl = backend.EGL
        none = egl.EGL_NO_SURFACE
        egl.eglMakeCurrent(backend.EGL_DISPLAY, none, none, egl.EGL_NO_CONTEXT)


def _close_all() -> None:
    for renderer in list(_open_renderers):
        renderer.close()


def project_points(
    points: ArrayLike,
    position: ArrayLike,
    orientation: ArrayLike,
    fovy: float,
    height: int,
    width: int,
) -> NDArray[np.float64]:
    """Return the pixels at which a camera sees points.

    Args:
        points: (..., 3) m, world frame.
        position: (3,) m, world frame: the camera's centre.
        orientation: (3, 3) world from camera (camera: x right, y up, looking along −z).
        fovy: vertical field of view, degrees.
        height: image height, pixels.
        width: image width, pixels.

    Returns:
        (..., 2) pixels: column (right) and row (down) from the image's upper left corner, so that
        the centre of the first pixel is (0.5, 0.5). Points out of view are outside the image;
        points that are not in front of the camera are NaN.
    """
    from_camera = np.asarray(points, float) - np.asarray(position, float)
    in_camera = from_camera @ np.asarray(orientation, float)
    depth = -in_camera[..., 2:]
    focal = height / 2 / math.tan(math.radians(fovy) / 2)  # pixels
    with np.errstate(divide="ignore", invalid="ignore"):
        from_centre = focal * in_camera[..., :2] / depth * (1, -1)
    return np.where(depth > 0, from_centre + np.array([width / 2, height / 2]), np.nan)


def project(
    model: mujoco.MjModel,
    data: mujoco.MjData,
    camera: str,
    points: ArrayLike,
    image_size: tuple[int, int],
) -> NDArray[np.float64]:
    """Return the pixels at which a camera of a model sees points, as `project_points` does.

    Args:
        model: the model.
        data: its state, with the camera's pose computed (``mj_forward`` or ``mj_step``).
        camera: its name.
        points: (..., 3) m, world frame.
        image_size: (height, width) in pixels.

    Raises:
        RequestError: the model has no such camera.
    """
    names = [model.camera(i).name for i in range(model.ncam)]
    number = names.index(require_choice("camera", camera, names))
    position, orientation = data.cam_xpos[number], data.cam_xmat[number].reshape(3, 3)
    return project_points(points, position, orientation, model.cam_fovy[number], *image_size)
