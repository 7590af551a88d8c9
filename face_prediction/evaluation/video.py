"""H.264 files that browsers play."""

from __future__ import annotations

import logging
import re
from collections.abc import Iterable, Iterator, Sequence
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
from face_prediction.evaluation.batches import Batch, PicturePlan
from face_prediction.evaluation.error_stats import neighbours
from face_prediction.evaluation.errors import mouth_distances
from face_prediction.evaluation.figures import (
    Shown,
    draw_calibration,
    draw_errors,
    draw_forecast,
    new_figure,
)
from face_prediction.evaluation.scoring import Verdict, forecast_of
from face_prediction.evaluation.setup import PERSISTENCE, LineUp
from face_prediction.evaluation.statistics import KindSummary
from face_prediction.forecast.interface import mouth_centre
from face_prediction.tracking.geometry import Crop
from robo_manip_baselines.runs.files import atomic_file


def write_h264(path: Path, images: Iterable[np.ndarray], fps: float, crf: int = 20) -> None:
    """Write ``images`` (H, W, 3) uint8 RGB, all of one even height and width, to ``path``.

    The same images give the same bytes. ``crf`` is libx264's quality, 0 (lossless) to 51.

    Raises:
        RequestError: the folder cannot be written to.
        ValueError: there is no image.
    """
    import av  # not needed to make tables

    with (
        atomic_file(path) as temporary,
        # the index goes to the front, so that a browser starts to play before all has arrived
        av.open(str(temporary), "w", format="mp4", options={"movflags": "+faststart"}) as container,
    ):
        stream = container.add_stream("libx264", rate=Fraction(fps).limit_denominator(1001))
        stream.pix_fmt = "yuv420p"
        stream.options = {"crf": str(crf), "preset": "medium"}
        stream.codec_context.thread_count = 1  # the same bytes whatever the number of cores
        count = 0
        for image in images:
            if not count:
                stream.height, stream.width = image.shape[:2]
            frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(image), format="rgb24")
            container.mux(stream.encode(frame))
            count += 1
        if not count:
            raise ValueError(f"no image for '{path}'")
        container.mux(stream.encode(None))


Floats = NDArray[np.float64]

#: Frames before the first forecast, so that it does not come at once.
LEAD = 20
#: Seconds of a clip that are shown, at most.
LONGEST = 6.0


@dataclass(frozen=True)
class ClipStory:
    """What is shown; places are pixels of the clip's own images."""

    clip: str
    #: (T,) frame numbers in the clip, its rate, and the true mouth centre (T, 2) in each
    frames: NDArray[np.int64]
    fps: float
    mouth: Floats
    #: T pictures (S, S, 3), and where each lies in the image
    pictures: Sequence[NDArray[np.uint8]]
    crops: Sequence[Crop]
    #: name and forecasts (W, H, 2) of the mouth centre of each predictor shown
    forecasts: Sequence[tuple[str, Floats]]
    #: (W,) frame numbers of the last frames of the histories
    origins: NDArray[np.int64]

    @property
    def is_dense(self) -> bool:
        """Whether a new forecast comes before the last one has been caught up with."""
        horizon = self.forecasts[0][1].shape[1]
        return len(self.origins) > 1 and bool(np.diff(self.origins).min() < horizon)

    def seconds(self, frames: NDArray[np.integer]) -> Floats:
        """Times of frame numbers in the clip."""
        return frames / self.fps


def clip_story(
    dataset: FaceDataset,
    indices: Sequence[int],
    residuals: Sequence[tuple[str, Floats]],
) -> ClipStory:
    """The story of sequences ``indices`` that follow one another in a clip.

    Args:
        dataset: where they are.
        indices: W of them, each beginning the stride after the one before it.
        residuals: name and errors (W, H, 2) in crops of each predictor to be shown.
    """
    settings = dataset.manifest.settings
    clip = dataset.entry(indices[0]).clip
    path = dataset.folder / CLIP_FOLDER / f"{clip}.h5"
    with open_clip(path) as file:
        corners = read_array(path, file, "sequences/crop")
        starts = read_array(path, file, "sequences/start")
    first = next(i for i in range(len(dataset)) if dataset.entry(i).clip == clip)
    frames: list[int] = []
    mouth: list[Floats] = []
    pictures: list[NDArray[np.uint8]] = []
    crops: list[Crop] = []
    forecasts = [(name, np.empty_like(errors)) for name, errors in residuals]
    origins: list[int] = []
    for place, index in enumerate(indices):
        crop = Crop(*map(int, corners[index - first]))
        start = int(starts[index - first])
        low = np.array([crop.left, crop.top])
        path_here = low + crop.side * mouth_centre(dataset.landmarks(index))
        for (_, errors), (_, forecast) in zip(residuals, forecasts, strict=True):
            forecast[place] = path_here[settings.history :] + crop.side * errors[place]
        origins.append(start + settings.history - 1)
        # each sequence adds what is new in its history, the last one also what was to be forecast
        shown_from = settings.history - (settings.stride if place else LEAD)
        shown_to = settings.length if place == len(indices) - 1 else settings.history
        part = slice(max(shown_from, 0), shown_to)
        frames += range(start + part.start, start + part.stop)
        mouth += list(path_here[part])
        pictures += list(dataset.pictures(index, part))
        crops += [crop] * (part.stop - part.start)
    return ClipStory(
        clip=clip,
        frames=np.array(frames),
        fps=settings.fps,
        mouth=np.stack(mouth),
        pictures=pictures,
        crops=crops,
        forecasts=forecasts,
        origins=np.array(origins),
    )


def telling_run(verdict: Verdict, kind: str, stride: int, fps: float) -> NDArray[np.intp]:
    """Places of successive sequences of one clip of a kind, `LONGEST` in all at most.

    Of the longest that there are, the one whose mouth moves more than three quarters of the others'
    do, by the error of persistence: with too little motion there is nothing to see.
    """
    selection = verdict.selection
    places = selection.of_kind(kind)
    clips = [selection.clips[place] for place in places]
    runs = neighbours(clips, selection.starts[places].tolist(), stride)
    count = max(1, int(LONGEST * fps) // stride)
    parts = [run[i : i + count] for run in runs for i in range(0, len(run), count)]
    longest = max(map(len, parts))
    candidates = [places[part] for part in parts if len(part) == longest]
    size = mouth_distances(verdict.row(PERSISTENCE).residuals)
    order = sorted(candidates, key=lambda part: float(size[part].mean()))
    return order[int(0.75 * (len(order) - 1))]


#: A second of footage takes so many seconds, so that five frames can be followed by eye.
SLOWED = 3
#: Images for which a new forecast stands still, unless there is one at almost every frame.
PAUSE = 6
#: Pixels of the video: width and height, both even.
SIZE = (1280, 560)
#: Share of the crop that the picture shows, around the mouth.
VIEW = 0.55
#: Of the truth in the plots, and on the picture; of the forecasts (orange and blue).
TRUTH, TRUTH_ON_PICTURE = (0, 0, 0), (255, 255, 255)
FORECASTS = ((230, 90, 0), (0, 114, 178))

Floats = NDArray[np.float64]
Image = NDArray[np.uint8]
Colour = tuple[int, int, int]


def write_clip_video(path: Path, story: ClipStory) -> None:
    """Write ``story`` as H.264, slowed down.

    Raises:
        RequestError: matplotlib is not installed, or the folder cannot be written to.
    """
    write_h264(path, draw_story(story), story.fps / SLOWED)


def draw_story(story: ClipStory) -> Iterator[Image]:
    """The images (560, 1280, 3) of the video: one for each of T frames, and the pauses."""
    stage = _set_stage(story)
    for number, frame in enumerate(story.frames.tolist()):
        image = _draw(stage, story, number)
        yield image
        for _ in range(PAUSE if frame in story.origins and not story.is_dense else 0):
            yield image


@dataclass(frozen=True)
class _Stage:
    """What stays the same: drawn axes, and where things go on them."""

    background: Image
    #: left and top of the picture in pixels of the video, and its side
    corner: tuple[int, int]
    side: int
    #: part of the clip's images that the picture shows
    view: Crop
    #: for U and V, what brings (seconds, pixels of the clip) to pixels of the video
    plots: Sequence[Any]

    def on_picture(self, points: Floats) -> Floats:
        """Pixels (n, 2) of the picture of pixels (n, 2) of the clip's images."""
        return (points - (self.view.left, self.view.top)) * (self.side / self.view.side)

    def on_plot(self, axis: int, seconds: Floats, values: Floats) -> Floats:
        """Pixels (n, 2) of the video of points of a plot."""
        points = self.plots[axis].transform(np.stack([seconds, values], axis=-1))
        return np.stack([points[:, 0], SIZE[1] - points[:, 1]], axis=-1)


def _set_stage(story: ClipStory) -> _Stage:
    figure = new_figure(SIZE[0] / 100, SIZE[1] / 100)
    grid = figure.add_gridspec(2, 2, width_ratios=(1, 1.4))
    picture = figure.add_subplot(grid[:, 0])
    picture.set_aspect("equal")
    picture.set_xticks([])
    picture.set_yticks([])
    picture.set_title(f"{story.clip}, {SLOWED} times slower", fontsize=13)
    seconds = story.seconds(story.frames)
    plots: list[Any] = []
    for axis, label in enumerate(("mouth to the right, px", "mouth down, px")):
        plot = figure.add_subplot(grid[axis, 1])
        everything = [f[..., axis].ravel() for _, f in story.forecasts]
        values = np.concatenate([story.mouth[:, axis], *everything])
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
    named = [("true mouth centre (white on the picture)", TRUTH)]
    for (name, _), colour in zip(story.forecasts, FORECASTS, strict=False):
        named.append((f"forecast, {name}", colour))
    for name, colour in named:
        plots[0].plot([], [], color=np.array(colour) / 255, lw=3, label=name)
    figure.legend(loc="outside upper right", ncols=3, fontsize=12)
    figure.canvas.draw()
    box = picture.get_window_extent()
    side = int(min(box.width, box.height))
    extent = float(np.ptp(story.mouth, axis=0).max())
    shown = max(VIEW * float(np.mean([crop.side for crop in story.crops])), 1.3 * extent)
    middle = (story.mouth.min(axis=0) + story.mouth.max(axis=0)) / 2
    left, top = np.round(middle - shown / 2).astype(int).tolist()
    return _Stage(
        background=np.asarray(figure.canvas.buffer_rgba())[..., :3].copy(),
        corner=(round(box.x0), round(SIZE[1] - box.y1)),
        side=side,
        view=Crop(left, top, round(shown)),
        plots=[plot.transData.frozen() for plot in plots],
    )


def _draw(stage: _Stage, story: ClipStory, number: int) -> Image:
    """The image at frame ``number`` of those shown: nothing on it is later, but the forecasts."""
    image = stage.background.copy()
    now = story.frames[number]
    seen = _look(stage, story, number)
    _line(seen, stage.on_picture(story.mouth[max(0, number - LEAD) : number + 1]),
          TRUTH_ON_PICTURE, 2)  # fmt: skip
    made = np.flatnonzero(story.origins <= now).tolist()
    # the first, drawn last, is on top
    for (_, forecasts), colour in reversed(list(zip(story.forecasts, FORECASTS, strict=False))):
        for k in made:
            origin = story.origins[k]
            begin = story.mouth[story.frames == origin][:1]
            ahead = np.concatenate([begin, forecasts[k]])
            seconds = story.seconds(origin + np.arange(len(ahead)))
            for axis in range(2):
                _line(image, stage.on_plot(axis, seconds, ahead[:, axis]), colour, 2)
            if k == made[-1]:
                _line(seen, stage.on_picture(ahead), colour, 2)
                _dots(seen, stage.on_picture(ahead[1:]), colour, 4)
    seconds = story.seconds(story.frames[: number + 1])
    for axis in range(2):
        points = stage.on_plot(axis, seconds, story.mouth[: number + 1, axis])
        _line(image, points, TRUTH, 2)
        _dots(image, points[-1:], TRUTH, 4)
    _dots(seen, stage.on_picture(story.mouth[[number]]), TRUTH_ON_PICTURE, 5)
    left, top = stage.corner
    image[top : top + stage.side, left : left + stage.side] = seen
    return image


def _look(stage: _Stage, story: ClipStory, number: int) -> Image:
    """The picture of a frame under the view that stands still; black where none was cut."""
    import cv2  # not needed to make tables

    crop, view, picture = story.crops[number], stage.view, story.pictures[number]
    scale = stage.side / view.side
    grow = scale * crop.side / picture.shape[0]
    # pixel centres are at halves: pixel 0 of the picture covers 0 to 1
    shift = scale * np.array([crop.left - view.left, crop.top - view.top]) + grow / 2 - 0.5
    matrix = np.array([[grow, 0, shift[0]], [0, grow, shift[1]]])
    size = (stage.side, stage.side)
    return np.asarray(cv2.warpAffine(picture, matrix, size, flags=cv2.INTER_LINEAR), np.uint8)


def _line(image: Image, points: Floats, colour: Colour, thickness: int) -> None:
    import cv2

    for a, b in pairwise(points):
        if np.isfinite(a).all() and np.isfinite(b).all():
            cv2.line(image, _fixed(a), _fixed(b), colour, thickness, cv2.LINE_AA, shift=4)


def _dots(image: Image, points: Floats, colour: Colour, radius: int) -> None:
    """Dots with a dark rim, to be seen on skin as well as on paper."""
    import cv2

    for point in points[np.isfinite(points).all(axis=-1)]:
        cv2.circle(image, _fixed(point), radius * 16 + 12, (0, 0, 0), -1, cv2.LINE_AA, shift=4)
        cv2.circle(image, _fixed(point), radius * 16, colour, -1, cv2.LINE_AA, shift=4)


def _fixed(point: Floats) -> tuple[int, int]:
    """Sixteenths of a pixel, far enough inside what OpenCV's integers hold."""
    x, y = np.clip(np.round(16 * point), -1e6, 1e6).astype(int).tolist()
    return x, y


logger = logging.getLogger(__name__)

#: Of the sequences of a kind, the one shown is where so large a share moves less: with the usual
#: sequence there would be little to see.
_LIVELIER_THAN = 0.9


def draw_plots(folder: Path, summaries: Sequence[KindSummary]) -> None:
    """``errors.png`` and, where there are intervals, ``calibration.png``: nobody's picture."""
    draw_errors(folder / "errors.png", summaries)
    with_intervals = [summary for summary in summaries if any(summary.has_intervals)]
    if with_intervals:
        draw_calibration(folder / "calibration.png", with_intervals)


def draw_pictures(folder: Path, dataset: FaceDataset, verdict: Verdict, line_up: LineUp) -> None:
    """``forecast_KIND_ROW.png`` of each row that makes pictures; of one sequence for each kind."""
    settings, selection = dataset.manifest.settings, verdict.selection
    frames = range(settings.history + 1, settings.length + 1)
    for kind in dict.fromkeys(selection.kinds):
        place = telling_sequence(verdict, kind)
        fold, subject = int(selection.folds[place]), selection.subjects[place]
        for contestant in line_up.contestants:
            size = line_up.picture_sizes[contestant.name]
            if not size:
                continue
            predictor = contestant.fit.of(fold, subject)
            plan = PicturePlan.of([predictor.needs], [size])
            batch = Batch(dataset, [int(selection.indices[place])], plan)
            forecast = forecast_of(
                predictor, batch.history, batch.shown(predictor.needs), settings.future
            )
            if forecast.pictures is None:
                continue
            draw_forecast(
                folder / f"forecast_{kind}_{_file_name(contestant.name)}.png",
                f"{contestant.name}, {kind}: clip {selection.clips[place]}",
                frames,
                Shown(batch.coming(size)[0], batch.future[0]),
                Shown(forecast.pictures[0], forecast.landmarks[0]),
            )


def draw_video(
    path: Path, dataset: FaceDataset, verdict: Verdict, summaries: Sequence[KindSummary]
) -> None:
    """The best network, or else the best baseline, and what it is compared with, on one clip."""
    summary = summaries[0]
    settings = dataset.manifest.settings
    run = telling_run(verdict, summary.kind, settings.stride, settings.fps)
    distance = summary.numbers["pooled_distance"].value
    networks = [i for i, role in enumerate(summary.roles) if role == "network"]
    names = [summary.best_baseline]
    if networks and np.isfinite(distance[networks]).any():
        names.insert(0, summary.rows[networks[int(np.nanargmin(distance[networks]))]])
    elif summary.best_baseline != PERSISTENCE:
        names.append(PERSISTENCE)
    shown = [(name, verdict.row(name).residuals[run]) for name in names]
    write_clip_video(path, clip_story(dataset, verdict.selection.indices[run].tolist(), shown))


def telling_sequence(verdict: Verdict, kind: str) -> int:
    """The place of a sequence with more motion than most of its kind."""
    places = verdict.selection.of_kind(kind)
    last = mouth_distances(verdict.row(PERSISTENCE).residuals[places])[:, -1]
    return int(places[np.argsort(last, kind="stable")[int(_LIVELIER_THAN * (len(last) - 1))]])


def _file_name(name: str) -> str:
    return re.sub(r"\W+", "_", name).strip("_")
