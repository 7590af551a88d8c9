"""MP4 videos: written frame by frame, joined without encoding again, read at any frame.

Images are RGB, (H, W, 3) uint8. The same frames and settings give the same bytes.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np
from numpy.typing import NDArray

from robo_manip_baselines.runs.errors import RequestError, require_choice

Image = NDArray[np.uint8]

VIDEO_CODECS = {"libsvtav1": 30, "h264": 23, "hevc": 28, "lossless": 0}
"""Codec -> its usual constant rate factor. ``libsvtav1`` is the default of LeRobot; ``lossless`` is
H.264 of RGB pixels, which gives every pixel back, and which FFmpeg decodes everywhere."""

SVTAV1_PRESET = 12
"""The fastest, as LeRobot encodes."""

# Or libsvtav1 prints its settings for every video.
os.environ.setdefault("SVT_LOG", "1")


@dataclass(frozen=True)
class VideoEncoding:
    """Codec of videos, and its settings.

    Attributes:
        codec: one of `VIDEO_CODECS`.
        crf: constant rate factor: lower is better and larger. Without meaning for ``lossless``.
        gop: frames from one key frame to the next: lower is faster to read at random, and larger.

    Raises:
        RequestError: there is no such codec, or a number is out of its range.
    """

    codec: str = "libsvtav1"
    crf: int = VIDEO_CODECS["libsvtav1"]
    gop: int = 2

    def __post_init__(self) -> None:
        require_choice("video codec", self.codec, VIDEO_CODECS)
        highest = 63 if self.codec == "libsvtav1" else 51
        if not 0 <= self.crf <= highest:
            raise RequestError(f"crf {self.crf}: must be 0 to {highest} for {self.codec}")
        if self.gop < 1:
            raise RequestError(f"gop {self.gop}: must be 1 frame or more")

    @property
    def encoder(self) -> str:
        """Name of the encoder in FFmpeg."""
        return {"h264": "libx264", "hevc": "libx265", "lossless": "libx264rgb"}.get(
            self.codec, self.codec
        )

    @property
    def pixel_format(self) -> str:
        """FFmpeg's name of the stored pixels."""
        return "rgb24" if self.codec == "lossless" else "yuv420p"

    @property
    def preset(self) -> str | None:
        """Speed of the encoder; None for its default."""
        return str(SVTAV1_PRESET) if self.codec == "libsvtav1" else None

    def options(self) -> dict[str, str]:
        """Return the options of the encoder."""
        crf = 0 if self.codec == "lossless" else self.crf
        options = {"g": str(self.gop), "crf": str(crf)}
        if self.preset:
            options["preset"] = self.preset
        if self.codec == "hevc":
            options["x265-params"] = "log-level=error:bframes=0"
        elif self.codec != "libsvtav1":
            options["bf"] = "0"  # frames lie in the file in the order in which they are shown
        return options


class VideoWriter:
    """Video that is written frame by frame. Use as a context manager.

    Args:
        path: of the MP4 file.
        size: height and width, even numbers unless the encoding is lossless.
        fps: frames a second.
        encoding: how.

    Raises:
        RequestError: the size cannot be encoded.
    """

    def __init__(
        self, path: Path, size: tuple[int, int], fps: int, encoding: VideoEncoding
    ) -> None:
        height, width = size
        if encoding.pixel_format == "yuv420p" and (height % 2 or width % 2):
            raise RequestError(
                f"images of {height}x{width}: {encoding.codec} takes even sizes; choose the video "
                "codec lossless"
            )
        self._container = av.open(str(path), "w", format="mp4", options={"movflags": "faststart"})
        stream: Any = self._container.add_stream(
            encoding.encoder, rate=fps, options=encoding.options()
        )
        stream.height, stream.width = height, width
        stream.pix_fmt = encoding.pixel_format
        if encoding.encoder.startswith("libx264"):
            stream.codec_context.thread_count = 1  # or the bytes depend on the number of cores
        self._stream, self._frames, self._fps = stream, 0, fps

    def add(self, image: Image) -> None:
        """Append a frame, (H, W, 3) uint8 RGB."""
        frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(image), format="rgb24")
        frame.pts, frame.time_base = self._frames, Fraction(1, self._fps)
        self._frames += 1
        self._container.mux(self._stream.encode(frame))

    def close(self) -> None:
        """Write what the encoder still holds, and the file's index."""
        self._container.mux(self._stream.encode(None))
        self._container.close()

    def __enter__(self) -> VideoWriter:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if kind is None:
            self.close()
        else:
            self._container.close()


def join_videos(parts: Iterable[Path], out: Path) -> None:
    """Write videos of one encoding after one another into one file, without encoding again."""
    with av.open(str(out), "w", format="mp4", options={"movflags": "faststart"}) as target:
        copy: Any = None
        start = 0  # of the part, in ticks of its time base
        for part in parts:
            with av.open(str(part)) as source:
                stream = source.streams.video[0]
                if copy is None:
                    copy = target.add_stream_from_template(stream, opaque=True)
                    copy.time_base = stream.time_base
                end = start
                for packet in source.demux(stream):
                    if packet.dts is None or packet.pts is None:  # the end of the stream
                        continue
                    packet.pts, packet.dts = packet.pts + start, packet.dts + start
                    end = max(end, packet.pts + (packet.duration or 0))
                    packet.stream = copy
                    target.mux(packet)
                start = end


@dataclass(frozen=True)
class VideoInfo:
    """Properties of a video.

    Attributes:
        frames: number of them.
        size: height and width.
        fps: frames a second.
        codec: FFmpeg's name of it.
        pixel_format: likewise.
    """

    frames: int
    size: tuple[int, int]
    fps: Fraction
    codec: str
    pixel_format: str


class VideoReader:
    """Frames of a video, in order or at random. Use as a context manager.

    Args:
        path: of the file.
        threads: of the decoder; 0 lets it choose.

    Raises:
        RequestError: it is no video.
    """

    def __init__(self, path: Path, threads: int = 0) -> None:
        self.path = path
        with ExitStack() as stack:
            try:
                self._container = stack.enter_context(av.open(str(path)))
                self._stream: Any = self._container.streams.video[0]
            except (OSError, ValueError, IndexError) as error:
                message = f"'{path}' is no video: {' '.join(str(error).split())}"
                raise RequestError(message) from error
            self._stream.codec_context.thread_count = threads
            self._stream.thread_type = "AUTO" if threads != 1 else "NONE"
            self._fps = Fraction(self._stream.average_rate or self._stream.base_rate or 0)
            if not self._fps:
                raise RequestError(f"'{path}' is no video: it has no frame rate")
            self._start = self._stream.start_time or 0
            stack.pop_all()  # open until `__exit__`

    @property
    def info(self) -> VideoInfo:
        """Properties of the video, as its header declares them."""
        stream, codec = self._stream, self._stream.codec_context
        size = (codec.height, codec.width)
        name = stream.codec.canonical_name
        return VideoInfo(stream.frames, size, self._fps, name, codec.pix_fmt)

    def frame(self, index: int) -> Image:
        """Return the frame of this index, found by its time from the key frame before it.

        Raises:
            RequestError: there is none, or the video is damaged.
        """
        ticks = 1 / (self._fps * self._stream.time_base)
        wanted = self._start + round(index * ticks)
        try:
            self._container.seek(wanted, stream=self._stream, backward=True)
            for frame in self._container.decode(self._stream):
                if frame.pts is not None and frame.pts > wanted - ticks / 2:
                    if frame.pts < wanted + ticks / 2:
                        return frame.to_ndarray(format="rgb24")
                    break
        except (OSError, ValueError) as error:
            raise RequestError(f"'{self.path}', frame {index}: {error}") from error
        raise RequestError(f"'{self.path}' has no frame {index}")

    def __iter__(self) -> Iterator[Image]:
        try:
            self._container.seek(0)
            for frame in self._container.decode(self._stream):
                yield frame.to_ndarray(format="rgb24")
        except (OSError, ValueError) as error:
            raise RequestError(
                f"'{self.path}' is damaged: {' '.join(str(error).split())}"
            ) from error

    def __enter__(self) -> VideoReader:
        return self

    def __exit__(self, *_: object) -> None:
        self._container.close()
