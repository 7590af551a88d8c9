"""Frames of a video at their own times, upright, as contiguous RGB arrays."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from robo_manip_baselines.runs.errors import RequestError
from robo_manip_baselines.runs.progress import track

WHOLE_SHARE = 0.9
"""A video that decodes to less than this share of the frames in its header is refused as truncated,
where no damaged packet has revealed it already (Matroska). Edit lists drop some frames of whole
files: the worst of 68 test clips gives 93 % (1531 of 1641)."""


@dataclass(frozen=True)
class VideoFrame:
    """One decoded frame: time in seconds, and its image (H, W, 3) uint8 RGB, C-contiguous."""

    time: float
    image: np.ndarray


def require_video(path: Path) -> None:
    """Raise RequestError if ``path`` is absent, a folder, empty or unreadable."""
    if path.is_dir():
        raise RequestError(f"{path}: is a folder; name video files")
    if not path.exists():
        raise RequestError(f"{path}: no such file")
    try:
        with path.open("rb") as stream:
            empty = not stream.read(1)
    except OSError as error:
        raise RequestError(f"{path}: cannot be read ({error.strerror})") from None
    if empty:
        raise RequestError(f"{path}: the file is empty")


class VideoReader:
    """Reads one video with PyAV. Use as a context manager.

    Attributes:
        expected_frames: frames by the header; 0 where it does not give them.
        average_rate: frames per second by the header; 0 where it does not give it.

    Raises:
        RequestError: the file is no video, holds no video stream, or breaks off before its end;
            the message names the file.
    """

    def __init__(self, path: Path) -> None:
        import av
        from av.error import FFmpegError

        require_video(path)
        self._path = path
        try:
            self._container = av.open(str(path))
        except (FFmpegError, OSError) as error:
            wrong = f"cannot be opened as a video ({error.strerror}); truncated, or not a video"
            raise RequestError(f"{path}: {wrong}") from None
        if not self._container.streams.video:
            self._container.close()
            raise RequestError(f"{path}: holds no video stream")
        stream = self._stream = self._container.streams.video[0]
        stream.thread_type = "AUTO"
        expected = 0
        if stream.frames:
            expected = int(stream.frames)
        elif stream.average_rate and stream.duration and stream.time_base:
            expected = int(stream.duration * stream.time_base * stream.average_rate)
        elif stream.average_rate and self._container.duration and len(self._container.streams) == 1:
            expected = int(self._container.duration / 1e6 * float(stream.average_rate))
        self.expected_frames = expected
        self.average_rate = float(stream.average_rate or stream.guessed_rate or 0.0)

    def __enter__(self) -> VideoReader:
        return self

    def __exit__(self, *_: object) -> None:
        self._container.close()

    def frames(self) -> Iterator[VideoFrame]:
        """Every frame with a time later than the one before it, to the end of the file.

        Raises:
            RequestError: the file breaks off before its end.
        """
        from av.error import FFmpegError

        count = 0
        last = -np.inf
        try:
            for packet in self._container.demux(self._stream):
                if packet.is_corrupt:
                    wrong = f"breaks off after {count} frames; truncated or damaged"
                    raise RequestError(f"{self._path}: {wrong}")
                for frame in packet.decode():
                    count += 1
                    if frame.time is None or frame.time <= last:
                        continue  # of two frames at one instant the first is kept
                    last = frame.time
                    image = frame.to_ndarray(format="rgb24")
                    yield VideoFrame(last, upright(image, frame.rotation))
        except FFmpegError as error:
            wrong = f"breaks off after {count} frames ({error.strerror}); truncated or damaged"
            raise RequestError(f"{self._path}: {wrong}") from None
        if count < WHOLE_SHARE * self.expected_frames:
            wrong = f"its header promises {self.expected_frames} frames and {count} can be decoded"
            raise RequestError(f"{self._path}: truncated, {wrong}")
        if count == 0:
            raise RequestError(f"{self._path}: holds no frame that can be decoded")


def upright(image: np.ndarray, rotation: int) -> np.ndarray:
    """``image`` (H, W, 3) turned as its display matrix asks, as a C-contiguous array.

    ``rotation`` is PyAV's: degrees counter-clockwise to turn the image by. Contiguous because PyAV
    pads the rows of images whose width is no multiple of 32, and MediaPipe reads such an array as
    if it had no padding: a sheared image without a face.
    """
    return np.ascontiguousarray(np.rot90(image, k=round(rotation / 90) % 4))


def with_bar(
    frames: Iterable[VideoFrame], total: int | None, label: str | None
) -> Iterable[VideoFrame]:
    """Pass on ``frames`` (``total``, if known) under a progress bar ``label``; None: no bar."""
    return track(frames, total, "frame", label or "", shown=label is not None, keep=False)
