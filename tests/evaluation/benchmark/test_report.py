"""The report as a page of text: whole, safe, the same each time, every figure with its lines."""

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
    ReportData,
    episodes_to_show,
    link,
    read_video,
    render_report,
    report_data,
    study_facts,
    write_report,
)
from robo_manip_baselines.benchmark.statistics.conditions import FURTHER, Arm
from robo_manip_baselines.benchmark.statistics.outcomes import Line, Selection
from robo_manip_baselines.benchmark.statistics.study import Study, analyse
from robo_manip_baselines.rollout.videos import VideoWriter
from robo_manip_baselines.runs.errors import RequestError

MakeLines = Callable[..., tuple[Line, ...]]

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
def data(study: Study) -> ReportData:
    videos = [EpisodeVideo(line, b"mp4", b"jpeg") for line in episodes_to_show(study)]
    return report_data(study, title="Feeding", videos=videos, facts={"Machine": "two cores"})


@pytest.fixture(scope="module")
def text(data: ReportData) -> str:
    return render_report(data)


@pytest.mark.long
def test_the_page_is_whole(text: str, data: ReportData) -> None:
    page = Page(text)
    names = page.all("id")
    assert len(names) == len(set(names))
    anchors = [href for href in page.all("href") if href.startswith("#") and "?" not in href]
    assert {anchor[1:] for anchor in anchors} <= set(names)
    labels = " ".join([*page.all("aria-labelledby"), *page.all("aria-describedby")]).split()
    assert set(labels) <= set(names)
    for table in data.tables:
        assert f"table-{table.name}" in names
    for plot in data.plots:
        assert f"plot-{plot.name}" in names
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
def test_the_same_figures_give_the_same_page(text: str, data: ReportData) -> None:
    assert render_report(data) == text


@pytest.mark.long
def test_every_figure_of_the_tables_has_its_lines(text: str, data: ReportData) -> None:
    arms = {figures.arm.name for figures in data.study.arms}
    links = [href for href in Page(text).all("href") if href.startswith("#lines?")]
    assert len(links) == sum(
        cell.selection is not None
        for table in data.tables
        for row in table.rows
        for cell in row.cells
    )
    for href in links:
        query = parse_qs(href.partition("?")[2])
        assert set(query) <= {
            "is_different",
            *("arm", "versus", "train_seed", "is_success", "is_strict", "within", "failure"),
        }
        assert {*query["arm"], *query.get("versus", [""])[0].split(",")} <= arms | {""}
    # What has no lines is words, the paper's, or nothing.
    for table in data.tables:
        for row in table.rows:
            for column, cell in zip(table.columns, row.cells, strict=True):
                if cell.selection is None and cell.text != "–":
                    assert column.is_text or column.title.startswith("Paper")


@pytest.mark.long
def test_all_lines_are_in_the_page(text: str, lines: tuple[Line, ...]) -> None:
    found = re.search(r'<script type="application/json" id="lines-data">(.*?)</script>', text)
    assert found is not None
    content = json.loads(found[1])
    assert content["files"] == ["results.jsonl"]
    by_number = {row[1]: row for row in content["rows"]}
    assert len(by_number) == len(lines)
    for line in lines[::97]:
        r = line.result
        row = by_number[line.number]
        assert row[2:9] == [
            *(r.arm, r.train_seed, r.seed, r.is_success, r.is_success_strict),
            *(r.completion_time, r.failure),
        ]
        if r.closest_offset:
            assert row[9] == pytest.approx([1000 * x for x in r.closest_offset], abs=0.051)


@pytest.mark.long
def test_each_arm_shows_a_success_and_a_failure(text: str, data: ReportData) -> None:
    labels = [a["aria-label"] or "" for tag, a in Page(text).attributes if tag == "video"]
    assert len(labels) == 32
    for place, figures in enumerate(data.study.arms):
        success, failure = labels[2 * place : 2 * place + 2]
        assert success.startswith(f"{figures.arm.label}, seed ")
        assert success.endswith(": success")
        assert not failure.endswith(": success")


@pytest.mark.long
def test_hostile_names_stay_words(make_lines: MakeLines) -> None:
    lines = make_lines(arms=["current", "baseline"], train_seeds=1, episodes=4)
    evil = tuple(
        replace(line, file=EVIL, result=replace(line.result, arm=EVIL, motion_clip=EVIL))
        if line.result.arm == "baseline"
        else line
        for line in lines
    )
    described = {EVIL: Arm(EVIL, f"label {EVIL}", FURTHER)}
    study = analyse(evil, resamples=50, described=described)
    video = EpisodeVideo(evil[0], b"", b"")
    page = render_report(report_data(study, title=EVIL, videos=[video], facts={EVIL: EVIL}))
    assert "<b onclick" not in page
    found = [tag for tag, _ in Page(page).attributes]
    assert found.count("script") == 2
    links = [href for href in Page(page).all("href") if href.startswith("#lines?")]
    assert any(parse_qs(href.partition("?")[2])["arm"] == [EVIL] for href in links)


def test_links() -> None:
    assert link(Selection("a b&c")) == "#lines?arm=a+b%26c"
    assert link(Selection("a", train_seed=0, is_success=False)) == (
        "#lines?arm=a&train_seed=0&is_success=false"
    )
    assert link(Selection("a", versus=("b,c", "d"), is_different=True)) == (
        "#lines?arm=a&versus=b%252Cc%2Cd&is_different=true"
    )
    assert link(Selection("a", is_strict=True, failure="dropped")) == (
        "#lines?arm=a&is_strict=true&failure=dropped"
    )


@pytest.mark.long
def test_facts_of_the_study(study: Study) -> None:
    assert study_facts(study) == {
        "Environment": "FeedingEnv",
        "Episodes": "3200 of 16 arms",
        "Training seeds": "0, 1",
        "Evaluation seeds": "100 that all arms have, from 1000 to 1099",
        "Recorded motion": "7 clips of 5 people",
        "Versions": "numpy 2",
    }


@pytest.mark.long
def test_episodes_to_show_are_the_first_of_their_kind(make_lines: MakeLines) -> None:
    lines = make_lines(arms=["baseline"], train_seeds=2, episodes=20)
    ordered = sorted(lines, key=lambda line: (line.result.train_seed or 0, line.result.seed))
    study = analyse(tuple(reversed(lines)), resamples=50)
    success, failure = episodes_to_show(study)
    assert success == next(line for line in ordered if line.result.is_success)
    kinds = [line.result.failure for line in ordered if not line.result.is_success]
    assert kinds.count(failure.result.failure) == max(map(kinds.count, kinds))
    assert failure == next(
        line for line in ordered if line.result.failure == failure.result.failure
    )
    won = tuple(line for line in lines if line.result.is_success)
    assert len(episodes_to_show(analyse(won, resamples=50))) == 1


@pytest.mark.long
def test_files(tmp_path: Path, data: ReportData, text: str) -> None:
    path = tmp_path / "new" / "report.html"
    write_report(path, data)
    assert path.read_text(encoding="utf-8") == text
    assert [p.name for p in path.parent.iterdir()] == ["report.html"]
    (tmp_path / "file").write_text("")
    with pytest.raises(RequestError, match="cannot write"):
        write_report(tmp_path / "file" / "report.html", data)


def test_videos_are_made_small(tmp_path: Path, make_lines: MakeLines) -> None:
    (line,) = make_lines(arms=["current"], train_seeds=1, episodes=1)
    path = tmp_path / "long.mp4"
    rng = np.random.default_rng(0)
    with VideoWriter(path, 25.0) as video:
        for number in range(30):
            image = rng.integers(0, 60, (90, 1600, 3), dtype=np.uint8)
            image[:, : 50 * number] = (200, 0, 0)
            video.write(image)
    found = read_video(path, line)
    assert found.line is line
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
def test_videos_that_are_none(tmp_path: Path, make_lines: MakeLines, content: bytes | None) -> None:
    (line,) = make_lines(arms=["current"], train_seeds=1, episodes=1)
    if content is not None:
        (tmp_path / "v.mp4").write_bytes(content)
    with pytest.raises(RequestError, match=r"v\.mp4' cannot be read .*; evaluate with --video"):
        read_video(tmp_path / "v.mp4", line)
