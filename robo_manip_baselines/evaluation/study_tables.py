"""The tables of a benchmark: Tables IV and V of the paper with intervals, differences, failures."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable

from robo_manip_baselines.evaluation.cells import (
    ARM,
    arm_cell,
    arm_table,
    interval_cell,
    later,
    p_cell,
    reference_label,
    seconds,
)
from robo_manip_baselines.evaluation.failure import FAILURES
from robo_manip_baselines.evaluation.paper_tables import (
    findings_table,
    success_beside_paper,
    times_beside_paper,
)
from robo_manip_baselines.evaluation.statistics.comparison import SIGNIFICANCE
from robo_manip_baselines.evaluation.statistics.intervals import Estimate
from robo_manip_baselines.evaluation.statistics.lines import Selection
from robo_manip_baselines.evaluation.statistics.study import ArmFigures, Study
from robo_manip_baselines.evaluation.success_tables import (
    success_by_training_seed,
    success_differences,
    success_table,
)
from robo_manip_baselines.evaluation.tables import NOTHING, Cell, Column, Table

_NO_ESTIMATE = Estimate(None, None, None, 0)


def study_tables(study: Study) -> tuple[Table, ...]:
    """Return all tables that have a row, in the order in which a reader wants them."""
    tables = (
        findings_table(study),
        success_table(study),
        success_by_training_seed(study),
        success_differences(study),
        success_beside_paper(study),
        times_table(study),
        times_beside_paper(study),
        failures_table(study),
    )
    return tuple(table for table in tables if table.rows)


def times_table(study: Study) -> Table:
    """Table V: completion times of successes, and against the reference's on common seeds."""
    means = [figures.time.mean for figures in study.arms if figures.time.mean is not None]
    columns = [
        ARM,
        Column("Successes", ("successes",)),
        Column("Time, s", ("time",)),
        Column("95 % interval", ("low", "high")),
        Column("Pairs", ("pairs",)),
        Column("Difference, s", ("difference",)),
        Column("Its 95 % interval", ("difference_low", "difference_high")),
        Column("Wilcoxon p", ("p",)),
        Column("Holm p", ("p_holm",)),
    ]
    if study.has_many_train_seeds:
        columns.insert(4, Column("By training seed", ("by_training_seed",)))

    def cells(figures: ArmFigures) -> list[Cell]:
        name, time = figures.arm.name, figures.time
        won = Selection(name, is_success=True)
        both = Selection(name, is_success=True, versus=(study.reference,))
        pairs = figures.paired_times
        d = pairs.difference if pairs else _NO_ESTIMATE
        found = [
            arm_cell(figures),
            Cell(str(time.n), (time.n,), won),
            Cell(
                seconds(time.mean),
                (time.mean,),
                won,
                is_strong=time.mean is not None and time.mean == min(means),
            ),
            interval_cell(time.low, time.high, seconds, won),
            Cell(str(d.n), (d.n,), both) if pairs else Cell(NOTHING, (None,)),
            Cell(later(d.mean), (d.mean,), both if pairs else None),
            interval_cell(d.low, d.high, later, both),
            p_cell(pairs.p if pairs else None, both),
            p_cell(figures.p_times, both, is_strong=True),
        ]
        if study.has_many_train_seeds:
            parts = figures.time_by_seed.values()
            found.insert(4, Cell(" / ".join(map(seconds, parts)), (_joined(parts),), won))
        return found

    notes = (
        "Time: mean from the lift to success, over successes only, with a bootstrap interval"
        + (" over training and evaluation seeds." if study.has_many_train_seeds else "."),
        f"Difference: minus {reference_label(study)}, over episodes that both managed, so that an "
        "arm does not look fast for failing where it is slow; Wilcoxon's signed-rank test, "
        f"Holm-corrected over the rows, bold below {SIGNIFICANCE:.2f}.",
    )
    title = "Table V: completion times"
    return arm_table(study, "completion_times", title, tuple(columns), cells, notes)


def failures_table(study: Study) -> Table:
    """How many episodes of each arm failed in which way."""
    columns = (
        ARM,
        Column("Episodes", ("episodes",)),
        Column("Success", ("success",)),
        *(Column(kind.replace("_", " ").capitalize(), (kind,)) for kind in FAILURES),
    )

    def cells(figures: ArmFigures) -> list[Cell]:
        name = figures.arm.name
        counts = Counter(line.result.failure for line in figures.lines)
        return [
            arm_cell(figures),
            Cell(str(len(figures.lines)), (len(figures.lines),), Selection(name)),
            Cell(
                str(figures.success.count),
                (figures.success.count,),
                Selection(name, is_success=True),
            ),
            *(
                Cell(str(counts[kind]), (counts[kind],), Selection(name, failure=kind))
                for kind in FAILURES
            ),
        ]

    notes = tuple(
        f"{kind.replace('_', ' ').capitalize()}: {what}." for kind, what in FAILURES.items()
    )
    return arm_table(study, "failures", "How episodes ended", columns, cells, notes)


def _joined(values: Iterable[float | None]) -> str:
    """Join figures of training seeds for the CSV, in full precision."""
    return ";".join("" if value is None else repr(value) for value in values)
