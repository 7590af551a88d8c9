"""The live loop: detector, predictor and display in turn, with their times.

The display is drawn over the image, in a window or an H.264 file. Images are RGB, (rows, columns,
3) uint8. Legend: L landmarks, H horizon.
"""

from __future__ import annotations

import os
import re
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from face_prediction.evaluation.video import Colour, draw_dot, draw_line, h264_file
from face_prediction.forecast import mouth_centre
from face_prediction.live.sources import FindFace
from face_prediction.live.streaming import LiveForecast, StreamingPredictor
from face_prediction.tracking.geometry import LIPS, Crop
from face_prediction.tracking.video import VideoFrame
from robo_manip_baselines.runs.errors import RequestError
from robo_manip_baselines.runs.markdown import markdown_table

RECENT = 30  # frames that the rates on the screen are averaged over
STAGES = ("detector", "predictor", "whole")
TITLE = "face-prediction live"
WHITE: Colour = (255, 255, 255)
GREEN: Colour = (80, 230, 110)  # the mouth now, and the lips
NEAR: Colour = (255, 225, 60)  # the mouth in the nearest frame that is forecast
FAR: Colour = (255, 60, 40)  # and in the farthest
INSET = 0.34
"""Side of the magnified mouth as a share of the image's shorter side."""
_ESCAPE = 27
_FONT = 0  # OpenCV's FONT_HERSHEY_SIMPLEX; OpenCV is imported only when something is drawn

Show = Callable[[NDArray[np.uint8], float], bool]
"""Takes an image of a time in seconds; returns False once the user has seen enough."""


@dataclass
class LiveStatistics:
    """Times and counts of a run so far; kept up to date, so that an interrupted one has them too.

    Attributes:
        seconds: of each stage, frame by frame; the predictor's only with a face.
        frames: number of them.
        faces: frames with a face.
        crops: crops that were laid.
    """

    seconds: dict[str, list[float]] = field(default_factory=lambda: {name: [] for name in STAGES})
    frames: int = 0
    faces: int = 0
    crops: int = 0

    def times_table(self) -> str:
        """Mean and 95 % quantile of every stage, as Markdown."""
        rows = []
        for stage, seconds in self.seconds.items():
            if seconds:
                mean, high = 1e3 * np.mean(seconds), 1e3 * np.quantile(seconds, 0.95)
                times = (f"{value:.1f}" for value in (mean, high, 1e3 / mean))
                rows.append((stage, len(seconds), *times))
        return markdown_table(["", "frames", "mean ms", "95 % ms", "a second"], rows)


def run_loop(
    frames: Iterable[VideoFrame],
    find: FindFace,
    predictor: StreamingPredictor,
    show: Show,
    name: str,
    history: int,
    statistics: LiveStatistics,
    clock: Callable[[], float] = time.perf_counter,
) -> None:
    """Find, forecast, draw and show, until there are no more frames or the user has seen enough.

    The predictor, whose ``name`` is on the screen, is in its first state; ``history`` is the number
    of frames of a whole history; ``statistics`` are filled.
    """
    last = None
    for frame in frames:
        begun = clock()
        landmarks = None if frame.is_damaged else find(frame.image, frame.time)
        found = clock()
        forecast = predictor.update(frame.time, landmarks, frame.image)
        done = clock()
        statistics.seconds["detector"].append(found - begun)
        statistics.frames += 1
        image = frame.image.copy()
        if landmarks is not None and forecast is not None:
            statistics.seconds["predictor"].append(done - found)
            statistics.faces += 1
            statistics.crops += forecast.is_new_crop
            draw_mouth(image, landmarks, forecast.landmarks)
        draw_text(image, captions(statistics, forecast, name, history))
        goes_on = show(image, frame.time)
        ended = clock()
        # from image to image, the wait for the camera included
        statistics.seconds["whole"].append(ended - (begun if last is None else last))
        last = ended
        if not goes_on:
            return


def captions(
    statistics: LiveStatistics, forecast: LiveForecast | None, name: str, history: int
) -> list[tuple[str, Colour]]:
    """The lines on the screen."""
    lines: list[tuple[str, Colour]] = []
    for stage, seconds in statistics.seconds.items():
        mean = float(np.mean(seconds[-RECENT:])) if seconds else 0.0
        if mean > 0:
            lines.append((f"{stage} {1e3 * mean:.1f} ms, {1 / mean:.0f} a second", WHITE))
    if forecast is None:
        lines.append(("face lost", NEAR))
    elif forecast.known < history:
        lines.append((f"{name}: {forecast.known} of {history} frames seen", NEAR))
    else:
        count = len(forecast.landmarks)
        lines.append((f"{name}: mouth now (green) and in 1 to {count} frames", GREEN))
    return lines


@contextmanager
def video_sink(path: Path, rate: float) -> Iterator[Show]:
    """An H.264 file, in which every image keeps its own time; ``rate`` images a second or so.

    Raises:
        RequestError: the folder cannot be written to, or there was no image.
    """
    with h264_file(path, rate, preset="veryfast", is_timed=True) as append:

        def show(image: NDArray[np.uint8], time: float) -> bool:
            append(image, time)
            return True

        yield show


@contextmanager
def window_sink() -> Iterator[Show]:
    """A window on the screen; Escape, q or its close button end it.

    Raises:
        RequestError: this OpenCV has no windows, or there is no screen.
    """
    import cv2

    gui = re.search(r"^\s*GUI:\s*(\S+)", cv2.getBuildInformation(), re.MULTILINE)
    if gui and gui.group(1).upper() == "NONE":
        raise RequestError(
            "the OpenCV that is installed (opencv-python-headless) opens no window; name a file "
            "with --out"
        )
    screen = os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    if sys.platform == "linux" and not screen:
        raise RequestError("there is no screen ($DISPLAY is not set); name a file with --out")

    def show(image: NDArray[np.uint8], time: float) -> bool:
        cv2.imshow(TITLE, np.ascontiguousarray(image[..., ::-1]))
        is_ended = cv2.waitKey(1) & 0xFF in (_ESCAPE, ord("q"))
        return not is_ended and cv2.getWindowProperty(TITLE, cv2.WND_PROP_VISIBLE) >= 1

    cv2.namedWindow(TITLE, cv2.WINDOW_NORMAL)
    try:
        yield show
    finally:
        cv2.destroyAllWindows()


def draw_mouth(
    image: NDArray[np.uint8], landmarks: NDArray[np.floating], ahead: NDArray[np.floating]
) -> None:
    """Draw the lips and the mouth centre now, and the forecast centres, onto ``image``.

    Landmarks (L, 2 or 3) are those now, and (H, L, 2) ``ahead``, in normalised image coordinates.
    At the lower right the mouth is magnified, with the same drawn in: five frames are soon over,
    and a mouth goes a few pixels in them.
    """
    import cv2

    size = np.array([image.shape[1], image.shape[0]])
    lips = landmarks[list(LIPS), :2] * size
    path = np.vstack([mouth_centre(landmarks)[None], mouth_centre(ahead)]) * size
    face = float(np.ptp(landmarks[:, 0]) * size[0])
    window = max(round(0.6 * face), 8)
    left, top = np.round(path[0] - window / 2).astype(int).tolist()
    side = int(INSET * size.min())
    inset = Crop(left, top, window).cut(image, side)
    _draw_path(image, lips, path, max(1.5, 0.012 * face))
    corner, scale = np.array([left, top]), side / window
    _draw_path(inset, (lips - corner) * scale, (path - corner) * scale, max(2.0, 0.012 * side))
    cv2.rectangle(inset, (0, 0), (side - 1, side - 1), WHITE, 1)
    image[-side:, -side:] = inset


def draw_text(image: NDArray[np.uint8], lines: Sequence[tuple[str, Colour]]) -> None:
    """Write lines of text at the top left of ``image``, on a dark ground, sized to it."""
    import cv2

    if not lines:
        return
    scale = max(0.35, min(image.shape[:2]) / 800)
    widest = max(cv2.getTextSize(text, _FONT, scale, 1)[0][0] for text, _ in lines)
    room = image.shape[1] - round(30 * scale)
    if widest > room > 0:
        scale, widest = scale * (room / widest), room
    step = round(30 * scale)
    ground = image[: step * len(lines) + step // 2, : widest + step]
    ground[:] = (ground * 0.45).astype(np.uint8)
    for number, (text, colour) in enumerate(lines, start=1):
        place = (step // 2, step * number)
        cv2.putText(image, text, place, _FONT, scale, colour, 1, cv2.LINE_AA)


def _draw_path(
    image: NDArray[np.uint8], lips: NDArray[np.floating], path: NDArray[np.floating], radius: float
) -> None:
    """Dots for the lips (P, 2), the mouth now, and in every later frame (H + 1, 2), in pixels."""
    # OpenCV counts from the middle of the first pixel
    lips, path = lips - 0.5, path - 0.5
    weights = np.linspace(0.0, 1.0, len(path) - 1)[:, None]
    shades = np.round((1 - weights) * NEAR + weights * FAR).astype(int).tolist()
    for point in lips:
        draw_dot(image, point, radius / 2, GREEN)
    draw_dot(image, path[0], radius + 1.5, (0, 0, 0))
    for start, end, colour in zip(path[:-1], path[1:], shades, strict=True):
        draw_line(image, start, end, colour, 1)
    for point, colour in zip(path, [GREEN, *shades], strict=True):
        draw_dot(image, point, radius, colour)
