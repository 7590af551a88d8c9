"""Where live images come from: a video file, frame by frame, or a camera, always its newest."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Generator
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from face_prediction.tracking.detector import DetectorSettings, FaceDetector, native_stderr_silenced
from face_prediction.tracking.extract import FaceFollower, ZoomingDetector
from face_prediction.tracking.geometry import read_canonical_face
from face_prediction.tracking.video import VideoFrame, VideoReader
from robo_manip_baselines.runs.errors import RequestError

#: Seconds that a camera may take to give an image before it counts as gone.
CAMERA_TIMEOUT = 5.0


class Capture(Protocol):
    """What of OpenCV's VideoCapture is used."""

    def read(self) -> tuple[bool, Any]:
        """The next image (rows, columns, 3) uint8 BGR."""
        ...

    def release(self) -> None:
        """Let the camera go."""
        ...


def video_frames(path: Path) -> Generator[VideoFrame, None, None]:
    """Every frame of a video file.

    Raises:
        RequestError: it cannot be read to its end.
    """
    with VideoReader(path) as video:
        yield from video.frames()


def open_camera(number: int) -> Capture:
    """Camera ``number`` of the system, 0 being the first.

    Raises:
        RequestError: there is none.
    """
    import cv2  # not needed unless a camera is

    with native_stderr_silenced():
        capture = cv2.VideoCapture(number)
        opened = capture.isOpened()
    if not opened:
        capture.release()
        raise RequestError(f"--camera {number}: cannot be opened; is it there, and free?")
    return capture


def camera_frames(
    capture: Capture, clock: Callable[[], float] = time.monotonic
) -> Generator[VideoFrame, None, None]:
    """The newest image of a camera each time one is asked for, until it gives no more.

    A thread reads on while an image is worked on, so that none waits in a queue and grows old.
    Times are seconds since the first image.

    Raises:
        RequestError: nothing comes for `CAMERA_TIMEOUT` seconds.
    """
    newest: deque[tuple[float, Any]] = deque(maxlen=1)
    arrived = threading.Condition()
    stopped = threading.Event()

    def read() -> None:
        while not stopped.is_set():
            is_read, image = capture.read()
            with arrived:
                if not is_read:
                    stopped.set()
                else:
                    newest.append((clock(), image))
                arrived.notify()

    thread = threading.Thread(target=read, daemon=True)
    thread.start()
    begun: float | None = None
    last = -np.inf
    try:
        while True:
            with arrived:
                if not arrived.wait_for(lambda: newest or stopped.is_set(), CAMERA_TIMEOUT):
                    raise RequestError(f"the camera gave no image for {CAMERA_TIMEOUT:g} s")
                if not newest:
                    return
                at, image = newest.pop()
            begun = at if begun is None else begun
            if at - begun > last:
                last = at - begun
                yield VideoFrame(last, np.ascontiguousarray(image[..., ::-1]))
    finally:
        stopped.set()
        thread.join(CAMERA_TIMEOUT)
        capture.release()


class FaceFinder:
    """Finds the same face in successive images. Use as a context manager.

    Args:
        model: MediaPipe's face_landmarker.task.

    Raises:
        RequestError: MediaPipe is not installed, or the model cannot be loaded.
    """

    def __init__(self, model: Path) -> None:
        self._detector = FaceDetector(model, DetectorSettings())
        self._zooming = ZoomingDetector(self._detector.detect, read_canonical_face(model))
        self._follower = FaceFollower()

    def __enter__(self) -> FaceFinder:
        return self

    def __exit__(self, *_: object) -> None:
        self._detector.close()

    def find(self, image: NDArray[np.uint8], time: float) -> NDArray[np.float64] | None:
        """Landmarks (468, 3), normalised image coordinates, or None.

        Args:
            image: (rows, columns, 3) uint8 RGB.
            time: s, later than the one before.
        """
        size = (image.shape[1], image.shape[0])
        faces = self._zooming.detect(image, time)
        face = self._follower.choose(faces, time, size)
        return None if face is None else self._zooming.refine(face, image, time).landmarks
