"""Videos of evaluations side by side: a row for each condition, a column for each seed.

All videos play at once. Of each, one frame is in memory at a time.
"""

from __future__ import annotations

import contextlib
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from robo_manip_baselines.observation import CAMERAS
from robo_manip_baselines.rollout.results import RESULTS, EpisodeResult, read_results
from robo_manip_baselines.rollout.videos import CLOSE_UP, VideoWriter, put_caption, video_name
from robo_manip_baselines.runs.errors import RequestError, require_choice
from robo_manip_baselines.runs.progress import track

Image = NDArray[np.uint8]

VIDEOS = "videos"
"""Folder of an evaluation's videos, beside its results."""

VIEWS = (*CAMERAS, f"{CLOSE_UP}_zoom")
"""Views of an evaluation's video, from left to right, all of one width."""

ALL_VIEWS = "all"

STRIP = 28
"""Height in pixels of the strip above a tile that names its episode."""

BACKGROUND = 24
"""Grey level, of 255, of strips and of tiles without a video."""

LARGEST_SIDE = 8192
"""Pixels; more than that, few players decode."""

RATE_TOLERANCE = 1e-3
"""Frames a second by which videos that play at once may differ."""


@dataclass(frozen=True)
class Tiling:
    """Videos to show at once.

    Attributes:
        rows: label of a condition -> seed -> video and result.
        seeds: of the columns.
    """

    rows: Mapping[str, Mapping[int, tuple[Path, EpisodeResult]]]
    seeds: tuple[int, ...]


def find_tiles(folders: Sequence[Path], columns: int) -> Tiling:
    """Find the videos of evaluations.

    Args:
        folders: of evaluations with videos, or folders above several of them, as a benchmark's.
        columns: most seeds; those that most conditions have a video of come first.

    Raises:
        RequestError: there is no video, or two are of the same condition and seed.
    """
    found: dict[str, dict[int, tuple[Path, EpisodeResult]]] = {}
    for folder in folders:
        evaluations = sorted(p.parent for p in folder.glob(f"**/{VIDEOS}") if p.is_dir())
        evaluations = [path for path in evaluations if (path / RESULTS).is_file()]
        for evaluation in evaluations:
            for result in read_results(evaluation):
                path = evaluation / VIDEOS / video_name(result)
                if not path.is_file():
                    continue
                row = found.setdefault(_label(result), {})
                if result.seed in row:
                    raise RequestError(
                        f"'{path}' and '{row[result.seed][0]}' are both of {_label(result)}, seed "
                        f"{result.seed}; name one of them"
                    )
                row[result.seed] = path, result
    if not found:
        names = ", ".join(f"'{folder}'" for folder in folders)
        raise RequestError(
            f"{names}: no {RESULTS} with videos beside it; evaluate with bin/Rollout.py --policy "
            "... --video 4"
        )
    counts = Counter(seed for row in found.values() for seed in row)
    chosen = sorted(counts, key=lambda seed: (-counts[seed], seed))[:columns]
    return Tiling(found, tuple(sorted(chosen)))


def _label(result: EpisodeResult) -> str:
    trained = "" if result.train_seed is None else f", training seed {result.train_seed}"
    return f"{result.condition or result.policy}{trained}"


def write_tiles(path: Path, tiling: Tiling, *, view: str = CAMERAS[0], width: int = 320) -> None:
    """Write one H.264 video in which all videos play at once; those that end hold their last frame.

    Args:
        path: of the video.
        tiling: what to show.
        view: one of `VIEWS`, or ``all``.
        width: of a tile, pixels.

    Raises:
        RequestError: a video cannot be read, or does not fit the others.
    """
    require_choice("view", view, (*VIEWS, ALL_VIEWS))
    with contextlib.ExitStack() as stack:
        grid = [
            [_open(stack, label, row.get(seed), view, width) for seed in tiling.seeds]
            for label, row in tiling.rows.items()
        ]
        clips = [clip for row in grid for clip in row if clip is not None]
        first = clips[0]
        for clip in clips:
            if abs(clip.rate - first.rate) > RATE_TOLERANCE or clip.size != first.size:
                raise RequestError(
                    f"'{clip.path}' has {clip.rate:g} frames/s in tiles of {clip.size}, "
                    f"'{first.path}' {first.rate:g} and {first.size}; evaluate them alike"
                )
        height = first.size[0] + STRIP
        shape = height * len(grid), width * len(tiling.seeds)
        if max(shape) > LARGEST_SIDE:
            raise RequestError(
                f"a video of {shape[0]}x{shape[1]} pixels; give a smaller --width or fewer "
                "--columns or folders"
            )
        empty = np.full((height, width, 3), BACKGROUND, np.uint8)
        total = max(clip.length for clip in clips)
        frames = _frames(grid, empty)
        with VideoWriter(path, first.rate) as video:
            for image in track(frames, total, "frame", path.name):
                video.write(image)


def _frames(grid: Sequence[Sequence[_Clip | None]], empty: Image) -> Iterator[Image]:
    clips = [clip for row in grid for clip in row if clip is not None]
    while sum(clip.advance() for clip in clips):  # any() would stop at the first
        rows = [
            np.concatenate([empty if clip is None else clip.tile for clip in row], axis=1)
            for row in grid
        ]
        yield np.concatenate(rows)


class _Clip:
    """A video that is read frame by frame.

    Attributes:
        path: of the video.
        rate: frames a second.
        length: number of frames, as the file says.
        size: height and width of the view, pixels, as drawn.
        tile: strip and view of the present frame.
    """

    def __init__(self, path: Path, container: Any, label: str, view: str, width: int) -> None:
        (stream,) = container.streams.video
        self.path, self.rate, self.length = path, float(stream.average_rate or 0), stream.frames
        self._frames = container.decode(stream)
        self._columns = _columns(path, stream.width, stream.height, view)
        part = self._columns.stop - self._columns.start
        self.size = max(2, round(stream.height * width / part)), width
        strip = np.full((STRIP, width, 3), BACKGROUND, np.uint8)
        self.tile = np.concatenate([put_caption(strip, label), np.zeros((*self.size, 3), np.uint8)])

    def advance(self) -> bool:
        """Show the next frame; return False, and keep the last, at the end.

        Raises:
            RequestError: the video is damaged.
        """
        import av.error  # slow to import

        try:
            frame = next(self._frames, None)
        except (av.error.FFmpegError, OSError) as error:
            raise RequestError(f"'{self.path}' is damaged: {error}; evaluate again") from error
        if frame is None:
            return False
        image = frame.to_ndarray(format="rgb24")[:, self._columns]
        height, width = self.size
        self.tile[STRIP:] = cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)
        return True


def _columns(path: Path, width: int, height: int, view: str) -> slice:
    """Return the columns of a view in a video of so many pixels."""
    if view == ALL_VIEWS:
        return slice(0, width)
    part = width // len(VIEWS)
    if part < height:  # no four views, each wider than high
        raise RequestError(
            f"'{path}' ({width}x{height}) has no {len(VIEWS)} views side by side; give --view all"
        )
    first = VIEWS.index(view) * part
    return slice(first, first + part)


def _open(
    stack: contextlib.ExitStack,
    label: str,
    found: tuple[Path, EpisodeResult] | None,
    view: str,
    width: int,
) -> _Clip | None:
    if found is None:
        return None
    import av.error  # slow to import

    path, result = found
    outcome = result.failure.replace("_", " ") or "success"
    text = f"{label}, seed {result.seed}: {outcome}"
    try:
        return _Clip(path, stack.enter_context(av.open(str(path))), text, view, width)
    except (av.error.FFmpegError, OSError, ValueError) as error:
        if isinstance(error, RequestError):
            raise
        raise RequestError(f"'{path}' is no video: {error}; evaluate again") from error
