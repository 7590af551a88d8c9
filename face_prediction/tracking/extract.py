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
from face_prediction.tracking.tracks import (
    NUM_LANDMARKS,
    TRACK_FILE,
    FaceTrack,
    NoFaceError,
    Size,
    load_track,
)
from face_prediction.tracking.video import DECODING, VideoReader, with_bar
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

CHUNK = 256
"""Decoded frames whose detections are held before they are resampled."""

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

    def after(self, earlier: Samples) -> Samples:
        """These samples after ``earlier`` ones."""
        pairs = zip(vars(earlier).values(), vars(self).values(), strict=True)
        return Samples(*(np.concatenate(pair) for pair in pairs))

    def tail(self, count: int) -> Samples:
        """The last ``count`` samples."""
        return Samples(*(array[-count:].copy() for array in vars(self).values()))


class Resampler:
    """Detections every 1/fps seconds from the first source time to the last, chunk by chunk.

    A frame that falls between two decoded frames is interpolated (landmarks and position linearly,
    rotation along the arc) when both are valid and no more than ``max_gap`` seconds apart;
    otherwise it is invalid and NaN.
    """

    def __init__(self, fps: float, max_gap: float = MAX_GAP) -> None:
        self._fps, self._max_gap = fps, max_gap
        self._begin: float | None = None
        self._count = 0  # samples made
        self._kept: Samples | None = None  # last two detections

    def add(self, source: Samples, *, is_last: bool = False) -> tuple[Samples, np.ndarray]:
        """Samples that the detections so far determine.

        Args:
            source: the next detections; at least one in all.
            is_last: no more will follow.

        Returns:
            The samples (T, ...), and ``interpolated`` (T,) bool: which of them lie between two
            decoded frames.
        """
        if self._kept is not None:
            source = source.after(self._kept)
        times = source.timestamps
        self._begin = float(times[0]) if self._begin is None else self._begin
        count = int(np.floor((times[-1] - self._begin) * self._fps + 1e-6)) + 1
        wanted = self._begin + np.arange(self._count, count) / self._fps
        if not is_last:  # at the last time and after it, the next detection counts
            wanted = wanted[wanted < times[-1]]
        self._count += len(wanted)
        self._kept = source.tail(2)
        return _samples_at(wanted, source, self._max_gap)


def resample(source: Samples, fps: float, max_gap: float = MAX_GAP) -> tuple[Samples, np.ndarray]:
    """Whole result of a `Resampler` of ``source``."""
    return Resampler(fps, max_gap).add(source, is_last=True)


def _samples_at(wanted: np.ndarray, source: Samples, max_gap: float) -> tuple[Samples, np.ndarray]:
    """Samples at the times ``wanted`` (T,), and which of them lie between two decoded frames."""
    times = source.timestamps
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


class RowStore:
    """Rows of one array, appended to contiguous memory that grows in place."""

    def __init__(self, dtype: str, shape: tuple[int, ...] = ()) -> None:
        self._dtype, self._shape = np.dtype(dtype), shape
        self._bytes = bytearray()

    def append(self, rows: np.ndarray) -> None:
        """Append rows (T, *shape), perhaps none, converted to the type of the store."""
        self._bytes += np.ascontiguousarray(rows, dtype=self._dtype).reshape(-1).view(np.uint8).data

    def array(self) -> np.ndarray:
        """All rows, without a copy; nothing may be appended afterwards."""
        return np.frombuffer(self._bytes, dtype=self._dtype).reshape(-1, *self._shape)


class TrackBuilder:
    """Collects the detections of a video, and resamples them `CHUNK` by `CHUNK`.

    Beyond one chunk only what the track will hold is kept, in the track's types.

    Args:
        fps: frames per second of the track; None keeps the decoded frames.
        max_gap: as for `resample`.
    """

    def __init__(self, fps: float | None, max_gap: float) -> None:
        self._fps = fps
        self._resampler = None if fps is None else Resampler(fps, max_gap)
        self._times: list[float] = []  # of this chunk
        self._faces: list[FaceDetection | None] = []
        self._size: Size = (0, 0)
        self._rows = {
            "landmarks": RowStore("float32", (NUM_LANDMARKS, 3)),
            "valid": RowStore("bool"),
            "interpolated": RowStore("bool"),
            "timestamps": RowStore("float64"),
            "head_pose": RowStore("float64", (4, 4)),
            "jaw": RowStore("float32"),
            "source_timestamps": RowStore("float64"),
            "source_valid": RowStore("bool"),
        }

    def add(self, time: float, face: FaceDetection | None, image_size: Size) -> None:
        """Take in the face of the frame at ``time`` seconds, or None."""
        if len(self._times) == CHUNK:
            self._flush(is_last=False)
        self._times.append(time)
        self._faces.append(face)
        self._size = image_size

    def finish(self, source: dict[str, Any], detector: dict[str, Any]) -> FaceTrack:
        """The track of all frames, at least one."""
        self._flush(is_last=True)
        arrays = {name: rows.array() for name, rows in self._rows.items()}
        times = arrays["source_timestamps"]
        steps = np.diff(times)
        # intervals that differ by more than 5 ms; container clocks tick more finely
        source = {**source, "variable_rate": bool(len(steps) > 1 and np.ptp(steps) > 0.005)}
        fps = self._fps
        if fps is None:
            span = float(times[-1] - times[0])
            fps = (len(times) - 1) / span if span > 0 else 1.0
        return FaceTrack(
            **arrays, image_size=self._size, fps=float(fps), source=source, detector=detector
        )

    def _flush(self, *, is_last: bool) -> None:
        nowhere = FaceDetection(np.full((NUM_LANDMARKS, 3), np.nan), np.full((4, 4), np.nan))
        samples = Samples(
            timestamps=np.array(self._times),
            landmarks=np.array([(face or nowhere).landmarks for face in self._faces]),
            head_pose=np.array([(face or nowhere).head_pose for face in self._faces]),
            valid=np.array([face is not None for face in self._faces]),
        )
        self._times, self._faces = [], []
        self._rows["source_timestamps"].append(samples.timestamps)
        self._rows["source_valid"].append(samples.valid)
        interpolated = np.zeros(len(samples.valid), dtype=bool)
        if self._resampler is not None:
            samples, interpolated = self._resampler.add(samples, is_last=is_last)
        for name, values in vars(samples).items():
            self._rows[name].append(values)
        self._rows["interpolated"].append(interpolated)
        self._rows["jaw"].append(jaw_openings(samples.landmarks, samples.head_pose, self._size))


def extract_track(
    path: Path, detector: FaceDetector, settings: ExtractSettings, label: str | None = None
) -> FaceTrack:
    """Read the video at ``path`` and follow one face through it.

    Faces are not looked for in damaged frames. ``detector`` has the settings' detector settings;
    ``label`` is that of a progress bar, None: no bar.

    Raises:
        RequestError: the video cannot be read to its end, or not as a player shows it, or is longer
            than a track may be.
        NoFaceError: no frame of it shows a face.
    """
    digest = file_digest(path)
    follower = FaceFollower()
    detect, zooming = detector.detect, None
    if settings.zoom:
        zooming = ZoomingDetector(detect, read_canonical_face(detector.model))
        detect = zooming.detect
    builder = TrackBuilder(settings.fps, settings.max_gap)
    frames = damaged = with_face = several = 0
    begin = 0.0
    with VideoReader(path) as video:
        for frame in with_bar(video.frames(), video.expected_frames or None, label):
            size = (frame.image.shape[1], frame.image.shape[0])
            frames += 1
            begin = frame.time if frames == 1 else begin
            require_room(path, frames, frame.time - begin, settings.fps)
            face = None
            if frame.is_damaged:
                damaged += 1
            else:
                faces = detect(frame.image, frame.time)
                several += len(faces) > 1
                face = follower.choose(faces, frame.time, size)
                if zooming and face is not None:
                    face = zooming.refine(face, frame.image, frame.time)
            with_face += face is not None
            builder.add(frame.time, face, size)
    if with_face == 0:
        of_them = f", {damaged} of which are damaged" if damaged else ""
        raise NoFaceError(f"{path}: no face found in any of its {frames} frames{of_them}")
    source = {
        "name": path.name,
        "sha256": digest,
        "decoding": DECODING,
        "frames": frames,
        "frames_damaged": damaged,
        "frames_lost": video.lost_frames,
        "frames_with_face": with_face,
        "frames_with_several_faces": several,
        "reacquired": follower.reacquired,
        "frames_zoomed": zooming.frames if zooming else 0,
        "zoom_windows": zooming.windows if zooming else 0,
        "average_rate": video.average_rate,
    }
    return builder.finish(source, settings.record(detector.description()))


def require_room(path: Path, frames: int, seconds: float, fps: float | None) -> None:
    """Raise RequestError if a track of so many decoded ``frames`` could not be read back."""
    made = frames if fps is None else int(seconds * fps + 1e-6) + 1
    most = TRACK_FILE.limits
    if made > most["T"] or frames > most["S"]:
        raise RequestError(
            f"{path}: a track holds {most['T']} frames of {most['S']} decoded ones at most; cut "
            "the video, or give a lower --fps"
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
    source = {"sha256": source_hash, "decoding": DECODING}
    return made_so and all(track.source.get(name) == value for name, value in source.items())
