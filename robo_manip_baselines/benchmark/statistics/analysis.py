"""All statistics of a benchmark, computed from its result rows."""

from __future__ import annotations

import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from robo_manip_baselines.benchmark.statistics.conditions import (
    CURRENT,
    ConditionDescription,
    describe_condition,
    sort_conditions,
)
from robo_manip_baselines.benchmark.statistics.inference import (
    NO_COMPARISON,
    RESAMPLES,
    Comparison,
    Estimate,
    bound_unseen,
    holm,
    mean_estimate,
    paired_success,
    paired_times,
    proportion,
    published_success,
    published_time,
    rate_estimate,
)
from robo_manip_baselines.benchmark.statistics.outcomes import (
    END_POINTS,
    Floats,
    OutcomeMatrix,
    ResultRow,
    on_common_seeds,
    outcome_matrix,
    people_on_common_seeds,
    sorted_train_seeds,
)
from robo_manip_baselines.envs.mujoco.tasks.registry import (
    Claim,
    PublishedResult,
    TaskEntry,
    TaskStudy,
)
from robo_manip_baselines.envs.mujoco.tasks.safety import SafetySummary, summarize_safety
from robo_manip_baselines.observation import ObservationSpec
from robo_manip_baselines.rollout.agreement import require_one_comparison
from robo_manip_baselines.rollout.results import Proportion
from robo_manip_baselines.runs.errors import RequestError, require_choice

_COMPARISONS = (
    "success_difference",
    "strict_difference",
    "time_difference",
    "published_success",
    "published_time",
)


@dataclass(frozen=True, eq=False)
class ConditionStatistics:
    """Statistics of one condition.

    Attributes:
        condition: its name and label.
        rows: its result rows.
        outcomes: the same as a matrix.
        success, strict: rates over all episodes, see `rate_estimate`.
        within_limit: success within the task's time limit, likewise; None where it has none.
        safe: safe successes, likewise; None where rows of earlier releases do not say.
        safety: of all episodes; None likewise.
        success_by_seed: training seed -> rate of its episodes, with Wilson's interval.
        time: s, mean completion time of successes.
        time_by_seed: training seed -> mean, s; None without a success.
        published: result in the paper; None where it has no such condition.
        reference: name of the condition that it is compared with; its own for the reference itself.
        success_difference, strict_difference, time_difference: from the reference, on common seeds;
            `NO_COMPARISON` for the reference itself.
        published_success, published_time: against the paper, likewise without such a condition.
    """

    condition: ConditionDescription
    rows: tuple[ResultRow, ...]
    outcomes: OutcomeMatrix
    success: Proportion
    strict: Proportion
    within_limit: Proportion | None
    safe: Proportion | None
    safety: SafetySummary | None
    success_by_seed: dict[int | None, Proportion]
    time: Estimate
    time_by_seed: dict[int | None, float | None]
    reference: str
    published: PublishedResult | None = None
    success_difference: Comparison = NO_COMPARISON
    strict_difference: Comparison = NO_COMPARISON
    time_difference: Comparison = NO_COMPARISON
    published_success: Comparison = NO_COMPARISON
    published_time: Comparison = NO_COMPARISON

    @property
    def is_reference(self) -> bool:
        """Whether it is compared with nothing."""
        return self.reference == self.condition.name


@dataclass(frozen=True)
class Finding:
    """Answer of the data to a claim.

    Attributes:
        claim: in question.
        contrast: between conditions, episode by episode.
        published: the same contrast of the paper's results; None where it has not all of the
            conditions.
    """

    claim: Claim
    contrast: Estimate
    published: float | None = None

    @property
    def verdict(self) -> str:
        """``holds`` or ``does not hold`` where the interval lies on one side of the limit."""
        low, high, limit = self.contrast.low, self.contrast.high, self.claim.limit
        if low is None or high is None:
            return "no answer"
        return "holds" if low > limit else "does not hold" if high < limit else "undecided"


@dataclass(frozen=True, eq=False)
class BenchmarkStatistics:
    """Statistics of all conditions of a benchmark.

    Attributes:
        task: that the conditions were evaluated on.
        study: its published results, claims and figures.
        conditions: in the order of the paper's table, further ones last.
        seeds: evaluation seeds that all conditions have, with every training seed.
        findings: on the claims whose conditions were all evaluated.
        headline: end point that was declared before anything was run, a key of `END_POINTS`.
    """

    task: TaskEntry
    study: TaskStudy
    conditions: tuple[ConditionStatistics, ...]
    seeds: tuple[int, ...]
    findings: tuple[Finding, ...]
    headline: str = "success"

    @property
    def measure(self) -> str:
        """Measure of the end point: ``success`` or ``strict``."""
        return END_POINTS[self.headline]

    @property
    def end_point(self) -> str:
        """End point in words: ``success`` or ``strict success``."""
        return "strict success" if self.measure == "strict" else "success"

    def rate(self, condition: ConditionStatistics) -> Proportion:
        """Return the rate of the end point in a condition."""
        return condition.strict if self.measure == "strict" else condition.success

    def of(self, name: str) -> ConditionStatistics:
        """Return the statistics of a condition by its name.

        Raises:
            KeyError: it was not evaluated.
        """
        return {c.condition.name: c for c in self.conditions}[name]

    @property
    def references(self) -> tuple[str, ...]:
        """Names of the conditions that others are compared with; mostly one."""
        return tuple(dict.fromkeys(c.reference for c in self.conditions))

    @property
    def train_seeds(self) -> tuple[int | None, ...]:
        """Training seeds of any condition; None is a policy that was not trained."""
        return sorted_train_seeds(s for c in self.conditions for s in c.outcomes.train_seeds)

    @property
    def has_many_train_seeds(self) -> bool:
        """True if any condition was trained more than once."""
        return any(len(c.outcomes.train_seeds) > 1 for c in self.conditions)


def analyze(
    rows: Sequence[ResultRow],
    *,
    task: TaskEntry,
    reference: str | Mapping[str, str] | None = None,
    conditions: Mapping[str, ConditionDescription] | None = None,
    headline: str = "success",
    resamples: int = RESAMPLES,
) -> BenchmarkStatistics:
    """Compute all statistics.

    The same rows give the same numbers, and the interval of a condition does not depend on which
    other conditions there are.

    Args:
        rows: of all conditions, see `read_result_rows`.
        task: that they are of.
        reference: condition that the others are compared with, or name of a condition -> name of
            its own; None takes ``current``, or the first one where that was not evaluated.
        conditions: name -> description of conditions whose rows do not describe them; may hold
            others, too.
        headline: end point of tables and figures, ``success`` or ``success_strict``.
        resamples: of each bootstrap.

    Raises:
        RequestError: there are no rows, none of the reference, or rows that do not belong together,
            see `require_one_comparison`; or no such end point.
    """
    require_choice("end point", headline, END_POINTS)
    if not rows:
        raise RequestError("there are no result rows; evaluate a condition first")
    require_one_comparison([row.result for row in rows])
    if (env := rows[0].result.env) != task.name:
        raise RequestError(f"results of {env} are no results of {task.name}; give its own task")
    grouped: dict[str, list[ResultRow]] = {}
    for row in rows:
        grouped.setdefault(row.result.condition, []).append(row)
    declared = conditions or {}
    described = sort_conditions(
        (declared.get(name) or _described_by(name, own) for name, own in grouped.items()),
        given=list(declared),
    )
    if reference is None:
        reference = next((c.name for c in described if c.group == CURRENT), described[0].name)
    if isinstance(reference, str):
        reference = dict.fromkeys(grouped, reference)
    references = {name: reference[name] for name in grouped}
    for name in references.values():
        require_choice("reference condition", name, grouped)
    study = task.load_study()
    if (rows[0].result.settings or {}).get("env_kwargs", {}).get("face", "visual") != "visual":
        # No paper has a face that yields.
        study = replace(study, published={}, success_table="", time_table="")
    outcomes = {name: outcome_matrix(own) for name, own in grouped.items()}
    limit = task.success_time_limit

    def rng(name: str, measure: str) -> np.random.Generator:
        return _generator(f"{name}/{measure}")

    def statistics_of(condition: ConditionDescription) -> ConditionStatistics:
        name = condition.name
        own, published = outcomes[name], study.published.get(name)

        def rate(grid: Floats, measure: str) -> Proportion:
            return rate_estimate(grid, rng(name, measure), resamples)

        def difference(compare: Callable[..., Comparison], measure: str) -> Comparison:
            if name == references[name]:
                return NO_COMPARISON
            pair = [own, outcomes[references[name]]]
            draws = rng(name, f"{measure} difference")
            if compare is paired_success:
                compare = partial(paired_success, people=people_on_common_seeds(pair))
            ours, theirs = on_common_seeds(pair, measure)
            return compare(ours, theirs, draws, resamples)

        success = rate(own.success, "success")
        is_measured = np.isfinite(own.safe).sum() == own.episodes
        episodes = [r.result.safety for r in grouped[name] if r.result.safety is not None]
        return ConditionStatistics(
            condition,
            tuple(grouped[name]),
            own,
            success,
            strict=rate(own.strict, "strict"),
            within_limit=None if limit is None else rate(own.success_within(limit), "in time"),
            safe=rate(own.safe, "safe") if is_measured else None,
            safety=summarize_safety(episodes) if is_measured else None,
            success_by_seed=dict(zip(own.train_seeds, map(proportion, own.success), strict=True)),
            time=mean_estimate(own.time, rng(name, "time"), resamples),
            time_by_seed={
                train_seed: float(np.nanmean(row)) if np.isfinite(row).any() else None
                for train_seed, row in zip(own.train_seeds, own.time, strict=True)
            },
            reference=references[name],
            published=published,
            success_difference=difference(paired_success, "success"),
            strict_difference=difference(paired_success, "strict"),
            time_difference=difference(paired_times, "time"),
            published_success=published_success(success, own.episodes, published, study.trials),
            published_time=published_time(own.time, published, study.time_rounding),
        )

    found = [statistics_of(condition) for condition in described]
    for kind in _COMPARISONS:
        corrected = holm([getattr(c, kind) for c in found])
        found = [replace(c, **{kind: new}) for c, new in zip(found, corrected, strict=True)]
    claims = [claim for claim in study.claims if set(claim.weights) <= set(outcomes)]
    findings = tuple(_finding(claim, study, outcomes, resamples) for claim in claims)
    seeds = set.intersection(*(own.complete_seeds for own in outcomes.values()))
    return BenchmarkStatistics(task, study, tuple(found), tuple(sorted(seeds)), findings, headline)


def _generator(text: str) -> np.random.Generator:
    return np.random.default_rng([0, zlib.crc32(text.encode())])


def _described_by(name: str, rows: Sequence[ResultRow]) -> ConditionDescription:
    spec = rows[0].result.observation
    return describe_condition(name, ObservationSpec.from_json(spec) if spec else None)


def _finding(
    claim: Claim,
    study: TaskStudy,
    outcomes: Mapping[str, OutcomeMatrix],
    resamples: int,
) -> Finding:
    """Take the contrast of a claim over the seeds that all of its conditions have.

    Times are compared over episodes in which all of them succeeded.
    """
    rng = _generator(claim.text)
    matrices = on_common_seeds([outcomes[name] for name in claim.weights], claim.measure)
    contrast = np.tensordot(list(claim.weights.values()), matrices, axes=1)
    estimate = mean_estimate(contrast, rng, resamples)
    is_success = claim.measure == "success"
    if is_success and estimate.n and not np.nan_to_num(contrast).any():
        estimate = bound_unseen(estimate)
    values = {
        name: result.successes / study.trials if is_success else result.completion_time
        for name, result in study.published.items()
    }
    published = None
    if set(claim.weights) <= set(values):
        published = sum(weight * values[name] for name, weight in claim.weights.items())
    return Finding(claim, estimate, published)
