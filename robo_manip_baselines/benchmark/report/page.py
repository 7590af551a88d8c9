"""Report of a benchmark: one HTML page with tables, figures, videos and result rows."""

from __future__ import annotations

import base64
import json
import tempfile
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any
from urllib.parse import quote, urlencode

import numpy as np

from robo_manip_baselines.benchmark.report.figures import ReportFigure, benchmark_figures
from robo_manip_baselines.benchmark.statistics.analysis import BenchmarkStatistics
from robo_manip_baselines.benchmark.statistics.outcomes import ResultRow, RowSelection
from robo_manip_baselines.benchmark.tables.benchmark import benchmark_tables
from robo_manip_baselines.benchmark.tables.table import Table
from robo_manip_baselines.envs.mujoco.face.motions import SYNTHETIC
from robo_manip_baselines.envs.mujoco.tasks.registry import ResultColumn
from robo_manip_baselines.rollout.results import EpisodeResult
from robo_manip_baselines.runs.errors import RequestError
from robo_manip_baselines.runs.extras import install_command
from robo_manip_baselines.runs.files import write_text

FOLDER = Path(__file__).parent

VIDEO_WIDTH = 1280
"""Pixels at most: the width of the page."""

FRAME_STEP = 2
"""One frame of so many is kept: 12.5 in a second."""

VIDEO_QUALITY = 30
"""crf of libx264; with the above, 12 s of four views are a tenth of what an evaluation writes."""

POSTER_QUALITY = 80
"""of the JPEG."""


@dataclass(frozen=True)
class EpisodeVideo:
    """Video of an episode.

    Attributes:
        row: result of the episode.
        content: an mp4 file, H.264.
        poster: a JPEG file of the last frame, shown before the video plays.
    """

    row: ResultRow
    content: bytes
    poster: bytes


def episodes_to_show(statistics: BenchmarkStatistics) -> tuple[ResultRow, ...]:
    """Pick the episodes whose videos a report shows: of each condition a success and a failure.

    The first by training seed, then by seed, so that nobody has chosen them. Of failures, the first
    of the most frequent kind.
    """
    picked: list[ResultRow] = []
    for condition in statistics.conditions:
        rows = sorted(condition.rows, key=lambda r: (r.result.train_seed or 0, r.result.seed))
        kinds = [row.result.failure for row in rows if not row.result.is_success]
        for kind in ["", max(kinds, key=kinds.count)] if kinds else [""]:
            picked += [row for row in rows if row.result.failure == kind][:1]
    return tuple(picked)


def read_video(path: Path, row: ResultRow) -> EpisodeVideo:
    """Read the video of an episode and make it small.

    Args:
        path: of a video that an evaluation has written.
        row: result of the episode.

    Raises:
        RequestError: there is none, or it cannot be played.
    """
    # Imported here: they load the simulator.
    import av.error
    import cv2

    from robo_manip_baselines.rollout.videos import VideoWriter

    try:
        with tempfile.TemporaryDirectory() as folder, av.open(str(path)) as source:
            small = Path(folder) / "small.mp4"
            (track,) = source.streams.video
            rate = float(track.average_rate or 0) / FRAME_STEP
            width = min(VIDEO_WIDTH, track.width)
            size = (width, round(width * track.height / track.width))
            image = np.empty((0, 0, 3), dtype=np.uint8)
            with VideoWriter(small, rate, crf=VIDEO_QUALITY, preset="medium") as video:
                for number, frame in enumerate(source.decode(track)):
                    if number % FRAME_STEP == 0:
                        full = frame.to_ndarray(format="rgb24")
                        image = np.asarray(cv2.resize(full, size, interpolation=cv2.INTER_AREA))
                        video.write(image)
            bgr = cv2.cvtColor(image, cv2.COLOR_RGB2BGR)
            jpeg = cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, POSTER_QUALITY])[1]
            return EpisodeVideo(row, small.read_bytes(), jpeg.tobytes())
    except (av.error.FFmpegError, OSError, ValueError) as error:
        raise RequestError(
            f"video '{path}' cannot be read ({error}); evaluate with --video, or leave it out"
        ) from error


@dataclass(frozen=True, eq=False)
class Report:
    """Content of a report.

    Attributes:
        title: of the page.
        statistics: of the benchmark.
        tables, figures: made from them.
        videos: of episodes.
        facts: at the top, such as the command and the machine: name -> text.
        caution: why the results compare nothing; empty where they do.
    """

    title: str
    statistics: BenchmarkStatistics
    tables: tuple[Table, ...]
    figures: tuple[ReportFigure, ...]
    videos: tuple[EpisodeVideo, ...] = ()
    facts: Mapping[str, str] = field(default_factory=dict)
    caution: str = ""


def make_report(
    statistics: BenchmarkStatistics,
    title: str,
    videos: Iterable[EpisodeVideo] = (),
    facts: Mapping[str, str] | None = None,
    caution: str = "",
) -> Report:
    """Make the tables and figures of a report; see `Report` for the arguments.

    Raises:
        RequestError: matplotlib is not installed.
    """
    tables, figures = benchmark_tables(statistics, caution), benchmark_figures(statistics)
    return Report(title, statistics, tables, figures, tuple(videos), facts or {}, caution)


def write_report(path: Path, report: Report) -> None:
    """Write a report.

    Args:
        path: of the page, usually ``report.html`` in the folder that the files of the result rows
            are relative to.
        report: its content.

    Raises:
        RequestError: Jinja is not installed, or the file cannot be written.
    """
    page = render_report(report)
    try:
        write_text(path, page)
    except OSError as error:
        raise RequestError(f"cannot write '{path}': {error.strerror}; name another file") from error


def render_report(report: Report) -> str:
    """Return a report as HTML. The same report gives the same page.

    Raises:
        RequestError: Jinja is not installed.
    """
    try:
        from jinja2 import Environment, FileSystemLoader, StrictUndefined
    except ImportError as error:
        raise RequestError(
            f"reports need Jinja ({error}); run: {install_command('train')}"
        ) from None
    environment = Environment(
        loader=FileSystemLoader(FOLDER),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters |= {"link": link, "sort_key": sort_key, "base64": _base64}
    statistics = report.statistics
    videos: dict[str, list[EpisodeVideo]] = {c.condition.name: [] for c in statistics.conditions}
    for video in sorted(report.videos, key=lambda video: not video.row.result.is_success):
        videos[video.row.result.condition].append(video)
    rows = row_data(statistics)
    return environment.get_template("report.html.jinja").render(
        report=report,
        statistics=statistics,
        facts={**general_facts(statistics), **report.facts},
        style=(FOLDER / "report.css").read_text(encoding="utf-8"),
        script=(FOLDER / "report.js").read_text(encoding="utf-8"),
        columns=rows["columns"],
        rows=embedded(rows),
        videos=videos,
    )


def link(selection: RowSelection) -> str:
    """Return the fragment of an address that makes the page list the selected rows."""
    query: dict[str, str] = {}
    for name, value in asdict(selection).items():
        if name == "versus" and value:
            query[name] = ",".join(map(quote, value))
        elif isinstance(value, bool) and (value or not name.endswith("_different")):
            query[name] = str(value).lower()
        elif isinstance(value, str | int | float) and not isinstance(value, bool):
            query[name] = str(value)
    return f"#rows?{urlencode(query)}"


def sort_key(value: object) -> str:
    """Return the key that a table cell is sorted by; empty comes last."""
    if value is None:
        return ""
    return repr(float(value)) if isinstance(value, int | float) else str(value)


def general_facts(statistics: BenchmarkStatistics) -> dict[str, str]:
    """Return facts about all episodes together."""
    results = [row.result for c in statistics.conditions for row in c.rows]
    seeds = statistics.seeds
    versions: dict[str, set[str]] = {}
    for result in results:
        for name, version in result.versions.items():
            versions.setdefault(name, set()).add(version)
    facts = {
        "Environment": ", ".join(sorted({r.env for r in results})),
        "End point": statistics.end_point,
        "Episodes": f"{len(results)} of {len(statistics.conditions)} conditions",
        "Training runs": _training_runs(statistics.train_seeds),
        "Evaluation seeds": f"{len(seeds)} that all conditions have"
        + (f", from {seeds[0]} to {seeds[-1]}" if seeds else ""),
        "Motion": _motion(results),
    }
    if versions:
        facts["Versions"] = ", ".join(
            f"{name} {' and '.join(sorted(found))}" for name, found in sorted(versions.items())
        )
    return facts


def _motion(results: Sequence[EpisodeResult]) -> str:
    """Describe the motions by name, and the recordings where there are any."""
    recorded = [r for r in results if r.motion_clip != SYNTHETIC]
    parts = sorted({r.motion for r in results})
    if recorded:
        people = len({r.motion_subject for r in recorded})
        parts.append(f"{len({r.motion_clip for r in recorded})} clips of {people} people")
    return ", ".join(parts)


def _training_runs(seeds: Sequence[int | None]) -> str:
    """Describe the training runs of a condition; the seed alone reads as their number."""
    trained = [str(seed) for seed in seeds if seed is not None]
    if not trained:
        return "none: no condition was trained"
    if len(trained) == 1:
        return f"1 of each condition (seed {trained[0]})"
    return f"{len(trained)} of each condition (seeds {', '.join(trained)})"


def row_data(statistics: BenchmarkStatistics) -> dict[str, Any]:
    """Return the result rows as the page's script reads them, in a compact form."""
    columns = [column for column in statistics.task.columns if column.in_report]
    rows = [row for c in statistics.conditions for row in c.rows]
    files = sorted({row.file for row in rows})
    return {
        "files": files,
        "columns": [_heading(column) for column in columns],
        "rows": [
            [
                files.index(row.file),
                row.number,
                r.condition,
                r.train_seed,
                r.seed,
                r.is_success,
                r.is_success_strict,
                r.completion_time,
                r.failure,
                r.motion_clip,
                *(_shown(column, r.columns[column.name]) for column in columns),
            ]
            for row in rows
            for r in [row.result]
        ],
    }


def _heading(column: ResultColumn) -> str:
    """Return the heading of a task's column; lengths are in mm."""
    unit = "mm" if column.unit == "m" else column.unit
    return column.name.replace("_", " ").capitalize() + (f", {unit}" if unit else "")


def _shown(column: ResultColumn, value: Any) -> Any:
    """Return a value in the unit of the heading, with the digits that the page shows."""
    if value is None:
        return None
    shown = np.round(np.multiply(value, 1000.0 if column.unit == "m" else 1.0), 2)
    return shown.tolist()


def embedded(content: Mapping[str, Any]) -> str:
    """Return JSON that is safe in a script element."""
    text = json.dumps(content, ensure_ascii=False, allow_nan=False, separators=(",", ":"))
    return text.replace("<", "\\u003c")


def _base64(content: bytes) -> str:
    return base64.b64encode(content).decode()
