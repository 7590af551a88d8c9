"""Live images and faces: a video file, frame by frame, or a camera, always its newest image."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Generator, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from face_prediction.tracking.detector import DetectorSettings, FaceDetector, native_stderr_silenced
from face_prediction.tracking.extract import FaceFollower, ZoomingDetector
from face_prediction.tracking.geometry import CanonicalFace, read_canonical_face
from face_prediction.tracking.video import VideoFrame, VideoReader
from robo_manip_baselines.runs.errors import RequestError

if TYPE_CHECKING:
    from cv2 import VideoCapture

CAMERA_TIMEOUT = 5.0  # s that a camera may take to give an image before it counts as gone

FindFace = Callable[[NDArray[np.uint8], float], NDArray[np.floating] | None]


def live_frames(
    video: Path | None, camera: int | None, seconds: float | None = None
) -> Generator[VideoFrame, None, None]:
    """Frames of a video file or of camera ``camera``, ``seconds`` of them at most.

    Raises:
        RequestError: it cannot be opened, or not read to its end.
    """
    frames = _file_frames(video) if video else camera_frames(open_camera(camera or 0))
    first: float | None = None
    try:
        for frame in frames:
            first = frame.time if first is None else first
            if seconds is not None and frame.time - first >= seconds:
                return
            yield frame
    finally:
        frames.close()


def _file_frames(path: Path) -> Generator[VideoFrame, None, None]:
    with VideoReader(path) as video:
        yield from video.frames()


def open_camera(number: int) -> VideoCapture:
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
    capture: VideoCapture, clock: Callable[[], float] = time.monotonic
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
    begun, last = None, -np.inf
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


@contextmanager
def face_finder(model: Path) -> Iterator[FindFace]:
    """A detector that follows one face through successive images, see `follow_face`.

    Args:
        model: MediaPipe's face_landmarker.task.

    Raises:
        RequestError: MediaPipe is not installed, or the model cannot be loaded.
    """
    with FaceDetector(model, DetectorSettings()) as detector:
        yield follow_face(detector, read_canonical_face(model))


def follow_face(detector: FaceDetector, canonical: CanonicalFace) -> FindFace:
    """Begin to follow one face through successive images.

    Returns:
        A function of an image (rows, columns, 3) uint8 RGB and its time in s, later than the one
        before, that returns landmarks (468, 3), normalised image coordinates, or None.
    """
    zooming = ZoomingDetector(detector.detect, canonical)
    follower = FaceFollower()

    def find(image: NDArray[np.uint8], time: float) -> NDArray[np.floating] | None:
        size = (image.shape[1], image.shape[0])
        face = follower.choose(zooming.detect(image, time), time, size)
        return None if face is None else zooming.refine(face, image, time).landmarks

    return find
