"""What the tables of a benchmark are made of: a row for each arm, figures spelt alike."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable

from robo_manip_baselines.benchmark.statistics.comparison import SIGNIFICANCE
from robo_manip_baselines.benchmark.statistics.findings import findings
from robo_manip_baselines.benchmark.statistics.intervals import Estimate
from robo_manip_baselines.benchmark.statistics.outcomes import Selection
from robo_manip_baselines.benchmark.statistics.study import ArmFigures, Study
from robo_manip_baselines.benchmark.tables.table import NOTHING, Cell, Column, Row, Table
from robo_manip_baselines.envs.mujoco.tasks.feeding.failure import APPROACH_LIMIT, FAILURES
from robo_manip_baselines.envs.mujoco.tasks.feeding.paper import TRIALS
from robo_manip_baselines.rollout.results import Share

ARM = Column("Arm", ("arm",), is_text=True)


def arm_table(
    study: Study,
    name: str,
    title: str,
    columns: tuple[Column, ...],
    cells: Callable[[ArmFigures], list[Cell] | None],
    notes: tuple[str, ...],
) -> Table:
    """Make a table with a row for each arm for which there are cells."""
    rows = [(figures.arm.group, cells(figures)) for figures in study.arms]
    return Table(
        name, title, columns, tuple(Row(group, tuple(row)) for group, row in rows if row), notes
    )


def arm_cell(figures: ArmFigures) -> Cell:
    """Make the first cell of a row."""
    return Cell(figures.arm.label, (figures.arm.name,))


def reference_label(study: Study) -> str:
    """Return what the tables call the arm that others are compared with."""
    reference = study.of(study.reference)
    return f"“{reference.arm.label if reference else study.reference}”"


def percent(rate: float | None) -> str:
    """Spell a rate, ``74.0 %``."""
    return NOTHING if rate is None else f"{100.0 * rate:.1f} %"


def points(difference: float | None) -> str:
    """Spell a difference of rates in percentage points, ``−3.5``."""
    return NOTHING if difference is None else _signed(f"{100.0 * difference:+.1f}")


def seconds(time: float | None) -> str:
    """Spell a time in seconds, ``4.31``."""
    return NOTHING if time is None else f"{time:.2f}"


def later(difference: float | None) -> str:
    """Spell a difference of times in seconds, ``+0.20``."""
    return NOTHING if difference is None else _signed(f"{difference:+.2f}")


def interval_cell(
    low: float | None,
    high: float | None,
    text: Callable[[float], str],
    selection: Selection | None,
) -> Cell:
    """Make a cell of an interval whose ends ``text`` spells."""
    if low is None or high is None:
        return Cell(NOTHING, (None, None))
    return Cell(f"{text(low)} to {text(high)}".replace(" % to", " to"), (low, high), selection)


def p_cell(p: float | None, selection: Selection, *, is_strong: bool = False) -> Cell:
    """Make a cell of a p-value, in bold if asked for and the value is small."""
    if p is None:
        return Cell(NOTHING, (None,))
    text = "< 0.001" if p < 0.001 else f"{p:.3f}"
    return Cell(text, (p,), selection, is_strong=is_strong and p < SIGNIFICANCE)


def compatible_cell(corrected_p: float | None) -> Cell:
    """Make a cell that says whether a test left two figures compatible."""
    if corrected_p is None:
        return Cell(NOTHING, (None,))
    is_compatible = corrected_p >= SIGNIFICANCE
    return Cell("yes" if is_compatible else "no", (is_compatible,))


def _signed(number: str) -> str:
    """Write a minus sign, and no sign before zero."""
    if float(number) == 0.0:
        return number.lstrip("+-")
    return number.replace("-", "−")


def success_table(study: Study) -> Table:
    """Table IV: success with intervals."""
    best = max(_rate(figures.success) for figures in study.arms)
    columns = (
        ARM,
        Column("Episodes", ("episodes",)),
        Column("Success", ("success",)),
        Column("95 % interval", ("low", "high")),
        Column("Strict success", ("strict_success",)),
        Column("Its 95 % interval", ("strict_low", "strict_high")),
        Column(f"In {APPROACH_LIMIT:g} s", ("in_time", "in_time_low", "in_time_high")),
    )

    def cells(figures: ArmFigures) -> list[Cell]:
        success, strict, name = figures.success, figures.strict, figures.arm.name
        own, in_time = Selection(name), figures.in_time
        return [
            arm_cell(figures),
            Cell(str(figures.outcomes.episodes), (figures.outcomes.episodes,), own),
            Cell(
                percent(success.rate),
                (success.rate,),
                Selection(name, is_success=True),
                is_strong=_rate(success) == best,
            ),
            interval_cell(success.low, success.high, percent, own),
            Cell(percent(strict.rate), (strict.rate,), Selection(name, is_strict=True)),
            interval_cell(strict.low, strict.high, percent, own),
            Cell(
                percent(in_time.rate),
                (in_time.rate, in_time.low, in_time.high),
                Selection(name, within=APPROACH_LIMIT),
            ),
        ]

    interval = "95 % interval: Wilson"
    if study.has_many_train_seeds:
        interval = (
            "95 % interval: hierarchical bootstrap, training seeds, then the evaluation seeds that "
            "they share; too narrow with two or three training seeds that differ much. An arm with "
            "one training seed: Wilson, the training run being given"
        )
    notes = (
        f"{interval}.",
        "Strict success: the cube let go inside the mouth, the face never touched.",
        f"In {APPROACH_LIMIT:g} s: success within that time of the lift, as Algorithm 1 allows.",
    )
    return arm_table(study, "success", "Table IV: success rates", columns, cells, notes)


def success_by_training_seed(study: Study) -> Table:
    """Success of every training run; without rows where no arm has several."""
    seeds = study.train_seeds
    columns = (
        ARM,
        *(
            Column(
                f"Training seed {NOTHING if seed is None else seed}",
                tuple(f"seed_{seed}{end}" for end in ("", "_low", "_high")),
            )
            for seed in seeds
        ),
        Column("Range, points", ("range",)),
    )

    def cells(figures: ArmFigures) -> list[Cell] | None:
        if not study.has_many_train_seeds:
            return None
        rates = [part.rate for part in figures.success_by_seed.values() if part.rate is not None]
        spread = max(rates) - min(rates) if len(rates) > 1 else None
        return [
            arm_cell(figures),
            *(_run_cell(figures, seed) for seed in seeds),
            Cell(
                NOTHING if spread is None else f"{100 * spread:.1f}",
                (spread,),
                None if spread is None else Selection(figures.arm.name),
            ),
        ]

    notes = (
        "In brackets: 95 % interval (Wilson) over evaluation seeds, the training run being given.",
        "Range: between the best and the worst run.",
    )
    title = "Success by training seed"
    return arm_table(study, "success_by_training_seed", title, columns, cells, notes)


def success_differences(study: Study) -> Table:
    """Every arm's success against the reference's, on common seeds."""
    columns = (
        ARM,
        Column("Pairs", ("pairs",)),
        Column("Difference", ("difference",)),
        Column("95 % interval", ("low", "high")),
        Column("Won : lost", ("won", "lost")),
        Column("McNemar p", ("p",)),
        Column("Holm p", ("p_holm",)),
    )

    def cells(figures: ArmFigures) -> list[Cell] | None:
        pairs = figures.paired_success
        if pairs is None:
            return None
        both = Selection(figures.arm.name, versus=(study.reference,))
        differing = Selection(figures.arm.name, versus=(study.reference,), is_different=True)
        d = pairs.difference
        return [
            arm_cell(figures),
            Cell(str(d.n), (d.n,), both),
            Cell(points(d.mean), (d.mean,), both),
            interval_cell(d.low, d.high, points, both),
            Cell(f"{pairs.wins} : {pairs.losses}", (pairs.wins, pairs.losses), differing),
            p_cell(pairs.p, differing),
            p_cell(figures.p_success, differing, is_strong=True),
        ]

    notes = (
        "Difference: rate minus that of the reference, in percentage points, on training and "
        "evaluation seeds that both have.",
        "95 % interval: bootstrap over common seeds"
        + (", training seeds first" if study.has_many_train_seeds else "")
        + "; with no differing episode, Clopper and Pearson's bound for something not seen.",
        "Won : lost: episodes that only this arm, and only the reference, managed.",
        f"McNemar's exact test, Holm-corrected over the rows; bold below {SIGNIFICANCE:.2f}."
        + (
            " It takes the training runs as given and their episodes as independent: where it and "
            "the interval disagree, believe the interval."
            if study.has_many_train_seeds
            else ""
        ),
    )
    title = f"Success against {reference_label(study)}"
    return arm_table(study, "success_differences", title, columns, cells, notes)


def _run_cell(figures: ArmFigures, seed: int | None) -> Cell:
    """Make the cell of one training run."""
    part = figures.success_by_seed.get(seed)
    if part is None or part.low is None or part.high is None:
        return Cell(NOTHING, (None, None, None))
    return Cell(
        f"{percent(part.rate)} ({100 * part.low:.1f} to {100 * part.high:.1f})",
        (part.rate, part.low, part.high),
        Selection(figures.arm.name, train_seed=seed),
    )


def _rate(part: Share) -> float:
    return -1.0 if part.rate is None else part.rate


ONE_RUN = (
    "With one training run of each arm, verdicts are about the policies that were trained: the "
    "intervals leave out how much another run would differ."
)


def findings_table(study: Study) -> Table:
    """What the paper found, what the further arms ask, and what became of it here."""
    columns = (
        Column("Claim", ("claim",), is_text=True),
        Column("Paper", ("paper",)),
        Column("Here", ("here",)),
        Column("95 % interval", ("low", "high")),
        Column("Episodes", ("episodes",)),
        Column("Verdict", ("verdict",), is_text=True),
    )
    rows = []
    for finding in findings(study):
        claim, d = finding.claim, finding.contrast
        is_success = claim.measure == "success"
        text = points if is_success else later
        unit = " points" if is_success else " s"
        first, *others = claim.weights
        lines = Selection(first, is_success=None if is_success else True, versus=tuple(others))
        cells = (
            Cell(claim.text, (claim.text,)),
            Cell(NOTHING if claim.paper is None else text(claim.paper) + unit, (claim.paper,)),
            Cell(text(d.mean) + (unit if d.mean is not None else ""), (d.mean,), lines),
            interval_cell(d.low, d.high, text, lines),
            Cell(str(d.n), (d.n,), lines),
            Cell(finding.verdict, (finding.verdict,), is_strong=True),
        )
        rows.append(Row("Further claims" if claim.paper is None else "The paper's claims", cells))
    notes = (
        "Each is a difference between (means of) arms, episode by episode, on seeds that all of "
        "them have; of times, on episodes that all of them managed. It holds, or does not, where "
        "its interval lies on one side of the limit; otherwise the data cannot tell.",
        *([] if study.has_many_train_seeds else [ONE_RUN]),
    )
    title = "Claims, and what became of them"
    return Table("findings", title, columns, tuple(rows), notes)


def success_beside_paper(study: Study) -> Table:
    """Every arm of the paper: its count beside ours, and whether they are compatible."""
    columns = (
        ARM,
        Column("Here", ("success", "episodes")),
        Column(f"Paper (n = {TRIALS})", ("paper_success",)),
        Column("Here − paper", ("difference",)),
        Column("95 % interval", ("low", "high")),
        Column("Fisher p", ("p",)),
        Column("Holm p", ("p_holm",)),
        Column("Compatible", ("is_compatible",), is_text=True),
    )

    def cells(figures: ArmFigures) -> list[Cell] | None:
        found = figures.paper
        if found is None:
            return None
        own, d = Selection(figures.arm.name), found.difference
        return [
            arm_cell(figures),
            Cell(
                f"{percent(figures.success.rate)} of {figures.outcomes.episodes}",
                (figures.success.rate, figures.outcomes.episodes),
                own,
            ),
            Cell(f"{found.paper.rate:.0%}".replace("%", " %"), (found.paper.rate,)),
            Cell(points(d.mean), (d.mean,), own),
            interval_cell(d.low, d.high, points, own),
            p_cell(found.p, own),
            p_cell(figures.p_paper, own, is_strong=True),
            compatible_cell(figures.p_paper),
        ]

    notes = (
        "Compatible: Fisher's exact test on the two counts, Holm-corrected over the rows, gives at "
        f"least {SIGNIFICANCE:.2f}. With {TRIALS} trials in the paper that is a weak statement: "
        "the interval (Newcombe) says which differences remain possible."
        + (
            " Episodes of all training runs are taken together, as if independent."
            if study.has_many_train_seeds
            else ""
        ),
    )
    title = "Success beside the paper's Table IV"
    return arm_table(study, "success_beside_paper", title, columns, cells, notes)


def times_beside_paper(study: Study) -> Table:
    """Every arm of the paper: its mean completion time beside ours."""
    columns = (
        ARM,
        Column("Here, s", ("time",)),
        Column("Paper, s", ("paper_time",)),
        Column("Here − paper, s", ("difference",)),
        Column("95 % interval", ("low", "high")),
        Column("t-test p", ("p",)),
        Column("Holm p", ("p_holm",)),
        Column("Compatible", ("is_compatible",), is_text=True),
    )

    def cells(figures: ArmFigures) -> list[Cell] | None:
        found = figures.paper_time
        if found is None:
            return None
        won, d = Selection(figures.arm.name, is_success=True), found.difference
        return [
            arm_cell(figures),
            Cell(seconds(figures.time.mean), (figures.time.mean,), won),
            Cell(f"{found.paper.completion_time:.1f}", (found.paper.completion_time,)),
            Cell(later(d.mean), (d.mean,), won),
            interval_cell(d.low, d.high, later, won),
            p_cell(found.p, won),
            p_cell(figures.p_paper_time, won, is_strong=True),
            compatible_cell(figures.p_paper_time),
        ]

    notes = (
        "The paper gives no spread. It is taken to be ours, over as many successes as its Table IV "
        "says; the interval and the test allow for its times being rounded to 0.1 s.",
        f"Compatible: the Holm-corrected p-value is at least {SIGNIFICANCE:.2f}.",
    )
    title = "Completion times beside the paper's Table V"
    return arm_table(study, "completion_times_beside_paper", title, columns, cells, notes)


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
