"""Videos to face tracks: one face followed and brought to a constant rate.

Small faces are detected through a window of the frame (`ZoomingDetector`), one person is followed
(`FaceFollower`), and the detections, made at the times of the decoded frames, are resampled to a
constant rate without bridging a gap (`resample`).

Legend: S source frames, T frames, L landmarks.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from annotated_types import Interval

from face_prediction.tracking.detector import DetectorSettings, FaceDetection, FaceDetector
from face_prediction.tracking.geometry import (
    CanonicalFace,
    Crop,
    head_pose_from_landmarks,
    jaw_openings,
    matrix_from_quaternion,
    quaternion_from_matrix,
    read_canonical_face,
    slerp,
)
from face_prediction.tracking.tracks import NUM_LANDMARKS, FaceTrack, NoFaceError, Size, load_track
from face_prediction.tracking.video import VideoReader, with_bar
from robo_manip_baselines.runs.errors import RequestError
from robo_manip_baselines.runs.files import file_digest
from robo_manip_baselines.runs.ranges import require_ranges

DEFAULT_FPS = 30.0
"""Rate of the paper's recordings (IV.B)."""
MAX_GAP = 0.1
"""Seconds: two decoded frames further apart than this are a gap. In 0.1 s a mouth at the median
speed (1-4 cm/s) has gone 4 mm, in an unknown direction."""
SAME_TIME = 1e-3
"""A frame nearer than this to a decoded one is that frame (video clocks tick in 1/90000 s or
more)."""

SMALL_FACE = 0.2
"""Faces narrower than this share of the frame's longer side are detected through a window."""
WINDOW_FACES = 3.0
"""Side of the window in face widths."""
OFF_CENTRE = 0.2
"""The window moves when the face's middle is further than this share of its side from its own."""
SIZE_CHANGE = 1.4
"""The window changes its size when the face's width has changed by this factor."""
SEARCH_INTERVAL = 0.5
"""Seconds without a face before a search, and between searches."""

SAME_FACE_DISTANCE = 0.75
"""A face whose middle is further than this from where the tracked one was, in face widths, is
another person. A mouth at 0.6 m/s crosses a seventh of a face between frames at 30 fps."""
LOST_AFTER = 0.5
"""After this many seconds without the tracked face, the nearest face is followed instead."""

Detect = Callable[[np.ndarray, float], list[FaceDetection]]


@dataclass(frozen=True)
class ExtractSettings:
    """Settings that shape a track besides the video; recorded in it.

    Attributes:
        detector: Settings of the detector.
        fps: Frames per second of the tracks; None keeps the decoded frames as they are.
        max_gap: Longest time in seconds between two decoded frames that is interpolated across.
        zoom: Detect small faces through a still window three faces wide (with image only).
    """

    detector: DetectorSettings = field(default_factory=DetectorSettings)
    fps: Annotated[float, Interval(gt=0.0, le=1000.0)] | None = DEFAULT_FPS
    max_gap: Annotated[float, Interval(ge=0.0, le=1.0)] = MAX_GAP
    zoom: bool = True

    def __post_init__(self) -> None:
        require_ranges(self, "--{} {}")
        if self.zoom and self.detector.running_mode == "video":
            raise RequestError("--zoom works with --running_mode image only; add --no_zoom")

    def record(self, detector: dict[str, Any]) -> dict[str, Any]:
        """The ``detector`` of a track: the detector's description and these settings."""
        own = {"fps": self.fps, "max_gap": self.max_gap, "zoom": self.zoom}
        return {**detector, "settings": own}


@dataclass(frozen=True)
class Samples:
    """Detections at their times: landmarks (T, L, 3), head_pose (T, 4, 4), valid (T,)."""

    timestamps: np.ndarray
    landmarks: np.ndarray
    head_pose: np.ndarray
    valid: np.ndarray


def resample(source: Samples, fps: float, max_gap: float = MAX_GAP) -> tuple[Samples, np.ndarray]:
    """Detections every 1/fps seconds from the first source time to the last.

    A frame that falls between two decoded frames is interpolated (landmarks and position linearly,
    rotation along the arc) when both are valid and no more than ``max_gap`` seconds apart;
    otherwise it is invalid and NaN.

    Returns:
        The samples, and ``interpolated`` (T,) bool: which of them lie between two decoded frames.
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
    bridged = source.valid[before] & source.valid[after] & (gap <= max_gap + 1e-6)
    valid = np.where(between, bridged, source.valid[nearest])

    def mix(array: np.ndarray) -> np.ndarray:
        filled = np.nan_to_num(array)  # NaN * 0 would spoil a frame that does not need this one
        w = weight.reshape(-1, *([1] * (array.ndim - 1)))
        return (1 - w) * filled[before] + w * filled[after]

    landmarks, head_pose = mix(source.landmarks), mix(source.head_pose)
    known = np.isfinite(source.head_pose[:, :1, :1])
    rotation = quaternion_from_matrix(np.where(known, source.head_pose[:, :3, :3], np.eye(3)))
    head_pose[:, :3, :3] = matrix_from_quaternion(slerp(rotation[before], rotation[after], weight))
    head_pose[:, 3] = (0.0, 0.0, 0.0, 1.0)
    landmarks[~valid] = np.nan
    head_pose[~valid] = np.nan
    return Samples(wanted, landmarks, head_pose, valid), between & valid


class ZoomingDetector:
    """Finds faces in whole frames, and through a window once a small one is followed.

    A window that shows no face is kept for half a second, in case a hand has passed before it;
    then, and at the start, the frame is searched through overlapping windows, twice a second.

    Attributes:
        frames: frames seen through a window.
        windows: times that a window was set.
    """

    def __init__(self, detect: Detect, canonical: CanonicalFace) -> None:
        self._detect = detect
        self._canonical = canonical
        self._window: Crop | None = None
        self._seen = -np.inf
        self._searched = -np.inf
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
                size = (image.shape[1], image.shape[0])
                found = (self._through(window, image, time) for window in search_windows(size))
                faces = next(filter(None, found), [])
        if faces:
            self._seen = time
        return faces

    def refine(self, face: FaceDetection, image: np.ndarray, time: float) -> FaceDetection:
        """The followed ``face``, seen through a window if it is small and has left its old one."""
        size = (image.shape[1], image.shape[0])
        centre, width = face.box(size)
        if self._window is not None and is_well_inside(self._window, centre, width):
            return face
        window = window_around(centre, width, size)
        if window is None or window == self._window:
            self._window = window
            return face
        faces = self._through(window, image, time)
        distances = [float(np.linalg.norm(closer.box(size)[0] - centre)) for closer in faces]
        if not distances or min(distances) > width / 2:
            self._window = None
            return face
        self._window = window
        self.windows += 1
        return faces[int(np.argmin(distances))]

    def _through(self, window: Crop, image: np.ndarray, time: float) -> list[FaceDetection]:
        size = (image.shape[1], image.shape[0])
        return [
            whole_image_detection(face, window, size, self._canonical)
            for face in self._detect(np.ascontiguousarray(window.region(image)), time)
        ]


def is_well_inside(window: Crop, centre: np.ndarray, width: float) -> bool:
    """Return whether a face of this middle (2,) and width, in pixels, suits the window still."""
    middle = np.array([window.left, window.top]) + window.side / 2
    wanted = window.side / WINDOW_FACES
    is_centred = bool(np.all(np.abs(centre - middle) <= OFF_CENTRE * window.side))
    return is_centred and wanted / SIZE_CHANGE <= width <= wanted * SIZE_CHANGE


def window_around(centre: np.ndarray, width: float, image_size: Size) -> Crop | None:
    """The window for a face of this middle (2,) and width in pixels; None for a large face."""
    longer, shorter = max(image_size), min(image_size)
    side = round(WINDOW_FACES * width)
    if width >= SMALL_FACE * longer or side >= shorter:
        return None
    pairs = zip(centre, image_size, strict=True)
    left, top = (int(np.clip(round(c - side / 2), 0, length - side)) for c, length in pairs)
    return Crop(left, top, side)


def search_windows(image_size: Size) -> list[Crop]:
    """Squares of half the shorter side that overlap by half, over the whole image."""
    side = min(image_size) // 2
    if side < 2:
        return []
    lefts, tops = (
        np.linspace(0, length - side, int(np.ceil(2 * (length - side) / side)) + 1).astype(int)
        for length in image_size
    )
    return [Crop(int(left), int(top), side) for top in tops for left in lefts]


def whole_image_detection(
    face: FaceDetection, window: Crop, image_size: Size, canonical: CanonicalFace
) -> FaceDetection:
    """A face found in ``window``, in the coordinates and under the camera of the whole image."""
    width, height = image_size
    scale = np.array([window.side / width, window.side / height, window.side / width])
    landmarks = face.landmarks * scale + (window.left / width, window.top / height, 0.0)
    return FaceDetection(landmarks, head_pose_from_landmarks(landmarks, image_size, canonical))


class FaceFollower:
    """Chooses the same person among the faces of successive frames."""

    def __init__(self) -> None:
        self._centre: np.ndarray | None = None  # (2,) pixels
        self._width = 0.0  # pixels
        self._seen = -np.inf
        self.reacquired = 0

    def choose(
        self, faces: Sequence[FaceDetection], time: float, image_size: Size
    ) -> FaceDetection | None:
        """The tracked face among ``faces`` at ``time`` seconds, or None when it is not there.

        The first face is the widest one. Later ones must be near the last place; when the tracked
        face has been away for half a second, the nearest face becomes the tracked one.
        """
        if not faces:
            return None
        boxes = [face.box(image_size) for face in faces]
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
    path: Path, detector: FaceDetector, settings: ExtractSettings, label: str | None = None
) -> FaceTrack:
    """Read the video at ``path`` and follow one face through it.

    ``detector`` has the settings' detector settings; ``label`` is that of a progress bar, None: no
    bar.

    Raises:
        RequestError: the video cannot be read to its end.
        NoFaceError: no frame of it shows a face.
    """
    digest = file_digest(path)
    follower = FaceFollower()
    detect, zooming = detector.detect, None
    if settings.zoom:
        zooming = ZoomingDetector(detect, read_canonical_face(detector.model))
        detect = zooming.detect
    times: list[float] = []
    found: list[FaceDetection | None] = []
    several = 0
    size = (0, 0)
    with VideoReader(path) as video:
        for frame in with_bar(video.frames(), video.expected_frames or None, label):
            height, width = frame.image.shape[:2]
            if times and (width, height) != size:
                raise RequestError(f"{path}: its image size changes at {frame.time:.2f} s")
            size = (width, height)
            faces = detect(frame.image, frame.time)
            several += len(faces) > 1
            times.append(frame.time)
            face = follower.choose(faces, frame.time, size)
            if zooming and face is not None:
                face = zooming.refine(face, frame.image, frame.time)
            found.append(face)
    steps = np.diff(times)
    source = {
        "name": path.name,
        "sha256": digest,
        "frames": len(times),
        "frames_with_face": sum(face is not None for face in found),
        "frames_with_several_faces": several,
        "reacquired": follower.reacquired,
        "frames_zoomed": zooming.frames if zooming else 0,
        "zoom_windows": zooming.windows if zooming else 0,
        "average_rate": video.average_rate,
        # intervals that differ by more than 5 ms; container clocks tick more finely
        "variable_rate": bool(len(steps) > 1 and np.ptp(steps) > 0.005),
    }
    if source["frames_with_face"] == 0:
        raise NoFaceError(f"{path}: no face found in any of its {len(times)} frames")
    nowhere = FaceDetection(np.full((NUM_LANDMARKS, 3), np.nan), np.full((4, 4), np.nan))
    samples = Samples(
        timestamps=np.array(times),
        landmarks=np.array([(face or nowhere).landmarks for face in found]),
        head_pose=np.array([(face or nowhere).head_pose for face in found]),
        valid=np.array([face is not None for face in found]),
    )
    fps = settings.fps
    if fps is None:
        track, interpolated = samples, np.zeros(len(times), dtype=bool)
        span = times[-1] - times[0]
        fps = (len(times) - 1) / span if span > 0 else 1.0
    else:
        track, interpolated = resample(samples, fps, settings.max_gap)
    return FaceTrack(
        landmarks=track.landmarks.astype(np.float32),
        valid=track.valid,
        interpolated=interpolated,
        timestamps=track.timestamps,
        head_pose=track.head_pose,
        jaw=jaw_openings(track.landmarks, track.head_pose, size).astype(np.float32),
        image_size=size,
        fps=float(fps),
        source_timestamps=samples.timestamps,
        source_valid=samples.valid,
        source=source,
        detector=settings.record(detector.description()),
    )


def is_track_up_to_date(
    out: Path, source_hash: str, settings: ExtractSettings, detector: dict[str, Any]
) -> bool:
    """Return whether ``out`` already holds the track of this video made with these settings.

    Raises:
        RequestError: ``out`` exists and is no face track, so that writing would destroy it.
    """
    if not out.exists():
        return False
    try:
        track = load_track(out)
    except RequestError as error:
        raise RequestError(f"{error}; it is in the way of a track, so remove it first") from None
    made_so = dict(track.detector) == settings.record(detector)
    return made_so and track.source.get("sha256") == source_hash
