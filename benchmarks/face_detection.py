"""Detection rate of MediaPipe's face detector on the drawn face in ``front_close``, with images.

Recorded poses from every run of the shipped motion library, at base offsets of ±5 cm an axis, are
rendered at 640×480 with the arms at their start; the mouth's centre (mean of the 40 lip landmarks)
is compared with the projected truth. Needs OpenGL, MediaPipe and its model file::

    python benchmarks/face_detection.py --model face_landmarker.task

prints a table and writes docs/images/face_*.png.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

os.environ.setdefault("MUJOCO_GL", "egl")

import cv2
import mujoco
import numpy as np
from numpy.typing import NDArray

from robo_manip_baselines.envs.mujoco.cell.rendering import project
from robo_manip_baselines.envs.mujoco.cell.scene import MOUTH_BASE, build_cell
from robo_manip_baselines.envs.mujoco.cell.vx300s import HOME_QPOS
from robo_manip_baselines.envs.mujoco.face import REST_OPENING, FaceModel, add_face
from robo_manip_baselines.envs.mujoco.face.motion import SEGMENT_DURATION, MotionLibrary
from robo_manip_baselines.envs.mujoco.tasks.face_env import FACE_OFFSET
from robo_manip_baselines.envs.mujoco.tasks.face_scene import PARKED_QPOS
from robo_manip_baselines.observation.spec import ARM_JOINTS
from robo_manip_baselines.runs.command import run_command
from robo_manip_baselines.runs.errors import RequestError
from robo_manip_baselines.runs.files import atomic_file
from robo_manip_baselines.runs.images import encode_image
from robo_manip_baselines.runs.markdown import markdown_table

ROOT = Path(__file__).resolve().parent.parent
CAMERA, WIDTH, HEIGHT = "front_close", 640, 480
MOUTH = np.array(MOUTH_BASE)
CENTRE = np.array([-0.03, 0.0, 0.03])  # of the face, from the mouth


@dataclass(frozen=True)
class View:
    """One picture: the image (H, W, 3), where its mouth is in pixels (2,), and the clip."""

    image: NDArray[np.uint8]
    mouth: NDArray[np.float64]
    clip: str


def compile_cell() -> tuple[mujoco.MjModel, mujoco.MjData]:
    """The cell with a face; the right arm at home, the left one parked."""
    spec = build_cell()
    add_face(spec)
    model = spec.compile()
    data = mujoco.MjData(model)
    for arm, pose in (("left", PARKED_QPOS), ("right", HOME_QPOS)):
        for joint, angle in zip(ARM_JOINTS, pose, strict=True):
            data.joint(f"{arm}/{joint}").qpos[:] = angle
    return model, data


def place_face(
    model: mujoco.MjModel,
    data: mujoco.MjData,
    mouth: NDArray[np.float64],
    orientation: Sequence[float] | NDArray[np.float64],
    jaw: float,
) -> None:
    """Set the mocap bodies of the face."""
    for name, (at, turn) in FaceModel.load().body_poses(mouth, orientation, jaw).items():
        body = model.body(name).mocapid[0]
        data.mocap_pos[body], data.mocap_quat[body] = at, turn
    mujoco.mj_forward(model, data)


def recorded_views(count: int, seed: int) -> Iterator[View]:
    """Draw ``count`` frames from all runs in turn, as episodes would show them."""
    rng = np.random.default_rng(seed)
    library = MotionLibrary.load()
    model, data = compile_cell()
    with mujoco.Renderer(model, HEIGHT, WIDTH) as renderer:
        renderer.scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = 0
        for index in range(count):
            clips = sorted(set(library.run_clip))
            segment = library.draw(rng, clips=[clips[index % len(clips)]])
            moved, orientation, jaw = segment.at(rng.uniform(0.0, SEGMENT_DURATION))
            mouth = MOUTH + rng.uniform(-FACE_OFFSET, FACE_OFFSET, 3) + moved
            place_face(model, data, mouth, orientation, float(jaw) + REST_OPENING)
            renderer.update_scene(data, CAMERA)
            at = project(model, data, CAMERA, mouth, (HEIGHT, WIDTH))
            yield View(renderer.render().copy(), at, segment.clip)


def mouth_errors(views: Sequence[View], model_file: Path) -> NDArray[np.float64]:
    """Detected minus true mouth centre (N, 2) in pixels; NaN where no face was found."""
    import mediapipe
    from mediapipe.tasks.python import BaseOptions, vision

    lips = sorted(
        {v for e in vision.FaceLandmarksConnections.FACE_LANDMARKS_LIPS for v in (e.start, e.end)}
    )
    options = vision.FaceLandmarkerOptions(
        base_options=BaseOptions(model_asset_path=str(model_file)),
        running_mode=vision.RunningMode.IMAGE,
    )
    errors = np.full((len(views), 2), np.nan)
    with vision.FaceLandmarker.create_from_options(options) as landmarker:
        for index, view in enumerate(views):
            image = mediapipe.Image(mediapipe.ImageFormat.SRGB, np.ascontiguousarray(view.image))
            found = landmarker.detect(image).face_landmarks
            if found:
                points = np.array([(p.x * WIDTH, p.y * HEIGHT) for p in found[0]])
                errors[index] = points[lips].mean(axis=0) - view.mouth
    return errors


def table(views: Sequence[View], errors: NDArray[np.float64]) -> str:
    """Markdown: a row per clip and one for all."""
    distance = np.linalg.norm(errors, axis=1)
    clips = np.array([view.clip for view in views])
    groups = [(clip, clips == clip) for clip in sorted(set(clips))]
    groups.append(("all", np.ones(len(clips), dtype=bool)))
    rows = []
    for name, chosen in groups:
        there = distance[chosen & np.isfinite(distance)]
        numbers = (f"{v:.1f}" for v in np.percentile(there, [50, 95, 100]))
        rows.append((name, f"{len(there)} of {chosen.sum()}", *numbers))
    return markdown_table(["clip", "found", "median px", "95 % px", "largest px"], rows)


def write_pictures(views: Sequence[View], errors: NDArray[np.float64], folder: Path) -> None:
    """``face_openings.png``, ``face_turned.png`` and ``face_poses.png``."""
    folder.mkdir(parents=True, exist_ok=True)
    save(folder / "face_openings.png", closeups([(0, 0, 0, jaw) for jaw in (0, 0.015, 0.03, 0.05)]))
    turns = [(-30, 0, 0), (30, 0, 0), (0, 15, 0), (0, -15, 0)]
    save(folder / "face_turned.png", closeups([(*turn, REST_OPENING) for turn in turns]))
    marked = []
    for view, error in list(zip(views, errors, strict=True))[:6]:
        image = view.image.copy()
        for point, colour in ((view.mouth, (0, 255, 0)), (view.mouth + error, (255, 255, 0))):
            if np.isfinite(point).all():
                cv2.drawMarker(image, point.round().astype(int).tolist(), colour, 1, 12, 1)
        column = int(np.clip(view.mouth[0] - 160, 0, WIDTH - 320))
        row = int(np.clip(view.mouth[1] - 150, 0, HEIGHT - 240))
        marked.append(image[row : row + 240, column : column + 320])
    rows = [np.hstack(marked[start : start + 3]) for start in range(0, len(marked), 3)]
    save(folder / "face_poses.png", np.vstack(rows))


def closeups(poses: Sequence[tuple[float, float, float, float]]) -> NDArray[np.uint8]:
    """The face close by, side by side: yaw, pitch, roll in degrees and the jaw's opening in m."""
    model, data = compile_cell()
    eye = mujoco.MjvCamera()
    eye.lookat, eye.distance, eye.azimuth, eye.elevation = MOUTH + CENTRE, 0.52, 152, -3
    images = []
    with mujoco.Renderer(model, 2 * HEIGHT, WIDTH) as renderer:
        renderer.scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = 0
        for yaw, pitch, roll, jaw in poses:
            turn = np.array([1.0, 0.0, 0.0, 0.0])
            for axis, degrees in ((1, yaw), (0, pitch), (2, roll)):
                quat, product = np.empty(4), np.empty(4)
                mujoco.mju_axisAngle2Quat(quat, np.eye(3)[axis], np.deg2rad(degrees))
                mujoco.mju_mulQuat(product, turn, quat)
                turn = product
            data.joint("right/waist").qpos[:] = 1.2  # the arm out of the picture
            place_face(model, data, MOUTH, turn, jaw)
            renderer.update_scene(data, eye)
            crop = renderer.render()[HEIGHT // 2 : -HEIGHT // 2, 80:-80]
            images.append(cv2.resize(crop, (320, 320), interpolation=cv2.INTER_AREA))
    return np.hstack(images)


def save(path: Path, image: NDArray[np.uint8]) -> None:
    """Write an RGB image as PNG."""
    with atomic_file(path) as temporary:
        temporary.write_bytes(encode_image(image, "png").tobytes())


def main() -> None:
    """Measure, print, draw."""
    parser = argparse.ArgumentParser(description="Find the drawn face with MediaPipe.")
    parser.add_argument("--model", type=Path, required=True, help="face_landmarker.task")
    parser.add_argument("--frames", type=int, default=300)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--pictures", type=Path, default=ROOT / "docs/images")
    options = parser.parse_args()
    if options.frames < 1:
        raise RequestError(f"--frames {options.frames}: must be 1 or more")
    if not options.model.is_file():
        raise RequestError(f"--model {options.model}: no such file; give face_landmarker.task")
    views = list(recorded_views(options.frames, options.seed))
    errors = mouth_errors(views, options.model)
    print(table(views, errors))
    write_pictures(views, errors, options.pictures)


if __name__ == "__main__":
    run_command(main)
