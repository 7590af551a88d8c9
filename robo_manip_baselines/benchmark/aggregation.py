"""What a benchmark came to: result lines of all arms in one file, tables, plots, a report.

All of it is made from the units' files alone, in a fixed order: it is the same whoever did the
units, where and in which order.
"""

from __future__ import annotations

import json
import logging
import os
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

from robo_manip_baselines.benchmark.plan import Plan, Run
from robo_manip_baselines.benchmark.report.figures import write_plots
from robo_manip_baselines.benchmark.report.page import (
    episodes_to_show,
    read_video,
    report_data,
    write_report,
)
from robo_manip_baselines.benchmark.statistics.outcomes import Line, read_lines
from robo_manip_baselines.benchmark.statistics.study import Study, analyse
from robo_manip_baselines.benchmark.tables.table import write_tables
from robo_manip_baselines.benchmark.work_item import Store, Unit, versions
from robo_manip_baselines.rollout.results import RESULTS, read_results
from robo_manip_baselines.runs.files import atomic_file

REPORT = "report.html"
VERSIONS = "versions.json"
COMMANDS = "commands.txt"
TABLES = "tables"
PLOTS = "plots"

logger = logging.getLogger(__name__)


def write_results(plan: Plan, store: Store, out: Path, reference: str | None = None) -> Study:
    """Write ``results.jsonl`` and work out the figures.

    Args:
        plan: all of whose evaluations are done.
        store: holds them.
        out: folder to write to.
        reference: arm that the others are compared with, see ``analyse``.
    """
    lines = [
        replace(result, arm=run.arm.name).to_line()
        for run in plan.runs
        for unit in run.evaluations
        for result in read_results(store.files(unit)[RESULTS].parent)
    ]
    _write(out / RESULTS, "".join(f"{line}\n" for line in lines))
    described = {arm.name: arm.described for arm in plan.arms}
    return analyse(read_lines([out / RESULTS], out), reference=reference, described=described)


def videos_to_make(plan: Plan, study: Study) -> dict[Unit, Line]:
    """Return the units that draw a success and a failure of each arm, and whose lines they are."""
    runs = {(run.arm.name, run.train_seed): run for run in plan.runs}
    shown = episodes_to_show(study)
    return {plan.video(_run(runs, line), line.result): line for line in shown}


def write_outcome(
    plan: Plan, store: Store, study: Study, out: Path, videos: Mapping[Unit, Line], command: str
) -> None:
    """Write tables, plots, the report, and how all of it came about.

    Args:
        plan: what was done.
        store: holds the files of the units.
        study: from ``write_results``.
        out: folder to write to.
        videos: units that have drawn episodes.
        command: line that did all this.
    """
    drawn = [(path, line) for unit, line in videos.items() for path in _videos(store, unit)]
    with ThreadPoolExecutor(os.cpu_count()) as pool:  # PyAV and OpenCV let go of the GIL
        clips = list(pool.map(lambda video: read_video(*video), drawn))
    preset = plan.preset
    facts = {
        "Command": command,
        "Demonstrations": f"{preset.demonstrations} of each expert, "
        + (f"cameras {', '.join(preset.cameras)}" if preset.cameras else "without images"),
    }
    if preset.caution:
        facts["Caution"] = preset.caution
    data = report_data(study, title=f"Benchmark {plan.env}", videos=clips, facts=facts)
    _keep_only(out / TABLES, write_tables(out / TABLES, data.tables))
    _keep_only(out / PLOTS, write_plots(out / PLOTS, data.plots))
    _write(out / VERSIONS, json.dumps(versions(), indent=2) + "\n")
    _write(out / COMMANDS, "".join(f"{line}\n" for line in commands(plan, command)))
    write_report(out / REPORT, data)


def commands(plan: Plan, command: str) -> list[str]:
    """Return the command of the whole, and of each unit in the folder that it ran in."""
    script = {"demonstrations": "Rollout.py", "training": "Train.py", "evaluation": "Rollout.py"}
    return [
        command,
        *(
            f"# {unit.folder}: python bin/{script[unit.kind]} {' '.join(unit.settings['args'])}"
            for unit in plan.units()
        ),
    ]


def summary(study: Study, out: Path) -> str:
    """Lay out the closing table."""
    rows: Sequence[tuple[str, str]] = [
        *(
            (
                figures.arm.label,
                f"{figures.outcomes.episodes:4d} episodes, success {figures.success}",
            )
            for figures in study.arms
        ),
        ("tables", str(out / TABLES)),
        ("report", str(out / REPORT)),
    ]
    width = max(len(name) for name, _ in rows)
    return "\n".join(f"{name:<{width}}  {value}" for name, value in rows)


def _run(runs: Mapping[tuple[str, int], Run], line: Line) -> Run:
    return runs[line.result.arm, line.result.train_seed or 0]


def _videos(store: Store, unit: Unit) -> list[Path]:
    return [path for path in store.files(unit).values() if path.suffix == ".mp4"]


def _keep_only(folder: Path, written: Sequence[Path]) -> None:
    """Remove what an earlier, other benchmark has left in a folder."""
    for path in folder.iterdir() if folder.is_dir() else ():
        if path not in written:
            path.unlink()


def _write(path: Path, text: str) -> None:
    with atomic_file(path) as temporary:
        temporary.write_text(text, encoding="utf-8")
