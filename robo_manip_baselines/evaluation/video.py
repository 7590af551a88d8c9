"""Videos of what happened: pictures side by side, tracks and captions drawn in, H.264 written.

Images are RGB, (H, W, 3) uint8; drawing functions return a new image and leave theirs alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import ExitStack
from fractions import Fraction
from pathlib import Path
from types import TracebackType

import av
import cv2
import numpy as np

from robo_manip_baselines.data.files import atomic_file

Colour = tuple[int, int, int]

YELLOW: Colour = (255, 214, 10)
WHITE: Colour = (255, 255, 255)
BLACK: Colour = (0, 0, 0)


class VideoWriter:
    """An H.264 file that browsers play, there when it is whole and not before.

    Use as a context manager; the file appears when the block ends well. The first frame decides
    the size; an odd height or width gets a row or column of its edge repeated, because 4:2:0
    video has even sizes only.

    Args:
        path: file to write, ``….mp4``.
        fps: frames a second.
        crf: quality of libx264, 0 (lossless) to 51; 20 shows no blocks in rendered scenes.
    """

    def __init__(self, path: str | Path, fps: float, *, crf: int = 20) -> None:
        if fps <= 0:
            raise ValueError(f"a video needs a positive number of frames a second, not {fps}")
        self.path = Path(path)
        self._fps = Fraction(fps).limit_denominator(1001)
        self._crf = crf
        self._stack = ExitStack()
        self._shape: tuple[int, ...] | None = None

    def __enter__(self) -> VideoWriter:
        temporary = self._stack.enter_context(atomic_file(self.path))
        # The index goes to the front so that a browser starts to play before all has arrived.
        self._container = self._stack.enter_context(
            av.open(str(temporary), "w", format="mp4", options={"movflags": "+faststart"})
        )
        stream = self._container.add_stream("libx264", rate=self._fps)
        stream.pix_fmt = "yuv420p"
        stream.options = {"crf": str(self._crf), "preset": "medium"}
        stream.codec_context.thread_count = 1  # the same bytes whatever the number of cores
        self._stream = stream
        return self

    def __exit__(
        self,
        exc_type: type[BaseException] | None,
        exc: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        if exc is None:
            try:
                self._finish()
            except BaseException as error:
                self._stack.__exit__(type(error), error, error.__traceback__)
                raise
        self._stack.__exit__(exc_type, exc, traceback)

    def write(self, image: np.ndarray) -> None:
        """Append a frame.

        Raises:
            ValueError: if it is not (H, W, 3) uint8, or unlike the first.
        """
        if image.ndim != 3 or image.shape[2] != 3 or image.dtype != np.uint8:
            raise ValueError(f"a frame is (H, W, 3) uint8, not {image.shape} {image.dtype}")
        even = pad_to_even(image)
        if self._shape is None:
            self._shape = image.shape
            self._stream.height, self._stream.width = even.shape[:2]
        if image.shape != self._shape:
            raise ValueError(f"frame of {image.shape} in a video of {self._shape}")
        frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(even), format="rgb24")
        self._container.mux(self._stream.encode(frame))

    def _finish(self) -> None:
        if self._shape is None:
            raise ValueError(f"no frame was written to '{self.path}'")
        self._container.mux(self._stream.encode(None))


def pad_to_even(image: np.ndarray) -> np.ndarray:
    """Repeat the last row or column of an image with an odd height or width."""
    height, width = image.shape[:2]
    return np.pad(image, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge")


def side_by_side(images: Sequence[np.ndarray]) -> np.ndarray:
    """Join images of any sizes in a row, each scaled to the height of the first.

    Returns:
        (H, sum of widths, 3) uint8.
    """
    if not images:
        raise ValueError("no image to put side by side")
    height = images[0].shape[0]
    row: list[np.ndarray] = []
    for image in images:
        if image.shape[0] != height:
            width = max(1, round(image.shape[1] * height / image.shape[0]))
            is_smaller = height < image.shape[0]
            method = cv2.INTER_AREA if is_smaller else cv2.INTER_LINEAR
            image = np.asarray(cv2.resize(image, (width, height), interpolation=method))
        row.append(image)
    return np.concatenate(row, axis=1)


def draw_track(
    image: np.ndarray,
    points: np.ndarray,
    colour: Colour = YELLOW,
    *,
    thickness: int = 2,
    radius: int = 8,
) -> np.ndarray:
    """Draw where a point has been: a line that fades towards its past, a ring at its present.

    Args:
        image: (H, W, 3) uint8.
        points: (N, 2) pixels, x right and y down, oldest first; rows that are NaN (not in view)
            interrupt the line.
        colour: RGB.
        thickness: of the line, in pixels.
        radius: of the ring, in pixels.

    Returns:
        A new image.
    """
    points = np.asarray(points, dtype=np.float64).reshape(-1, 2)
    # Far outside the picture a line is cut off unseen; OpenCV's fixed-point numbers overflow.
    limit = 4 * max(image.shape)
    valid = np.isfinite(points).all(axis=1) & (np.abs(points) < limit).all(axis=1)
    fixed = np.round(np.where(valid[:, None], points, 0) * 16).astype(int)  # 1/16 pixel
    opacity = np.zeros(image.shape[:2], dtype=np.uint8)
    for index in range(1, len(points)):
        if valid[index - 1] and valid[index]:
            value = round(255 * (0.15 + 0.85 * index / (len(points) - 1)))
            _add_line(opacity, fixed[index - 1], fixed[index], thickness, value)
    drawn = _paint(image, opacity, colour)
    if len(points) and valid[-1]:
        centre = (int(fixed[-1][0]), int(fixed[-1][1]))
        # The dark rim lies outside only: what is in the ring stays to be seen.
        rim = radius * 16 + 8 * thickness + 8
        cv2.circle(drawn, centre, rim, BLACK, 1, cv2.LINE_AA, shift=4)
        cv2.circle(drawn, centre, radius * 16, colour, thickness, cv2.LINE_AA, shift=4)
    return drawn


def put_caption(image: np.ndarray, text: str) -> np.ndarray:
    """Write one line at the lower left, white with a dark rim, sized to the image.

    Returns:
        A new image.
    """
    height, width = image.shape[:2]
    scale = max(height / 700, 0.35)
    font = cv2.FONT_HERSHEY_SIMPLEX
    margin = round(12 * scale) + 4
    text_width = cv2.getTextSize(text, font, scale, 1)[0][0]
    if text_width > width - 2 * margin > 0:
        scale *= (width - 2 * margin) / text_width
    # The rim is grown from the letters: drawn thicker, letters of OpenCV 5 are also wider apart.
    opacity = np.zeros((height, width), dtype=np.uint8)
    cv2.putText(opacity, text, (margin, height - margin), font, scale, 255, 1, cv2.LINE_AA)
    rim = np.asarray(cv2.dilate(opacity, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (5, 5))))
    return _paint(_paint(image, rim, BLACK), opacity, WHITE)


def _paint(image: np.ndarray, opacity: np.ndarray, colour: Colour) -> np.ndarray:
    """Lay a colour over an image, opacity (H, W) uint8 from 0 to 255."""
    painted = image.copy()
    touched = opacity > 0
    weight = opacity[touched][:, None] / np.float32(255)
    mixed = image[touched] * (1 - weight) + np.asarray(colour, dtype=np.float32) * weight
    painted[touched] = np.round(mixed).astype(np.uint8)
    return painted


def _add_line(
    opacity: np.ndarray, start: np.ndarray, end: np.ndarray, thickness: int, value: int
) -> None:
    """Raise ``opacity`` to ``value`` along a line given in 1/16 pixels; crossings do not add."""
    height, width = opacity.shape
    low = np.maximum(np.minimum(start, end) // 16 - thickness - 2, 0)
    high = np.minimum(np.maximum(start, end) // 16 + thickness + 3, (width, height))
    if (high <= low).any():
        return
    region = opacity[low[1] : high[1], low[0] : high[0]]
    line = np.zeros_like(region)
    shift = low * 16
    first = (int(start[0] - shift[0]), int(start[1] - shift[1]))
    last = (int(end[0] - shift[0]), int(end[1] - shift[1]))
    cv2.line(line, first, last, value, thickness, cv2.LINE_AA, shift=4)
    np.maximum(region, line, out=region)
