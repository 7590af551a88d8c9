"""Looking closer at a small face: a still window of the frame that the detector is shown.

MediaPipe's face detector shrinks whatever it is shown to 128 pixels. A face that fills little of
the frame is a few pixels there, and the box found around it, which decides what the landmark
network sees, trembles; shown a window three faces wide it is steadier. The window stands still
until the face has moved away from its middle, because a window that followed every frame would
put its own motion into the landmarks.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from face_prediction.detector import FaceDetection
from face_prediction.face_geometry import CanonicalFace, head_pose_from_landmarks

#: Faces narrower than this share of the frame's longer side are looked at through a window.
SMALL_FACE = 0.2
#: Side of the window in face widths.
WINDOW_FACES = 3.0
#: The window moves when the face's middle is further than this share of its side from its own.
OFF_CENTRE = 0.2
#: ... and changes its size when the face's width has changed by this factor.
SIZE_CHANGE = 1.4
#: Seconds without a face before a search, and between searches.
SEARCH_INTERVAL = 0.5

Detect = Callable[[np.ndarray, float], list[FaceDetection]]


@dataclass(frozen=True)
class Window:
    """A square of the frame: left and top edge and side, in pixels."""

    left: int
    top: int
    side: int

    def cut(self, image: np.ndarray) -> np.ndarray:
        """The part (side, side, 3) of ``image`` under the window."""
        rows = slice(self.top, self.top + self.side)
        return np.ascontiguousarray(image[rows, self.left : self.left + self.side])

    def fits(self, centre: np.ndarray, width: float) -> bool:
        """Whether a face of this middle (2,) and width, in pixels, is still well inside."""
        middle = np.array([self.left, self.top]) + self.side / 2
        wanted = self.side / WINDOW_FACES
        return bool(
            np.all(np.abs(centre - middle) <= OFF_CENTRE * self.side)
            and wanted / SIZE_CHANGE <= width <= wanted * SIZE_CHANGE
        )


def window_around(centre: np.ndarray, width: float, image_size: tuple[int, int]) -> Window | None:
    """The window for a face of this middle (2,) and width in pixels; None for a large face."""
    longer, shorter = max(image_size), min(image_size)
    side = round(WINDOW_FACES * width)
    if width >= SMALL_FACE * longer or side >= shorter:
        return None
    left, top = (
        int(np.clip(round(c - side / 2), 0, length - side))
        for c, length in zip(centre, image_size, strict=True)
    )
    return Window(left, top, side)


def face_box(face: FaceDetection, image_size: tuple[int, int]) -> tuple[np.ndarray, float]:
    """Middle (2,) and width of the box around a face, in pixels."""
    points = face.landmarks[:, :2] * image_size
    low, high = points.min(axis=0), points.max(axis=0)
    return (low + high) / 2, float(high[0] - low[0])


class ZoomingDetector:
    """Finds faces in whole frames, and through a window once a small one is followed.

    A window that shows no face is kept for half a second, in case a hand has passed before it;
    then, and at the start, the frame is searched through overlapping windows, twice a second.
    """

    def __init__(self, detect: Detect, canonical: CanonicalFace) -> None:
        self._detect = detect
        self._canonical = canonical
        self._window: Window | None = None
        self._seen = -np.inf
        self._searched = -np.inf
        #: frames seen through a window, and how often a window was set
        self.frames = 0
        self.windows = 0

    def detect(self, image: np.ndarray, time: float) -> list[FaceDetection]:
        """Faces in ``image`` (H, W, 3) uint8 RGB, in the coordinates of the whole image."""
        faces: list[FaceDetection] = []
        if self._window is not None:
            faces = self._through(self._window, image, time)
            self.frames += bool(faces)
        faces = faces or self._detect(image, time)
        lost = time - self._seen > SEARCH_INTERVAL
        if not faces and lost:
            self._window = None
            if time - self._searched >= SEARCH_INTERVAL:
                self._searched = time
                faces = self._search(image, time)
        if faces:
            self._seen = time
        return faces

    def refine(self, face: FaceDetection, image: np.ndarray, time: float) -> FaceDetection:
        """The followed ``face``, seen through a window if it is small and has left its old one."""
        size = (image.shape[1], image.shape[0])
        centre, width = face_box(face, size)
        if self._window is not None and self._window.fits(centre, width):
            return face
        window = window_around(centre, width, size)
        if window is None or window == self._window:
            self._window = window
            return face
        distances = [
            (float(np.linalg.norm(face_box(closer, size)[0] - centre)), index, closer)
            for index, closer in enumerate(self._through(window, image, time))
        ]
        if not distances or min(distances)[0] > width / 2:
            self._window = None
            return face
        self._window = window
        self.windows += 1
        return min(distances)[2]

    def _through(self, window: Window, image: np.ndarray, time: float) -> list[FaceDetection]:
        size = (image.shape[1], image.shape[0])
        return [
            whole_image_detection(face, window, size, self._canonical)
            for face in self._detect(window.cut(image), time)
        ]

    def _search(self, image: np.ndarray, time: float) -> list[FaceDetection]:
        for window in search_windows((image.shape[1], image.shape[0])):
            faces = self._through(window, image, time)
            if faces:
                return faces
        return []


def search_windows(image_size: tuple[int, int]) -> list[Window]:
    """Squares of half the shorter side that overlap by half, over the whole image."""
    side = min(image_size) // 2
    if side < 2:
        return []
    lefts, tops = (
        np.linspace(0, length - side, int(np.ceil(2 * (length - side) / side)) + 1).astype(int)
        for length in image_size
    )
    return [Window(int(left), int(top), side) for top in tops for left in lefts]


def whole_image_detection(
    face: FaceDetection, window: Window, image_size: tuple[int, int], canonical: CanonicalFace
) -> FaceDetection:
    """A face found in ``window``, in the coordinates and under the camera of the whole image."""
    width, height = image_size
    scale = np.array([window.side / width, window.side / height, window.side / width])
    landmarks = face.landmarks * scale + (window.left / width, window.top / height, 0.0)
    return FaceDetection(landmarks, head_pose_from_landmarks(landmarks, image_size, canonical))
