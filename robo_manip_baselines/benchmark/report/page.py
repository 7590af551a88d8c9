"""Videos of episodes, small enough for dozens of them to travel in one page."""

from __future__ import annotations

import base64
import json
import tempfile
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from urllib.parse import quote, urlencode

import av
import cv2
import numpy as np

from robo_manip_baselines.benchmark.report.figures import Plot
from robo_manip_baselines.benchmark.report.plots import benchmark_plots
from robo_manip_baselines.benchmark.statistics.outcomes import Line, Selection
from robo_manip_baselines.benchmark.statistics.study import ArmFigures, Study
from robo_manip_baselines.benchmark.tables.study import study_tables
from robo_manip_baselines.benchmark.tables.table import Table
from robo_manip_baselines.rollout.videos import VideoWriter
from robo_manip_baselines.runs.errors import RequestError
from robo_manip_baselines.runs.files import atomic_file

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


@dataclass(frozen=True, eq=False)
class ReportData:
    """All that a report shows.

    Attributes:
        title: of the page.
        study: the figures.
        tables: made from it.
        plots: likewise.
        videos: of episodes of its arms.
        facts: what else to say at the top, such as the command and the machine: name -> text.
    """

    title: str
    study: Study
    tables: tuple[Table, ...]
    plots: tuple[Plot, ...]
    videos: tuple[EpisodeVideo, ...] = ()
    facts: Mapping[str, str] = field(default_factory=dict)


def report_data(
    study: Study,
    *,
    title: str,
    videos: Iterable[EpisodeVideo] = (),
    facts: Mapping[str, str] | None = None,
) -> ReportData:
    """Make tables and plots of a study.

    Raises:
        RequestError: matplotlib is not installed.
    """
    return ReportData(
        title, study, study_tables(study), benchmark_plots(study), tuple(videos), facts or {}
    )


FOLDER = Path(__file__).parent


def write_report(path: Path, data: ReportData) -> None:
    """Write a report.

    Args:
        path: of the page, usually ``report.html`` in the folder that the result lines' files are
            told relative to.
        data: what it shows.

    Raises:
        RequestError: Jinja is not installed, or the file cannot be written.
    """
    page = render_report(data)
    try:
        with atomic_file(path) as temporary:
            temporary.write_text(page, encoding="utf-8")
    except OSError as error:
        raise RequestError(f"cannot write '{path}': {error.strerror}; name another file") from error


def render_report(data: ReportData) -> str:
    """Return a report as HTML. The same data give the same page.

    Raises:
        RequestError: Jinja is not installed.
    """
    try:
        from jinja2 import Environment, FileSystemLoader, StrictUndefined
    except ImportError as error:
        raise RequestError(
            f"reports need Jinja ({error}); pip install 'robo_manip_baselines[train]'"
        ) from None
    environment = Environment(
        loader=FileSystemLoader(FOLDER),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["link"] = link
    environment.filters["sort_key"] = sort_key
    page = environment.get_template("report.html.jinja")
    return page.render(
        data=data,
        facts={**study_facts(data.study), **data.facts},
        style=(FOLDER / "report.css").read_text(encoding="utf-8"),
        script=(FOLDER / "report.js").read_text(encoding="utf-8"),
        lines=embedded(lines_of(data.study)),
        arms=[_videos(figures, data.videos) for figures in data.study.arms],
    )


def link(selection: Selection) -> str:
    """Return the fragment that makes the page list the lines of a selection."""
    query: dict[str, str] = {"arm": selection.arm}
    if selection.versus:
        query["versus"] = ",".join(map(quote, selection.versus))
    for name in ("train_seed", "is_success", "is_strict", "within", "failure"):
        value = getattr(selection, name)
        if value is not None:
            query[name] = str(value).lower() if isinstance(value, bool) else str(value)
    if selection.is_different:
        query["is_different"] = "true"
    return f"#lines?{urlencode(query)}"


def sort_key(value: object) -> str:
    """Return what a column is sorted by; empty for what comes last."""
    if value is None:
        return ""
    return repr(float(value)) if isinstance(value, int | float) else str(value)


def study_facts(study: Study) -> dict[str, str]:
    """Return what can be said of all episodes together."""
    results = [line.result for figures in study.arms for line in figures.lines]
    train_seeds = [str(seed) for seed in study.train_seeds if seed is not None]
    versions: dict[str, set[str]] = {}
    for result in results:
        for name, version in result.versions.items():
            versions.setdefault(name, set()).add(version)
    facts = {
        "Environment": ", ".join(sorted({r.env for r in results})),
        "Episodes": f"{len(results)} of {len(study.arms)} arms",
        "Training seeds": ", ".join(train_seeds) or "none",
        "Evaluation seeds": f"{len(study.seeds)} that all arms have"
        + (f", from {study.seeds[0]} to {study.seeds[-1]}" if study.seeds else ""),
        "Recorded motion": f"{len({r.motion_clip for r in results})} clips of "
        f"{len({r.motion_subject for r in results})} people",
    }
    if versions:
        spelt = (f"{name} {' and '.join(sorted(versions[name]))}" for name in sorted(versions))
        facts["Versions"] = ", ".join(spelt)
    return facts


def lines_of(study: Study) -> dict[str, Any]:
    """Return the result lines as the page's script reads them: a table by columns, m as mm."""
    lines = [line for figures in study.arms for line in figures.lines]
    files = sorted({line.file for line in lines})
    places = {file: number for number, file in enumerate(files)}

    def row(line: Line) -> list[Any]:
        r = line.result
        offset = r.closest_offset and [round(1000.0 * part, 1) for part in r.closest_offset]
        return [
            places[line.file],
            line.number,
            r.arm,
            r.train_seed,
            r.seed,
            r.is_success,
            r.is_success_strict,
            r.completion_time,
            r.failure,
            offset,
            round(r.face_force, 2),
            r.motion_clip,
        ]

    return {"files": files, "rows": [row(line) for line in lines]}


def embedded(content: Mapping[str, Any]) -> str:
    """Return JSON that can stand in a script element."""
    text = json.dumps(content, ensure_ascii=False, allow_nan=False, separators=(",", ":"))
    return text.replace("<", "\\u003c")


def _videos(figures: ArmFigures, videos: tuple[EpisodeVideo, ...]) -> dict[str, Any]:
    """Return what the page shows of an arm's videos, successes first."""
    own = [video for video in videos if video.line.result.arm == figures.arm.name]
    own.sort(key=lambda video: not video.line.result.is_success)
    return {
        "arm": figures.arm,
        "videos": [
            {
                "line": video.line,
                "result": video.line.result,
                "outcome": video.line.result.failure.replace("_", " ") or "success",
                "source": _data_address("video/mp4", video.content),
                "poster": _data_address("image/jpeg", video.poster),
            }
            for video in own
        ],
    }


def _data_address(kind: str, content: bytes) -> str:
    return f"data:{kind};base64,{base64.b64encode(content).decode()}"
