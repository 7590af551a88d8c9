"""The page on the report says what the code does."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

import pytest

from robo_manip_baselines.benchmark.report.plots import benchmark_plots
from robo_manip_baselines.benchmark.statistics.outcomes import Line
from robo_manip_baselines.benchmark.statistics.study import Study, analyse
from robo_manip_baselines.benchmark.tables.study import study_tables

pytestmark = pytest.mark.long

PAGE = (Path(__file__).parents[3] / "docs" / "benchmark_report.md").read_text(encoding="utf-8")


def test_tables_and_plots_are_there(study: Study) -> None:
    named = re.findall(r"^\| `(\w+)` \|", PAGE, flags=re.MULTILINE)
    assert named == [table.name for table in study_tables(study)]
    section = PAGE.partition("## Plots\n")[2].partition(". SVG")[0]
    drawn = [plot.name for plot in benchmark_plots(study)]
    assert re.findall(r"`(\w+)`", section) == drawn


def test_the_example_runs(
    make_lines: Callable[..., tuple[Line, ...]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    lines = make_lines(arms=["baseline", "current"], train_seeds=1, episodes=6)
    for arm in ("baseline", "current"):
        folder = Path("results/feeding") / arm
        folder.mkdir(parents=True)
        own = [line.result.to_line() for line in lines if line.result.arm == arm]
        (folder / "results.jsonl").write_text("\n".join(own) + "\n")
    (example,) = re.findall(r"```python\n(.*?)```", PAGE, flags=re.DOTALL)
    names: dict[str, object] = {}
    exec(example, names)
    found = names["study"]
    assert isinstance(found, Study)
    assert found.arms[0].time == analyse(lines).arms[0].time
    made = {str(path.relative_to("results/feeding")) for path in Path("results").rglob("*.*")}
    assert {"report.html", "tables/success.tex", "plots/arrivals.svg"} <= made
    assert "current/results.jsonl" in Path("results/feeding/report.html").read_text()
