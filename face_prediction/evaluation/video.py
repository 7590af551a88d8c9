"""H.264 video, and the timeline of a clip with forecasts drawn ahead of the truth.

Coordinates are pixels of the clip's images or of the video, (x, y) floats, 0 at the outer edge of
the first pixel. Legend: T frames, W forecasts, H horizon.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from fractions import Fraction
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from face_prediction.dataset.clip_file import open_clip, read_array
from face_prediction.dataset.manifest import CLIP_FOLDER
from face_prediction.dataset.reader import FaceDataset
from face_prediction.evaluation.error_stats import neighbours
from face_prediction.evaluation.figures import new_matplotlib_figure
from face_prediction.evaluation.scoring import EvaluationScores
from face_prediction.evaluation.setup import PERSISTENCE
from face_prediction.evaluation.statistics import KindSummary
from face_prediction.forecast.interface import mouth_centre
from face_prediction.prediction.errors import mouth_distances
from face_prediction.tracking.geometry import Crop
from robo_manip_baselines.runs.errors import RequestError
from robo_manip_baselines.runs.videos import h264_stream

Floats = NDArray[np.float64]
Image = NDArray[np.uint8]
Colour = tuple[int, int, int]

LEAD = 20  # frames before the first forecast, so that it does not come at once
LONGEST = 6.0  # seconds of a clip in the video, at most
SLOWED = 3  # seconds that a second of footage takes, so that five frames can be followed by eye
PAUSE = 6  # images for which a forecast stands still, unless there is one at almost every frame
SIZE = (1280, 560)  # pixels of the video: width and height, both even
VIEW = 0.55  # share of the crop that the image of the face covers, around the mouth
TRUTH, TRUTH_ON_IMAGE = (0, 0, 0), (255, 255, 255)  # in the plots, and on the image of the face
FORECASTS = ((230, 90, 0), (0, 114, 178))  # orange and blue
_CLOCK = 90_000  # ticks a second of the times in a file, as cameras and broadcasts have it
_SHIFT = 4  # OpenCV draws at sixteenths of a pixel


@contextmanager
def h264_file(
    path: Path, rate: float, *, preset: str, threads: int = 0, is_timed: bool = False
) -> Iterator[Callable[..., None]]:
    """An H.264 file that browsers play, there when it is whole and not before.

    Yields a function that appends an image (rows, columns, 3) uint8 RGB, and, if the file is
    timed, its time in seconds. An odd row or column at the edge is left out, because 4:2:0 video
    has even sizes only.

    Args:
        path: file to write, ``….mp4``.
        rate: images a second; if the file is timed, about how many.
        preset: of libx264.
        threads: of the encoder; with 1 the same images give the same bytes on every machine.
        is_timed: every image has its own time, whatever the rate. Where the first time is below
            0, which a file cannot hold, all are later by as much.

    Raises:
        RequestError: the folder cannot be written to, or there was no image.
    """
    import av  # not needed to make tables

    count = last_tick = begin = 0
    about = Fraction(rate).limit_denominator(1001)
    settings = {"crf": 20, "preset": preset, "threads": threads}
    with h264_stream(path, about, **settings) as (container, stream):
        if is_timed:
            stream.codec_context.time_base = Fraction(1, _CLOCK)

        def append(image: Image, time: float = 0.0) -> None:
            nonlocal count, last_tick, begin
            height, width = (side // 2 * 2 for side in image.shape[:2])
            if not count:
                stream.height, stream.width = height, width
            pixels = np.ascontiguousarray(image[:height, :width])
            frame = av.VideoFrame.from_ndarray(pixels, format="rgb24")
            if is_timed:
                tick = round(time * _CLOCK)
                begin = begin if count else min(tick, 0)
                last_tick = max(tick - begin, last_tick + 1 if count else 0)
                frame.time_base, frame.pts = Fraction(1, _CLOCK), last_tick
            container.mux(stream.encode(frame))
            count += 1

        yield append
        if not count:
            raise RequestError(f"{path}: there was no image to write")


def draw_line(image: Image, start: Floats, end: Floats, colour: Colour, thickness: int) -> None:
    """Draw a line between points that are finite."""
    import cv2

    if np.isfinite([start, end]).all():
        cv2.line(image, _fixed(start), _fixed(end), colour, thickness, cv2.LINE_AA, _SHIFT)


def draw_dot(image: Image, point: Floats, radius: float, colour: Colour) -> None:
    """Draw a filled circle at a point that is finite."""
    import cv2

    if np.isfinite(point).all():
        size = max(1, round(radius * 2**_SHIFT))
        cv2.circle(image, _fixed(point), size, colour, -1, cv2.LINE_AA, _SHIFT)


def _fixed(point: Floats) -> tuple[int, int]:
    """Sixteenths of a pixel, far enough inside what OpenCV's integers hold."""
    x, y = np.clip(np.round(point * 2**_SHIFT), -1e6, 1e6).astype(int).tolist()
    return x, y


@dataclass(frozen=True)
class ForecastTimeline:
    """Truth and forecasts along a clip; places are pixels of the clip's own images.

    Attributes:
        frames: (T,) frame numbers in the clip, increasing; ``fps`` a second.
        mouth: (T, 2) true mouth centre.
        images: T of (S, S, 3) uint8, as the dataset holds them.
        crops: T, the part of the clip's image that each image is.
        forecasts: name and forecasts (W, H, 2) of the mouth centre of each predictor.
        origins: (W,) frame numbers of the last frames of the histories.
    """

    clip: str
    frames: NDArray[np.int64]
    fps: float
    mouth: Floats
    images: Sequence[Image]
    crops: Sequence[Crop]
    forecasts: Sequence[tuple[str, Floats]]
    origins: NDArray[np.int64]


def forecast_timeline(
    dataset: FaceDataset, indices: Sequence[int], residuals: Sequence[tuple[str, Floats]]
) -> ForecastTimeline:
    """The timeline of sequences that follow one another in a clip.

    Args:
        dataset: open for reading.
        indices: W sequences, each beginning the stride after the one before it.
        residuals: name and errors (W, H, 2) in crops of each predictor.
    """
    settings = dataset.manifest.settings
    clip = dataset.entry(indices[0]).clip
    path = dataset.folder / CLIP_FOLDER / f"{clip}.h5"
    with open_clip(path) as file:
        corners = read_array(path, file, "sequences/crop")
        starts = read_array(path, file, "sequences/start")
    first = next(i for i in range(len(dataset)) if dataset.entry(i).clip == clip)
    frames, mouth, images, crops, origins = [], [], [], [], []
    forecasts = [(name, np.empty_like(errors)) for name, errors in residuals]
    for place, index in enumerate(indices):
        crop = Crop(*map(int, corners[index - first]))
        start = int(starts[index - first])
        centres = (crop.left, crop.top) + crop.side * mouth_centre(dataset.landmarks(index))
        for (_, errors), (_, forecast) in zip(residuals, forecasts, strict=True):
            forecast[place] = centres[settings.history :] + crop.side * errors[place]
        origins.append(start + settings.history - 1)
        # each sequence adds what is new in its history, the last one also what was to be forecast
        begin = max(settings.history - (settings.stride if place else LEAD), 0)
        end = settings.length if place == len(indices) - 1 else settings.history
        frames += range(start + begin, start + end)
        mouth += list(centres[begin:end])
        images += list(dataset.images(index, slice(begin, end)))
        crops += [crop] * (end - begin)
    seen = (np.array(frames), settings.fps, np.stack(mouth), images, crops)
    return ForecastTimeline(clip, *seen, forecasts, np.array(origins))


def write_forecast_video(
    path: Path, dataset: FaceDataset, scores: EvaluationScores, summary: KindSummary
) -> None:
    """The best network, or else the best baseline, and what it is compared with, on one clip.

    Raises:
        RequestError: matplotlib is not installed, or the folder cannot be written to.
    """
    settings = dataset.manifest.settings
    run = _lively_run(scores, summary.kind, settings.stride, settings.fps)
    distance = summary.numbers["pooled_distance"].value
    networks = [i for i, row in enumerate(summary.rows) if row.role == "network"]
    names = [summary.best_baseline]
    if networks and np.isfinite(distance[networks]).any():
        names.insert(0, summary.rows[networks[int(np.nanargmin(distance[networks]))]].name)
    elif summary.best_baseline != PERSISTENCE:
        names.append(PERSISTENCE)
    residuals = [(name, scores.row(name).residuals[run]) for name in names]
    timeline = forecast_timeline(dataset, scores.selection.indices[run].tolist(), residuals)
    with h264_file(path, timeline.fps / SLOWED, preset="medium", threads=1) as append:
        for image in timeline_images(timeline):
            append(image)


def timeline_images(timeline: ForecastTimeline) -> Iterator[Image]:
    """The images (560, 1280, 3) of the video: one for each of T frames, and the pauses."""
    stage, horizon = _Stage(timeline), timeline.forecasts[0][1].shape[1]
    # a new forecast comes before the last one has been caught up with
    is_dense = np.any(np.diff(timeline.origins) < horizon)
    for number, frame in enumerate(timeline.frames.tolist()):
        image = stage.draw(number)
        yield from [image] * (1 + PAUSE * (frame in timeline.origins and not is_dense))


class _Stage:
    """The axes, drawn once, and how frames are drawn on them: the face, and U and V over time."""

    def __init__(self, timeline: ForecastTimeline) -> None:
        self.timeline = timeline
        figure = new_matplotlib_figure(SIZE[0] / 100, SIZE[1] / 100)
        grid = figure.add_gridspec(2, 2, width_ratios=(1, 1.4))
        face = figure.add_subplot(grid[:, 0])
        face.set(aspect="equal", xticks=[], yticks=[])
        face.set_title(f"{timeline.clip}, {SLOWED} times slower", fontsize=13, parse_math=False)
        seconds = timeline.frames / timeline.fps
        plots: list[Any] = []
        for axis, label in enumerate(("mouth to the right, px", "mouth down, px")):
            plot = figure.add_subplot(grid[axis, 1])
            ahead = [forecasts[..., axis].ravel() for _, forecasts in timeline.forecasts]
            values = np.concatenate([timeline.mouth[:, axis], *ahead])
            low, high = float(np.nanmin(values)), float(np.nanmax(values))
            room = 0.08 * (high - low) + 0.5
            plot.set_ylim(low - room, high + room)
            if axis:
                plot.invert_yaxis()
            plot.set_xlim(seconds[0], seconds[-1] + 0.05)
            plot.set_ylabel(label, fontsize=12)
            plot.tick_params(labelsize=11)
            plot.grid(alpha=0.3)
            plots.append(plot)
        plots[1].set_xlabel("time in the clip, s", fontsize=12)
        names = [f"forecast, {name}" for name, _ in timeline.forecasts]
        names.insert(0, "true mouth centre (white on the image)")
        for name, colour in zip(names, (TRUTH, *FORECASTS), strict=False):
            plots[0].plot([], [], color=np.array(colour) / 255, lw=3, label=name)
        figure.legend(loc="outside upper right", ncols=3, fontsize=12)
        figure.canvas.draw()
        self.background = np.asarray(figure.canvas.buffer_rgba())[..., :3].copy()
        box = face.get_window_extent()
        self.left, self.top = round(box.x0), round(SIZE[1] - box.y1)
        self.side = int(min(box.width, box.height))
        # transforms (seconds, pixels of the clip) to pixels of the video, for U and V
        self.transforms = [plot.transData.frozen() for plot in plots]
        extent = float(np.ptp(timeline.mouth, axis=0).max())
        side = max(VIEW * float(np.mean([crop.side for crop in timeline.crops])), 1.3 * extent)
        middle = (timeline.mouth.min(axis=0) + timeline.mouth.max(axis=0)) / 2
        left, top = np.round(middle - side / 2).astype(int).tolist()
        # the part of the clip's images around the mouth that stands still
        self.view = Crop(left, top, round(side))

    def draw(self, number: int) -> Image:
        """The image at frame ``number``: nothing on it is later, but the forecasts."""
        timeline = self.timeline
        image, face = self.background.copy(), self._face(number)
        past = timeline.mouth[max(0, number - LEAD) : number + 1]
        self._path(face, self._on_face(past), TRUTH_ON_IMAGE)
        made = np.flatnonzero(timeline.origins <= timeline.frames[number]).tolist()
        pairs = list(zip(timeline.forecasts, FORECASTS, strict=False))
        for (_, forecasts), colour in reversed(pairs):  # the first, drawn last, is on top
            for k in made:
                origin = timeline.origins[k]
                begin = timeline.mouth[timeline.frames == origin][:1]
                ahead = np.concatenate([begin, forecasts[k]])
                for axis in range(2):
                    points = self._on_plot(axis, origin + np.arange(len(ahead)), ahead[:, axis])
                    self._path(image, points, colour)
                if k == made[-1]:
                    on_face = self._on_face(ahead)
                    self._path(face, on_face, colour)
                    for point in on_face[1:]:
                        self._dot(face, point, colour, 4)
        for axis in range(2):
            seen = slice(number + 1)
            points = self._on_plot(axis, timeline.frames[seen], timeline.mouth[seen, axis])
            self._path(image, points, TRUTH)
            self._dot(image, points[-1], TRUTH, 4)
        self._dot(face, self._on_face(timeline.mouth[number]), TRUTH_ON_IMAGE, 5)
        image[self.top : self.top + self.side, self.left : self.left + self.side] = face
        return image

    def _face(self, number: int) -> Image:
        """The clip's image under the view; black where none was cut."""
        import cv2  # not needed to make tables

        crop, image = self.timeline.crops[number], self.timeline.images[number]
        scale = self.side / self.view.side
        grow = scale * crop.side / image.shape[0]
        # pixel centres are at halves: pixel 0 of the image covers 0 to 1
        corner = np.array([crop.left - self.view.left, crop.top - self.view.top])
        x, y = scale * corner + grow / 2 - 0.5
        matrix, size = np.array([[grow, 0, x], [0, grow, y]]), (self.side, self.side)
        return np.asarray(cv2.warpAffine(image, matrix, size, flags=cv2.INTER_LINEAR), np.uint8)

    def _on_face(self, points: Floats) -> Floats:
        """Pixels (..., 2) of the clip's images on the image of the face."""
        return (points - (self.view.left, self.view.top)) * (self.side / self.view.side)

    def _on_plot(self, axis: int, frames: NDArray[np.integer], values: Floats) -> Floats:
        """Pixels (n, 2) of the video of points of a plot."""
        seconds = frames / self.timeline.fps
        points = self.transforms[axis].transform(np.stack([seconds, values], axis=-1))
        return np.stack([points[:, 0], SIZE[1] - points[:, 1]], axis=-1)

    @staticmethod
    def _path(image: Image, points: Floats, colour: Colour) -> None:
        for start, end in pairwise(points):
            draw_line(image, start, end, colour, 2)

    @staticmethod
    def _dot(image: Image, point: Floats, colour: Colour, radius: int) -> None:
        """A dot with a dark rim, to be seen on skin as well as on paper."""
        draw_dot(image, point, radius + 0.75, (0, 0, 0))
        draw_dot(image, point, radius, colour)


def _lively_run(scores: EvaluationScores, kind: str, stride: int, fps: float) -> NDArray[np.intp]:
    """Places of successive sequences of one clip of a kind, `LONGEST` in all at most.

    Of the longest that there are, the one whose mouth moves more than three quarters of the others'
    do, by the error of persistence: with too little motion there is nothing to see.
    """
    selection = scores.selection
    places = selection.of_kind(kind)
    rows = selection.rows_at(places)
    runs = neighbours([row.clip for row in rows], [row.start for row in rows], stride)
    count = max(1, int(LONGEST * fps) // stride)
    parts = [run[i : i + count] for run in runs for i in range(0, len(run), count)]
    longest = max(map(len, parts))
    candidates = [places[part] for part in parts if len(part) == longest]
    size = mouth_distances(scores.row(PERSISTENCE).residuals)
    candidates.sort(key=lambda part: float(size[part].mean()))
    return candidates[int(0.75 * (len(candidates) - 1))]
