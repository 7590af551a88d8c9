"""Statistics of a whole benchmark, and the rows that they come from."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from importlib.resources import files as package_files
from pathlib import Path

import numpy as np
import pytest
import yaml

from robo_manip_baselines.benchmark.statistics.analysis import (
    BenchmarkStatistics,
    Finding,
    analyze,
)
from robo_manip_baselines.benchmark.statistics.conditions import FURTHER, ConditionDescription
from robo_manip_baselines.benchmark.statistics.inference import NO_COMPARISON, Estimate, holm
from robo_manip_baselines.benchmark.statistics.outcomes import (
    ResultRow,
    on_common_seeds,
    outcome_matrix,
    read_result_rows,
)
from robo_manip_baselines.envs.mujoco.tasks.feeding import ENTRY as TASK
from robo_manip_baselines.envs.mujoco.tasks.feeding.paper import (
    FURTHER_CLAIMS,
    LITTLE,
    PAPER_CLAIMS,
    STUDY,
)
from robo_manip_baselines.observation import Corruption, ObservationSpec
from robo_manip_baselines.rollout import results as results_module
from robo_manip_baselines.runs.errors import RequestError

pytestmark = pytest.mark.long

MakeRows = Callable[..., tuple[ResultRow, ...]]


def change(rows: tuple[ResultRow, ...], **changes: object) -> tuple[ResultRow, ...]:
    return tuple(replace(row, result=replace(row.result, **changes)) for row in rows)  # type: ignore[arg-type]


def test_rows_have_a_file_and_a_number(rows: tuple[ResultRow, ...]) -> None:
    assert len(rows) == 3200
    assert {row.file for row in rows} == {"results.jsonl"}
    assert [row.number for row in rows] == list(range(1, 3201))


def test_rows_of_many_files(tmp_path: Path, make_rows: MakeRows) -> None:
    rows = make_rows(conditions=["current"], train_seeds=2, episodes=3)
    for train_seed in (0, 1):
        folder = tmp_path / "runs" / f"seed{train_seed}"
        folder.mkdir(parents=True)
        own = [row.result for row in rows if row.result.train_seed == train_seed]
        text = "".join(f"{result.to_line()}\n" for result in own)
        (folder / "results.jsonl").write_text(text + '{"torn": ')
    files = sorted(tmp_path.glob("runs/*/results.jsonl"))
    found = read_result_rows(files, root=tmp_path)
    assert [(row.file, row.number) for row in found] == [
        (f"runs/seed{seed}/results.jsonl", number) for seed in (0, 1) for number in (1, 2, 3)
    ]
    assert [row.result for row in found] == [row.result for row in rows]
    elsewhere = read_result_rows(files[:1], root=tmp_path / "report")[0].file
    assert elsewhere == "../runs/seed0/results.jsonl"
    with pytest.raises(RequestError, match=r"training seed 0, seed 1000 is also in .*line 1"):
        read_result_rows([files[0], files[0]])
    files[0].write_text('{"seed": 1}\n')
    with pytest.raises(RequestError, match=r"line 1: env: is missing"):
        read_result_rows(files)
    with pytest.raises(RequestError, match="cannot read"):
        read_result_rows([tmp_path / "none.jsonl"])


def test_environments_are_not_mixed(
    tmp_path: Path, make_rows: MakeRows, monkeypatch: pytest.MonkeyPatch
) -> None:
    one = make_rows(conditions=["current"], train_seeds=1, episodes=2)
    path = tmp_path / "results.jsonl"
    other = replace(TASK, name="WipingEnv")
    monkeypatch.setattr(results_module, "task_entry", {"FeedingEnv": TASK, "WipingEnv": other}.get)
    results = [one[0].result, replace(one[1].result, env="WipingEnv")]
    path.write_text("".join(f"{result.to_line()}\n" for result in results))
    with pytest.raises(RequestError, match="FeedingEnv and WipingEnv do not compare"):
        read_result_rows([path])


def test_counts_are_those_of_the_rows(
    statistics: BenchmarkStatistics, rows: tuple[ResultRow, ...]
) -> None:
    assert statistics.references == ("current",)
    assert statistics.seeds == tuple(range(1000, 1100))
    assert [c.condition.name for c in statistics.conditions][:4] == [
        "baseline",
        "current",
        "current_pred_h1",
        "current_pred_h1_uniform",
    ]
    assert len(statistics.conditions) == 16
    for c in statistics.conditions:
        own = [row.result for row in rows if row.result.condition == c.condition.name]
        assert c.success.count == sum(r.is_success for r in own)
        assert c.strict.count == sum(r.is_success_strict for r in own)
        assert c.within_limit is not None
        assert c.within_limit.count == sum((r.completion_time or 9) <= 6.0 for r in own)
        assert c.success.rate == c.success.count / 200
        times = [r.completion_time for r in own if r.completion_time is not None]
        assert c.time.mean == pytest.approx(np.mean(times))
        assert c.time.n == len(times)
        for seed, part in c.success_by_seed.items():
            assert part.count == sum(r.is_success for r in own if r.train_seed == seed)
            times = [r.completion_time for r in own if r.is_success and r.train_seed == seed]
            assert c.time_by_seed[seed] == pytest.approx(np.mean(times))  # type: ignore[arg-type]
        assert c.published == STUDY.published.get(c.condition.name)


def test_pairs_are_those_of_the_rows(
    statistics: BenchmarkStatistics, rows: tuple[ResultRow, ...]
) -> None:
    won = {(r.condition, r.train_seed, r.seed): r.is_success for r in (row.result for row in rows)}
    for c in statistics.conditions:
        if c.condition.name == "current":
            assert c.success_difference == c.time_difference == NO_COMPARISON
            continue
        both = [
            (won[c.condition.name, t, s], won["current", t, s])
            for t in (0, 1)
            for s in range(1000, 1100)
        ]
        assert c.success_difference.wins == both.count((True, False))
        assert c.success_difference.losses == both.count((False, True))
        assert c.success_difference.difference.n == 200
        assert c.time_difference.difference.n == both.count((True, True))
        over_people = c.success_difference.over_people
        assert over_people is not None
        assert over_people.n == 5
        assert over_people.mean == c.success_difference.difference.mean


@pytest.mark.parametrize(
    ("kind", "tests"),
    [
        ("success_difference", 15),
        ("strict_difference", 15),
        ("time_difference", 15),
        ("published_success", 12),
        ("published_time", 12),
    ],
)
def test_each_kind_of_test_is_corrected_over_its_conditions(
    statistics: BenchmarkStatistics, kind: str, tests: int
) -> None:
    found = [getattr(c, kind) for c in statistics.conditions]
    assert found == holm([replace(comparison, p_holm=None) for comparison in found])
    assert sum(comparison.p is not None for comparison in found) == tests


def test_people_of_synthetic_motions_are_others_with_every_seed(make_rows: MakeRows) -> None:
    rows = make_rows(conditions=["baseline", "current"], train_seeds=1, episodes=30)

    def of(*conditions: str) -> list[ResultRow]:
        moved = {"motion_clip": "synthetic", "motion_subject": "synthetic", "motion": "sway"}
        return [
            replace(row, result=replace(row.result, **moved))
            if row.result.condition in conditions
            else row
            for row in rows
        ]

    for swaying, people in (((), 5), (("baseline", "current"), 30), (("baseline",), 5)):
        found = analyze(of(*swaying), task=TASK, resamples=50).of("baseline").success_difference
        assert found.over_people is not None
        assert found.over_people.n == people


def test_the_declared_end_point_leads(make_rows: MakeRows) -> None:
    rows = make_rows(conditions=["baseline", "current"], train_seeds=1, episodes=30)
    plain = analyze(rows, task=TASK, resamples=50)
    strict = analyze(rows, task=TASK, headline="success_strict", resamples=50)
    assert (plain.headline, plain.measure, plain.end_point) == ("success", "success", "success")
    assert (strict.measure, strict.end_point) == ("strict", "strict success")
    for one, other in zip(plain.conditions, strict.conditions, strict=True):
        assert (plain.rate(one), strict.rate(other)) == (one.success, one.strict)
        assert one.strict_difference == other.strict_difference
    won = {(r.condition, r.seed): r.is_success_strict for r in (row.result for row in rows)}
    wins = sum(won["baseline", s] and not won["current", s] for s in range(1000, 1030))
    assert strict.of("baseline").strict_difference.wins == wins
    with pytest.raises(RequestError, match=r"unknown end point 'strict'.*did you mean"):
        analyze(rows, task=TASK, headline="strict")


def test_intervals_do_not_depend_on_other_conditions(
    rows: tuple[ResultRow, ...], statistics: BenchmarkStatistics
) -> None:
    few = tuple(row for row in rows if row.result.condition in ("baseline", "current"))
    alone = analyze(tuple(reversed(few)), task=TASK, resamples=500)
    for name in ("baseline", "current"):
        one, other = alone.of(name), statistics.of(name)
        assert one.time == other.time
        assert one.success == other.success
        # The correction depends on the number of conditions, as it should.
        assert replace(one.success_difference, p_holm=None) == replace(
            other.success_difference, p_holm=None
        )


def test_each_condition_has_its_own_reference(make_rows: MakeRows) -> None:
    """The numbers are those of a comparison with that reference alone, but for Holm's."""
    now, late = ["current", "current_pred_h2"], ["current_delay3", "current_pred_h2_delay3"]
    rows = make_rows(conditions=[*now, *late], train_seeds=2, episodes=20)
    own = {"current": now, "current_delay3": late}
    references = {name: reference for reference, names in own.items() for name in names}
    both = analyze(rows, task=TASK, reference=references, resamples=50)
    assert set(both.references) == set(own)
    for reference, (_, name) in own.items():
        alone = analyze(rows, task=TASK, reference=reference, resamples=50).of(name)
        assert both.of(name).reference == reference
        for kind in ("success_difference", "strict_difference", "time_difference"):
            ours, theirs = (getattr(c, kind) for c in (both.of(name), alone))
            assert replace(ours, p_holm=None) == replace(theirs, p_holm=None)
            assert ours.difference.n
        assert both.of(reference).is_reference
        assert both.of(reference).success_difference == NO_COMPARISON


def test_reference(make_rows: MakeRows) -> None:
    rows = make_rows(conditions=["baseline", "current_pred_h2"], train_seeds=1, episodes=5)
    assert analyze(rows, task=TASK, resamples=50).references == ("baseline",)
    given = analyze(rows, task=TASK, reference="current_pred_h2", resamples=50)
    assert given.references == ("current_pred_h2",)
    assert [c.is_reference for c in given.conditions] == [False, True]
    with pytest.raises(RequestError, match=r"unknown reference condition 'current_pred_h3'.*h2"):
        analyze(rows, task=TASK, reference="current_pred_h3")
    with pytest.raises(RequestError, match="there are no result rows"):
        analyze([], task=TASK)
    with pytest.raises(RequestError, match="unknown reference condition 'gone'"):
        analyze(rows, task=TASK, reference=dict.fromkeys(["baseline", "current_pred_h2"], "gone"))
    described = {"baseline": ConditionDescription("baseline", "Blind", FURTHER)}
    renamed = analyze(rows, task=TASK, conditions=described, resamples=50)
    assert renamed.conditions[1].condition.label == "Blind"


def test_conditions_without_a_common_training_seed(make_rows: MakeRows) -> None:
    rows = make_rows(conditions=["baseline", "current"], train_seeds=1, episodes=5)
    apart = tuple(row for row in rows if row.result.condition == "current") + change(
        tuple(row for row in rows if row.result.condition == "baseline"), train_seed=None
    )
    baseline = analyze(apart, task=TASK, resamples=50).of("baseline")
    assert baseline.outcomes.train_seeds == (None,)
    assert baseline.success_difference.p is baseline.success_difference.p_holm is None


def test_six_seconds_are_in_time(make_rows: MakeRows) -> None:
    rows = make_rows(conditions=["current"], train_seeds=1, episodes=3)
    timed = tuple(
        change((row,), is_success=time is not None, completion_time=time, failure=kind)[0]
        for row, time, kind in zip(rows, (6.0, 6.02, None), ("", "", "dropped"), strict=True)
    )
    (c,) = analyze(timed, task=TASK, resamples=50).conditions
    assert c.within_limit is not None
    assert (c.success.count, c.within_limit.count, c.within_limit.rate) == (2, 1, 1 / 3)


def test_none_succeeded(make_rows: MakeRows) -> None:
    rows = change(
        make_rows(conditions=["baseline", "current"], train_seeds=2, episodes=4),
        is_success=False,
        is_success_strict=False,
        completion_time=None,
        failure="too_late",
    )
    statistics = analyze(rows, task=TASK, resamples=50)
    for c in statistics.conditions:
        assert c.success.count == 0
        assert c.time.mean is None
        assert c.time_difference.p_holm is None
        assert c.success.high is not None
        assert c.success.high > 0.3


def test_common_seeds_of_three_conditions(rows: tuple[ResultRow, ...]) -> None:
    outcomes = [
        outcome_matrix(tuple(x for x in rows if x.result.condition == name and keep(x.result.seed)))
        for name, keep in (
            ("baseline", lambda s: s < 1020),
            ("current", lambda s: s >= 1010),
            ("current_pred_h2", lambda s: s % 2 == 0),
        )
    ]
    grids = on_common_seeds(outcomes, "success")
    assert grids.shape == (3, 2, 5)
    np.testing.assert_array_equal(grids[0], outcomes[0].success[:, [10, 12, 14, 16, 18]])
    assert (
        np.isnan(on_common_seeds(outcomes, "time")).all(axis=0).sum()
        == (grids.min(axis=0) == 0).sum()
    )


def test_claims_hold_in_the_papers_own_numbers(statistics: BenchmarkStatistics) -> None:
    published = {finding.claim.text: finding.published for finding in statistics.findings}
    papers = [published[claim.text] for claim in PAPER_CLAIMS]
    assert np.round(papers, 4).tolist() == [0.18, 0.14, 0.0833, -0.052, 0.3]  # type: ignore[arg-type]
    for claim in PAPER_CLAIMS:
        contrast = published[claim.text]
        assert contrast is not None
        assert contrast > claim.limit
    assert all(sum(claim.weights.values()) == pytest.approx(0.0) for claim in STUDY.claims)


def test_further_claims_are_about_conditions_that_ship() -> None:
    (path,) = Path(str(package_files("robo_manip_baselines.benchmark"))).glob("*/feeding.yaml")
    content = yaml.safe_load(path.read_text(encoding="utf-8"))
    (conditions,) = (value for value in content.values() if isinstance(value, list))
    names = {condition["name"] for condition in conditions}
    asked = {name for claim in FURTHER_CLAIMS for name in claim.weights}
    assert names - set(STUDY.published) < asked <= names


def test_findings(statistics: BenchmarkStatistics, make_rows: MakeRows) -> None:
    found = {finding.claim.text: finding for finding in statistics.findings}
    assert len(found) == 5 + 1
    first = found["The present mouth position raises success"]
    current, baseline = statistics.of("current"), statistics.of("baseline")
    assert first.contrast.mean == pytest.approx(
        (current.success.rate or 0) - (baseline.success.rate or 0)
    )
    assert first.contrast.n == 200
    costs = next(f for f in found.values() if f.claim.limit == -LITTLE)
    rates = {c.condition.name: c.success.rate or 0.0 for c in statistics.conditions}
    assert costs.contrast.mean == pytest.approx(
        np.mean(
            [rates[f"current_pred_h{h}_uniform"] - rates[f"current_pred_h{h}"] for h in range(1, 6)]
        )
    )
    few = analyze(
        make_rows(conditions=["current", "baseline"], episodes=5), task=TASK, resamples=50
    )
    assert [finding.claim for finding in few.findings] == [STUDY.claims[0]]


@pytest.mark.parametrize(
    ("claim", "low", "high", "verdict"),
    [
        (0, 0.01, 0.2, "holds"),
        (0, -0.2, -0.01, "does not hold"),
        (0, -0.1, 0.1, "undecided"),
        (0, None, None, "no answer"),
        (3, -0.09, 0.02, "holds"),  # what errors may cost
        (3, -0.2, -0.11, "does not hold"),
        (3, -0.11, -0.09, "undecided"),
    ],
)
def test_verdicts(claim: int, low: float | None, high: float | None, verdict: str) -> None:
    assert Finding(STUDY.claims[claim], Estimate(0.0, low, high, 10)).verdict == verdict


def test_rows_describe_their_condition(make_rows: MakeRows) -> None:
    """Rows of version 2 hold the observation spec; a delay that no name of version 1 has."""
    spec = ObservationSpec("current", cameras=(), corruption=Corruption(delay=45))
    rows = change(
        make_rows(conditions=["current"], train_seeds=1, episodes=3),
        condition=spec.name,
        observation=spec.to_json(),
    )
    (c,) = analyze(rows, task=TASK, resamples=50).conditions
    assert c.condition.label == "Current only, 45 frames late"
    assert c.condition.group == FURTHER


def test_a_task_without_a_paper_or_a_time_limit(make_rows: MakeRows) -> None:
    task = replace(TASK, success_time_limit=None, study="")
    statistics = analyze(make_rows(episodes=3), task=task, resamples=50)
    assert statistics.findings == ()
    for c in statistics.conditions:
        assert c.within_limit is c.published is None
        assert c.published_success == c.published_time == NO_COMPARISON
