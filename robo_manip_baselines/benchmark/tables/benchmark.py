"""Tables of a benchmark. Most have a row for each condition, and are lists of `Statistic`."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from typing import Any

import numpy as np

from robo_manip_baselines.benchmark.statistics.analysis import (
    BenchmarkStatistics,
    ConditionStatistics,
    Finding,
)
from robo_manip_baselines.benchmark.statistics.inference import SIGNIFICANCE
from robo_manip_baselines.benchmark.statistics.outcomes import RowSelection
from robo_manip_baselines.benchmark.tables.columns import (
    ALL,
    STRICT,
    SUCCESSES,
    Statistic,
    beside_paper,
    condition_table,
    ends,
    highest,
    interval,
    later,
    lowest,
    make_cell,
    p_values,
    percent,
    points,
    seconds,
)
from robo_manip_baselines.benchmark.tables.table import NOTHING, Cell, Column, Row, Table
from robo_manip_baselines.envs.mujoco.tasks.registry import ResultColumn
from robo_manip_baselines.envs.mujoco.tasks.safety import (
    FORCE_TIERS,
    NEAR_EYE,
    NEAR_FACE,
    SAFE_FORCE,
)

VERDICTS = ("verdict", "is_compatible")
"""Names of the columns that answer a question by a word."""


def benchmark_tables(statistics: BenchmarkStatistics, caution: str = "") -> tuple[Table, ...]:
    """Return all tables that have a row, the most important first.

    With a caution, why the results compare nothing, tables have no p-values and no verdicts.
    """
    tables = (
        findings_table(statistics),
        success_table(statistics),
        success_by_training_seed(statistics),
        *(success_differences(statistics, measure) for measure in _compared(statistics)),
        success_beside_paper(statistics),
        times_table(statistics),
        times_beside_paper(statistics),
        safety_table(statistics),
        measures_table(statistics),
        failures_table(statistics),
    )
    filled = [table for table in tables if table.rows]
    return tuple(without_verdicts(table, caution) if caution else table for table in filled)


def _compared(statistics: BenchmarkStatistics) -> tuple[str, ...]:
    """Measures that are compared with the reference's: the end point, and success."""
    return ("strict", "success") if statistics.measure == "strict" else ("success",)


def without_verdicts(table: Table, caution: str) -> Table:
    """Return a table with "no comparison" for verdicts, no p-values and nothing in bold.

    Where it had any of them, the caution is its first note.
    """
    names = [column.names[0] for column in table.columns]

    def plain(name: str, cell: Cell) -> Cell:
        nothing = (None,) * len(cell.values)
        if name in VERDICTS:
            return Cell("no comparison", nothing)
        if name in ("p", "p_holm"):
            return Cell(NOTHING, nothing)
        return replace(cell, is_strong=False)

    rows = tuple(replace(row, cells=tuple(map(plain, names, row.cells))) for row in table.rows)
    is_comparison = bool({"p", *VERDICTS} & set(names))
    notes = (f"No comparison: {caution}",) if is_comparison else ()
    return replace(table, rows=rows, notes=(*notes, *table.notes))


def findings_table(statistics: BenchmarkStatistics) -> Table:
    """Make the table of claims: the paper's contrasts, ours, and the verdicts."""
    columns = (
        Column("Claim", ("claim",), is_text=True),
        Column("Paper", ("paper",)),
        Column("Here", ("here",)),
        Column("95 % interval", ("low", "high")),
        Column("Episodes", ("episodes",)),
        Column("Verdict", ("verdict",), is_text=True),
    )

    def row(finding: Finding) -> Row:
        claim, theirs, d = finding.claim, finding.published, finding.contrast
        is_success = claim.measure == "success"
        text, unit = (points, "points") if is_success else (later, "s")
        first, *others = claim.weights
        rows = RowSelection(first, is_success=None if is_success else True, versus=tuple(others))

        def number(value: float) -> str:
            return f"{text(value)} {unit}"

        cells = (
            make_cell((claim.text,), str),
            make_cell((theirs,), number),
            make_cell((d.mean,), number, rows),
            make_cell((d.low, d.high), ends(text), rows),
            make_cell((d.n,), str, rows),
            make_cell((finding.verdict,), str, is_strong=bool),
        )
        return Row("Further claims" if theirs is None else "The paper's claims", cells)

    notes = [
        "Each is a difference between (means of) conditions, episode by episode, on seeds that all "
        "of them have; of times, on episodes in which all of them succeeded. It holds, or does "
        "not, where its interval lies on one side of the limit; otherwise the data cannot tell."
    ]
    if not statistics.has_many_train_seeds:
        notes.append(
            "With one training run of each condition, verdicts are about the policies that were "
            "trained: the intervals leave out how much another run would differ."
        )
    rows = tuple(map(row, statistics.findings))
    return Table("findings", "Claims and verdicts", columns, rows, tuple(notes))


def success_table(statistics: BenchmarkStatistics) -> Table:
    """Make the table of success rates."""
    task, limit = statistics.task, statistics.task.success_time_limit
    is_strict = statistics.measure == "strict"
    best: Any = (None, highest) if is_strict else (highest, None)
    rates = [
        Statistic("Success", "success", percent, "success.rate", SUCCESSES, best[0]),
        interval("95 % interval", percent, "success", ALL),
        Statistic("Strict success", "strict_success", percent, "strict.rate", STRICT, best[1]),
        interval("Its 95 % interval", percent, "strict", ALL, "strict_"),
    ]
    columns = [
        Statistic("Episodes", "episodes", str, "outcomes.episodes", ALL),
        *(rates[2:] + rates[:2] if is_strict else rates),
    ]
    note = "95 % interval: Wilson."
    if statistics.has_many_train_seeds:
        note = (
            "95 % interval: hierarchical bootstrap, training seeds, then the evaluation seeds that "
            "they share; too narrow with two or three training seeds that differ much. A condition "
            "with one training seed: Wilson, the training run being given."
        )
    notes = [note]
    if task.strict_success:
        notes.append(f"Strict success: {task.strict_success}.")
    if limit is not None:
        names = "in_time in_time_low in_time_high"
        paths = "within_limit.rate within_limit.low within_limit.high"
        columns.append(
            Statistic(
                f"In {limit:g} s", names, lambda rate, *_: percent(rate), paths, {"within": limit}
            )
        )
        notes.append(f"In {limit:g} s: success within that time, {task.completion_time}.")
    if all(c.safe for c in statistics.conditions):
        columns += [
            Statistic("Safe success", "success_safe", percent, "safe.rate", ALL),
            interval("Its 95 % interval", percent, "safe", ALL, "safe_"),
        ]
        notes.append(SAFE_SUCCESS)
    title = _titled(statistics.study.success_table, "Success rates")
    return condition_table("success", title, statistics.conditions, columns, notes)


SAFE_SUCCESS = (
    f"Safe success: success, no eye touched, and no force above {SAFE_FORCE:g} N on any region of "
    "the face, food on lips and mouth apart. It compares conditions; it is no claim about "
    "standards."
)


def safety_table(statistics: BenchmarkStatistics) -> Table:
    """Make the table of safety; without rows where rows of earlier releases do not say."""

    def number(value: float) -> str:
        return f"{value:.1f}"

    def above(tier: str) -> Statistic:
        def values(c: ConditionStatistics) -> tuple[Any, ...]:
            own = c.safety
            if own is None:
                return None, None, None
            return own.above[tier], own.times_above[tier], own.time_above[tier]

        return Statistic(
            f"Above {tier} N",
            f"episodes_above_{tier} times_above_{tier} time_above_{tier}",
            lambda episodes, times, time: f"{episodes} ({times} times, {time:.2f} s)",
            values,
            ALL,
        )

    def refusals(c: ConditionStatistics) -> tuple[Any, ...]:
        own = c.safety
        return (None, None) if own is None else (own.refusals, own.refusals_respected)

    columns = [
        Statistic("Episodes", "episodes", str, "outcomes.episodes", ALL),
        Statistic("Safe success", "success_safe", percent, "safe.rate", ALL, highest),
        interval("95 % interval", percent, "safe", ALL),
        Statistic(
            "Largest force, N",
            "force force_p90 force_max",
            "{:.1f} ({:.1f}; {:.1f})".format,
            "safety.force safety.force_p90 safety.force_max",
            ALL,
        ),
        *(above(str(tier)) for tier in FORCE_TIERS),
        Statistic("Food on lips, N", "food_force", number, "safety.food_force", ALL),
        Statistic("Eyes touched", "eye_contacts", str, "safety.eye_contacts", ALL),
        Statistic("Near an eye", "eye_near_misses", str, "safety.eye_near_misses", ALL),
        Statistic(
            "Approach, m/s",
            "approach_speed_p90 approach_speed",
            "{:.3f} ({:.3f})".format,
            "safety.approach_speed_p90 safety.approach_speed",
            ALL,
        ),
        Statistic(
            "Refusals respected",
            "refusals refusals_respected",
            lambda all_, respected: f"{respected} of {all_}",
            refusals,
            ALL,
        ),
    ]
    notes = (
        SAFE_SUCCESS,
        "Largest force: mean of the episodes' largest normal forces on one region of the face; in "
        "brackets the 90th percentile and the largest of all. Above: episodes; in brackets how "
        "many times, and for how long on average in an episode. Food on lips and mouth is apart, "
        "the mean of its largest forces.",
        f"Near an eye: how many times something came within {1000 * NEAR_EYE:g} mm of an eyeball.",
        f"Approach: speed at which the distance to the face shrank within {1000 * NEAR_FACE:g} mm "
        "of it: mean of the episodes' 90th percentiles, and the largest in brackets.",
        "Refusals respected: of the times that the head turned away from a gripper nearby, those "
        "in which it was not followed and not touched.",
    )
    measured = all(c.safety for c in statistics.conditions)
    conditions = statistics.conditions if measured else ()
    return condition_table("safety", "Safety", conditions, columns, notes)


def success_by_training_seed(statistics: BenchmarkStatistics) -> Table:
    """Make the table of success of every training run; without rows where none has several."""

    def run(seed: int | None) -> Statistic:
        def rate(c: ConditionStatistics) -> tuple[float | None, ...]:
            found = c.success_by_seed.get(seed)
            return (found.rate, found.low, found.high) if found else (None, None, None)

        return Statistic(
            f"Training seed {NOTHING if seed is None else seed}",
            f"seed_{seed} seed_{seed}_low seed_{seed}_high",
            lambda rate, low, high: f"{percent(rate)} ({100 * low:.1f} to {100 * high:.1f})",
            rate,
            {"train_seed": seed},
        )

    def spread(c: ConditionStatistics) -> tuple[float | None]:
        rates = [run.rate for run in c.success_by_seed.values() if run.rate is not None]
        return (max(rates) - min(rates) if len(rates) > 1 else None,)

    columns = [
        *map(run, statistics.train_seeds),
        Statistic("Range, points", "range", lambda rate: f"{100 * rate:.1f}", spread, ALL),
    ]
    notes = (
        "In brackets: 95 % interval (Wilson) over evaluation seeds, the training run being given.",
        "Range: between the best and the worst run.",
    )
    conditions = statistics.conditions if statistics.has_many_train_seeds else ()
    name, title = "success_by_training_seed", "Success by training seed"
    return condition_table(name, title, conditions, columns, notes)


def success_differences(statistics: BenchmarkStatistics, measure: str = "success") -> Table:
    """Make the table of every condition's success against the reference's, on common seeds.

    Args:
        statistics: of the benchmark.
        measure: ``success`` or ``strict``.
    """
    is_strict = measure == "strict"

    def both(c: ConditionStatistics) -> dict[str, Any]:
        return {"versus": (c.reference,)}

    def differing(c: ConditionStatistics) -> dict[str, Any]:
        return {**both(c), "is_strictly_different" if is_strict else "is_different": True}

    comparison = f"{measure}_difference"
    difference = f"{comparison}.difference"
    counts = f"{comparison}.wins {comparison}.losses"
    people = f"{comparison}.over_people"

    def over_people(number: int, low: float | None, high: float | None) -> str:
        if low is None or high is None:
            return "one person" if number == 1 else "nobody"
        return f"{ends(points)(low, high)} ({number} people)"

    columns = [
        *reference_column(statistics),
        Statistic("Pairs", "pairs", str, f"{difference}.n", both),
        Statistic("Difference", "difference", points, f"{difference}.mean", both),
        interval("95 % interval", points, difference, both),
        Statistic(
            "95 % interval over people",
            "people people_low people_high",
            over_people,
            f"{people}.n {people}.low {people}.high",
            both,
        ),
        Statistic("Won : lost", "won lost", "{} : {}".format, counts, differing),
        *p_values("McNemar", comparison, differing),
    ]
    many = statistics.has_many_train_seeds
    notes = (
        "Difference: rate minus that of the reference, in percentage points, on training and "
        "evaluation seeds that both have.",
        f"95 % interval: bootstrap over common seeds{', training seeds first' if many else ''}; "
        "with no differing episode, Clopper and Pearson's bound for something not seen.",
        "Over people: bootstrap that resamples the people who move, then their episodes; too "
        "narrow with few people. A computed motion is another person with every seed.",
        "Won : lost: episodes in which only this condition, and only the reference, succeeded"
        + (" by the strict condition." if is_strict else "."),
        f"McNemar's exact test, Holm-corrected over the rows; bold below {SIGNIFICANCE:.2f}."
        + (
            " It takes the training runs as given and their episodes as independent: where it and "
            "the interval disagree, believe the interval."
            if many
            else ""
        ),
    )
    what = "Strict success" if is_strict else "Success"
    title = f"{what} against {reference_text(statistics)}"
    others = [c for c in statistics.conditions if not c.is_reference]
    return condition_table(f"{measure}_differences", title, others, columns, notes)


def reference_text(statistics: BenchmarkStatistics) -> str:
    """Return the label of what conditions are compared with, in quotes where it is one."""
    name, *others = statistics.references
    return "the reference" if others else f"“{statistics.of(name).condition.label}”"


def reference_column(statistics: BenchmarkStatistics) -> tuple[Statistic, ...]:
    """Return the column of what each condition is compared with; none where it is one for all."""

    def label(c: ConditionStatistics) -> tuple[str | None]:
        return (None if c.is_reference else statistics.of(c.reference).condition.label,)

    column = Statistic("Against", "reference", str, label, None, is_text=True)
    return (column,) if len(statistics.references) > 1 else ()


def success_beside_paper(statistics: BenchmarkStatistics) -> Table:
    """Make the table of the paper's counts beside ours, and whether they are compatible."""
    trials = statistics.study.trials

    def published(c: ConditionStatistics) -> tuple[float | None]:
        return (c.published and c.published.successes / trials,)

    columns = [
        Statistic(
            "Here",
            "success episodes",
            lambda rate, episodes: f"{percent(rate)} of {episodes}",
            "success.rate outcomes.episodes",
            ALL,
        ),
        Statistic(
            f"Paper (n = {trials})",
            "paper_success",
            lambda rate: f"{100 * rate:.0f} %",
            published,
            None,
        ),
        *beside_paper("Fisher", "published_success", "", points, ALL),
    ]
    notes = (
        "Compatible: Fisher's exact test on the two counts, Holm-corrected over the rows, gives at "
        f"least {SIGNIFICANCE:.2f}. With {trials} trials in the paper that is a weak statement: "
        "the interval (Newcombe) says which differences remain possible."
        + (
            " Episodes of all training runs are taken together, as if independent."
            if statistics.has_many_train_seeds
            else ""
        ),
    )
    title = f"Success beside the paper's {statistics.study.success_table or 'results'}"
    conditions = [c for c in statistics.conditions if c.published]
    return condition_table("success_beside_paper", title, conditions, columns, notes)


def times_table(statistics: BenchmarkStatistics) -> Table:
    """Make the table of completion times, and against the reference's on common seeds."""
    many = statistics.has_many_train_seeds
    comparison, difference = "time_difference", "time_difference.difference"

    def both(c: ConditionStatistics) -> dict[str, Any]:
        return {**SUCCESSES, "versus": (c.reference,)}

    def pairs(c: ConditionStatistics) -> tuple[int | None]:
        return (None if c.is_reference else c.time_difference.difference.n,)

    def by_seed(c: ConditionStatistics) -> tuple[str]:
        return (";".join("" if time is None else repr(time) for time in c.time_by_seed.values()),)

    def seconds_by_seed(joined: str) -> str:
        return " / ".join(seconds(float(t)) if t else NOTHING for t in joined.split(";"))

    columns = [
        Statistic("Successes", "successes", str, "time.n", SUCCESSES),
        Statistic("Time, s", "time", seconds, "time.mean", SUCCESSES, lowest),
        interval("95 % interval", seconds, "time", SUCCESSES),
        Statistic("By training seed", "by_training_seed", seconds_by_seed, by_seed, SUCCESSES),
        *reference_column(statistics),
        Statistic("Pairs", "pairs", str, pairs, both),
        Statistic("Difference, s", "difference", later, f"{difference}.mean", both),
        interval("Its 95 % interval", later, difference, both, "difference_"),
        *p_values("Wilcoxon", comparison, both),
    ]
    if not many:
        del columns[3]
    notes = (
        f"Time: mean {statistics.task.completion_time}, over successes only, with a bootstrap "
        f"interval{' over training and evaluation seeds' if many else ''}.",
        f"Difference: minus {reference_text(statistics)}, over episodes in which both succeeded, "
        "so that a condition does not look fast for failing where it is slow; "
        "Wilcoxon's signed-rank test, Holm-corrected over the rows, bold below "
        f"{SIGNIFICANCE:.2f}.",
    )
    title = _titled(statistics.study.time_table, "Completion times")
    return condition_table("completion_times", title, statistics.conditions, columns, notes)


def times_beside_paper(statistics: BenchmarkStatistics) -> Table:
    """Make the table of the paper's mean completion times beside ours."""
    study = statistics.study
    columns = [
        Statistic("Here, s", "time", seconds, "time.mean", SUCCESSES),
        Statistic("Paper, s", "paper_time", "{:.1f}".format, "published.completion_time", None),
        *beside_paper("t-test", "published_time", ", s", later, SUCCESSES),
    ]
    notes = (
        "The paper gives no spread. It is taken to be ours, over as many successes as its "
        f"{study.success_table or 'counts'} says; the interval and the test allow for its times "
        f"being rounded to {2 * study.time_rounding:g} s.",
        f"Compatible: the Holm-corrected p-value is at least {SIGNIFICANCE:.2f}.",
    )
    title = f"Completion times beside the paper's {study.time_table or 'results'}"
    conditions = [c for c in statistics.conditions if c.published]
    return condition_table("completion_times_beside_paper", title, conditions, columns, notes)


def mean_and_p90(
    condition: ConditionStatistics, column: ResultColumn
) -> tuple[float | None, float | None]:
    """Return mean and 90th percentile of a column of numbers; None where no row has one."""
    found = [row.result.columns.get(column.name) for row in condition.rows]
    numbers = [value for value in found if value is not None]
    if not numbers:
        return None, None
    return float(np.mean(numbers)), float(np.percentile(numbers, 90.0))


def measures_table(statistics: BenchmarkStatistics) -> Table:
    """Make the table of the task's columns that are end points; without rows where none has any."""
    shown = [column for column in statistics.task.columns if column.in_tables]

    def title_of(column: ResultColumn) -> str:
        return column.name.replace("_", " ").capitalize()

    def measure(column: ResultColumn) -> Statistic:
        def values(c: ConditionStatistics) -> tuple[float | None, float | None]:
            return mean_and_p90(c, column)

        name = column.name
        title = title_of(column) + (f", {column.unit}" if column.unit else "")
        return Statistic(title, f"{name} {name}_p90", "{:.2f} ({:.2f})".format, values, ALL)

    columns = [
        Statistic("Episodes", "episodes", str, "outcomes.episodes", ALL),
        *map(measure, shown),
    ]
    notes = ["Mean over all episodes, and the 90th percentile."]
    notes += [f"{title_of(column)}: {column.description}." for column in shown]
    has_any = any(
        row.result.columns.get(column.name) is not None
        for c in statistics.conditions
        for row in c.rows
        for column in shown
    )
    conditions = statistics.conditions if has_any else ()
    return condition_table("measures", "Further end points", conditions, columns, notes)


def failures_table(statistics: BenchmarkStatistics) -> Table:
    """Make the table of failures by kind."""
    titles = {kind: kind.replace("_", " ").capitalize() for kind in statistics.task.failures}

    def count_of(kind: str) -> Statistic:
        def count(c: ConditionStatistics) -> tuple[int]:
            return (Counter(row.result.failure for row in c.rows)[kind],)

        return Statistic(titles[kind], kind, str, count, {"failure": kind})

    columns = [
        Statistic("Episodes", "episodes", str, "outcomes.episodes", ALL),
        Statistic("Success", "success", str, "success.count", SUCCESSES),
        *map(count_of, titles),
    ]
    notes = [f"{titles[kind]}: {what}." for kind, what in statistics.task.failures.items()]
    title = "How episodes ended"
    return condition_table("failures", title, statistics.conditions, columns, notes)


def _titled(table: str, title: str) -> str:
    """Put the name of the paper's table before a title."""
    return f"{table}: {title[0].lower()}{title[1:]}" if table else title
