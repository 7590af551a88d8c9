"""MediaPipe's face landmarker: its model file, its settings, and faces in images."""

from __future__ import annotations

import contextlib
import hashlib
import logging
import os
import sys
import tempfile
import urllib.request
from collections.abc import Iterator
from dataclasses import dataclass
from http.client import HTTPException
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from annotated_types import Interval

from face_prediction.tracking.geometry import CENTIMETRE
from face_prediction.tracking.tracks import NUM_LANDMARKS, Size
from robo_manip_baselines.runs.errors import RequestError
from robo_manip_baselines.runs.extras import install_command
from robo_manip_baselines.runs.files import atomic_file, file_digest
from robo_manip_baselines.runs.ranges import require_ranges

logger = logging.getLogger(__name__)

MODEL_NAME = "face_landmarker.task"
MODEL_URL = (
    "https://storage.googleapis.com/mediapipe-models/face_landmarker/face_landmarker/"
    "float16/1/face_landmarker.task"
)
"""MediaPipe's model page, "Face Landmarker", float16, version 1 (Apache-2.0)."""
MODEL_SHA256 = "64184e229b263107bc2b804c6625db1341ff2bb731874b0bcc2fe6544e0bc9ff"
TIMEOUT_S = 30.0

RunningMode = Literal["image", "video"]


def default_model_path() -> Path:
    """``face_landmarker.task`` in ``$XDG_CACHE_HOME/face_prediction`` (or ``~/.cache/…``)."""
    cache = os.environ.get("XDG_CACHE_HOME") or str(Path.home() / ".cache")
    return Path(cache) / "face_prediction" / MODEL_NAME


def find_model(
    given: Path | None,
    url: str = MODEL_URL,
    expected: str = MODEL_SHA256,
    option: str | None = "--detector_model",
) -> Path:
    """The model to use: ``given`` if named, else the cached one, downloaded once if absent.

    ``option`` is the one that names a model in the command that asks, None where it has none.

    Raises:
        RequestError: the named file is absent, or the cached one is damaged or absent and cannot
            be downloaded; the message says what to do.
    """
    if given is not None:
        if not given.is_file():
            raise RequestError(f"{option} {given}: no such file; download it from {MODEL_URL}")
        return given
    path = default_model_path()
    if path.is_file():
        if file_digest(path) != expected:
            raise RequestError(
                f"{path}: not the expected file (sha256 differs); delete it and retry"
            )
        return path
    try:
        with urllib.request.urlopen(url, timeout=TIMEOUT_S) as response:
            logger.info("downloading %s to %s", url, path)
            data = response.read()
    except (OSError, HTTPException) as error:  # URLError is of the former, a break of the latter
        raise RequestError(
            f"no model at {path} and none could be downloaded ({getattr(error, 'reason', error)}); "
            f"on a machine with a network fetch {url}, then put it there"
            + (f" or name it with {option}" if option else "")
        ) from None
    found = hashlib.sha256(data).hexdigest()
    if found != expected:
        raise RequestError(f"{url}: sha256 {found}, expected {expected}; nothing was kept")
    try:
        with atomic_file(path) as temporary:
            temporary.write_bytes(data)
    except (OSError, RequestError) as error:
        raise RequestError(
            f"{path}: cannot be written ({error})"
            + (f"; name a model with {option}" if option else "")
        ) from None
    return path


@dataclass(frozen=True)
class DetectorSettings:
    """Settings of the detector; recorded in every track.

    Attributes:
        running_mode: image: every frame on its own, unsmoothed. video: MediaPipe follows one face
            and low-passes its landmarks.
        num_faces: Faces looked for in a frame, so that the tracked one is among them (image mode).
        min_detection_confidence: Least score of the face detector. MediaPipe's default.
        min_presence_confidence: Least score of the landmark network's "a face is present".
            MediaPipe's default.
    """

    running_mode: RunningMode = "image"
    num_faces: Annotated[int, Interval(ge=1, le=64)] = 4
    min_detection_confidence: Annotated[float, Interval(ge=0.0, le=1.0)] = 0.5
    min_presence_confidence: Annotated[float, Interval(ge=0.0, le=1.0)] = 0.5

    def __post_init__(self) -> None:
        require_ranges(self)


@dataclass(frozen=True)
class FaceDetection:
    """One face in one image: landmarks (468, 3) normalised, head_pose (4, 4) in metres."""

    landmarks: np.ndarray
    head_pose: np.ndarray

    def box(self, image_size: Size) -> tuple[np.ndarray, float]:
        """Middle (2,) and width of the box around the face, in pixels."""
        points = self.landmarks[:, :2] * image_size
        low, high = points.min(axis=0), points.max(axis=0)
        return (low + high) / 2, float(high[0] - low[0])


class FaceDetector:
    """Finds faces in RGB images. Use as a context manager; :meth:`close` frees the native graph.

    Raises:
        RequestError: MediaPipe is not installed, or the model cannot be loaded.
    """

    def __init__(self, model: Path, settings: DetectorSettings) -> None:
        try:
            with native_stderr_silenced():
                import mediapipe
                from mediapipe.tasks.python import BaseOptions, vision
        except ImportError as error:
            raise RequestError(
                f"MediaPipe cannot be imported ({error}); run: {install_command('face-prediction')}"
            ) from None
        self._mediapipe: Any = mediapipe
        self._settings = settings
        self._follows = settings.running_mode == "video"
        self.model = model
        options = vision.FaceLandmarkerOptions(
            base_options=BaseOptions(model_asset_path=str(model)),
            running_mode=vision.RunningMode.VIDEO if self._follows else vision.RunningMode.IMAGE,
            # with more, MediaPipe detects in every frame of a video and does not smooth
            num_faces=1 if self._follows else settings.num_faces,
            min_face_detection_confidence=settings.min_detection_confidence,
            min_face_presence_confidence=settings.min_presence_confidence,
            output_facial_transformation_matrixes=True,
        )
        try:
            with native_stderr_silenced():
                self._landmarker = vision.FaceLandmarker.create_from_options(options)
        except (RuntimeError, ValueError, OSError) as error:
            first_line = str(error).splitlines()[0] if str(error) else type(error).__name__
            raise RequestError(
                f"{model}: MediaPipe cannot load it as a face landmarker model ({first_line})"
            ) from None
        self._warm = False
        self._begun: float | None = None  # s of the first image in video mode
        self._clock = -1  # ms of the last one

    def __enter__(self) -> FaceDetector:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Free the native graph; MediaPipe may hang at exit when it is left to the interpreter."""
        with native_stderr_silenced():
            self._landmarker.close()

    def detect(self, image: np.ndarray, time: float) -> list[FaceDetection]:
        """Faces in ``image`` (H, W, 3) uint8 RGB; ``time`` in seconds matters in video mode."""
        if image.dtype != np.uint8 or image.ndim != 3 or image.shape[2] != 3:
            raise ValueError(f"image must be (H, W, 3) uint8, not {image.dtype} {image.shape}")
        srgb = self._mediapipe.ImageFormat.SRGB
        mp_image = self._mediapipe.Image(image_format=srgb, data=np.ascontiguousarray(image))
        # the inference threads announce themselves on the first image
        with contextlib.nullcontext() if self._warm else native_stderr_silenced():
            if self._follows:
                # MediaPipe's clock counts milliseconds from 0, and no two images may share one
                self._begun = time if self._begun is None else self._begun
                self._clock = max(round((time - min(self._begun, 0.0)) * 1000), self._clock + 1)
                result = self._landmarker.detect_for_video(mp_image, self._clock)
            else:
                result = self._landmarker.detect(mp_image)
        self._warm = True
        in_metres = np.ones((4, 4))
        in_metres[:3, 3] = CENTIMETRE
        faces: list[FaceDetection] = []
        poses = result.facial_transformation_matrixes
        for points, matrix in zip(result.face_landmarks, poses, strict=True):
            landmarks = np.array([(p.x, p.y, p.z) for p in points[:NUM_LANDMARKS]])
            faces.append(FaceDetection(landmarks, np.array(matrix, dtype=float) * in_metres))
        return faces

    def description(self) -> dict[str, Any]:
        """Detector, model and settings, for the record kept in a track."""
        return {
            "name": "MediaPipe FaceLandmarker",
            "version": self._mediapipe.__version__,
            "model_sha256": file_digest(self.model),
            "smoothed": self._follows,
            **vars(self._settings),
        }


@contextlib.contextmanager
def native_stderr_silenced() -> Iterator[None]:
    """Send what native code writes to descriptor 2 to a file while the block runs.

    MediaPipe, absl and TensorFlow Lite announce their set-up there before any of their own logging
    switches works. It is written out when the block fails.
    """
    try:
        saved = os.dup(2)
    except OSError:  # no stderr at all: nothing to silence
        yield
        return
    sys.stderr.flush()
    with tempfile.TemporaryFile() as written:
        os.dup2(written.fileno(), 2)
        try:
            yield
        except Exception:
            os.dup2(saved, 2)
            written.seek(0)
            os.write(2, written.read())
            raise
        finally:
            os.dup2(saved, 2)
            os.close(saved)
