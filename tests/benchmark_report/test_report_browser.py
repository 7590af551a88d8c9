"""The report in headless Chromium: it draws, sorts, plays, and every number opens its rows.

Needs a Chromium that plays H.264, as Debian's does.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from robo_manip_baselines.benchmark.report.page import (
    episodes_to_show,
    link,
    make_report,
    read_video,
    write_report,
)
from robo_manip_baselines.benchmark.statistics.analysis import BenchmarkStatistics, analyze
from robo_manip_baselines.benchmark.statistics.outcomes import ResultRow
from robo_manip_baselines.benchmark.tables.benchmark import benchmark_tables
from robo_manip_baselines.envs.mujoco.tasks.feeding import ENTRY as TASK
from robo_manip_baselines.rollout.videos import VideoWriter

pytestmark = pytest.mark.long

PATIENCE = 30_000
"""ms; a busy machine is slow, a broken page never gets there."""


def write_video(path: Path) -> Path:
    """Write a square that moves, as an evaluation would."""
    with VideoWriter(path, 25.0) as video:
        for number in range(30):
            image = np.zeros((64, 320, 3), dtype=np.uint8)
            image[20:40, 4 * number : 4 * number + 20] = 255
            video.write(image)
    return path


@dataclass
class Opened:
    """A page, the statistics in it, and what it complained about or asked for."""

    page: Any
    statistics: BenchmarkStatistics
    address: str
    messages: list[str] = field(default_factory=list)
    requests: list[str] = field(default_factory=list)

    def count(self, query: str) -> int:
        """Open the rows of a link and count them."""
        title, shown = self.page.evaluate(
            """async (hash) => {
                 const happens = (target, event) => new Promise((resolve) => {
                   target.addEventListener(event, resolve, { once: true });
                 });
                 const dialog = document.getElementById("rows");
                 const changed = happens(window, "hashchange");
                 location.hash = hash;
                 await changed;
                 const seen = [
                   dialog.querySelector("h2").textContent,
                   dialog.querySelectorAll("tbody tr").length,
                 ];
                 const closed = happens(dialog, "close");
                 dialog.close();
                 await closed;
                 return seen;
               }""",
            query,
        )
        assert title.endswith(f": {shown} row{'' if shown == 1 else 's'}")
        return shown


@pytest.fixture(scope="module")
def opened(
    tmp_path_factory: pytest.TempPathFactory,
    make_rows: Callable[..., tuple[ResultRow, ...]],
    browser: Any,
) -> Iterator[Opened]:
    names = ("baseline", "current", "current_pred_h2", "current_pred_h2_uniform")
    statistics = analyze(make_rows(conditions=names, episodes=30), task=TASK, resamples=100)
    path = tmp_path_factory.mktemp("report") / "report.html"
    video = write_video(path.with_name("video.mp4"))
    shown = [read_video(video, row) for row in episodes_to_show(statistics)]
    write_report(path, make_report(statistics, title="Feeding", videos=shown))
    page = browser.new_page(viewport={"width": 1280, "height": 900})
    page.set_default_timeout(PATIENCE)
    found = Opened(page, statistics, path.as_uri())
    page.on("console", lambda message: found.messages.append(message.text))
    page.on("pageerror", lambda error: found.messages.append(str(error)))
    page.on("request", lambda request: found.requests.append(request.url))
    page.goto(found.address)
    yield found
    page.close()
    assert found.messages == []


def test_it_draws_and_asks_for_nothing(opened: Opened) -> None:
    page = opened.page
    assert page.title() == "Feeding"
    assert opened.messages == []
    assert {url for url in opened.requests if not url.startswith("data:")} == {opened.address}
    for name in ("success_by_horizon", "completion_times", "arrivals", "failures"):
        box = page.locator(f"#figure-{name} svg").bounding_box()
        assert box["width"] > 300
        assert box["height"] > 100
    assert page.get_by_role("img", name="Success against the horizon").count() == 1
    # The poster is drawn before anybody plays.
    first = page.locator("video").first
    first.scroll_into_view_if_needed()
    assert (
        page.evaluate(
            """async (source) => {
             const image = new Image();
             image.src = source;
             await image.decode();
             return image.naturalWidth;
           }""",
            first.get_attribute("poster"),
        )
        == 320
    )
    # Wide tables scroll in their frame; the page itself does not.
    assert page.evaluate("document.documentElement.scrollWidth <= innerWidth")
    page.set_viewport_size({"width": 360, "height": 800})
    assert page.evaluate("document.documentElement.scrollWidth <= innerWidth")
    page.set_viewport_size({"width": 1280, "height": 900})


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_ink_and_ground_follow_the_readers_colours(opened: Opened, scheme: str) -> None:
    opened.page.emulate_media(color_scheme=scheme)
    brightness = opened.page.evaluate(
        """() => [getComputedStyle(document.body).backgroundColor,
                  getComputedStyle(document.body).color,
                  getComputedStyle(document.querySelector("#figure-failures svg text")).fill]
               .map((colour) => colour.match(/\\d+/g).slice(0, 3)
                   .reduce((sum, part) => sum + Number(part), 0) / 3)"""
    )
    ground, ink, drawn = brightness
    assert (ground > 200 > 60 > ink) if scheme == "light" else (ink > 200 > 60 > ground)
    assert drawn == ink


def test_paper_is_white_whatever_the_reader_likes(opened: Opened) -> None:
    opened.page.emulate_media(media="print", color_scheme="dark")
    ground, ink, shown = opened.page.evaluate(
        """() => [getComputedStyle(document.body).backgroundColor,
                  getComputedStyle(document.body).color,
                  getComputedStyle(document.getElementById("videos")).display]"""
    )
    assert (ground, ink, shown) == ("rgb(255, 255, 255)", "rgb(0, 0, 0)", "none")
    opened.page.emulate_media(media="screen", color_scheme="light")


def test_a_phone_shows_numbers_beside_the_labels(opened: Opened) -> None:
    """390 px: the page itself does not scroll sideways, and a label leaves room for numbers."""
    opened.page.set_viewport_size({"width": 390, "height": 844})
    try:
        width, tables = opened.page.evaluate(
            """() => [document.documentElement.scrollWidth,
                 [...document.querySelectorAll("main table tbody tr:first-child")].map((row) => {
                   const ends = [...row.cells].map((cell) => cell.getBoundingClientRect().right);
                   return [row.cells[0].offsetWidth, ends.filter((end) => end <= 390).length];
                 })]"""
        )
    finally:
        opened.page.set_viewport_size({"width": 1280, "height": 900})
    assert width == 390
    assert tables
    for label, cells in tables:
        assert label <= 130, tables
        assert cells >= 2, tables


def test_a_table_sorts(opened: Opened) -> None:
    table = opened.page.locator("#table-success table")
    head = table.locator("thead th", has_text="Success").first
    cells = table.locator("tbody tr td:nth-child(3)")

    def rates() -> list[float]:
        return [float(text.split()[0]) for text in cells.all_inner_texts()]

    before = rates()
    assert before != sorted(before)
    head.get_by_role("button").click()
    assert head.get_attribute("aria-sort") == "ascending"
    assert rates() == sorted(before)
    head.get_by_role("button").click()
    assert head.get_attribute("aria-sort") == "descending"
    assert rates() == sorted(before, reverse=True)
    head.get_by_role("button").click()
    assert head.get_attribute("aria-sort") is None
    assert rates() == before


def test_missing_numbers_sort_to_the_end(opened: Opened) -> None:
    table = opened.page.locator("#table-completion_times table")
    head = table.locator("thead th", has_text="Difference, s")
    place = opened.page.evaluate("head => head.cellIndex + 1", head.element_handle())
    for order in ("ascending", "descending"):
        head.get_by_role("button").click()
        assert head.get_attribute("aria-sort") == order
        assert table.locator(f"tbody tr td:nth-child({place})").last.inner_text() == "–"
    head.get_by_role("button").click()


def test_videos_play(opened: Opened) -> None:
    videos = opened.page.locator("video")
    assert videos.count() == 8
    for place in range(videos.count()):
        state = videos.nth(place).evaluate(
            """async (video) => {
                 video.muted = true;
                 await video.play();
                 await new Promise((resolve) => {
                   video.addEventListener("timeupdate", resolve, { once: true });
                 });
                 video.pause();
                 return [video.currentTime, video.readyState, video.videoWidth, video.error];
               }"""
        )
        assert state[0] > 0.0
        assert state[1] >= 2
        assert state[2:] == [320, None]


def test_numbers_open_as_many_rows_as_they_say(opened: Opened) -> None:
    statistics = opened.statistics
    tables = {table.name: table for table in benchmark_tables(statistics)}
    for row, c in zip(tables["success"].rows, statistics.conditions, strict=True):
        _, episodes, success, _, strict, _, within, *_ = row.cells
        assert opened.count(link(episodes.selection)) == c.outcomes.episodes == 60  # type: ignore[arg-type]
        assert opened.count(link(success.selection)) == c.success.count  # type: ignore[arg-type]
        assert opened.count(link(strict.selection)) == c.strict.count  # type: ignore[arg-type]
        assert opened.count(link(within.selection)) == c.within_limit.count  # type: ignore[arg-type]
    for row in tables["success_by_training_seed"].rows:
        for cell in row.cells[1:3]:
            assert opened.count(link(cell.selection)) == 30  # type: ignore[arg-type]
    for row in tables["success_differences"].rows:
        pairs, won_lost = row.cells[1], row.cells[5]
        won, lost = won_lost.values
        assert opened.count(link(pairs.selection)) == 2 * pairs.values[0]  # type: ignore[arg-type,operator]
        assert opened.count(link(won_lost.selection)) == 2 * (won + lost)  # type: ignore[arg-type,operator]
        strict = statistics.of(row.cells[0].values[0]).strict_difference  # type: ignore[arg-type]
        chosen = replace(won_lost.selection, is_different=False, is_strictly_different=True)  # type: ignore[type-var]
        assert opened.count(link(chosen)) == 2 * (strict.wins + strict.losses)
    for row in tables["completion_times"].rows:
        pairs = row.cells[5]
        if pairs.selection:
            assert opened.count(link(pairs.selection)) == 2 * pairs.values[0]  # type: ignore[operator]
    for row in tables["failures"].rows:
        for cell in row.cells[1:]:
            assert opened.count(link(cell.selection)) == cell.values[0]  # type: ignore[arg-type]
    for row in tables["findings"].rows:
        episodes = row.cells[4]
        conditions = 1 + len(episodes.selection.versus)  # type: ignore[union-attr]
        assert opened.count(link(episodes.selection)) == conditions * episodes.values[0]  # type: ignore[arg-type,operator]


def test_a_click_opens_rows_with_their_place(opened: Opened) -> None:
    page, statistics = opened.page, opened.statistics
    page.locator("#table-failures tbody tr").first.locator("td").nth(1).get_by_role("link").click()
    page.locator("#rows").wait_for()  # it still has the rows of the last time
    first = page.locator("#rows tbody tr").first
    wanted = next(row for row in statistics.conditions[0].rows if row.result.is_success)
    assert first.locator("td").all_inner_texts()[:5] == [
        f"results.jsonl:{wanted.number}",
        wanted.result.condition,
        str(wanted.result.train_seed),
        str(wanted.result.seed),
        "success",
    ]
    assert first.get_by_role("link").get_attribute("href") == f"results.jsonl#L{wanted.number}"
    page.locator("#rows thead button", has_text="Time").click()
    times = [float(t) for t in page.locator("#rows tbody td:nth-child(7)").all_inner_texts()]
    assert times == sorted(times)
    page.locator("#rows thead button", has_text="Row").click()
    places = page.locator("#rows tbody td:nth-child(1)").all_inner_texts()
    numbers = [int(place.rpartition(":")[2]) for place in places]
    assert numbers == sorted(numbers)
    assert {1, 2} == {len(str(number)) for number in numbers}  # 9 comes before 10
    page.get_by_role("button", name="Close", exact=True).click()
    page.locator("#rows").wait_for(state="hidden")
    page.wait_for_url(opened.address)  # without the rows
