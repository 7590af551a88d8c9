"""Videos of episodes, small enough for dozens of them to travel in one page."""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from pathlib import Path

import av
import cv2
import numpy as np

from robo_manip_baselines.errors import RequestError
from robo_manip_baselines.evaluation.statistics.lines import Line
from robo_manip_baselines.evaluation.statistics.study import Study
from robo_manip_baselines.evaluation.video import VideoWriter

WIDTH = 1280
"""pixels at most: as wide as the page."""

FRAME_STEP = 2
"""Of so many frames one is kept: 12.5 in a second."""

QUALITY = 30
"""crf of libx264; with the above, 12 s of four views are a tenth of what an evaluation writes."""

POSTER_QUALITY = 80
"""of the JPEG."""


@dataclass(frozen=True)
class EpisodeVideo:
    """The video of an episode.

    Attributes:
        line: what the episode came to.
        content: an mp4 file, H.264.
        poster: a JPEG file, shown before it plays: the last frame, which says how it ended.
    """

    line: Line
    content: bytes
    poster: bytes


def episodes_to_show(study: Study) -> tuple[Line, ...]:
    """Pick the episodes whose videos a report wants: of each arm a success and a failure.

    The first by training seed, then by seed, so that nobody has chosen them. Of failures, the first
    of the most frequent kind.
    """
    picked: list[Line] = []
    for figures in study.arms:
        lines = sorted(
            figures.lines, key=lambda line: (line.result.train_seed or 0, line.result.seed)
        )
        kinds = [line.result.failure for line in lines if not line.result.is_success]
        wanted = ["", max(kinds, key=kinds.count)] if kinds else [""]
        for kind in wanted:
            picked += [line for line in lines if line.result.failure == kind][:1]
    return tuple(picked)


def read_video(path: Path, line: Line) -> EpisodeVideo:
    """Read the video of an episode and make it small.

    Args:
        path: as evaluations write it, see ``policy_video``.
        line: what the episode came to.

    Raises:
        RequestError: there is none, or it cannot be played.
    """
    try:
        with tempfile.TemporaryDirectory() as folder, av.open(str(path)) as source:
            small = Path(folder) / "small.mp4"
            (track,) = source.streams.video
            rate = float(track.average_rate or 0) / FRAME_STEP
            width = min(WIDTH, track.width)
            height = round(width * track.height / track.width)
            image = np.empty((0, 0, 3), dtype=np.uint8)
            with VideoWriter(small, rate, crf=QUALITY) as video:
                for number, frame in enumerate(source.decode(track)):
                    if number % FRAME_STEP == 0:
                        full = frame.to_ndarray(format="rgb24")
                        image = np.asarray(
                            cv2.resize(full, (width, height), interpolation=cv2.INTER_AREA)
                        )
                        video.write(image)
            return EpisodeVideo(line, small.read_bytes(), _jpeg(image))
    except (OSError, ValueError) as error:  # PyAV's errors are of these kinds
        raise RequestError(
            f"video '{path}' cannot be read ({error}); evaluate with --video, or leave it out"
        ) from error


def _jpeg(image: np.ndarray) -> bytes:
    bgr = cv2.cvtColor(image, cv2.COLOR_RGB2BGR)
    return cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, POSTER_QUALITY])[1].tobytes()
