"""The live loop: detector, predictor and display in turn, with their times."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field

import numpy as np

from face_prediction.live.display import GREEN, NEAR, WHITE, Colour, Show, draw_mouth, draw_text
from face_prediction.live.sources import FindFace
from face_prediction.live.streaming import LiveForecast, StreamingPredictor
from face_prediction.tracking.video import VideoFrame

RECENT = 30  # frames that the rates on the screen are averaged over
STAGES = ("detector", "predictor", "whole")


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
        lines = ["| | frames | mean ms | 95 % ms | a second |", "|---|---|---|---|---|"]
        for stage, seconds in self.seconds.items():
            if seconds:
                mean, high = 1e3 * np.mean(seconds), 1e3 * np.quantile(seconds, 0.95)
                times = f"{mean:.1f} | {high:.1f} | {1e3 / mean:.1f}"
                lines.append(f"| {stage} | {len(seconds)} | {times} |")
        return "\n".join(lines)


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
        landmarks = find(frame.image, frame.time)
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
