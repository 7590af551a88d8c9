"""Where drawn images go: an H.264 file, or a window.

Images are RGB, (rows, columns, 3) uint8.
"""

from __future__ import annotations

import os
import re
import sys
from contextlib import ExitStack
from fractions import Fraction
from pathlib import Path
from types import TracebackType
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from face_prediction.errors import RequestError
from face_prediction.whole_file import whole_file

#: Ticks a second of the times in a file: 1/90000 s, as cameras and broadcasts have it.
_CLOCK = 90_000
TITLE = "face-prediction live"
_ESCAPE = 27


class Sink(Protocol):
    """Takes images one after another."""

    def show(self, image: NDArray[np.uint8], time: float) -> bool:
        """Take one image of ``time`` seconds; False: the user has seen enough."""
        ...


class VideoFile:
    """An H.264 file that browsers play, there when it is whole and not before.

    Use as a context manager. Every image keeps its own time, whatever the rate; an odd row or
    column at the edge is left out, because 4:2:0 video has even sizes only.

    Args:
        path: file to write, ``….mp4``.
        rate: about how many images a second there will be.
        quality: of libx264, 0 (lossless) to 51.
    """

    def __init__(self, path: Path, rate: float, quality: int = 20) -> None:
        self._path = path
        self._rate = Fraction(rate if rate > 0 else 30.0).limit_denominator(1001)
        self._quality = quality
        self._stack = ExitStack()
        self._last = -1

    def __enter__(self) -> VideoFile:
        import av

        temporary = self._stack.enter_context(whole_file(self._path))
        # the index in front, so that a browser starts to play before all has arrived
        self._container = self._stack.enter_context(
            av.open(str(temporary), "w", format="mp4", options={"movflags": "+faststart"})
        )
        self._stream = self._container.add_stream("libx264", rate=self._rate)
        self._stream.pix_fmt = "yuv420p"
        self._stream.options = {"crf": str(self._quality), "preset": "veryfast"}
        self._stream.codec_context.time_base = Fraction(1, _CLOCK)
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        if error is None and self._last >= 0:
            self._container.mux(self._stream.encode(None))
        if error is None and self._last < 0:
            error = RequestError(f"--out {self._path}: there was no image to write")
            self._stack.__exit__(RequestError, error, None)
            raise error
        self._stack.__exit__(kind, error, traceback)

    def show(self, image: NDArray[np.uint8], time: float) -> bool:
        """Append one image; always True."""
        import av

        height, width = image.shape[0] // 2 * 2, image.shape[1] // 2 * 2
        if self._last < 0:
            self._stream.height, self._stream.width = height, width
        frame = av.VideoFrame.from_ndarray(
            np.ascontiguousarray(image[:height, :width]), format="rgb24"
        )
        frame.time_base = Fraction(1, _CLOCK)
        frame.pts = self._last = max(round(time * _CLOCK), self._last + 1)
        self._container.mux(self._stream.encode(frame))
        return True


class Window:
    """A window on the screen; Escape, q or its close button end it. Use as a context manager.

    Raises:
        RequestError: this OpenCV has no windows, or there is no screen.
    """

    def __init__(self) -> None:
        problem = window_problem()
        if problem:
            raise RequestError(f"{problem}; name a file with --out")

    def __enter__(self) -> Window:
        import cv2

        cv2.namedWindow(TITLE, cv2.WINDOW_NORMAL)
        return self

    def __exit__(self, *_: object) -> None:
        import cv2

        cv2.destroyAllWindows()

    def show(self, image: NDArray[np.uint8], time: float) -> bool:
        """Show one image; False once the user has closed the window."""
        import cv2

        cv2.imshow(TITLE, np.ascontiguousarray(image[..., ::-1]))
        is_ended = cv2.waitKey(1) & 0xFF in (_ESCAPE, ord("q"))
        return not is_ended and cv2.getWindowProperty(TITLE, cv2.WND_PROP_VISIBLE) >= 1


def window_problem() -> str | None:
    """Why no window can be opened, or None."""
    import cv2

    found = re.search(r"^\s*GUI:\s*(\S+)", cv2.getBuildInformation(), re.MULTILINE)
    if found and found.group(1).upper() == "NONE":
        return "the OpenCV that is installed (opencv-python-headless) opens no window"
    if sys.platform == "linux" and not (
        os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    ):
        return "there is no screen ($DISPLAY is not set)"
    return None
