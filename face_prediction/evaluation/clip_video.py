"""A video of one clip: the forecast of the mouth drawn ahead of where it then goes.

Legend: T frames shown, H horizon, n points.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from face_prediction.dataset.crop import Crop
from face_prediction.evaluation.canvas import new_figure
from face_prediction.evaluation.clip_story import LEAD, ClipStory
from face_prediction.evaluation.h264 import write_h264

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
