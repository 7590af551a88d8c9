"""Aggregation of a benchmark: result rows of all conditions in one file, tables, figures, report.

Everything is made from the files of the work items alone, in a fixed order: it does not depend on
where and in which order they were done.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

from robo_manip_baselines.benchmark.plan import Plan
from robo_manip_baselines.benchmark.report.figures import write_figures
from robo_manip_baselines.benchmark.report.page import (
    episodes_to_show,
    make_report,
    read_video,
    write_report,
)
from robo_manip_baselines.benchmark.statistics.analysis import (
    BenchmarkStatistics,
    ConditionStatistics,
    analyze,
)
from robo_manip_baselines.benchmark.statistics.conditions import describe_condition
from robo_manip_baselines.benchmark.statistics.outcomes import ResultRow, read_result_rows
from robo_manip_baselines.benchmark.tables.benchmark import mean_and_p90
from robo_manip_baselines.benchmark.tables.table import write_tables
from robo_manip_baselines.benchmark.work_item import (
    ITEMS,
    KINDS,
    ArtifactStore,
    WorkItem,
    item_versions,
)
from robo_manip_baselines.envs.mujoco.tasks.registry import task_entry
from robo_manip_baselines.rollout.results import RESULTS, read_results
from robo_manip_baselines.runs.documents import convert, read_json
from robo_manip_baselines.runs.errors import RequestError
from robo_manip_baselines.runs.files import (
    FolderKind,
    locked_file,
    write_json,
    write_text,
)
from robo_manip_baselines.runs.progress import closing_table
from robo_manip_baselines.runs.threads import processors

REPORT = "report.html"
VERSIONS = "versions.json"
CONFIGS = "configs.json"
EARLIER_ITEMS = "units"
"""Folder of the work items of earlier releases."""

TABLES = "tables"
FIGURES = "figures"


def aggregate_results(
    plan: Plan, store: ArtifactStore, out: Path, reference: str | None = None
) -> BenchmarkStatistics:
    """Write the result rows of all evaluations to ``results.jsonl``, and compute statistics.

    Args:
        plan: all of whose evaluations are done.
        store: of their outputs.
        out: folder to write to.
        reference: condition that the others are compared with; the plan's if None.
    """
    rows = [
        replace(result, condition=run.condition.name).to_line()
        for run in plan.runs
        for item in run.evaluations
        for result in read_results(store.outputs(item)[RESULTS].parent)
    ]
    write_text(out / RESULTS, "".join(f"{row}\n" for row in rows))
    # A condition of another expert or prediction is not what its observation alone describes.
    conditions = {c.name: describe_condition(c.name, c.spec, c.title) for c in plan.conditions}
    return analyze(
        read_result_rows([out / RESULTS], out),
        task=task_entry(plan.env),
        reference=reference or plan.references,
        conditions=conditions,
        headline=plan.headline,
    )


def videos_to_make(plan: Plan, statistics: BenchmarkStatistics) -> dict[WorkItem, ResultRow]:
    """Return work items that draw a success and a failure of each condition, with their rows."""
    return {plan.video(row.result): row for row in episodes_to_show(statistics)}


def write_aggregation(
    plan: Plan,
    store: ArtifactStore,
    statistics: BenchmarkStatistics,
    out: Path,
    videos: Mapping[WorkItem, ResultRow],
    command: str,
) -> None:
    """Write tables, figures, the report, and the configurations and versions behind them.

    Args:
        plan: all of whose items are done.
        store: of their outputs.
        statistics: from `aggregate_results`.
        out: folder to write to.
        videos: work items that have drawn episodes.
        command: command line of the benchmark.
    """
    with locked_file(out / CONFIGS, wait=True):
        preset = plan.preset
        drawn = [
            (path, row)
            for item, row in videos.items()
            for path in store.outputs(item).values()
            if path.suffix == ".mp4"
        ]
        with ThreadPoolExecutor(processors()) as pool:  # PyAV and OpenCV let go of the GIL
            clips = list(pool.map(lambda video: read_video(*video), drawn))
        facts = {"Command": command}
        if any(run.training for run in plan.runs):
            views = f"cameras {', '.join(preset.cameras)}" if preset.cameras else "without images"
            facts["Demonstrations"] = f"{preset.demonstrations} of each expert, {views}"
        if trained := [condition for condition in plan.conditions if condition.checkpoint]:
            facts["Trained already"] = ", ".join(f"{c.name}: {c.checkpoint}" for c in trained)
        facts["People"] = str(plan.people)
        facts["Face"] = plan.face
        title, caution = f"Benchmark {plan.env}", preset.caution
        report = make_report(statistics, title, videos=clips, facts=facts, caution=caution)
        written = write_tables(out / TABLES, report.tables)
        written += write_figures(out / FIGURES, report.figures)
        _remove_earlier(out, written)
        write_json(out / VERSIONS, item_versions())
        items = {item.folder: dict(item.settings) for item in plan.items()}
        files = [path.relative_to(out).as_posix() for path in written]
        write_json(out / CONFIGS, {"command": command, "items": items, "files": files})
        write_report(out / REPORT, report)


def closing_summary(statistics: BenchmarkStatistics, out: Path) -> str:
    """Lay out the table that the command prints at its end: the rates, and the peak force.

    The interval is that of the end point; of the task's columns in tables, the first one is shown.
    """
    columns = [column for column in statistics.task.columns if column.in_tables][:1]
    other = {"success": "strict success", "strict": "success"}[statistics.measure]

    def row(c: ConditionStatistics) -> str:
        rate = c.success.rate if statistics.measure == "strict" else c.strict.rate
        parts = [
            f"{c.outcomes.episodes:4d} episodes",
            f"{statistics.end_point} {statistics.rate(c)}",
            f"{other} {rate or 0.0:.1%}",
        ]
        if c.safe:
            parts.append(f"safe success {c.safe.rate or 0.0:.1%}")
        for column in columns:
            if (mean := mean_and_p90(c, column)[0]) is not None:
                parts.append(f"mean {column.name.replace('_', ' ')} {mean:.1f} {column.unit}")
        return ", ".join(parts)

    rows = {c.condition.label: row(c) for c in statistics.conditions}
    return closing_table(rows | {"tables": str(out / TABLES), "report": str(out / REPORT)})


def _remove_earlier(out: Path, written: Sequence[Path]) -> None:
    """Remove tables and figures of an earlier, different benchmark, by its list of them."""
    path = out / CONFIGS
    record = read_json(path).get("files", []) if path.exists() else []
    for name in convert(record, list[str], f"'{path}': files"):
        earlier = out / name
        if earlier.parent in (out / TABLES, out / FIGURES) and earlier not in written:
            earlier.unlink(missing_ok=True)


def _is_benchmark(folder: Path) -> bool:
    if (folder / EARLIER_ITEMS).exists():
        raise RequestError(
            f"'{folder}' holds a benchmark of an earlier release, which this one cannot continue; "
            "choose another --out"
        )
    items = folder / ITEMS
    return items.is_dir() and all(path.name in KINDS for path in items.iterdir())


BENCHMARK = FolderKind("benchmark of bin/Benchmark.py", _is_benchmark)
