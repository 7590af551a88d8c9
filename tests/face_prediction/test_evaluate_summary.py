"""Numbers of the tables against slow, obvious ones, and the files they are written to."""

from __future__ import annotations

import csv
import io
import json
from dataclasses import replace

import numpy as np
import pytest

from face_prediction.dataset.manifest import SequenceRow
from face_prediction.evaluation.predictors import Role
from face_prediction.evaluation.scoring import LEVELS, EvaluationScores, PredictorScores
from face_prediction.evaluation.setup import SequenceSelection
from face_prediction.evaluation.statistics import KindSummary, bootstrap_mean, summarise_kind
from face_prediction.evaluation.tables import (
    EvaluationReport,
    markdown_text,
    results_json,
    write_evaluation_report,
)
from face_prediction.prediction.errors import mouth_errors
from robo_manip_baselines.runs.errors import RequestError

N, H = 30, 5


def scored(name: str, role: Role, size: float, seed: int, *, images: int = 0) -> PredictorScores:
    rng = np.random.default_rng(seed)
    residuals = size * np.arange(1, H + 1)[:, None] * rng.standard_normal((N, H, 2))
    blank = np.full((N, H), np.nan)
    return PredictorScores(
        name,
        role,
        images,
        residuals,
        shuffled_residuals=np.full((N, H, 2), np.nan),
        nme=rng.uniform(0.01, 0.05, (N, H)),
        similarity=rng.uniform(0.8, 1.0, (N, H)) if images else blank,
        own_similarity=rng.uniform(0.7, 0.9, (N, H)) if images > 32 else blank,
        levels=rng.uniform(0, 1, (N, H, 2)) if role == "network" else blank[..., None] + (0, 0),
    )


@pytest.fixture
def scores() -> EvaluationScores:
    # ten natural sequences of one person, ten of another, and ten of grid
    people, kinds = ("ann", "bob", "cat"), ("natural", "natural", "grid")
    selection = SequenceSelection(
        np.arange(N),
        tuple(
            SequenceRow(f"clip{i // 5}", i % 5, people[i // 10], kinds[i // 10], 0, 15 * i, {})
            for i in range(N)
        ),
    )
    rows = (
        scored("persistence", "baseline", 0.004, 1, images=32),
        scored("line", "baseline", 0.003, 2),
        scored("net", "network", 0.002, 3, images=64),
        scored("blurred", "network", 0.006, 4, images=32),
    )
    rows[3].residuals[3, 2:] = np.nan  # no face found in three frames
    rows[3].nme[3, 2:] = np.nan
    copies = {64: np.random.default_rng(9).uniform(0.6, 0.8, (N, H))}
    return EvaluationScores(selection, rows, 32, copies)


@pytest.fixture
def summary(scores: EvaluationScores) -> KindSummary:
    return summarise_kind(scores, "natural", resamples=200)


def test_numbers_are_those_of_the_plain_measures(
    scores: EvaluationScores, summary: KindSummary
) -> None:
    numbers = {name: number.value for name, number in summary.numbers.items()}
    assert (summary.sequences, summary.subjects, summary.clips) == (20, 2, 4)
    for i, row in enumerate(scores.rows):
        residuals = row.residuals[:20]
        expected = mouth_errors(residuals)
        np.testing.assert_allclose(numbers["mean"][i], expected.mean)
        np.testing.assert_allclose(numbers["variance"][i], expected.variance)
        np.testing.assert_allclose(numbers["pooled_mean"][i], expected.pooled_mean)
        np.testing.assert_allclose(numbers["pooled_variance"][i], expected.pooled_variance)
        np.testing.assert_array_equal(summary.rows[i].missing, expected.missing)
        size = np.hypot(residuals[..., 0], residuals[..., 1])
        reference = np.hypot(*np.moveaxis(scores.rows[0].residuals[:20], -1, 0))
        np.testing.assert_allclose(numbers["distance"][i], np.nanmean(size, axis=0))
        both = np.isfinite(size) & np.isfinite(reference)
        sums = (np.where(both, values, 0.0).sum(axis=0) for values in (size, reference))
        np.testing.assert_allclose(numbers["skill"][i], 1 - np.divide(*sums), atol=1e-12)
        np.testing.assert_allclose(numbers["pooled_nme"][i], np.nanmean(row.nme[:20]))
        np.testing.assert_allclose(numbers["ssim"][i], row.similarity[:20].mean(axis=0))
    assert summary.rows[3].missing.tolist() == [0, 0, 1, 1, 1]


def test_the_best_baseline_is_that_of_the_far_frames(scores: EvaluationScores) -> None:
    near = scores.rows[1].residuals.copy()
    scores.rows[1].residuals[:, :2] *= 100  # worst at frames 71 and 72, still best after
    summary = summarise_kind(scores, "natural", resamples=10)
    assert summary.best_baseline == "line"
    scores.rows[1].residuals[:] = near
    scores.rows[1].residuals[:, 2:] *= 100
    assert summarise_kind(scores, "natural", resamples=10).best_baseline == "persistence"


def test_differences_are_paired_and_in_percent(
    scores: EvaluationScores, summary: KindSummary
) -> None:
    distances = [np.linalg.norm(row.residuals[:20], axis=-1) for row in scores.rows]
    value = summary.numbers["difference"].value
    for g, frames in enumerate((slice(0, 2), slice(2, 5))):
        for i, ours in enumerate(distances):
            both = np.isfinite(ours[:, frames])  # frames that only the baseline has do not count
            mine, other = ours[:, frames][both].sum(), distances[1][:, frames][both].sum()
            assert value[i, g] == pytest.approx(100 * (mine / other - 1))
    assert value[1].tolist() == [0.0, 0.0]


def test_intervals_hold_the_same_sequences_of_every_row(scores: EvaluationScores) -> None:
    """A row that is the best baseline made 20 % better everywhere is so in every resample."""
    scores.rows[2].residuals[:] = 0.8 * scores.rows[1].residuals
    summary = summarise_kind(scores, "natural", resamples=100)
    difference = summary.numbers["difference"]
    for part in (difference.value, difference.low, difference.high):
        np.testing.assert_allclose(part[2], [-20.0, -20.0])
    spread = summary.numbers["pooled_distance"]
    assert spread.low[2] < spread.value[2] < spread.high[2]


def test_intervals_are_those_of_a_bootstrap_over_people(scores: EvaluationScores) -> None:
    """Two people with unlike errors: the interval reaches from one to the other."""
    scores.rows[2].residuals[:10], scores.rows[2].residuals[10:20] = 0.01, 0.03
    distance = summarise_kind(scores, "natural", resamples=100).numbers["pooled_distance"]
    assert distance.low[2] == pytest.approx(0.01 * 2**0.5)
    assert distance.high[2] == pytest.approx(0.03 * 2**0.5)
    assert distance.value[2] == pytest.approx(0.02 * 2**0.5)


def test_one_bootstrap_is_that_of_each_number_by_itself(scores: EvaluationScores) -> None:
    summary = summarise_kind(scores, "natural", seed=3, resamples=250)
    subjects = [row.subject for row in scores.selection.rows[:20]]
    expected = bootstrap_mean(scores.rows[3].nme[:20], subjects, seed=3, resamples=250)
    found = summary.numbers["nme"]
    for part in ("value", "low", "high"):
        np.testing.assert_allclose(getattr(found, part)[3], getattr(expected, part))


def test_images_are_compared_at_one_size_and_at_their_own(
    scores: EvaluationScores, summary: KindSummary
) -> None:
    net, copy = scores.rows[2], scores.copies[64]
    numbers = {name: number.value for name, number in summary.numbers.items()}
    assert numbers["pooled_ssim_own_size"][2] == pytest.approx(net.own_similarity[:20].mean())
    assert numbers["pooled_ssim_copy_own_size"][2] == pytest.approx(copy[:20].mean())
    gain = (net.similarity - scores.rows[0].similarity)[:20].mean()
    assert numbers["pooled_ssim_gain"][2] == pytest.approx(gain)
    for name in ("ssim_own_size", "ssim_copy_own_size"):
        assert np.isnan(numbers[name][[0, 1, 3]]).all()
    assert np.isnan(numbers["ssim"][1]).all()


def test_coverage_is_the_share_inside(scores: EvaluationScores, summary: KindSummary) -> None:
    assert [row.has_intervals for row in summary.rows] == [False, False, True, True]
    for k, level in enumerate(LEVELS):
        inside = scores.rows[2].levels[:20] <= level
        coverage = summary.numbers["coverage"].value[2, :, k]
        np.testing.assert_allclose(coverage, inside.mean(axis=(0, 2)))
        assert summary.numbers["pooled_coverage"].value[2, k] == pytest.approx(inside.mean())


def test_shuffled_images(scores: EvaluationScores) -> None:
    scores.row("net").shuffled_residuals[:] = 3 * scores.row("net").residuals
    scores.row("blurred").shuffled_residuals[:] = scores.row("blurred").residuals
    found = summarise_kind(scores, "natural", resamples=50).numbers["shuffled_images"]
    np.testing.assert_allclose(found.value[2], [200.0] * 3)
    np.testing.assert_allclose(found.low[2], [200.0] * 3)
    np.testing.assert_array_equal(found.value[3], [0.0] * 3)
    assert np.isnan(found.value[:2]).all()


def test_the_same_seed_gives_the_same_numbers(scores: EvaluationScores) -> None:
    one, same, other = (
        summarise_kind(scores, "grid", seed=seed, resamples=50).numbers["pooled_mean"].low
        for seed in (0, 0, 1)
    )
    np.testing.assert_array_equal(one, same)
    assert np.any(one != other)


def test_what_cannot_be_summed_up_is_refused(scores: EvaluationScores) -> None:
    with pytest.raises(RequestError, match="no sequence of this kind"):
        summarise_kind(scores, "head_motion")
    names = ("residuals", "shuffled_residuals", "nme", "similarity", "own_similarity", "levels")
    short = tuple(replace(r, **{n: getattr(r, n)[:, :2] for n in names}) for r in scores.rows)
    with pytest.raises(RequestError, match="2 frames to forecast; the tables need 3 or more"):
        summarise_kind(EvaluationScores(scores.selection, short, 32, {}), "natural")


@pytest.fixture
def report(scores: EvaluationScores) -> EvaluationReport:
    scores.row("net").shuffled_residuals[:] = 3 * scores.row("net").residuals
    kinds = tuple(
        summarise_kind(scores, kind, resamples=50, seed=4) for kind in ("natural", "grid")
    )
    return EvaluationReport(
        kinds,
        70,
        (0, 2),
        {"notes": ["a note"], "dataset": {"sha256": "ab"}, "split": {"by": "person"}},
    )


def test_markdown_has_the_tables_of_each_kind_apart(report: EvaluationReport) -> None:
    text = markdown_text(report)
    natural, grid = text.split("\n## ")[1:]
    assert natural.startswith("natural: 20 sequences of 2 people, 4 clips")
    assert grid.startswith("grid: 10 sequences of 1 person, 2 clips")
    assert "With 1 person the intervals say little about others." in grid
    assert "- a note" in text
    summary = report.kinds[0]
    mean = summary.numbers["pooled_mean"]
    u, low, high = (part[2, 0] for part in (mean.value, mean.low, mean.high))
    assert f"| net | {u:.4f} ({low:.4f}–{high:.4f}) |" in natural
    for line in (
        "| paper, approach 3, cross-attention (other data) | 0.015 | 0.013 | 0.017 | 0.025 "
        "| 0.928 at 256 px |",
        "| mean dU | 71 | 72 | 73 | 74 | 75 |",
        "| paper, approach 3 (other data) | 0.010 | 0.019 | 0.013 | 0.020 | 0.014 |",
        "### Mean distance against line, the best baseline at frames 73–75",
        "|  | frames 71–72 | frames 73–75 | all |",
        "| net | +200.0 % (+200.0 % to +200.0 %) |",
        "3 of 100",
    ):
        assert line in natural, line
    assert "at 64 px" in natural
    lengths = {}
    for line in natural.splitlines():  # every row of a table has as many cells as its heading
        if line.startswith("|"):
            lengths.setdefault("cells", line.count("|"))
            assert line.count("|") == lengths["cells"], line
        else:
            lengths.clear()


def test_csv_and_json_hold_the_same_numbers(report: EvaluationReport, tmp_path) -> None:
    write_evaluation_report(tmp_path, report)
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        "results.json", "table1.csv", "table2.csv", "tables.md",
    ]  # fmt: skip
    record = json.loads((tmp_path / "results.json").read_text())
    assert (record["schema"], record["version"], record["folds"]) == ("face_evaluation", 1, [0, 2])
    assert record["dataset"] == {"sha256": "ab"}
    net = record["kinds"]["natural"]["rows"][2]
    assert net["name"] == "net"
    mean = report.kinds[0].numbers["pooled_mean"]
    for part in ("value", "low", "high"):
        expected = getattr(mean, part)[2]
        np.testing.assert_allclose(net["numbers"]["pooled_mean"][part], expected, rtol=1e-8)
    assert "ssim" not in record["kinds"]["natural"]["rows"][1]["numbers"]
    table = list(csv.DictReader(io.StringIO((tmp_path / "table1.csv").read_text())))
    row = next(r for r in table if (r["kind"], r["row"]) == ("natural", "net"))
    assert float(row["mean_dv_high"]) == pytest.approx(mean.high[2, 1])
    assert float(row["ssim_own_size"]) == pytest.approx(
        report.kinds[0].numbers["pooled_ssim_own_size"].value[2]
    )
    assert [r["row"] for r in table if r["role"] == "paper"][2] == "approach 3, cross-attention"
    frames = list(csv.DictReader(io.StringIO((tmp_path / "table2.csv").read_text())))
    (value,) = [
        r["value"]
        for r in frames
        if (r["kind"], r["row"], r["metric"], r["frame"]) == ("grid", "net", "var dV", "74")
    ]
    variance = report.kinds[1].numbers["variance"].value[2, 3, 1]
    assert float(value) == pytest.approx(variance)


def test_the_same_numbers_give_the_same_bytes(report: EvaluationReport, tmp_path) -> None:
    for name in ("a", "b"):
        write_evaluation_report(tmp_path / name, report)
    for path in (tmp_path / "a").iterdir():
        assert path.read_bytes() == (tmp_path / "b" / path.name).read_bytes()
    assert "NaN" not in results_json(report)
