"""The figures: what is in them, and that they come out the same."""

from __future__ import annotations

import re
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from robo_manip_baselines.benchmark.report.figures import (
    INK,
    ReportFigure,
    benchmark_figures,
    draw_completion_times,
    draw_episodes,
    lead_series,
    render_figure,
    write_figures,
)
from robo_manip_baselines.benchmark.statistics.analysis import BenchmarkStatistics, analyze
from robo_manip_baselines.benchmark.statistics.outcomes import ResultRow
from robo_manip_baselines.envs.mujoco.tasks.feeding import ENTRY as TASK
from robo_manip_baselines.envs.mujoco.tasks.feeding.paper import ARRIVALS
from robo_manip_baselines.observation import Corruption, ObservationSpec

pytestmark = pytest.mark.long

MakeRows = Callable[..., tuple[ResultRow, ...]]


def words(figure: ReportFigure) -> list[str]:
    """All that is written in a figure, in the order in which it is drawn."""
    root = ElementTree.fromstring(figure.svg)
    return ["".join(node.itertext()) for node in root.iter("{http://www.w3.org/2000/svg}text")]


@pytest.fixture(scope="module")
def figures(statistics: BenchmarkStatistics) -> dict[str, ReportFigure]:
    return {figure.name: figure for figure in benchmark_figures(statistics)}


def test_all_are_drawn_and_say_what_is_to_be_seen(
    figures: dict[str, ReportFigure], statistics: BenchmarkStatistics
) -> None:
    assert list(figures) == [
        "success_by_horizon",
        "completion_times",
        "arrivals",
        "failures",
        "touches",
        "delay_and_horizon",
        "net_lead",
    ]
    for figure in figures.values():
        assert figure.title
        assert figure.summary
    rates = {c.condition.label: c.success.rate or 0.0 for c in statistics.conditions}
    assert max(rates, key=lambda label: rates[label]) in figures["success_by_horizon"].summary
    for name in ("completion_times", "failures"):
        assert [w for w in words(figures[name]) if w in rates] == list(rates)


def test_success_against_the_horizon(figures: dict[str, ReportFigure]) -> None:
    text = words(figures["success_by_horizon"])
    assert text[:7] == ["baseline", "current", "1", "2", "3", "4", "5"]
    assert {"prediction without error", "prediction with error"} <= set(text)
    assert {"paper, without error", "paper, with error"} <= set(text)


def test_numbers_of_the_surface(
    figures: dict[str, ReportFigure], statistics: BenchmarkStatistics
) -> None:
    text = words(figures["delay_and_horizon"])
    shown = [
        c
        for c in statistics.conditions
        if c.condition.error == "none" and c.condition.horizon is not None
    ]
    for c in shown:
        assert f"{100 * (c.success.rate or 0):.0f}" in text
    assert [c.condition.delay for c in shown].count(3) == 2
    few = benchmark_figures(replace(statistics, conditions=statistics.conditions[:4]))
    assert [figure.name for figure in few] == list(figures)[:5]


def test_net_lead_has_a_curve_for_each_motion_and_delay(
    figures: dict[str, ReportFigure], make_rows: MakeRows
) -> None:
    curves = ["0 frames late", "3 frames late"]
    assert [w for w in words(figures["net_lead"]) if w in (*curves, "recorded")] == [
        "recorded",
        *curves,
    ]
    names = {
        "current": ("current", 1, 0, "recorded"),
        "current_pred_h1": ("current_pred", 5, 4, "sway"),
        "current_pred_h2": ("current_pred", 2, 4, "sway"),
        "baseline": ("history", 1, 4, "sway"),
    }
    rows = [
        replace(row, result=replace(row.result, motion=motion, observation=spec.to_json()))
        for row in make_rows(conditions=list(names), train_seeds=1, episodes=20)
        for obs, horizon, delay, motion in [names[row.result.condition]]
        for spec in [ObservationSpec(obs, horizon, (), corruption=Corruption(delay=delay))]
    ]
    statistics = analyze(rows, task=TASK, headline="success_strict", resamples=50)
    found = {(s.motion, s.delay): s.points for s in lead_series(statistics)}
    assert {key: sorted(points) for key, points in found.items()} == {
        ("recorded", 0): [0],
        ("sway", 4): [-2, 1],
    }
    assert found["sway", 4][1].condition.name == "current_pred_h1"
    drawn = {figure.name: figure for figure in benchmark_figures(statistics)}
    assert drawn["net_lead"].title == "Strict success against net lead"
    shown = words(drawn["net_lead"])
    assert "strict success, %" in shown
    panels = ["recorded", "sway", "0 frames late", "4 frames late"]
    assert [word for word in shown if word in panels] == panels
    few = replace(statistics, conditions=statistics.conditions[:2])
    assert "net_lead" not in [figure.name for figure in benchmark_figures(few)]


def test_every_episode_is_drawn_or_counted(statistics: BenchmarkStatistics) -> None:
    one = replace(statistics, conditions=statistics.conditions[:1])
    figure = render_figure("arrivals", "", draw_episodes(ARRIVALS), one)
    (note,) = (word for word in words(figure) if "not at the face" in word)
    missing = sum(int(number) for number in re.findall(r"\d+", note))
    root = ElementTree.fromstring(figure.svg)
    uses = root.iter("{http://www.w3.org/2000/svg}use")
    markers = [
        u for u in uses if "fill-opacity" in u.get("style", "") or "opacity" in u.get("style", "")
    ]
    assert len(markers) + missing == 200


def test_the_same_figures_give_the_same_bytes(
    figures: dict[str, ReportFigure], statistics: BenchmarkStatistics
) -> None:
    again = render_figure("completion_times", "", draw_completion_times, statistics)
    assert again.svg == figures["completion_times"].svg
    assert "<dc:date>" not in figures["completion_times"].svg


def test_inline_pictures_share_a_page(figures: dict[str, ReportFigure]) -> None:
    page = "".join(figure.inline for figure in figures.values())
    names = re.findall(r'\bid="([^"]+)"', page)
    assert len(names) == len(set(names))
    referred = set(re.findall(r'(?:href="#|url\(#)([^")]+)', page))
    assert referred
    assert referred <= set(names)
    assert INK not in page
    assert "currentColor" in page
    assert "<?xml" not in page
    for figure in figures.values():
        ElementTree.fromstring(figure.inline)


def test_files_have_a_white_ground(tmp_path: Path, figures: dict[str, ReportFigure]) -> None:
    paths = write_figures(tmp_path, list(figures.values()))
    assert [path.name for path in paths] == [f"{name}.svg" for name in figures]
    for path in paths:
        root = ElementTree.parse(path).getroot()
        assert root[0].get("fill") == "#ffffff"


def test_many_episodes_become_pixels(
    monkeypatch: pytest.MonkeyPatch,
    statistics: BenchmarkStatistics,
    figures: dict[str, ReportFigure],
) -> None:
    monkeypatch.setattr("robo_manip_baselines.benchmark.report.figures.MANY_POINTS", 10)
    one = replace(statistics, conditions=statistics.conditions[:1])
    for draw in (draw_episodes(ARRIVALS), draw_completion_times):
        figure = render_figure("many", "", draw, one)
        assert "data:image/png;base64" in figure.svg
        ElementTree.fromstring(figure.inline)


def test_little_is_drawn_too(make_rows: MakeRows) -> None:
    rows = make_rows(conditions=["shuffled_future"], train_seeds=1, episodes=1)
    result = replace(
        rows[0].result,
        is_success=False,
        completion_time=None,
        failure="never_grasped",
        columns={**rows[0].result.columns, "closest_offset": None, "cube_offset": None},
    )
    statistics = analyze([replace(rows[0], result=result)], task=TASK, resamples=50)
    figures = {figure.name: figure for figure in benchmark_figures(statistics)}
    names = ["success_by_condition", "completion_times", "arrivals", "failures", "touches"]
    assert list(figures) == names
    for figure in figures.values():
        ElementTree.fromstring(figure.svg)
        assert "paper" not in figure.caption
    assert figures["completion_times"].summary == "No episode succeeded."


def test_conditions_without_a_place_on_the_horizon_have_a_row_each(make_rows: MakeRows) -> None:
    conditions = ["shuffled_future", "current_delay3"]
    rows = make_rows(conditions=conditions, train_seeds=1, episodes=20)
    one = [row for row in rows if row.result.condition == conditions[0]]
    of_both, of_one = (analyze(found, task=TASK, resamples=50) for found in (rows, one))
    both, alone = benchmark_figures(of_both)[0], benchmark_figures(of_one)[0]
    assert both.name == alone.name == "success_by_condition"
    assert all(c.condition.label in " ".join(words(both)) for c in of_both.conditions)
    assert both.svg.count("<use ") == alone.svg.count("<use ") + 1  # its marker


def test_a_task_with_kinds_of_failure_of_its_own(make_rows: MakeRows) -> None:
    """A task without a study has the figures that every task has; its kinds may be many."""
    rows = make_rows(conditions=["baseline"], train_seeds=1, episodes=40)
    kinds = {f"kind_{number}": "a failure" for number in range(9)}
    failed = [row for row in rows if not row.result.is_success]
    named = [
        replace(row, result=replace(row.result, failure=f"kind_{number % 9}"))
        for number, row in enumerate(failed)
    ]
    task = replace(
        TASK, failures=kinds, study="", completion_time="from the first touch to success"
    )
    statistics = analyze(named, task=task, resamples=50)
    figures = {figure.name: figure for figure in benchmark_figures(statistics)}
    assert list(figures) == ["success_by_horizon", "completion_times", "failures", "touches"]
    assert "from the first touch to success, s" in words(figures["completion_times"])
    assert {f"kind {number}" for number in range(9)} <= set(words(figures["failures"]))
    assert "<pattern" in figures["failures"].svg
