"""Titles of conditions are shown as they are written, whatever signs they hold."""

from __future__ import annotations

import csv
import html
import io
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable

import pytest

from robo_manip_baselines.benchmark.conditions import ConditionConfig
from robo_manip_baselines.benchmark.report.figures import INK, benchmark_figures, in_two_lines
from robo_manip_baselines.benchmark.report.page import make_report, render_report
from robo_manip_baselines.benchmark.statistics.analysis import BenchmarkStatistics, analyze
from robo_manip_baselines.benchmark.statistics.conditions import describe_condition
from robo_manip_baselines.benchmark.statistics.outcomes import ResultRow
from robo_manip_baselines.benchmark.tables.benchmark import benchmark_tables
from robo_manip_baselines.benchmark.tables.table import to_csv, to_latex, to_markdown
from robo_manip_baselines.envs.mujoco.tasks.feeding import ENTRY as TASK
from robo_manip_baselines.runs.errors import RequestError

MakeRows = Callable[..., tuple[ResultRow, ...]]

TITLES = {
    "current": "_costs $5_{x} & 100 %, #1",
    "current_pred_h2": "\\alpha $\\frac{$ ^ ~ `a` *b* | </text><b>",
    "current_pred_h2_uniform": f'id="x" href="#y" url(#z) {INK} ]]> --> &amp; \'',
}


@pytest.fixture(scope="module")
def titled(make_rows: MakeRows) -> BenchmarkStatistics:
    rows = make_rows(conditions=tuple(TITLES), train_seeds=1, episodes=12)
    conditions = {name: describe_condition(name, None, title) for name, title in TITLES.items()}
    return analyze(rows, task=TASK, conditions=conditions, resamples=50)


@pytest.mark.long
def test_figures_show_titles_as_they_are(titled: BenchmarkStatistics) -> None:
    figures = {figure.name: figure for figure in benchmark_figures(titled)}
    for figure in figures.values():
        for svg in (figure.svg, figure.inline):
            ElementTree.fromstring(svg)
    for name in ("completion_times", "failures"):
        for svg in (figures[name].svg, figures[name].inline):
            text = {"".join(node.itertext()) for node in ElementTree.fromstring(svg).iter()}
            assert set(TITLES.values()) <= text


@pytest.mark.long
def test_the_report_shows_titles_as_they_are(titled: BenchmarkStatistics) -> None:
    page = render_report(make_report(titled, title="Benchmark", videos=(), facts={}))
    assert "<b>" not in page.replace("<b></b>", "")
    for title in TITLES.values():
        assert title in html.unescape(page)


def test_tables_hold_titles_as_they_are(titled: BenchmarkStatistics) -> None:
    table = next(t for t in benchmark_tables(titled) if t.name == "success")
    cells = {cell for row in csv.reader(io.StringIO(to_csv(table))) for cell in row}
    assert set(TITLES) <= cells
    latex, markdown = to_latex(table), to_markdown(table)
    assert r"\_costs \$5\_\{x\} \& 100 \%, \#1" in latex
    assert r"\textbackslash{}alpha \$\textbackslash{}frac\{\$" in latex
    assert r"\_costs \$5\_{x} \& 100 %, #1" in markdown
    assert r"\</text\>\<b\>" in markdown


@pytest.mark.parametrize("title", ["a\nb", "a\x00", "\x1b[31m", "\u2028", "x" * 201])
def test_titles_that_are_no_line_are_refused(title: str) -> None:
    with pytest.raises(RequestError, match=r"^title ") as caught:
        ConditionConfig("a", title=title)
    assert str(caught.value).isprintable()


@pytest.mark.parametrize(
    ("label", "lines"),
    [
        ("Mouth, late", ["Mouth, late"]),
        ("Current + prediction, 2 frames", ["Current + prediction", "2 frames"]),
        ("Mouth, late, and its true future", ["Mouth, late", "and its true future"]),
        ("dyskinetic_delay4_current", ["dyskinetic_delay4_current"]),
    ],
)
def test_long_labels_are_broken_near_their_middle(label: str, lines: list[str]) -> None:
    assert in_two_lines(label).split("\n") == lines
