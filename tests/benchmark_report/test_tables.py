"""One table, three formats; and what stands in the tables of a benchmark."""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from robo_manip_baselines.benchmark.aggregation import closing_summary
from robo_manip_baselines.benchmark.statistics.analysis import BenchmarkStatistics, analyze
from robo_manip_baselines.benchmark.statistics.outcomes import ResultRow
from robo_manip_baselines.benchmark.tables.benchmark import benchmark_tables
from robo_manip_baselines.benchmark.tables.columns import (
    later,
    p_text,
    p_values,
    percent,
    points,
    seconds,
)
from robo_manip_baselines.benchmark.tables.table import (
    Cell,
    Column,
    Row,
    Table,
    to_csv,
    to_latex,
    to_markdown,
    write_tables,
)
from robo_manip_baselines.envs.mujoco.tasks.feeding import ENTRY as TASK
from robo_manip_baselines.envs.mujoco.tasks.feeding.paper import STUDY

SMALL = Table(
    "small",
    "50 % of a_b | c",
    (Column("Name", ("name",), is_text=True), Column("Rate & more", ("rate", "is_good"))),
    (
        Row("one", (Cell("a_1 | <b>", ("a_1",)), Cell("−3.5 ± 1", (-0.035, True), is_strong=True))),
        Row("two", (Cell("50% {x}\\y~^", ("q",)), Cell("–", (None, False)))),
        Row("two", (Cell("“c” $ #", ("c",)), Cell("2 × 3 > 5", (1 / 3, False)))),
    ),
    notes=("A note_1.", "Another."),
)


def test_markdown() -> None:
    assert to_markdown(SMALL) == (
        "**50 % of a\\_b \\| c**\n"
        "\n"
        "| Name | Rate \\& more |\n"
        "| --- | --: |\n"
        "| a\\_1 \\| \\<b\\> | **−3.5 ± 1** |\n"
        "| 50% {x}\\\\y\\~^ | – |\n"
        "| “c” \\$ # | 2 × 3 \\> 5 |\n"
        "\n"
        "A note\\_1. Another.\n"
    )


def test_csv_has_every_value_in_full() -> None:
    rows = list(csv.DictReader(io.StringIO(to_csv(SMALL))))
    assert rows[0] == {"group": "one", "name": "a_1", "rate": "-0.035", "is_good": "true"}
    assert rows[1] == {"group": "two", "name": "q", "rate": "", "is_good": "false"}
    assert float(rows[2]["rate"]) == 1 / 3


def test_latex() -> None:
    text = to_latex(SMALL)
    body = text.partition(r"\toprule")[2].partition(r"\bottomrule")[0].strip().splitlines()
    assert body == [
        r"Name & Rate \& more \\",
        r"\midrule",
        r"a\_1 | \textless{}b\textgreater{} & \textbf{$-$3.5 $\pm$ 1} \\",
        r"\addlinespace",
        r"50\% \{x\}\textbackslash{}y\textasciitilde{}\textasciicircum{} & -- \\",
        r"``c'' \$ \# & 2 $\times$ 3 \textgreater{} 5 \\",
    ]
    assert r"\caption{50 \% of a\_b | c}" in text
    assert r"\begin{tabular}{lr}" in text
    assert r"\label{tab:small}" in text
    assert text.endswith("% A note_1.\n% Another.\n")


def test_a_table_with_a_hole_is_refused() -> None:
    row = SMALL.rows[0]
    with pytest.raises(ValueError, match="argument 2 is shorter"):
        replace(SMALL, rows=(replace(row, cells=row.cells[:1]),))
    with pytest.raises(ValueError, match="has not the values rate, is_good"):
        replace(SMALL, rows=(replace(row, cells=(row.cells[0], Cell("1", (1,)))),))


def test_numbers_are_formatted_alike() -> None:
    assert [percent(x) for x in (0.74, 1.0)] == ["74.0 %", "100.0 %"]
    assert [points(x) for x in (0.04, -0.125, -0.0001, 0.0)] == ["+4.0", "−12.5", "0.0", "0.0"]
    assert [later(x) for x in (0.25, -0.25, -0.001)] == ["+0.25", "−0.25", "0.00"]
    assert seconds(4.305) == "4.30"
    assert [p_text(p) for p in (0.0004, 0.0496)] == ["< 0.001", "0.050"]


@pytest.mark.long
def test_p_values_are_bold_below_the_limit(statistics: BenchmarkStatistics) -> None:
    found = [
        replace(c, success_difference=replace(c.success_difference, p=p, p_holm=p))
        for c, p in zip(statistics.conditions, (0.049, 0.05, None), strict=False)
    ]
    raw, corrected = (column.cells(found) for column in p_values("A", "success_difference", {}))
    assert [cell.text for cell in corrected] == ["0.049", "0.050", "–"]
    assert [cell.is_strong for cell in corrected] == [True, False, False]
    assert not any(cell.is_strong for cell in raw)
    assert [cell.selection is None for cell in raw] == [False, False, True]


@pytest.mark.long
def test_untrained_policies_are_not_compared(statistics: BenchmarkStatistics) -> None:
    """No p-value, no verdict and nothing in bold; the numbers themselves stay."""
    plain = {table.name: table for table in benchmark_tables(statistics)}
    for table in benchmark_tables(statistics, "hardly trained"):
        before = plain[table.name]
        names = [column.names[0] for column in table.columns]
        is_comparison = bool({"p", "verdict", "is_compatible"} & set(names))
        assert ("No comparison: hardly trained" in table.notes) == is_comparison
        for row, old in zip(table.rows, before.rows, strict=True):
            for name, cell, own in zip(names, row.cells, old.cells, strict=True):
                assert not cell.is_strong
                if name in ("verdict", "is_compatible"):
                    assert cell.text == "no comparison"
                elif name in ("p", "p_holm"):
                    assert (cell.text, cell.values) == ("–", (None,))
                else:
                    assert cell.values == own.values


def test_written_whole_in_three_formats(tmp_path: Path, statistics: BenchmarkStatistics) -> None:
    tables = benchmark_tables(statistics)
    paths = write_tables(tmp_path / "tables", tables)
    assert {path.suffix for path in paths} == {".md", ".csv", ".tex"}
    assert len(set(paths)) == 3 * len(tables) == 30
    for path in paths:
        text = path.read_text(encoding="utf-8")
        assert text.endswith("\n")
        assert "None" not in text
        assert "nan" not in text
        if path.suffix == ".tex":
            body = text.partition("\n%")[0]
            assert body.count("{") == body.count("}")
            # What is not ASCII by now would stop pdfLaTeX.
            assert body.isascii(), re.findall(r"[^\x00-\x7f]", body)


def rows_of(tables: tuple[Table, ...], name: str) -> dict[str, dict[str, str]]:
    (table,) = (table for table in tables if table.name == name)
    rows = csv.DictReader(io.StringIO(to_csv(table)))
    return {next(v for k, v in row.items() if k != "group"): row for row in rows}


@pytest.mark.long
def test_rows_of_the_benchmark(statistics: BenchmarkStatistics) -> None:
    tables = benchmark_tables(statistics)
    names = [c.condition.name for c in statistics.conditions]
    assert list(rows_of(tables, "success")) == names
    assert list(rows_of(tables, "completion_times")) == names
    assert list(rows_of(tables, "failures")) == names
    assert list(rows_of(tables, "success_differences")) == [n for n in names if n != "current"]
    assert list(rows_of(tables, "success_beside_paper")) == [
        n for n in names if n in STUDY.published
    ]
    assert list(rows_of(tables, "completion_times_beside_paper")) == [
        n for n in names if n in STUDY.published
    ]
    verdicts = rows_of(tables, "findings")
    assert [row["paper"] == "" for row in verdicts.values()] == 5 * [False] + [True]

    first = statistics.conditions[0]
    row = rows_of(tables, "success")["baseline"]
    assert int(row["episodes"]) == 200
    assert float(row["success"]) == first.success.rate
    assert (float(row["low"]), float(row["high"])) == (first.success.low, first.success.high)
    assert float(row["strict_high"]) == first.strict.high
    runs = rows_of(tables, "success_by_training_seed")["baseline"]
    for seed, part in first.success_by_seed.items():
        assert float(runs[f"seed_{seed}"]) == part.rate
        assert float(runs[f"seed_{seed}_low"]) == part.low
    rates = [part.rate or 0.0 for part in first.success_by_seed.values()]
    assert float(runs["range"]) == pytest.approx(abs(rates[0] - rates[1]))
    ends = rows_of(tables, "failures")["baseline"]
    assert int(ends["success"]) + sum(int(ends[kind]) for kind in TASK.failures) == 200
    beside = rows_of(tables, "success_beside_paper")["current_pred_h2"]
    assert beside["paper_success"] == "0.74"
    assert beside["is_compatible"] in ("true", "false")


@pytest.mark.long
def test_one_training_seed_has_no_columns_for_several(
    make_rows: Callable[..., tuple[ResultRow, ...]],
) -> None:
    rows = make_rows(conditions=["shuffled_future"], train_seeds=1, episodes=6)
    tables = benchmark_tables(analyze(rows, task=TASK, resamples=50))
    # Nothing to compare with: neither another condition, nor the paper, nor a finding.
    names = ["success", "completion_times", "safety", "measures", "failures"]
    assert [table.name for table in tables] == names
    assert "by_training_seed" not in to_csv(tables[1])
    assert "bootstrap" not in to_markdown(tables[0])
    assert to_markdown(tables[0]).count("**") == 4  # the title, and the best of one


@pytest.mark.long
def test_no_difference_seen_is_not_no_difference(
    make_rows: Callable[..., tuple[ResultRow, ...]],
) -> None:
    """Two conditions that end alike in four episodes: the claim's interval is the paired one's."""
    rows = make_rows(conditions=["baseline", "current"], train_seeds=1, episodes=4)
    alike = [
        replace(row, result=replace(row.result, is_success=False, completion_time=None))
        for row in rows
    ]
    statistics = analyze(alike, task=TASK, resamples=50)
    (claim,) = statistics.findings
    pairs = statistics.conditions[0].success_difference
    assert claim.verdict == "undecided"
    assert claim.contrast.high == pairs.difference.high == pytest.approx(1 - 0.025 ** (1 / 4))
    assert claim.contrast.low == pairs.difference.low


@pytest.mark.long
def test_the_declared_end_point_comes_first(
    make_rows: Callable[..., tuple[ResultRow, ...]],
) -> None:
    rows = make_rows(conditions=["baseline", "current"], train_seeds=1, episodes=40)
    statistics = analyze(rows, task=TASK, headline="success_strict", resamples=50)
    tables = {table.name: table for table in benchmark_tables(statistics)}
    names = [name for name in tables if name.endswith("differences")]
    assert names == ["strict_differences", "success_differences"]
    assert tables["strict_differences"].title == "Strict success against “Current only”"
    titles = [column.title for column in tables["success"].columns]
    assert titles[2:5:2] == ["Strict success", "Success"]
    best = max(statistics.conditions, key=lambda c: c.strict.rate or 0.0).condition.name
    strong = [
        (row.cells[0].values[0], column.title)
        for row in tables["success"].rows
        for column, cell in zip(tables["success"].columns, row.cells, strict=True)
        if cell.is_strong
    ]
    assert strong == [(best, "Strict success")]
    (row,) = tables["strict_differences"].rows
    won, lost = row.cells[5].values
    found = statistics.of("baseline").strict_difference
    assert (won, lost) == (found.wins, found.losses)
    assert row.cells[5].selection is not None
    assert row.cells[5].selection.is_strictly_different


def test_tables_name_each_conditions_reference(
    make_rows: Callable[..., tuple[ResultRow, ...]],
) -> None:
    names = ["current", "current_pred_h2", "current_delay3", "current_pred_h2_delay3"]
    rows = make_rows(conditions=names, train_seeds=1, episodes=20)
    references = {name: names[n - n % 2] for n, name in enumerate(names)}
    statistics = analyze(rows, task=TASK, reference=references, resamples=50)
    tables = {table.name: table for table in benchmark_tables(statistics)}
    differences = tables["success_differences"]
    assert differences.title == "Success against the reference"
    assert [row.cells[0].values[0] for row in differences.rows] == names[1::2]
    labels = [statistics.of(name).condition.label for name in names[::2]]
    assert [row.cells[1].text for row in differences.rows] == labels
    for row, reference in zip(differences.rows, names[::2], strict=True):
        assert all(c.selection.versus == (reference,) for c in row.cells[2:] if c.selection)
    times = {row.cells[0].values[0]: row for row in tables["completion_times"].rows}
    against = [column.title for column in tables["completion_times"].columns].index("Against")
    assert times["current_pred_h2_delay3"].cells[against].text == labels[1]
    assert times["current_delay3"].cells[against].values == (None,)


def test_safety_is_beside_success(rows: tuple[ResultRow, ...]) -> None:
    own = [row for row in rows if row.result.condition == "current"]
    statistics = analyze(own, task=TASK, resamples=50)
    tables = benchmark_tables(statistics)
    (row,) = rows_of(tables, "safety").values()
    safety = [r.result.safety for r in own if r.result.safety]
    assert int(row["episodes_above_10"]) == sum(s.force > 10 for s in safety)
    assert int(row["times_above_65"]) == 0
    assert float(row["force_max"]) == max(s.force for s in safety)
    assert float(row["success_safe"]) == pytest.approx(
        sum(s.success_safe for s in safety) / len(safety)
    )
    assert (row["refusals"], row["refusals_respected"]) == ("", "")
    (success,) = rows_of(tables, "success").values()
    assert success["success_safe"] == row["success_safe"]
    assert float(success["success_safe"]) < float(success["success"])


def test_rows_of_earlier_releases_have_no_safety(rows: tuple[ResultRow, ...]) -> None:
    own = [row for row in rows if row.result.condition == "current"]
    own[3] = replace(own[3], result=replace(own[3].result, safety=None))
    statistics = analyze(own, task=TASK, resamples=50)
    assert statistics.conditions[0].safety is None
    tables = {table.name: table for table in benchmark_tables(statistics)}
    assert "safety" not in tables
    assert "Safe success" not in [column.title for column in tables["success"].columns]


@pytest.mark.long
def test_further_end_points(make_rows: Callable[..., tuple[ResultRow, ...]]) -> None:
    """Rows of earlier releases know the peak force alone; a mean is over the rows that know."""
    rows = list(make_rows(conditions=["baseline"], train_seeds=1, episodes=11))
    for number, row in enumerate(rows):
        columns = {**row.result.columns, "face_force": float(number)}
        if number < 5:
            columns["dwell"] = 0.1 * number
        rows[number] = replace(row, result=replace(row.result, columns=columns))
    (row,) = rows_of(benchmark_tables(analyze(rows, task=TASK, resamples=50)), "measures").values()
    assert (float(row["face_force"]), float(row["face_force_p90"])) == (5.0, 9.0)
    assert float(row["dwell"]) == pytest.approx(0.2)
    assert float(row["dwell_p90"]) == pytest.approx(0.36)
    assert row["force_time_1"] == ""


@pytest.mark.long
@pytest.mark.parametrize("people", [1, 5])
def test_intervals_over_people_are_beside_the_others(
    make_rows: Callable[..., tuple[ResultRow, ...]], people: int
) -> None:
    rows = make_rows(conditions=["baseline", "current"], train_seeds=1, episodes=40)
    if people == 1:
        rows = tuple(replace(r, result=replace(r.result, motion_subject="me")) for r in rows)
    tables = benchmark_tables(analyze(rows, task=TASK, resamples=50))
    (row,) = rows_of(tables, "success_differences").values()
    assert row["people"] == str(people)
    assert (row["people_low"] == "") is (people == 1)
    text = to_markdown(next(t for t in tables if t.name == "success_differences"))
    assert ("one person" if people == 1 else "(5 people)") in text


@pytest.mark.long
@pytest.mark.parametrize("train_seeds", [1, 2])
def test_verdicts_on_one_training_run_say_so(
    make_rows: Callable[..., tuple[ResultRow, ...]], train_seeds: int
) -> None:
    rows = make_rows(conditions=["baseline", "current"], train_seeds=train_seeds, episodes=6)
    claims = benchmark_tables(analyze(rows, task=TASK, resamples=50))[0]
    assert claims.name == "findings"
    assert any("one training run of each condition" in note for note in claims.notes) is (
        train_seeds == 1
    )


@pytest.mark.long
def test_a_task_without_a_study(make_rows: Callable[..., tuple[ResultRow, ...]]) -> None:
    """All tables but those of the paper, without its names, without the column of a time limit."""
    task = replace(TASK, success_time_limit=None, study="", strict_success="", failures={})
    rows = make_rows(conditions=["baseline", "current"], train_seeds=1, episodes=6)
    tables = {t.name: t for t in benchmark_tables(analyze(rows, task=task, resamples=50))}
    assert list(tables) == [
        *("success", "success_differences", "completion_times", "safety", "measures", "failures"),
    ]
    assert tables["success"].title == "Success rates"
    assert tables["completion_times"].title == "Completion times"
    assert len(tables["success"].columns) == 8
    assert len(tables["failures"].columns) == 3
    assert "aper" not in "".join(map(to_markdown, tables.values()))


def test_the_closing_table_has_both_rates_and_the_force(
    rows: tuple[ResultRow, ...], statistics: BenchmarkStatistics
) -> None:
    pushed = tuple(
        replace(row, result=replace(row.result, columns={**row.result.columns, "face_force": f}))
        for row, f in zip(rows, [1.0, 4.0] * (len(rows) // 2), strict=True)
    )
    strict = analyze(pushed, task=statistics.task, resamples=50, headline="success_strict")
    for given, first, second in (
        (strict, "strict success", "success"),
        (analyze(pushed, task=statistics.task, resamples=50), "success", "strict success"),
    ):
        lines = closing_summary(given, Path("out")).splitlines()
        for c, line in zip(given.conditions, lines, strict=False):
            rates = {"success": c.success, "strict success": c.strict}
            assert line.startswith(c.condition.label)
            assert f"200 episodes, {first} {rates[first]}, {second} " in line
            assert c.safe is not None
            end = f"{second} {rates[second].rate:.1%}, safe success {c.safe.rate:.1%}"
            assert line.endswith(f"{end}, mean face force 2.5 N")
        assert lines[-1].split() == ["report", "out/report.html"]
