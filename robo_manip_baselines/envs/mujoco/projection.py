"""Where a point of the world is in a camera's image: a pinhole with square pixels, as drawn."""

from __future__ import annotations

import math

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from robo_manip_baselines.errors import require_choice


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
    in_camera = (np.asarray(points, float) - np.asarray(position, float)) @ np.asarray(
        orientation, float
    )
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
    return project_points(
        points,
        data.cam_xpos[number],
        data.cam_xmat[number].reshape(3, 3),
        model.cam_fovy[number],
        *image_size,
    )
