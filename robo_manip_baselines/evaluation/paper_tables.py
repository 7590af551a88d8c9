"""Tables that lay our figures beside the paper's."""

from __future__ import annotations

from robo_manip_baselines.evaluation.cells import (
    ARM,
    arm_cell,
    arm_table,
    compatible_cell,
    interval_cell,
    later,
    p_cell,
    percent,
    points,
    seconds,
)
from robo_manip_baselines.evaluation.paper_results import TRIALS
from robo_manip_baselines.evaluation.statistics.comparison import SIGNIFICANCE
from robo_manip_baselines.evaluation.statistics.findings import findings
from robo_manip_baselines.evaluation.statistics.lines import Selection
from robo_manip_baselines.evaluation.statistics.study import ArmFigures, Study
from robo_manip_baselines.evaluation.tables import NOTHING, Cell, Column, Row, Table

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
