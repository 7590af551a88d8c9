"""The report as a page of text: whole, safe, the same each time, every figure with its rows."""

from __future__ import annotations

import io
import json
import re
from collections.abc import Callable
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import parse_qs

import av
import cv2
import numpy as np
import pytest

from robo_manip_baselines.benchmark.report.page import (
    EpisodeVideo,
    Report,
    _training_runs,
    episodes_to_show,
    general_facts,
    link,
    make_report,
    read_video,
    render_report,
    write_report,
)
from robo_manip_baselines.benchmark.statistics.analysis import BenchmarkStatistics, analyze
from robo_manip_baselines.benchmark.statistics.conditions import FURTHER, ConditionDescription
from robo_manip_baselines.benchmark.statistics.outcomes import ResultRow, RowSelection
from robo_manip_baselines.envs.mujoco.tasks.feeding import ENTRY as TASK
from robo_manip_baselines.rollout.videos import VideoWriter
from robo_manip_baselines.runs.errors import RequestError

MakeRows = Callable[..., tuple[ResultRow, ...]]

VOID = {"meta", "link", "br", "img", "hr"}
EVIL = "</script><b onclick=alert(1)>\"'&"


class Page(HTMLParser):
    """Reads a page; what is not closed, or closed twice, is an error."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.attributes: list[tuple[str, dict[str, str | None]]] = []
        self.feed(text)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.attributes.append((tag, dict(attrs)))
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.attributes.append((tag, dict(attrs)))

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def all(self, name: str) -> list[str]:
        return [value for _, found in self.attributes if (value := found.get(name)) is not None]


@pytest.fixture(scope="module")
def report(statistics: BenchmarkStatistics) -> Report:
    videos = [EpisodeVideo(row, b"mp4", b"jpeg") for row in episodes_to_show(statistics)]
    return make_report(statistics, title="Feeding", videos=videos, facts={"Machine": "two cores"})


@pytest.fixture(scope="module")
def text(report: Report) -> str:
    return render_report(report)


@pytest.mark.long
def test_the_page_is_whole(text: str, report: Report) -> None:
    page = Page(text)
    names = page.all("id")
    assert len(names) == len(set(names))
    anchors = [href for href in page.all("href") if href.startswith("#") and "?" not in href]
    assert {anchor[1:] for anchor in anchors} <= set(names)
    labels = " ".join([*page.all("aria-labelledby"), *page.all("aria-describedby")]).split()
    assert set(labels) <= set(names)
    for table in report.tables:
        assert f"table-{table.name}" in names
    for figure in report.figures:
        assert f"figure-{figure.name}" in names
    assert "<title>Feeding</title>" in text
    assert "two cores" in text


@pytest.mark.long
def test_the_page_needs_nothing_else(text: str) -> None:
    page = Page(text)
    for source in page.all("src"):
        assert source.startswith("data:video/mp4;base64,")
    for poster in page.all("poster"):
        assert poster.startswith("data:image/jpeg;base64,")
    outside = set(re.findall(r"https?://[^\"'\s<]+", text))
    assert outside <= {"http://www.w3.org/2000/svg", "http://www.w3.org/1999/xlink"} | {
        address
        for address in outside
        if "w3.org" in address  # names of formats, not fetched
    }
    for tag, attributes in page.attributes:
        assert tag not in ("iframe", "object", "embed")
        assert tag != "link" or attributes["href"] == "data:,"
        assert not any(name.startswith("on") for name in attributes)
    assert "default-src 'none'" in text


@pytest.mark.long
def test_the_same_figures_give_the_same_page(text: str, report: Report) -> None:
    assert render_report(report) == text


@pytest.mark.long
def test_every_figure_of_the_tables_has_its_rows(text: str, report: Report) -> None:
    names = {c.condition.name for c in report.statistics.conditions}
    links = [href for href in Page(text).all("href") if href.startswith("#rows?")]
    assert len(links) == sum(
        cell.selection is not None
        for table in report.tables
        for row in table.rows
        for cell in row.cells
    )
    for href in links:
        query = parse_qs(href.partition("?")[2])
        assert set(query) <= {
            "is_different",
            *("condition", "versus", "train_seed", "is_success", "is_strict", "within", "failure"),
        }
        assert {*query["condition"], *query.get("versus", [""])[0].split(",")} <= names | {""}
    # What has no rows is words, the paper's, or nothing.
    for table in report.tables:
        for row in table.rows:
            for column, cell in zip(table.columns, row.cells, strict=True):
                if cell.selection is None and cell.text != "–":
                    assert column.is_text or column.title.startswith("Paper")


@pytest.mark.long
def test_all_rows_are_in_the_page(text: str, rows: tuple[ResultRow, ...]) -> None:
    found = re.search(r'<script type="application/json" id="rows-data">(.*?)</script>', text)
    assert found is not None
    content = json.loads(found[1])
    assert content["files"] == ["results.jsonl"]
    by_number = {values[1]: values for values in content["rows"]}
    assert len(by_number) == len(rows)
    assert content["columns"] == ["Closest offset, mm", "Face force, N"]
    for row in rows[::97]:
        r = row.result
        values = by_number[row.number]
        assert values[2:10] == [
            *(r.condition, r.train_seed, r.seed, r.is_success, r.is_success_strict),
            *(r.completion_time, r.failure, r.motion_clip),
        ]
        offset = r.columns["closest_offset"]
        if offset:
            assert values[10] == pytest.approx([1000 * x for x in offset], abs=0.0051)
        else:
            assert values[10] is None
        assert values[11] == r.columns["face_force"]


@pytest.mark.long
def test_each_condition_shows_a_success_and_a_failure(text: str, report: Report) -> None:
    labels = [a["aria-label"] or "" for tag, a in Page(text).attributes if tag == "video"]
    assert len(labels) == 32
    for place, c in enumerate(report.statistics.conditions):
        success, failure = labels[2 * place : 2 * place + 2]
        assert success.startswith(f"{c.condition.label}, seed ")
        assert success.endswith(": success")
        assert not failure.endswith(": success")


@pytest.mark.long
def test_hostile_names_stay_words(make_rows: MakeRows) -> None:
    rows = make_rows(conditions=["current", "baseline"], train_seeds=1, episodes=4)
    evil = tuple(
        replace(row, file=EVIL, result=replace(row.result, condition=EVIL, motion_clip=EVIL))
        if row.result.condition == "baseline"
        else row
        for row in rows
    )
    described = {EVIL: ConditionDescription(EVIL, f"label {EVIL}", FURTHER)}
    statistics = analyze(evil, task=TASK, resamples=50, conditions=described)
    video = EpisodeVideo(evil[0], b"", b"")
    page = render_report(make_report(statistics, title=EVIL, videos=[video], facts={EVIL: EVIL}))
    assert "<b onclick" not in page
    found = [tag for tag, _ in Page(page).attributes]
    assert found.count("script") == 2
    links = [href for href in Page(page).all("href") if href.startswith("#rows?")]
    assert any(parse_qs(href.partition("?")[2])["condition"] == [EVIL] for href in links)


def test_links() -> None:
    assert link(RowSelection("a b&c")) == "#rows?condition=a+b%26c"
    assert link(RowSelection("a", train_seed=0, is_success=False)) == (
        "#rows?condition=a&train_seed=0&is_success=false"
    )
    assert link(RowSelection("a", versus=("b,c", "d"), is_different=True)) == (
        "#rows?condition=a&versus=b%252Cc%2Cd&is_different=true"
    )
    assert link(RowSelection("a", versus=("b",), is_strictly_different=True)) == (
        "#rows?condition=a&versus=b&is_strictly_different=true"
    )
    assert link(RowSelection("a", is_strict=True, failure="dropped")) == (
        "#rows?condition=a&is_strict=true&failure=dropped"
    )


@pytest.mark.long
def test_facts_of_the_study(statistics: BenchmarkStatistics) -> None:
    assert general_facts(statistics) == {
        "Environment": "FeedingEnv",
        "End point": "success",
        "Episodes": "3200 of 16 conditions",
        "Training runs": "2 of each condition (seeds 0, 1)",
        "Evaluation seeds": "100 that all conditions have, from 1000 to 1099",
        "Motion": "recorded, 7 clips of 5 people",
        "Versions": "numpy 2",
    }


@pytest.mark.parametrize(
    ("train_seeds", "words"),
    [
        ((0,), "1 of each condition (seed 0)"),
        ((0, 1, 2), "3 of each condition (seeds 0, 1, 2)"),
        ((None,), "none: no condition was trained"),
    ],
)
def test_training_runs_are_counted(train_seeds: tuple[int | None, ...], words: str) -> None:
    assert _training_runs(train_seeds) == words


@pytest.mark.long
def test_a_caution_stands_at_the_top(statistics: BenchmarkStatistics) -> None:
    page = render_report(make_report(statistics, "Smoke", caution="Hardly <trained>."))
    assert "<strong>No comparison.</strong> Hardly &lt;trained&gt;." in page
    assert page.index("No comparison.") < page.index('<nav aria-label="Contents">')
    assert "No comparison" not in render_report(make_report(statistics, "Whole"))


@pytest.mark.long
def test_episodes_to_show_are_the_first_of_their_kind(make_rows: MakeRows) -> None:
    rows = make_rows(conditions=["baseline"], train_seeds=2, episodes=20)
    ordered = sorted(rows, key=lambda row: (row.result.train_seed or 0, row.result.seed))
    statistics = analyze(tuple(reversed(rows)), task=TASK, resamples=50)
    success, failure = episodes_to_show(statistics)
    assert success == next(row for row in ordered if row.result.is_success)
    kinds = [row.result.failure for row in ordered if not row.result.is_success]
    assert kinds.count(failure.result.failure) == max(map(kinds.count, kinds))
    assert failure == next(row for row in ordered if row.result.failure == failure.result.failure)
    won = tuple(row for row in rows if row.result.is_success and row.result.train_seed == 0)
    assert len(episodes_to_show(analyze(won, task=TASK, resamples=50))) == 1


@pytest.mark.long
def test_files(tmp_path: Path, report: Report, text: str) -> None:
    path = tmp_path / "new" / "report.html"
    write_report(path, report)
    assert path.read_text(encoding="utf-8") == text
    assert [p.name for p in path.parent.iterdir()] == ["report.html"]
    (tmp_path / "file").write_text("")
    with pytest.raises(RequestError, match="cannot write"):
        write_report(tmp_path / "file" / "report.html", report)


def test_videos_are_made_small(tmp_path: Path, make_rows: MakeRows) -> None:
    (row,) = make_rows(conditions=["current"], train_seeds=1, episodes=1)
    path = tmp_path / "long.mp4"
    rng = np.random.default_rng(0)
    with VideoWriter(path, 25.0) as video:
        for number in range(30):
            image = rng.integers(0, 60, (90, 1600, 3), dtype=np.uint8)
            image[:, : 50 * number] = (200, 0, 0)
            video.write(image)
    found = read_video(path, row)
    assert found.row is row
    assert len(found.content) < path.stat().st_size / 2
    with av.open(io.BytesIO(found.content)) as container:
        (track,) = container.streams.video
        assert (track.codec_context.name, track.width, track.height) == ("h264", 1280, 72)
        assert float(track.average_rate or 0) == 12.5
        assert sum(1 for _ in container.decode(track)) == 15
    poster = cv2.imdecode(np.frombuffer(found.poster, np.uint8), cv2.IMREAD_COLOR)
    assert poster is not None
    assert poster.shape == (72, 1280, 3)
    blue, _, red = poster[:, :1000].mean(axis=(0, 1))  # OpenCV's order
    assert red > 150 > 50 > blue


@pytest.mark.parametrize("content", [None, b"", b"no video"])
def test_videos_that_are_none(tmp_path: Path, make_rows: MakeRows, content: bytes | None) -> None:
    (row,) = make_rows(conditions=["current"], train_seeds=1, episodes=1)
    if content is not None:
        (tmp_path / "v.mp4").write_bytes(content)
    with pytest.raises(RequestError, match=r"v\.mp4' cannot be read .*; evaluate with --video"):
        read_video(tmp_path / "v.mp4", row)
