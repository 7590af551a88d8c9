"""Decoded frames at their own times to a constant rate, without bridging a gap.

Legend: S source frames, T frames, L landmarks.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from face_prediction.tracking.detector import DetectorSettings, FaceDetection, FaceDetector
from face_prediction.tracking.geometry import (
    CanonicalFace,
    head_pose_from_landmarks,
    matrix_from_quaternion,
    quaternion_from_matrix,
    read_canonical_face,
    slerp,
)
from face_prediction.tracking.lifting import jaw_openings
from face_prediction.tracking.tracks import NUM_LANDMARKS, FaceTrack, NoFaceError, load_track
from face_prediction.tracking.video import VideoFrame, VideoReader, sha256_of
from robo_manip_baselines.runs.errors import RequestError

#: Two decoded frames further apart than this are a gap: at 0.1 s a mouth at the median speed
#: (1-4 cm/s) has gone 4 mm, and nothing says which way.
MAX_GAP = 0.1
#: A frame nearer than this to a decoded one is that frame (video clocks tick in 1/90000 s or more).
SAME_TIME = 1e-3


@dataclass(frozen=True)
class Samples:
    """Detections at their times: landmarks (T, L, 3), head_pose (T, 4, 4), valid (T,)."""

    timestamps: np.ndarray
    landmarks: np.ndarray
    head_pose: np.ndarray
    valid: np.ndarray


def resample(source: Samples, fps: float, max_gap: float = MAX_GAP) -> tuple[Samples, np.ndarray]:
    """Samples every 1/fps seconds from the first source time to the last, and which were made.

    A frame that falls between two decoded frames is interpolated (landmarks and position linearly,
    rotation along the arc) when both are valid and no more than ``max_gap`` seconds apart;
    otherwise it is invalid and NaN. Returns the samples and ``interpolated`` (T,) bool.
    """
    times = source.timestamps
    count = int(np.floor((times[-1] - times[0]) * fps + 1e-6)) + 1
    wanted = times[0] + np.arange(count) / fps
    after = np.clip(np.searchsorted(times, wanted, side="right"), 1, max(len(times) - 1, 1))
    before = after - 1
    after = np.minimum(after, len(times) - 1)
    gap = times[after] - times[before]
    weight = np.clip((wanted - times[before]) / np.where(gap > 0, gap, 1.0), 0.0, 1.0)
    # a frame at a decoded time needs nothing from its neighbour
    weight = np.where(np.abs(wanted - times[before]) < SAME_TIME, 0.0, weight)
    weight = np.where(np.abs(wanted - times[after]) < SAME_TIME, 1.0, weight)
    between = (weight > 0.0) & (weight < 1.0)
    nearest = np.where(weight == 1.0, after, before)
    valid = np.where(
        between,
        source.valid[before] & source.valid[after] & (gap <= max_gap + 1e-6),
        source.valid[nearest],
    )
    landmarks = _mix(source.landmarks, before, after, weight)
    head_pose = _mix_poses(source.head_pose, before, after, weight)
    landmarks[~valid] = np.nan
    head_pose[~valid] = np.nan
    return Samples(wanted, landmarks, head_pose, valid), between & valid


def _mix(
    array: np.ndarray, before: np.ndarray, after: np.ndarray, weight: np.ndarray
) -> np.ndarray:
    filled = np.nan_to_num(array)  # NaN * 0 would spoil a frame that its neighbour does not enter
    w = weight.reshape(-1, *([1] * (array.ndim - 1)))
    return (1 - w) * filled[before] + w * filled[after]


def _mix_poses(
    poses: np.ndarray, before: np.ndarray, after: np.ndarray, weight: np.ndarray
) -> np.ndarray:
    mixed = _mix(poses, before, after, weight)
    known = np.where(np.isfinite(poses[:, :1, :1]), poses[:, :3, :3], np.eye(3))
    quaternion = quaternion_from_matrix(known)
    mixed[:, :3, :3] = matrix_from_quaternion(slerp(quaternion[before], quaternion[after], weight))
    mixed[:, 3] = (0.0, 0.0, 0.0, 1.0)
    return mixed


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


logger = logging.getLogger(__name__)

#: Rate of the paper's recordings (IV.B).
DEFAULT_FPS = 30.0
#: A face whose middle is further than this from where the tracked one was, in face widths, is
#: another person. A mouth at 0.6 m/s crosses a seventh of a face between frames at 30 fps.
SAME_FACE_DISTANCE = 0.75
#: After this many seconds without the tracked face, the nearest face is followed instead.
LOST_AFTER = 0.5


@dataclass(frozen=True)
class ExtractSettings:
    """Everything that shapes a track besides the video; recorded in it."""

    detector: DetectorSettings = field(default_factory=DetectorSettings)
    #: Frames per second of the track; None keeps the decoded frames as they are.
    fps: float | None = DEFAULT_FPS
    #: Longest time in seconds between two decoded frames that is interpolated across.
    max_gap: float = MAX_GAP
    #: Look at small faces through a window (image mode only).
    zoom: bool = True

    def __post_init__(self) -> None:
        if self.fps is not None and not (0.0 < self.fps <= 1000.0):
            raise RequestError(f"--fps {self.fps}: between 0 and 1000, or None")
        if not 0.0 <= self.max_gap <= 1.0:
            raise RequestError(f"--max_gap {self.max_gap}: between 0 and 1 s")
        if self.zoom and self.detector.running_mode == "video":
            raise RequestError("--zoom works with --running_mode image only; add --no_zoom")


class ProgressFactory(Protocol):
    """Wraps the frames of a video, to show how far it has got."""

    def __call__(
        self, frames: Iterable[VideoFrame], total: int | None, name: str
    ) -> Iterable[VideoFrame]:
        """Pass on every one of ``frames``, of which ``total`` are expected."""
        ...


def no_progress(frames: Iterable[VideoFrame], total: int | None, name: str) -> Iterable[VideoFrame]:
    """Shows nothing."""
    return frames


class FaceFollower:
    """Chooses the same person among the faces of successive frames."""

    def __init__(self) -> None:
        self._centre: np.ndarray | None = None  # (2,) pixels
        self._width = 0.0  # pixels
        self._seen = -np.inf
        self.reacquired = 0

    def choose(
        self, faces: Sequence[FaceDetection], time: float, image_size: tuple[int, int]
    ) -> FaceDetection | None:
        """The tracked face among ``faces`` at ``time`` seconds, or None when it is not there.

        The first face is the widest one. Later ones must be near the last place; when the tracked
        face has been away for half a second, the nearest face becomes the tracked one.
        """
        if not faces:
            return None
        boxes = [face_box(face, image_size) for face in faces]
        if self._centre is None:
            index = int(np.argmax([width for _, width in boxes]))
        else:
            distances = [float(np.linalg.norm(centre - self._centre)) for centre, _ in boxes]
            index = int(np.argmin(distances))
            if distances[index] > SAME_FACE_DISTANCE * self._width:
                if time - self._seen < LOST_AFTER:
                    return None
                self.reacquired += 1
        self._centre, self._width = boxes[index]
        self._seen = time
        return faces[index]


def extract_track(
    path: Path,
    detector: FaceDetector,
    settings: ExtractSettings,
    progress: ProgressFactory = no_progress,
) -> FaceTrack:
    """Read the video at ``path`` and follow one face through it.

    Raises:
        RequestError: the video cannot be read to its end.
        NoFaceError: no frame of it shows a face.
    """
    source_hash = sha256_of(path)
    with VideoReader(path) as video:
        info = video.info
        follower = FaceFollower()
        times: list[float] = []
        found: list[FaceDetection | None] = []
        zooming = None
        if settings.zoom:
            zooming = ZoomingDetector(detector.detect, read_canonical_face(detector.model))
        several = 0
        size = (0, 0)
        for frame in progress(video.frames(), info.expected_frames or None, path.name):
            height, width = frame.image.shape[:2]
            if times and (width, height) != size:
                raise RequestError(f"{path}: its image size changes at {frame.time:.2f} s")
            size = (width, height)
            faces = (
                zooming.detect(frame.image, frame.time)
                if zooming
                else (detector.detect(frame.image, frame.time))
            )
            several += len(faces) > 1
            times.append(frame.time)
            face = follower.choose(faces, frame.time, size)
            if zooming and face is not None:
                face = zooming.refine(face, frame.image, frame.time)
            found.append(face)
    source = {
        "name": path.name,
        "sha256": source_hash,
        "frames": len(times),
        "frames_with_face": sum(face is not None for face in found),
        "frames_with_several_faces": several,
        "reacquired": follower.reacquired,
        "frames_zoomed": zooming.frames if zooming else 0,
        "zoom_windows": zooming.windows if zooming else 0,
        "average_rate": info.average_rate,
        "variable_rate": is_variable_rate(times),
    }
    if source["frames_with_face"] == 0:
        raise NoFaceError(f"{path}: no face found in any of its {len(times)} frames")
    return build_track(times, found, size, settings, source, detector.description())


def build_track(
    times: Sequence[float],
    found: Sequence[FaceDetection | None],
    image_size: tuple[int, int],
    settings: ExtractSettings,
    source: dict[str, Any],
    detector: dict[str, Any],
) -> FaceTrack:
    """Put detections (one per decoded frame, None: no face) at a constant rate."""
    samples = Samples(
        timestamps=np.array(times),
        landmarks=np.array(
            [np.full((NUM_LANDMARKS, 3), np.nan) if f is None else f.landmarks for f in found]
        ),
        head_pose=np.array([np.full((4, 4), np.nan) if f is None else f.head_pose for f in found]),
        valid=np.array([f is not None for f in found]),
    )
    fps = settings.fps
    if fps is None:
        track, interpolated = samples, np.zeros(len(times), dtype=bool)
        span = times[-1] - times[0]
        fps = (len(times) - 1) / span if span > 0 else 1.0
    else:
        track, interpolated = resample(samples, fps, settings.max_gap)
    settings_record = {key: value for key, value in asdict(settings).items() if key != "detector"}
    return FaceTrack(
        landmarks=track.landmarks.astype(np.float32),
        valid=track.valid,
        interpolated=interpolated,
        timestamps=track.timestamps,
        head_pose=track.head_pose,
        jaw=jaw_openings(track.landmarks, track.head_pose, image_size).astype(np.float32),
        image_size=image_size,
        fps=float(fps),
        source_timestamps=samples.timestamps,
        source_valid=samples.valid,
        source=source,
        detector={**detector, "settings": settings_record},
    )


def is_variable_rate(times: Sequence[float]) -> bool:
    """Whether the intervals between decoded frames differ by more than 5 ms (container ticks)."""
    steps = np.diff(times)
    return bool(len(steps) > 1 and np.ptp(steps) > 0.005)


def is_up_to_date(
    out: Path, source_hash: str, settings: ExtractSettings, detector: dict[str, Any]
) -> bool:
    """Whether ``out`` already holds the track of this video made with these settings.

    Raises:
        RequestError: ``out`` exists and is no face track, so that writing would destroy it.
    """
    if not out.exists():
        return False
    try:
        track = load_track(out)
    except RequestError as error:
        raise RequestError(f"{error}; it is in the way of a track, so remove it first") from None
    wanted = {
        **detector,
        "settings": {k: v for k, v in asdict(settings).items() if k != "detector"},
    }
    return track.source.get("sha256") == source_hash and dict(track.detector) == wanted
