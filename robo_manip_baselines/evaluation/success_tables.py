"""Table IV: success of every arm, of every training run, and against the reference."""

from __future__ import annotations

from robo_manip_baselines.evaluation.cells import (
    ARM,
    arm_cell,
    arm_table,
    interval_cell,
    p_cell,
    percent,
    points,
    reference_label,
)
from robo_manip_baselines.evaluation.failure import APPROACH_LIMIT
from robo_manip_baselines.evaluation.statistics.comparison import SIGNIFICANCE
from robo_manip_baselines.evaluation.statistics.lines import Selection
from robo_manip_baselines.evaluation.statistics.study import ArmFigures, Study
from robo_manip_baselines.evaluation.summary import Share
from robo_manip_baselines.evaluation.tables import NOTHING, Cell, Column, Table


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
