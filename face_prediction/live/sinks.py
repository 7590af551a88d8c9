"""Where drawn images go: an H.264 file, or a window.

Images are RGB, (rows, columns, 3) uint8.
"""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Sequence
from contextlib import ExitStack
from fractions import Fraction
from pathlib import Path
from types import TracebackType
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from face_prediction.forecast import mouth_centre
from face_prediction.tracking.geometry import LIPS, Crop
from robo_manip_baselines.runs.errors import RequestError
from robo_manip_baselines.runs.files import atomic_file

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

        temporary = self._stack.enter_context(atomic_file(self._path))
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


Colour = tuple[int, int, int]

WHITE: Colour = (255, 255, 255)
BLACK: Colour = (0, 0, 0)
#: the mouth now, and the lips
GREEN: Colour = (80, 230, 110)
#: the mouth in the nearest and in the farthest frame that is forecast
NEAR: Colour = (255, 225, 60)
FAR: Colour = (255, 60, 40)
#: Side of the magnified mouth as a share of the image's shorter side.
INSET = 0.34
#: OpenCV's FONT_HERSHEY_SIMPLEX; OpenCV is imported by what draws, so that commands start without
_FONT = 0
#: OpenCV draws at sixteenths of a pixel
_SHIFT = 4


def draw_mouth(
    image: NDArray[np.uint8],
    landmarks: NDArray[np.floating],
    ahead: NDArray[np.floating],
) -> None:
    """Draw the lips and the mouth centre now, and the centres to come, onto ``image``.

    At the lower right the mouth is shown magnified, with the same drawn in: five frames are soon
    over, and a mouth goes a few pixels in them.

    Args:
        image: is drawn on.
        landmarks: (L, 2 or 3) now, normalised image coordinates.
        ahead: (H, L, 2) forecast, in the same.
    """
    import cv2

    size = np.array([image.shape[1], image.shape[0]])
    lips = landmarks[list(LIPS), :2] * size
    path = np.vstack([mouth_centre(landmarks)[None], mouth_centre(ahead)]) * size
    face = float(np.ptp(landmarks[:, 0]) * size[0])
    window = _window(path[0], face)
    side = int(INSET * size.min())
    inset = window.cut(image, side)
    _draw_path(image, lips, path, max(1.5, 0.012 * face))
    scale = side / window.side
    corner = np.array([window.left, window.top])
    _draw_path(inset, (lips - corner) * scale, (path - corner) * scale, max(2.0, 0.012 * side))
    cv2.rectangle(inset, (0, 0), (side - 1, side - 1), WHITE, 1)
    image[-side:, -side:] = inset


def draw_lines(image: NDArray[np.uint8], lines: Sequence[tuple[str, Colour]]) -> None:
    """Write lines of text at the top left of ``image``, on a dark ground, sized to it."""
    import cv2

    if not lines:
        return
    scale = max(0.35, min(image.shape[:2]) / 800)
    widest = max(cv2.getTextSize(text, _FONT, scale, 1)[0][0] for text, _ in lines)
    room = image.shape[1] - round(30 * scale)
    if widest > room > 0:
        scale *= room / widest
        widest = room
    step = round(30 * scale)
    ground = image[: step * len(lines) + step // 2, : widest + step]
    ground[:] = (ground * 0.45).astype(np.uint8)
    for number, (text, colour) in enumerate(lines, start=1):
        place = (step // 2, step * number)
        cv2.putText(image, text, place, _FONT, scale, colour, 1, cv2.LINE_AA)


def _window(mouth: NDArray[np.floating], face: float) -> Crop:
    """The square around the mouth that is magnified."""
    side = max(round(0.6 * face), 8)
    left, top = np.round(mouth - side / 2).astype(int)
    return Crop(int(left), int(top), side)


def _draw_path(
    image: NDArray[np.uint8],
    lips: NDArray[np.floating],
    path: NDArray[np.floating],
    radius: float,
) -> None:
    """Dots for the lips (P, 2), the mouth now, and in every later frame (H + 1, 2), in pixels."""
    import cv2

    for point in lips:
        _dot(image, point, radius / 2, GREEN)
    shades = [GREEN, *_shades(len(path) - 1)]
    _dot(image, path[0], radius + 1.5, BLACK)
    for start, end, colour in zip(path[:-1], path[1:], shades[1:], strict=True):
        cv2.line(image, _fixed(start), _fixed(end), colour, 1, cv2.LINE_AA, _SHIFT)
    for point, colour in zip(path, shades, strict=True):
        _dot(image, point, radius, colour)


def _shades(count: int) -> list[Colour]:
    """Colours from `NEAR` to `FAR`."""
    weights = np.linspace(0.0, 1.0, count)[:, None]
    mixed = np.round((1 - weights) * NEAR + weights * FAR).astype(int)
    return [(int(r), int(g), int(b)) for r, g, b in mixed]


def _dot(
    image: NDArray[np.uint8], point: NDArray[np.floating], radius: float, colour: Colour
) -> None:
    import cv2

    size = max(1, round(radius * 2**_SHIFT))
    cv2.circle(image, _fixed(point), size, colour, -1, cv2.LINE_AA, _SHIFT)


def _fixed(point: NDArray[np.floating]) -> tuple[int, int]:
    """OpenCV counts from the middle of the first pixel."""
    x, y = np.round((np.clip(point, -1e4, 1e5) - 0.5) * 2**_SHIFT).astype(int)
    return int(x), int(y)
