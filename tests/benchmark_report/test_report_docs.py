"""The page of the documentation about the report."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

import pytest

from robo_manip_baselines.benchmark.report.figures import benchmark_figures
from robo_manip_baselines.benchmark.statistics.analysis import BenchmarkStatistics, analyze
from robo_manip_baselines.benchmark.statistics.outcomes import ResultRow
from robo_manip_baselines.benchmark.tables.benchmark import benchmark_tables
from robo_manip_baselines.envs.mujoco.tasks.feeding import ENTRY as TASK

pytestmark = pytest.mark.long

PAGE = (Path(__file__).parents[2] / "docs" / "benchmark_report.md").read_text(encoding="utf-8")


def test_tables_and_figures_are_there(statistics: BenchmarkStatistics) -> None:
    named = re.findall(r"^\| `(\w+)` \|", PAGE, flags=re.MULTILINE)
    assert named == [table.name for table in benchmark_tables(statistics)]
    section = re.split(r"^## (?:Plots|Figures)\n", PAGE, flags=re.MULTILINE)[1].partition(". SVG")[
        0
    ]
    drawn = [figure.name for figure in benchmark_figures(statistics)]
    assert re.findall(r"`(\w+)`", section) == drawn


def test_the_example_runs(
    make_rows: Callable[..., tuple[ResultRow, ...]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    rows = make_rows(conditions=["baseline", "current"], train_seeds=1, episodes=6)
    for condition in ("baseline", "current"):
        folder = Path("results/feeding") / condition
        folder.mkdir(parents=True)
        own = [row.result.to_line() for row in rows if row.result.condition == condition]
        (folder / "results.jsonl").write_text("\n".join(own) + "\n")
    (example,) = re.findall(r"```python\n(.*?)```", PAGE, flags=re.DOTALL)
    names: dict[str, object] = {}
    exec(example, names)
    found = names["statistics"]
    assert isinstance(found, BenchmarkStatistics)
    assert found.conditions[0].time == analyze(rows, task=TASK).conditions[0].time
    made = {str(path.relative_to("results/feeding")) for path in Path("results").rglob("*.*")}
    assert {"report.html", "tables/success.tex", "plots/arrivals.svg"} <= made
    assert "current/results.jsonl" in Path("results/feeding/report.html").read_text()
