"""Frames of a video at their own times, as a player shows them, as contiguous RGB arrays."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING, cast

import numpy as np

from face_prediction.tracking.containers import missing_bytes
from face_prediction.tracking.damage import DamageTracker
from face_prediction.tracking.display import Display, NotShownError
from robo_manip_baselines.runs.errors import RequestError
from robo_manip_baselines.runs.progress import track

if TYPE_CHECKING:
    import av
    from av.container import InputContainer
    from av.video.stream import VideoStream

DECODING = 2
"""Version of what `VideoReader` makes of a file, recorded in tracks. 2: displayed as a player does,
damaged frames marked."""

LONGEST_PAUSE = 3600.0
"""Seconds between two frames; more is a damaged time, and would fill a track with empty frames."""

MOST_BEHIND = 3
"""Frames in a row that are left out because their times go back; more is another clock."""
REMEDY = "cut it there, or give it other times (ffmpeg -i VIDEO -r RATE OUT.mp4)"

_TIMELESS = frozenset(
    {"cavsvideo", "dirac", "evc", "h261", "h263", "h264", "hevc", "m4v", "mjpeg", "mpegvideo"}
    | {"obu", "rawvideo", "vc1", "vvc"}
)
"""Formats of FFmpeg that hold no times; it numbers their frames at 25 a second where the codec's
header states no other rate."""


@dataclass(frozen=True)
class VideoFrame:
    """One decoded frame.

    Attributes:
        time: s on the video's clock, below 0 where its container says so.
        image: (H, W, 3) uint8 RGB, C-contiguous.
        is_damaged: the image is not what was recorded, because data of it, or of a frame that it
            is predicted from, are damaged.
    """

    time: float
    image: np.ndarray
    is_damaged: bool = False


def require_video(path: Path) -> None:
    """Raise RequestError if ``path`` is absent, no regular file, empty or unreadable."""
    if path.is_dir():
        raise RequestError(f"{path}: is a folder; name video files")
    if not path.exists():
        raise RequestError(f"{path}: no such file")
    if not path.is_file():
        raise RequestError(f"{path}: is a pipe or device; name video files")
    try:
        with path.open("rb") as stream:
            empty = not stream.read(1)
    except OSError as error:
        raise RequestError(f"{path}: cannot be read ({error.strerror})") from None
    if empty:
        raise RequestError(f"{path}: the file is empty")


class VideoReader:
    """Reads one video with PyAV, frame by frame. Use as a context manager.

    Of several video streams the one that players choose is read; cover pictures are none.

    Attributes:
        expected_frames: frames by the header; 0 where it does not give them.
        average_rate: frames per second by the header; 0 where it does not give it.
        lost_frames: frames that could not be decoded, once all have been read.

    Raises:
        RequestError: the file is no video, holds no video stream, has been cut off, or is a raw
            stream of unknown rate; the message names the file.
    """

    def __init__(self, path: Path) -> None:
        import av
        from av.codec.context import Flags
        from av.error import FFmpegError

        require_video(path)
        self._path = path
        if missing := missing_bytes(path):
            size = path.stat().st_size
            raise self._wrong(f"truncated: {missing} of its {size + missing} bytes are missing")
        try:
            # absolute, because FFmpeg takes what is before a colon for a protocol
            self._container = av.open(str(path.absolute()), metadata_errors="replace")
        except (FFmpegError, OSError) as error:
            wrong = f"cannot be opened as a video ({error.strerror}); truncated, or not a video"
            raise RequestError(f"{path}: {wrong}") from None
        try:
            stream = main_stream(self._container)
            if stream is None:
                raise self._wrong("holds no video stream")
            if stream.codec_context is None:
                raise self._wrong("is in a format that FFmpeg cannot decode")
            self._stream = stream
            # with more threads FFmpeg flags damaged frames by chance: of two in a clip both, one or
            # none; and detection takes several times as long as decoding
            stream.codec_context.thread_count = 1
            # crop as the codec says to the pixel, not to the alignment of memory
            stream.codec_context.flags |= Flags.unaligned
            # AVI: numbers of the chunks, which are in decoding order (k-th image: k-th number)
            is_avi = self._container.format.name == "avi"
            self._chunk_times: deque[float] | None = deque() if is_avi else None
            self._rate = frame_rate(self._container, stream)
            if self._rate is None and self._container.format.name in _TIMELESS:
                remedy = "give it one (ffmpeg -framerate RATE -i VIDEO OUT.mp4)"
                raise self._wrong(f"is a raw stream without times and frame rate; {remedy}")
            self.expected_frames = promised_frames(self._container, stream)
            self.average_rate = float(self._rate or 0.0)
            self.lost_frames = 0
        except BaseException:
            self._container.close()
            raise

    def _wrong(self, problem: str) -> RequestError:
        return RequestError(f"{self._path}: {problem}")

    def __enter__(self) -> VideoReader:
        return self

    def __exit__(self, *_: object) -> None:
        self._container.close()

    def frames(self) -> Iterator[VideoFrame]:
        """Every frame with a time later than the one before it, to the end of the file.

        One frame at a time is decoded; a few more are held where frames are predicted from later
        ones.

        Raises:
            RequestError: the file breaks off before its end, holds no frame, or a player would
                show it in a way that is not supported here.
        """
        display = Display(self._container, self._stream)
        last, number, count, behind = -np.inf, 0, 0, 0
        for frame, is_damaged in self._decoded():
            time = self._time(frame, number)
            number += 1
            behind = behind + 1 if time is not None and time < last else 0
            if behind > MOST_BEHIND:
                raise self._wrong(f"its times go back from {last:.2f} s to {time:.2f} s; {REMEDY}")
            if time is None or time <= last:
                continue  # of two frames at one instant the first is kept
            if time - last > LONGEST_PAUSE and count:
                raise self._wrong(f"its times jump from {last:.2f} s to {time:.2f} s; {REMEDY}")
            last = time
            try:
                image = display.image(frame)
            except NotShownError as error:
                raise self._wrong(str(error)) from None
            count += 1
            yield VideoFrame(time, image, is_damaged)
        if count == 0:
            wrong = f"none of its {number} frames has a time" if number else "holds no frame"
            raise self._wrong(f"{wrong} that can be used; truncated, damaged, or not a video")
        if number > 2 * count:
            raise self._wrong(
                f"only {count} of its {number} frames have times of their own; {REMEDY}"
            )

    def _decoded(self) -> Iterator[tuple[av.VideoFrame, bool]]:
        """Every frame that can be decoded, in display order, and whether it is damaged."""
        from av.error import FFmpegError

        chunks = self._chunk_times
        tracker = DamageTracker(self._stream, has_times=chunks is None)
        packets = 0
        is_cut = False  # the packet read last was
        try:
            for packet in self._container.demux(self._stream):
                if packet.size:
                    packets += 1
                    is_cut = packet.is_corrupt
                    tracker.take(packet)
                    if chunks is not None and packet.dts is not None:
                        chunks.append(float(packet.dts * packet.time_base))
                try:
                    frames = packet.decode()
                except FFmpegError:
                    tracker.lose()
                    if chunks:
                        chunks.pop()
                    continue
                for frame in cast("list[av.VideoFrame]", frames):
                    yield from tracker.put(frame)
        except FFmpegError as error:
            wrong = f"breaks off after {packets} frames ({error.strerror}); truncated or damaged"
            raise self._wrong(wrong) from None
        yield from tracker.rest()
        self.lost_frames = tracker.lost
        if is_cut:
            raise self._wrong(f"truncated: breaks off inside the last of its {packets} frames")
        if tracker.lost and self._container.format.name in _TIMELESS:
            wrong = f"{tracker.lost} of its {packets} frames cannot be decoded"
            raise self._wrong(
                f"{wrong}, and without times the others have no place; record it again"
            )

    def _time(self, frame: av.VideoFrame, number: int) -> float | None:
        """Seconds of a frame, the ``number``-th that was displayed."""
        if frame.time is None and self._rate and self._container.format.name in _TIMELESS:
            return float(number / self._rate)
        if self._chunk_times:
            return self._chunk_times.popleft()
        return frame.time


def main_stream(container: InputContainer) -> VideoStream | None:
    """The video stream that players show; None: there is none."""
    from av.stream import Disposition

    still = Disposition.attached_pic | Disposition.timed_thumbnails | Disposition.still_image
    moving = [stream for stream in container.streams.video if not stream.disposition & still]
    best = container.streams.best("video")
    if best in moving:
        return cast("VideoStream", best)
    default = [stream for stream in moving if stream.disposition & Disposition.default]
    return next(iter(default + moving), None)


def frame_rate(container: InputContainer, stream: VideoStream) -> Fraction | None:
    """Frames per second by the header, on average; None: it does not give them."""
    if container.format.name in _TIMELESS:
        return stream.codec_context.framerate or None
    return stream.average_rate or stream.guessed_rate or None


def promised_frames(container: InputContainer, stream: VideoStream) -> int:
    """About how many frames the header says there are; 0: it does not."""
    if stream.frames:
        return int(stream.frames)
    if stream.average_rate and stream.duration and stream.time_base:
        return int(stream.duration * stream.time_base * stream.average_rate)
    if stream.average_rate and container.duration:
        return int(container.duration / 1e6 * float(stream.average_rate))
    return 0


def with_bar(
    frames: Iterable[VideoFrame], total: int | None, label: str | None
) -> Iterable[VideoFrame]:
    """Pass on ``frames`` (``total``, if known) under a progress bar ``label``; None: no bar."""
    return track(frames, total, "frame", label or "", shown=label is not None, keep=False)
