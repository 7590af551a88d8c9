"""All figures of a benchmark, from its result lines."""

from __future__ import annotations

import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from robo_manip_baselines.benchmark.statistics.comparison import (
    PairedSuccess,
    PairedTimes,
    PaperSuccess,
    PaperTime,
    against_paper,
    holm,
    paired_success,
    paired_times,
    time_against_paper,
)
from robo_manip_baselines.benchmark.statistics.conditions import CURRENT, Arm, in_order
from robo_manip_baselines.benchmark.statistics.intervals import (
    RESAMPLES,
    Estimate,
    mean_estimate,
    rate_estimate,
)
from robo_manip_baselines.benchmark.statistics.outcomes import (
    Line,
    Outcomes,
    on_common_seeds,
    outcomes_of,
)
from robo_manip_baselines.envs.mujoco.tasks.feeding.paper import PAPER
from robo_manip_baselines.rollout.results import Share, share
from robo_manip_baselines.runs.errors import RequestError, require_choice


@dataclass(frozen=True, eq=False)
class ArmFigures:
    """What is known of an arm.

    Attributes:
        arm: which one.
        lines: its result lines.
        outcomes: the same as a grid.
        success, strict: over all episodes, see ``rate_estimate``.
        in_time: success within 6 s of the lift (Algorithm 1), likewise.
        success_by_seed: training seed -> share of its episodes, with Wilson's interval.
        time: s, mean completion time of successes.
        time_by_seed: training seed -> mean, s; None without a success.
        paired_success, paired_times: against the reference; None for the reference itself.
        paper, paper_time: against the paper; None where the paper has no such arm.
        p_success, p_times, p_paper, p_paper_time: p-values, Holm-corrected over the arms.
    """

    arm: Arm
    lines: tuple[Line, ...]
    outcomes: Outcomes
    success: Share
    strict: Share
    in_time: Share
    success_by_seed: dict[int | None, Share]
    time: Estimate
    time_by_seed: dict[int | None, float | None]
    paired_success: PairedSuccess | None
    paired_times: PairedTimes | None
    paper: PaperSuccess | None
    paper_time: PaperTime | None
    p_success: float | None = None
    p_times: float | None = None
    p_paper: float | None = None
    p_paper_time: float | None = None


@dataclass(frozen=True, eq=False)
class Study:
    """All figures of a benchmark.

    Attributes:
        arms: in the order of the paper's table, further arms last.
        reference: name of the arm that the others are compared with.
        seeds: evaluation seeds that all arms have, with every training seed.
        seed, resamples: of the resampling.
    """

    arms: tuple[ArmFigures, ...]
    reference: str
    seeds: tuple[int, ...]
    seed: int
    resamples: int

    def of(self, name: str) -> ArmFigures | None:
        """Return an arm by its name; None if it was not run."""
        return next((figures for figures in self.arms if figures.arm.name == name), None)

    @property
    def train_seeds(self) -> tuple[int | None, ...]:
        """Training seeds of any arm; None is an arm that was not trained."""
        found = {seed for figures in self.arms for seed in figures.outcomes.train_seeds}
        return tuple(sorted(found, key=lambda seed: (seed is not None, seed)))

    @property
    def has_many_train_seeds(self) -> bool:
        """Whether any arm was trained more than once."""
        return any(len(figures.outcomes.train_seeds) > 1 for figures in self.arms)


def analyse(
    lines: Sequence[Line],
    *,
    reference: str | None = None,
    described: Mapping[str, Arm] | None = None,
    seed: int = 0,
    resamples: int = RESAMPLES,
) -> Study:
    """Work out all figures.

    The same lines give the same figures, and the interval of an arm does not depend on which other
    arms there are.

    Args:
        lines: of all arms, see ``read_lines``.
        reference: arm that the others are compared with; None takes ``current``, or the first arm
            where it was not run.
        described: arms whose names do not say enough, by name.
        seed: of the resampling.
        resamples: of each bootstrap.

    Raises:
        RequestError: there are no lines, or none of the reference.
    """
    if not lines:
        raise RequestError("there are no result lines; evaluate an arm first")
    by_arm: dict[str, list[Line]] = {}
    for line in lines:
        by_arm.setdefault(line.result.arm, []).append(line)
    arms = in_order(by_arm, described)
    if reference is None:
        reference = next((arm.name for arm in arms if arm.group == CURRENT), arms[0].name)
    require_choice("reference arm", reference, by_arm)
    outcomes = {name: outcomes_of(of_arm) for name, of_arm in by_arm.items()}

    def rng(name: str, what: str) -> np.random.Generator:
        return np.random.default_rng([seed, zlib.crc32(f"{name}/{what}".encode())])

    def figures_of(arm: Arm) -> ArmFigures:
        own = outcomes[arm.name]
        success = rate_estimate(own.success, rng(arm.name, "success"), resamples)
        success_pairs, time_pairs = None, None
        if arm.name != reference:
            pair = [own, outcomes[reference]]
            ours, theirs = on_common_seeds(pair, "success")
            success_pairs = paired_success(
                ours, theirs, rng(arm.name, "success difference"), resamples
            )
            ours, theirs = on_common_seeds(pair, "time")
            time_pairs = paired_times(ours, theirs, rng(arm.name, "time difference"), resamples)
        paper = PAPER.get(arm.name)
        return ArmFigures(
            arm=arm,
            lines=tuple(by_arm[arm.name]),
            outcomes=own,
            success=success,
            strict=rate_estimate(own.strict, rng(arm.name, "strict"), resamples),
            in_time=rate_estimate(own.in_time, rng(arm.name, "in time"), resamples),
            success_by_seed={
                train_seed: share(int(np.nansum(row)), int(np.isfinite(row).sum()))
                for train_seed, row in zip(own.train_seeds, own.success, strict=True)
            },
            time=mean_estimate(own.time, rng(arm.name, "time"), resamples),
            time_by_seed={
                train_seed: float(np.nanmean(row)) if np.isfinite(row).any() else None
                for train_seed, row in zip(own.train_seeds, own.time, strict=True)
            },
            paired_success=success_pairs,
            paired_times=time_pairs,
            paper=paper and against_paper(success.count, own.episodes, paper),
            paper_time=paper and time_against_paper(own.time, paper),
        )

    common = set.intersection(*(_complete_seeds(own) for own in outcomes.values()))
    return Study(
        _corrected([figures_of(arm) for arm in arms]),
        reference,
        tuple(sorted(common)),
        seed,
        resamples,
    )


def _complete_seeds(outcomes: Outcomes) -> set[int]:
    """Return the evaluation seeds that every training seed has."""
    is_there = np.isfinite(outcomes.success)
    return {seed for column, seed in enumerate(outcomes.seeds) if is_there[:, column].all()}


def _corrected(arms: Sequence[ArmFigures]) -> tuple[ArmFigures, ...]:
    """Correct the p-values for the number of arms, each kind of test for itself."""
    success = holm([f.paired_success and f.paired_success.p for f in arms])
    times = holm([f.paired_times and f.paired_times.p for f in arms])
    paper = holm([f.paper and f.paper.p for f in arms])
    paper_times = holm([f.paper_time and f.paper_time.p for f in arms])
    return tuple(
        replace(figures, p_success=a, p_times=b, p_paper=c, p_paper_time=d)
        for figures, a, b, c, d in zip(arms, success, times, paper, paper_times, strict=True)
    )
