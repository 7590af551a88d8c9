"""Where MediaPipe's face landmarker model is, and how it gets there."""

from __future__ import annotations

import contextlib
import hashlib
import logging
import os
import sys
import tempfile
import urllib.error
import urllib.request
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from face_prediction.tracking.tracks import NUM_LANDMARKS
from face_prediction.tracking.video import sha256_of
from robo_manip_baselines.runs.errors import RequestError

logger = logging.getLogger(__name__)

MODEL_NAME = "face_landmarker.task"
#: MediaPipe's model page, "Face Landmarker", float16, version 1 (Apache-2.0).
MODEL_URL = (
    "https://storage.googleapis.com/mediapipe-models/face_landmarker/face_landmarker/"
    "float16/1/face_landmarker.task"
)
MODEL_SHA256 = "64184e229b263107bc2b804c6625db1341ff2bb731874b0bcc2fe6544e0bc9ff"
TIMEOUT_S = 30.0


def default_model_path() -> Path:
    """``face_landmarker.task`` in ``$XDG_CACHE_HOME/face_prediction`` (or ``~/.cache/…``)."""
    cache = os.environ.get("XDG_CACHE_HOME") or str(Path.home() / ".cache")
    return Path(cache) / "face_prediction" / MODEL_NAME


def find_model(given: Path | None, url: str = MODEL_URL, expected: str = MODEL_SHA256) -> Path:
    """The model to use: ``given`` if named, else the cached one, downloaded once if absent.

    Raises:
        RequestError: the named file is absent, or the cached one is damaged or absent and cannot
            be downloaded; the message says what to do.
    """
    if given is not None:
        if not given.is_file():
            raise RequestError(f"--model {given}: no such file; download it from {MODEL_URL}")
        return given
    path = default_model_path()
    if not path.is_file():
        _download(url, path, expected)
    elif sha256_of(path) != expected:
        raise RequestError(f"{path}: not the expected file (sha256 differs); delete it, try again")
    return path


def _download(url: str, path: Path, expected: str) -> None:
    try:
        with urllib.request.urlopen(url, timeout=TIMEOUT_S) as response:
            logger.info("downloading %s to %s", url, path)
            data = response.read()
    except (urllib.error.URLError, OSError) as error:
        reason = getattr(error, "reason", error)
        raise RequestError(
            f"no model at {path} and none could be downloaded ({reason}); on a machine with a "
            f"network fetch {url}, then put it there or name it with --model"
        ) from None
    found = hashlib.sha256(data).hexdigest()
    if found != expected:
        raise RequestError(f"{url}: sha256 {found}, expected {expected}; nothing was kept")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        handle, name = tempfile.mkstemp(dir=path.parent, suffix=".tmp")
        with os.fdopen(handle, "wb") as stream:
            stream.write(data)
        Path(name).replace(path)
    except OSError as error:
        raise RequestError(
            f"{path}: cannot be written ({error.strerror}); name a model with --model"
        ) from None


RunningMode = Literal["image", "video"]
CENTIMETRE = 0.01


@dataclass(frozen=True)
class DetectorSettings:
    """How the detector runs; recorded in every track."""

    #: image: every frame on its own, the unsmoothed estimate. video: MediaPipe follows one face
    #: and low-passes its landmarks.
    running_mode: RunningMode = "image"
    #: Faces looked for in a frame (image mode), so that the tracked one is among them.
    num_faces: int = 4
    #: Least score of the face detector, MediaPipe's default.
    min_detection_confidence: float = 0.5
    #: Least score of "a face is present" of the landmark network, MediaPipe's default.
    min_presence_confidence: float = 0.5

    def __post_init__(self) -> None:
        if self.running_mode not in ("image", "video"):
            raise RequestError(f"running_mode '{self.running_mode}'; valid: image, video")
        if self.num_faces < 1:
            raise RequestError(f"num_faces {self.num_faces}; at least 1")
        for name in ("min_detection_confidence", "min_presence_confidence"):
            if not 0.0 <= getattr(self, name) <= 1.0:
                raise RequestError(f"{name} {getattr(self, name)}; between 0 and 1")


@dataclass(frozen=True)
class FaceDetection:
    """One face in one image: landmarks (468, 3) normalised, head_pose (4, 4) in metres."""

    landmarks: np.ndarray
    head_pose: np.ndarray


class FaceDetector:
    """Finds faces in RGB images. Use as a context manager; :meth:`close` frees the native graph.

    Raises:
        RequestError: MediaPipe is not installed, or the model cannot be loaded.
    """

    def __init__(self, model: Path, settings: DetectorSettings) -> None:
        vision, base_options, self._mediapipe = _import_mediapipe()
        self._settings = settings
        self.model = model
        mode = vision.RunningMode.IMAGE
        faces = settings.num_faces
        if settings.running_mode == "video":
            mode = vision.RunningMode.VIDEO
            faces = 1  # with more, MediaPipe detects anew in every frame and does not smooth
        options = vision.FaceLandmarkerOptions(
            base_options=base_options(model_asset_path=str(model)),
            running_mode=mode,
            num_faces=faces,
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
        mp_image = self._mediapipe.Image(
            image_format=self._mediapipe.ImageFormat.SRGB, data=np.ascontiguousarray(image)
        )
        # the inference threads announce themselves on the first image
        quiet = contextlib.nullcontext() if self._warm else native_stderr_silenced()
        with quiet:
            if self._settings.running_mode == "video":
                result = self._landmarker.detect_for_video(mp_image, round(time * 1000))
            else:
                result = self._landmarker.detect(mp_image)
        self._warm = True
        return [
            FaceDetection(
                np.array([(p.x, p.y, p.z) for p in points[:NUM_LANDMARKS]]), _in_metres(matrix)
            )
            for points, matrix in zip(
                result.face_landmarks, result.facial_transformation_matrixes, strict=True
            )
        ]

    def description(self) -> dict[str, Any]:
        """What found the faces, for the record kept in a track."""
        return {
            "name": "MediaPipe FaceLandmarker",
            "version": self._mediapipe.__version__,
            "model_sha256": sha256_of(self.model),
            "smoothed": self._settings.running_mode == "video",
            **vars(self._settings),
        }


def _in_metres(matrix: np.ndarray) -> np.ndarray:
    pose = np.array(matrix, dtype=float)
    pose[:3, 3] *= CENTIMETRE
    return pose


def _import_mediapipe() -> tuple[Any, Any, Any]:
    try:
        with native_stderr_silenced():
            import mediapipe
            from mediapipe.tasks.python import BaseOptions, vision
    except ImportError as error:
        raise RequestError(
            f"MediaPipe cannot be imported ({error}); "
            "pip install 'robo_manip_baselines[face_prediction]'"
        ) from None
    return vision, BaseOptions, mediapipe


@contextlib.contextmanager
def native_stderr_silenced() -> Iterator[None]:
    """Send what native code writes to descriptor 2 to a file while the block runs.

    MediaPipe, absl and TensorFlow Lite announce their set-up there before any of their own logging
    switches works. What was written is shown when the block fails.
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
