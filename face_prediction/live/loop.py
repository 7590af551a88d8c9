"""Detector, predictor and picture in turn, with their times."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from face_prediction.live.sinks import GREEN, NEAR, WHITE, Colour, Sink, draw_lines, draw_mouth
from face_prediction.live.streaming import LiveForecast, StreamingPredictor
from face_prediction.tracking.video import VideoFrame

#: Frames that the rates on the screen are averaged over.
RECENT = 30
STAGES = ("detector", "predictor", "whole")

Find = Callable[[NDArray[np.uint8], float], NDArray[np.floating] | None]


@dataclass
class Times:
    """Seconds that each stage took, frame by frame; the predictor's only with a face."""

    seconds: dict[str, list[float]] = field(default_factory=lambda: {name: [] for name in STAGES})

    def recent(self, stage: str) -> float:
        """Mean of the last `RECENT` frames in seconds; NaN: none yet."""
        last = self.seconds[stage][-RECENT:]
        return float(np.mean(last)) if last else float("nan")

    def table(self) -> str:
        """Mean and 95 % quantile of every stage, as Markdown."""
        lines = ["| | frames | mean ms | 95 % ms | a second |", "|---|---|---|---|---|"]
        for stage, seconds in self.seconds.items():
            if seconds:
                mean, high = 1e3 * np.mean(seconds), 1e3 * np.quantile(seconds, 0.95)
                lines.append(
                    f"| {stage} | {len(seconds)} | {mean:.1f} | {high:.1f} | {1e3 / mean:.1f} |"
                )
        return "\n".join(lines)


@dataclass
class Summary:
    """What has come of a run so far; kept up to date, so that an interrupted one has it too."""

    times: Times = field(default_factory=Times)
    frames: int = 0
    #: frames with a face, and crops that were laid
    faces: int = 0
    crops: int = 0


def run_loop(
    frames: Iterable[VideoFrame],
    find: Find,
    predictor: StreamingPredictor,
    sink: Sink,
    name: str,
    history: int,
    summary: Summary,
    clock: Callable[[], float] = time.perf_counter,
) -> None:
    """Find, forecast, draw and show, until there are no more frames or the user has seen enough.

    Args:
        frames: images with their times.
        find: the detector.
        predictor: in its first state.
        sink: takes what is drawn.
        name: of the predictor, for the screen.
        history: frames of a whole history.
        summary: is filled.
        clock: seconds.
    """
    last: float | None = None
    for frame in frames:
        begun = clock()
        landmarks = find(frame.image, frame.time)
        found = clock()
        forecast = predictor.update(frame.time, landmarks, frame.image)
        done = clock()
        seconds = summary.times.seconds
        seconds["detector"].append(found - begun)
        summary.frames += 1
        if forecast is not None:
            seconds["predictor"].append(done - found)
            summary.faces += 1
            summary.crops += forecast.is_new_crop
        image = frame.image.copy()
        if landmarks is not None and forecast is not None:
            draw_mouth(image, landmarks, forecast.landmarks)
        draw_lines(image, captions(summary.times, forecast, name, history))
        goes_on = sink.show(image, frame.time)
        ended = clock()
        # from image to image: what waiting for the camera takes is part of it
        seconds["whole"].append(ended - (begun if last is None else last))
        last = ended
        if not goes_on:
            return


def captions(
    times: Times, forecast: LiveForecast | None, name: str, history: int
) -> list[tuple[str, Colour]]:
    """The lines on the screen."""
    lines: list[tuple[str, Colour]] = []
    for stage in STAGES:
        mean = times.recent(stage)
        if np.isfinite(mean) and mean > 0:
            lines.append((f"{stage} {1e3 * mean:.1f} ms, {1 / mean:.0f} a second", WHITE))
    if forecast is None:
        lines.append(("face lost", NEAR))
    elif forecast.known < history:
        lines.append((f"{name}: {forecast.known} of {history} frames seen", NEAR))
    else:
        count = len(forecast.landmarks)
        lines.append((f"{name}: mouth now (green) and in 1 to {count} frames", GREEN))
    return lines
