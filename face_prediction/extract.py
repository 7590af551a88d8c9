"""Video to :class:`FaceTrack`: detect, follow one face, resample.

Legend: S source frames, T frames.
"""

from __future__ import annotations

import logging
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from face_prediction.detector import DetectorSettings, FaceDetection, FaceDetector
from face_prediction.errors import NoFaceError, RequestError
from face_prediction.face_geometry import read_canonical_face
from face_prediction.lifting import jaw_openings
from face_prediction.resample import MAX_GAP, Samples, resample
from face_prediction.tracks import NUM_LANDMARKS, FaceTrack, load_track
from face_prediction.video import VideoFrame, VideoReader, sha256_of
from face_prediction.zoom import ZoomingDetector, face_box

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
