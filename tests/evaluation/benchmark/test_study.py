"""Figures of a whole benchmark, and the lines that they come from."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from robo_manip_baselines.benchmark.conditions import ARMS, read_arms
from robo_manip_baselines.benchmark.statistics.comparison import holm
from robo_manip_baselines.benchmark.statistics.conditions import FURTHER, Arm
from robo_manip_baselines.benchmark.statistics.findings import (
    CLAIMS,
    FURTHER_CLAIMS,
    LITTLE,
    PAPER_CLAIMS,
    Finding,
    findings,
)
from robo_manip_baselines.benchmark.statistics.intervals import Estimate
from robo_manip_baselines.benchmark.statistics.outcomes import (
    Line,
    on_common_seeds,
    outcomes_of,
    read_lines,
)
from robo_manip_baselines.benchmark.statistics.study import Study, analyse
from robo_manip_baselines.envs.mujoco.tasks.feeding.paper import PAPER
from robo_manip_baselines.runs.errors import RequestError

pytestmark = pytest.mark.long

MakeLines = Callable[..., tuple[Line, ...]]


def change(lines: tuple[Line, ...], **changes: object) -> tuple[Line, ...]:
    return tuple(replace(line, result=replace(line.result, **changes)) for line in lines)  # type: ignore[arg-type]


def test_lines_know_where_they_stand(lines: tuple[Line, ...]) -> None:
    assert len(lines) == 3200
    assert {line.file for line in lines} == {"results.jsonl"}
    assert [line.number for line in lines] == list(range(1, 3201))


def test_lines_of_many_files(tmp_path: Path, make_lines: MakeLines) -> None:
    lines = make_lines(arms=["current"], train_seeds=2, episodes=3)
    for train_seed in (0, 1):
        folder = tmp_path / "runs" / f"seed{train_seed}"
        folder.mkdir(parents=True)
        own = [line.result for line in lines if line.result.train_seed == train_seed]
        text = "".join(f"{result.to_line()}\n" for result in own)
        (folder / "results.jsonl").write_text(text + '{"torn": ')
    files = sorted(tmp_path.glob("runs/*/results.jsonl"))
    found = read_lines(files, root=tmp_path)
    assert [(line.file, line.number) for line in found] == [
        (f"runs/seed{seed}/results.jsonl", number) for seed in (0, 1) for number in (1, 2, 3)
    ]
    assert [line.result for line in found] == [line.result for line in lines]
    elsewhere = read_lines(files[:1], root=tmp_path / "report")[0].file
    assert elsewhere == "../runs/seed0/results.jsonl"
    with pytest.raises(RequestError, match=r"training seed 0, seed 1000 is also in .*line 1"):
        read_lines([files[0], files[0]])
    files[0].write_text('{"seed": 1}\n')
    with pytest.raises(RequestError, match=r"line 1 is damaged: 'env' is missing"):
        read_lines(files)
    with pytest.raises(RequestError, match="cannot be read"):
        read_lines([tmp_path / "none.jsonl"])


def test_environments_are_not_mixed(tmp_path: Path, make_lines: MakeLines) -> None:
    one = make_lines(arms=["current"], train_seeds=1, episodes=2)
    path = tmp_path / "results.jsonl"
    results = [one[0].result, replace(one[1].result, env="WipingEnv")]
    path.write_text("".join(f"{result.to_line()}\n" for result in results))
    with pytest.raises(RequestError, match="FeedingEnv and WipingEnv do not compare"):
        read_lines([path])


def test_counts_are_those_of_the_lines(study: Study, lines: tuple[Line, ...]) -> None:
    assert study.reference == "current"
    assert study.seeds == tuple(range(1000, 1100))
    assert [figures.arm.name for figures in study.arms][:4] == [
        "baseline",
        "current",
        "current_pred_h1",
        "current_pred_h1_uniform",
    ]
    assert len(study.arms) == 16
    for figures in study.arms:
        own = [line.result for line in lines if line.result.arm == figures.arm.name]
        assert figures.success.count == sum(r.is_success for r in own)
        assert figures.strict.count == sum(r.is_success_strict for r in own)
        assert figures.in_time.count == sum((r.completion_time or 9) <= 6.0 for r in own)
        assert figures.success.rate == figures.success.count / 200
        times = [r.completion_time for r in own if r.completion_time is not None]
        assert figures.time.mean == pytest.approx(np.mean(times))
        assert figures.time.n == len(times)
        for seed, part in figures.success_by_seed.items():
            assert part.count == sum(r.is_success for r in own if r.train_seed == seed)
            times = [r.completion_time for r in own if r.is_success and r.train_seed == seed]
            assert figures.time_by_seed[seed] == pytest.approx(np.mean(times))  # type: ignore[arg-type]
        assert (figures.paper is None) == (figures.arm.name not in PAPER)


def test_pairs_are_those_of_the_lines(study: Study, lines: tuple[Line, ...]) -> None:
    won = {(r.arm, r.train_seed, r.seed): r.is_success for r in (line.result for line in lines)}
    for figures in study.arms:
        if figures.arm.name == "current":
            assert figures.paired_success is figures.paired_times is None
            continue
        both = [
            (won[figures.arm.name, t, s], won["current", t, s])
            for t in (0, 1)
            for s in range(1000, 1100)
        ]
        assert figures.paired_success is not None
        assert figures.paired_success.wins == both.count((True, False))
        assert figures.paired_success.losses == both.count((False, True))
        assert figures.paired_success.difference.n == 200
        assert figures.paired_times is not None
        assert figures.paired_times.difference.n == both.count((True, True))


def test_each_kind_of_test_is_corrected_over_its_arms(study: Study) -> None:
    raw = [f.paired_success and f.paired_success.p for f in study.arms]
    assert [f.p_success for f in study.arms] == holm(raw)
    assert [f.p_times for f in study.arms] == holm(
        [f.paired_times and f.paired_times.p for f in study.arms]
    )
    assert [f.p_paper for f in study.arms] == holm([f.paper and f.paper.p for f in study.arms])
    assert [f.p_paper_time for f in study.arms] == holm(
        [f.paper_time and f.paper_time.p for f in study.arms]
    )
    assert sum(f.p_success is not None for f in study.arms) == 15
    assert sum(f.p_paper is not None for f in study.arms) == 12


def test_figures_of_an_arm_do_not_depend_on_the_others(
    lines: tuple[Line, ...], study: Study
) -> None:
    few = tuple(line for line in lines if line.result.arm in ("baseline", "current"))
    alone = analyse(tuple(reversed(few)), resamples=500)
    for name in ("baseline", "current"):
        one, other = alone.of(name), study.of(name)
        assert one is not None
        assert other is not None
        assert one.time == other.time
        assert one.success == other.success
        assert one.paired_success == other.paired_success


def test_reference(make_lines: MakeLines) -> None:
    lines = make_lines(arms=["baseline", "current_pred_h2"], train_seeds=1, episodes=5)
    assert analyse(lines, resamples=50).reference == "baseline"
    assert analyse(lines, reference="current_pred_h2", resamples=50).reference == "current_pred_h2"
    with pytest.raises(RequestError, match=r"unknown reference arm 'current_pred_h3'.*h2"):
        analyse(lines, reference="current_pred_h3")
    with pytest.raises(RequestError, match="there are no result lines"):
        analyse([])
    described = {"baseline": Arm("baseline", "Blind", FURTHER)}
    assert analyse(lines, described=described, resamples=50).arms[1].arm.label == "Blind"


def test_seeds_that_not_all_have(make_lines: MakeLines) -> None:
    lines = make_lines(arms=["baseline", "current"], train_seeds=2, episodes=10)
    kept = tuple(
        line
        for line in lines
        if (line.result.arm, line.result.train_seed, line.result.seed)
        not in {("baseline", 1, 1003), ("baseline", 0, 1004), ("current", 0, 1007)}
        and (line.result.arm != "current" or line.result.seed < 1009)
    )
    study = analyse(kept, resamples=50)
    assert study.seeds == (1000, 1001, 1002, 1005, 1006, 1008)
    baseline = study.of("baseline")
    assert baseline is not None
    assert baseline.outcomes.episodes == 18
    assert baseline.paired_success is not None
    # 2 · 9 common cells, less the three that one of the arms lacks.
    assert baseline.paired_success.difference.n == 15


def test_arms_without_a_common_training_seed(make_lines: MakeLines) -> None:
    lines = make_lines(arms=["baseline", "current"], train_seeds=1, episodes=5)
    apart = tuple(line for line in lines if line.result.arm == "current") + change(
        tuple(line for line in lines if line.result.arm == "baseline"), train_seed=None
    )
    baseline = analyse(apart, resamples=50).of("baseline")
    assert baseline is not None
    assert baseline.outcomes.train_seeds == (None,)
    assert baseline.paired_success is not None
    assert (baseline.paired_success.p, baseline.p_success) == (None, None)


def test_six_seconds_are_in_time(make_lines: MakeLines) -> None:
    lines = make_lines(arms=["current"], train_seeds=1, episodes=3)
    timed = tuple(
        change((line,), is_success=time is not None, completion_time=time, failure=kind)[0]
        for line, time, kind in zip(lines, (6.0, 6.02, None), ("", "", "dropped"), strict=True)
    )
    (figures,) = analyse(timed, resamples=50).arms
    assert (figures.success.count, figures.in_time.count, figures.in_time.rate) == (2, 1, 1 / 3)


def test_none_succeeded(make_lines: MakeLines) -> None:
    lines = change(
        make_lines(arms=["baseline", "current"], train_seeds=2, episodes=4),
        is_success=False,
        is_success_strict=False,
        completion_time=None,
        failure="too_late",
    )
    study = analyse(lines, resamples=50)
    for figures in study.arms:
        assert figures.success.count == 0
        assert figures.time.mean is None
        assert figures.p_times is None
        assert figures.success.high is not None
        assert figures.success.high > 0.3


def test_common_seeds_of_three_arms(lines: tuple[Line, ...]) -> None:
    arms = [
        outcomes_of(tuple(x for x in lines if x.result.arm == name and keep(x.result.seed)))
        for name, keep in (
            ("baseline", lambda s: s < 1020),
            ("current", lambda s: s >= 1010),
            ("current_pred_h2", lambda s: s % 2 == 0),
        )
    ]
    grids = on_common_seeds(arms, "success")
    assert grids.shape == (3, 2, 5)
    np.testing.assert_array_equal(grids[0], arms[0].success[:, [10, 12, 14, 16, 18]])
    assert (
        np.isnan(on_common_seeds(arms, "time")).all(axis=0).sum() == (grids.min(axis=0) == 0).sum()
    )


def test_claims_hold_in_the_papers_own_numbers() -> None:
    papers = [claim.paper for claim in PAPER_CLAIMS if claim.paper is not None]
    assert np.round(papers, 4).tolist() == [0.18, 0.14, 0.0833, -0.052, 0.3]
    assert all(claim.paper and claim.paper > claim.limit for claim in PAPER_CLAIMS)
    assert all(sum(claim.weights.values()) == pytest.approx(0.0) for claim in CLAIMS)


def test_further_claims_are_about_arms_that_ship() -> None:
    _, arms = read_arms(ARMS / "feeding.yaml")
    assert [claim.paper for claim in FURTHER_CLAIMS] == [None] * len(FURTHER_CLAIMS)
    asked = {name for claim in FURTHER_CLAIMS for name in claim.weights}
    assert {arm.name for arm in arms} - set(PAPER) < asked <= {arm.name for arm in arms}


def test_findings(study: Study, make_lines: MakeLines) -> None:
    found = {finding.claim.text: finding for finding in findings(study)}
    assert len(found) == 5 + 1
    first = found["The present mouth position raises success"]
    current, baseline = study.of("current"), study.of("baseline")
    assert current is not None
    assert baseline is not None
    assert first.contrast.mean == pytest.approx(
        (current.success.rate or 0) - (baseline.success.rate or 0)
    )
    assert first.contrast.n == 200
    costs = next(f for f in found.values() if f.claim.limit == -LITTLE)
    rates = {f.arm.name: f.success.rate or 0.0 for f in study.arms}
    assert costs.contrast.mean == pytest.approx(
        np.mean(
            [rates[f"current_pred_h{h}_uniform"] - rates[f"current_pred_h{h}"] for h in range(1, 6)]
        )
    )
    few = analyse(make_lines(arms=["current", "baseline"], episodes=5), resamples=50)
    assert [finding.claim for finding in findings(few)] == [CLAIMS[0]]


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
    assert Finding(CLAIMS[claim], Estimate(0.0, low, high, 10)).verdict == verdict
