"""Synthetic faces and videos for the tests of ``face_prediction``."""

from __future__ import annotations

import logging
import warnings
from collections.abc import Callable, Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest

from face_prediction.commands.cli import main
from face_prediction.tracking.geometry import CANONICAL_MOUTH, LIPS, rigid_face
from face_prediction.tracking.tracks import NUM_LANDMARKS, FaceTrack
from robo_manip_baselines.runs.errors import RequestError


def _project(points: np.ndarray, image_size: tuple[int, int]) -> np.ndarray:
    """The oracle's camera, in pixels, as a textbook has it: focal length, then the middle."""
    width, height = image_size
    focal = height / 2 / np.tan(np.radians(63.0 / 2))
    column = width / 2 + focal * points[..., 0] / -points[..., 2]
    row = height / 2 - focal * points[..., 1] / -points[..., 2]
    return np.stack([column / width, row / height, np.zeros_like(row)], axis=-1)


@pytest.fixture(scope="session")
def project() -> Callable[[np.ndarray, tuple[int, int]], np.ndarray]:
    """Normalised image coordinates (..., 3) of camera-frame points (..., 3) in metres."""
    return _project


def _track(
    mouth: np.ndarray,
    *,
    rotation: np.ndarray | None = None,
    jaw: float | np.ndarray = 0.01,
    valid: np.ndarray | None = None,
    fps: float = 30.0,
    image_size: tuple[int, int] = (640, 480),
    name: str = "synthetic.mp4",
) -> FaceTrack:
    frames = len(mouth)
    rotations = np.tile(np.eye(3), (frames, 1, 1)) if rotation is None else rotation
    valid = np.ones(frames, dtype=bool) if valid is None else valid
    # lips on a ring in the head's mouth plane, 13 and 14 apart by the jaw opening
    ring = np.zeros((len(LIPS), 3))
    angle = 2 * np.pi * np.arange(len(LIPS)) / len(LIPS)
    ring[:, 0], ring[:, 1] = 0.02 * np.cos(angle), 0.01 * np.sin(angle)
    offsets = np.tile(ring, (frames, 1, 1))
    upper, lower = LIPS.index(13), LIPS.index(14)
    others = [i for i in range(len(LIPS)) if i not in (upper, lower)]
    offsets[:, upper] = offsets[:, lower] = 0.0
    offsets[:, upper, 1] = np.broadcast_to(jaw, frames) / 2
    offsets[:, lower, 1] = -np.broadcast_to(jaw, frames) / 2
    offsets[:, others] -= offsets[:, others].mean(axis=1, keepdims=True)
    points = mouth[:, None] + np.einsum("tij,tpj->tpi", rotations, offsets)
    pose = np.tile(np.eye(4), (frames, 1, 1))
    pose[:, :3, :3] = rotations
    pose[:, :3, 3] = mouth - rotations @ CANONICAL_MOUTH
    # the landmarks that the head pose is fitted to where the canonical face has them, every other
    # one in its mouth, and the relative depth that makes MediaPipe's model of it exact
    vertices = np.tile(CANONICAL_MOUTH, (NUM_LANDMARKS, 1))
    rigid = rigid_face()
    vertices[rigid.weights > 0] = rigid.vertices[rigid.weights > 0]
    whole = np.einsum("tij,vj->tvi", rotations, vertices) + pose[:, None, :3, 3]
    whole[:, list(LIPS)] = points
    landmarks = _project(whole, image_size)
    depth = -whole[..., 2]
    view_width = 2 * np.tan(np.radians(63.0 / 2)) * image_size[0] / image_size[1]
    landmarks[..., 2] = (depth / depth.mean(axis=1, keepdims=True) - 1) / view_width
    landmarks[~valid] = np.nan
    pose[~valid] = np.nan
    opening = np.where(valid, np.broadcast_to(jaw, frames), np.nan)
    times = np.arange(frames) / fps
    return FaceTrack(
        landmarks=landmarks,
        valid=valid,
        interpolated=np.zeros(frames, dtype=bool),
        timestamps=times,
        head_pose=pose,
        jaw=opening.astype(np.float32),
        image_size=image_size,
        fps=fps,
        source_timestamps=times,
        source_valid=valid,
        source={"name": name, "sha256": "0"},
        detector={"name": "synthetic", "settings": {"zoom": False}},
    )


@pytest.fixture(scope="session")
def make_track() -> Callable[..., FaceTrack]:
    """A track whose mouth is at ``mouth`` (T, 3) metres, with lips ``jaw`` metres apart."""
    return _track


def _write_video(
    path: Path,
    images: Sequence[np.ndarray],
    times: Sequence[float] | None = None,
    rotation: int = 0,
    options: dict[str, str] | None = None,
) -> Path:
    height, width = images[0].shape[:2]
    with av.open(str(path), "w", options=options or {}) as container:
        stream = container.add_stream("libx264", rate=30, options={"crf": "10"})
        stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
        stream.codec_context.time_base = Fraction(1, 600)  # holds 24, 25 and 30 a second
        if rotation:
            stream.set_display_rotation(rotation)
        for index, image in enumerate(images):
            frame = av.VideoFrame.from_ndarray(image, format="rgb24")
            time = index / 30 if times is None else times[index]
            frame.time_base = stream.codec_context.time_base
            frame.pts = round(time * 600)
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    return path


@pytest.fixture(scope="session")
def write_video() -> Callable[..., Path]:
    """Encode RGB images as H.264, at given times, with a display rotation."""
    return _write_video


@pytest.fixture
def statsmodels() -> Callable[[str], Any]:
    """Import a module of statsmodels, an independent implementation; its warnings are not ours."""

    def module(name: str) -> Any:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return pytest.importorskip(f"statsmodels.{name}", reason="statsmodels is not installed")

    return module


@pytest.fixture(scope="session")
def exit_code() -> Callable[[Sequence[str]], int]:
    """Run the command line and return its exit code; an error becomes a line of the log."""

    def run(arguments: Sequence[str]) -> int:
        try:
            return main(arguments)
        except RequestError as error:
            logging.getLogger(__name__).error("%s", error)
            return 2
        except KeyboardInterrupt:
            return 130

    return run
