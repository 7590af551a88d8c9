"""The plots: what is in them, and that they come out the same."""

from __future__ import annotations

import re
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from robo_manip_baselines.benchmark.report.figures import INK, Plot, write_plots
from robo_manip_baselines.benchmark.report.plots import (
    arrivals,
    benchmark_plots,
    completion_times,
    delay_surface,
    failure_kinds,
    success_by_horizon,
)
from robo_manip_baselines.benchmark.statistics.outcomes import Line
from robo_manip_baselines.benchmark.statistics.study import Study, analyse

pytestmark = pytest.mark.long

MakeLines = Callable[..., tuple[Line, ...]]


def words(plot: Plot) -> list[str]:
    """All that is written in a plot, in the order in which it is drawn."""
    root = ElementTree.fromstring(plot.svg)
    return ["".join(node.itertext()) for node in root.iter("{http://www.w3.org/2000/svg}text")]


@pytest.fixture(scope="module")
def plots(study: Study) -> dict[str, Plot]:
    return {plot.name: plot for plot in benchmark_plots(study)}


def test_all_are_drawn_and_say_what_is_to_be_seen(plots: dict[str, Plot], study: Study) -> None:
    assert list(plots) == [
        "success_by_horizon",
        "completion_times",
        "arrivals",
        "failures",
        "delay_and_horizon",
    ]
    for plot in plots.values():
        assert plot.title
        assert plot.summary
    rates = {f.arm.label: f.success.rate or 0.0 for f in study.arms}
    assert max(rates, key=lambda label: rates[label]) in plots["success_by_horizon"].summary
    for name in ("completion_times", "failures"):
        assert [w for w in words(plots[name]) if w in rates] == list(rates)


def test_success_against_the_horizon(plots: dict[str, Plot]) -> None:
    text = words(plots["success_by_horizon"])
    assert text[:7] == ["baseline", "current", "1", "2", "3", "4", "5"]
    assert {"prediction without error", "prediction with error"} <= set(text)
    assert {"paper, without error", "paper, with error"} <= set(text)


def test_numbers_of_the_surface(plots: dict[str, Plot], study: Study) -> None:
    text = words(plots["delay_and_horizon"])
    late = study.of("current_pred_h2_delay3")
    assert late is not None
    shown = [f for f in study.arms if f.arm.error == "none" and f.arm.horizon is not None]
    for figures in shown:
        assert f"{100 * (figures.success.rate or 0):.0f}" in text
    assert delay_surface(replace(study, arms=study.arms[:4])) is None
    assert [f.arm.delay for f in shown].count(3) == 2


def test_every_episode_is_drawn_or_counted(study: Study) -> None:
    one = replace(study, arms=study.arms[:1])
    plot = arrivals(one)
    (note,) = (word for word in words(plot) if "not at the face" in word)
    missing = sum(int(number) for number in re.findall(r"\d+", note))
    root = ElementTree.fromstring(plot.svg)
    uses = root.iter("{http://www.w3.org/2000/svg}use")
    markers = [
        u for u in uses if "fill-opacity" in u.get("style", "") or "opacity" in u.get("style", "")
    ]
    assert len(markers) + missing == 200


def test_the_same_figures_give_the_same_bytes(plots: dict[str, Plot], study: Study) -> None:
    assert completion_times(study).svg == plots["completion_times"].svg
    assert "<dc:date>" not in plots["completion_times"].svg


def test_inline_pictures_share_a_page(plots: dict[str, Plot]) -> None:
    page = "".join(plot.inline for plot in plots.values())
    names = re.findall(r'\bid="([^"]+)"', page)
    assert len(names) == len(set(names))
    referred = set(re.findall(r'(?:href="#|url\(#)([^")]+)', page))
    assert referred
    assert referred <= set(names)
    assert INK not in page
    assert "currentColor" in page
    assert "<?xml" not in page
    for plot in plots.values():
        ElementTree.fromstring(plot.inline)


def test_files_have_a_white_ground(tmp_path: Path, plots: dict[str, Plot]) -> None:
    paths = write_plots(tmp_path, list(plots.values()))
    assert [path.name for path in paths] == [f"{name}.svg" for name in plots]
    for path in paths:
        root = ElementTree.parse(path).getroot()
        assert root[0].get("fill") == "#ffffff"


def test_many_episodes_become_pixels(
    monkeypatch: pytest.MonkeyPatch, study: Study, plots: dict[str, Plot]
) -> None:
    monkeypatch.setattr("robo_manip_baselines.benchmark.report.plots.MANY_POINTS", 10)
    one = replace(study, arms=study.arms[:1])
    for draw in (arrivals, completion_times):
        assert "data:image/png;base64" in draw(one).svg
        ElementTree.fromstring(draw(one).inline)


def test_little_is_drawn_too(make_lines: MakeLines) -> None:
    lines = make_lines(arms=["shuffled_future"], train_seeds=1, episodes=1)
    result = replace(
        lines[0].result,
        is_success=False,
        completion_time=None,
        failure="never_grasped",
        closest_offset=None,
        cube_offset=None,
    )
    study = analyse([replace(lines[0], result=result)], resamples=50)
    for draw in (success_by_horizon, completion_times, arrivals, failure_kinds):
        ElementTree.fromstring(draw(study).svg)
    assert completion_times(study).summary == "No episode succeeded."
