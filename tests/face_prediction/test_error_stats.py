"""``error_stats.json``: what is measured, written, read and refused."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from face_prediction.evaluation.error_stats import (
    PAPER_CAMERA,
    Camera,
    MouthResiduals,
    PredictorErrorStats,
    autocorrelation,
    data_hash,
    load_predictor_error_stats,
    measure_error_stats,
    neighbours,
    save_predictor_error_stats,
)
from robo_manip_baselines.runs.errors import RequestError

STRIDE = 5


def correlated_residuals(seed: int = 0) -> tuple[np.ndarray, list[str], list[str], list[int]]:
    """Residuals (200, 5, 2) of four clips of two people, and their clips, subjects and starts."""
    rng = np.random.default_rng(seed)
    mixing = np.tril(rng.normal(0, 0.01, (10, 10)))
    residuals = (rng.normal(size=(200, 10)) @ mixing.T).reshape(200, 5, 2) + 1e-3
    clips = [f"clip{i // 50}" for i in range(200)]
    subjects = [f"subject{i // 100}" for i in range(200)]
    return residuals, clips, subjects, [STRIDE * (i % 50) for i in range(200)]


def measured(residuals: np.ndarray | None = None, **options: Any) -> PredictorErrorStats:
    example, *places = correlated_residuals()
    values = example if residuals is None else residuals
    given = MouthResiduals(values, *places, STRIDE, "kalman", data_hash(example))
    return measure_error_stats(given, "natural", **options)


@pytest.fixture(scope="module")
def stats() -> PredictorErrorStats:
    return measured()


def test_equations_6_and_7_give_the_papers_metres() -> None:
    across, up = PAPER_CAMERA.metres(np.array([0.015, 0.017]))
    assert (round(across, 4), round(up, 4)) == (0.0115, 0.0074)
    # the same by hand: 2 * 0.5 m * tan(37.5 deg) * 0.015, and tan(23.5 deg) * 0.017
    assert across == pytest.approx(0.767326988 * 0.015, rel=1e-8)
    assert up == pytest.approx(0.434812375 * 0.017, rel=1e-8)


def test_paper_means_go_through_the_file_as_metres(tmp_path: Path) -> None:
    signs = np.where(np.arange(200) % 2, 1.0, -1.0)[:, None, None]
    stats = measured(np.broadcast_to([0.015, 0.017], (200, 5, 2)) * signs)
    save_predictor_error_stats(tmp_path / "error_stats.json", stats)
    stored = json.loads((tmp_path / "error_stats.json").read_text())
    for horizon in stored["horizons"]:
        np.testing.assert_allclose(horizon["mean_abs"], [0.015, 0.017])
        assert [round(metres, 4) for metres in horizon["mean_abs_m"]] == [0.0115, 0.0074]


def test_metres_scale_with_depth_and_crop() -> None:
    error = np.array([[0.01, 0.02], [0.0, -0.01]])
    near, far = Camera(depth_m=0.5), Camera(depth_m=1.0)
    np.testing.assert_allclose(far.metres(error), 2 * near.metres(error))
    cropped = Camera(crop_width=0.25, crop_height=0.5)
    np.testing.assert_allclose(cropped.metres(error), near.metres(error) * [0.25, 0.5])
    with pytest.raises(RequestError, match="fov_x_deg 180"):
        Camera(fov_x_deg=180.0)
    with pytest.raises(RequestError, match="depth_m"):
        Camera(depth_m=float("nan"))


def test_each_horizon_is_measured(stats: PredictorErrorStats) -> None:
    residuals = correlated_residuals()[0]
    assert [h.frames for h in stats.horizons] == [1, 2, 3, 4, 5]
    for h, horizon in enumerate(stats.horizons):
        assert (horizon.forecasts, horizon.missing) == (200, 0)
        for axis in range(2):
            column = residuals[:, h, axis]
            assert horizon.mean_abs[axis] == pytest.approx(np.mean(np.abs(column)))
            assert horizon.var_abs[axis] == pytest.approx(np.var(np.abs(column)))
            assert horizon.bias[axis] == pytest.approx(np.mean(column))
            for level, quantile in zip(stats.quantile_levels, horizon.quantiles[axis], strict=True):
                # a quantile has its share of the data below it, to one in 200
                assert np.mean(column < quantile) == pytest.approx(level, abs=0.0051)
    assert (stats.sequences, stats.subjects) == (200, 2)


def test_covariance_is_that_of_numpy(stats: PredictorErrorStats) -> None:
    flat = correlated_residuals()[0].reshape(200, 10)
    np.testing.assert_allclose(stats.covariance, np.cov(flat.T, bias=True), rtol=1e-10)


def test_autocorrelation_of_a_known_process() -> None:
    rng = np.random.default_rng(1)
    x = np.zeros((4000, 1, 2))
    for t in range(1, 4000):
        x[t] = np.array([0.8, -0.5]) * x[t - 1] + rng.normal(size=2)
    found = autocorrelation(x, [np.arange(4000)], 4)
    expected = np.array([[0.8**k, (-0.5) ** k] for k in range(5)])
    # standard error of a correlation of 4000 dependent values: below 0.03
    np.testing.assert_allclose(found[:, 0], expected, atol=0.08)
    # what is correlated is what is left beside the mean
    np.testing.assert_allclose(autocorrelation(x + 7.0, [np.arange(4000)], 4), found, atol=1e-9)


def test_autocorrelation_never_pairs_two_clips() -> None:
    # constant within a clip and opposite between them: any pair across would lower it
    x = np.repeat([1.0, -1.0], 3)[:, None, None] * np.ones((1, 2, 2))
    runs = neighbours(["a"] * 3 + ["b"] * 3, [0, 5, 10, 15, 20, 25], 5)
    assert [run.tolist() for run in runs] == [[0, 1, 2], [3, 4, 5]]
    np.testing.assert_allclose(autocorrelation(x, runs, 9), np.ones((3, 2, 2)))


def test_gaps_and_order_of_sequences() -> None:
    runs = neighbours(["b", "a", "a", "a", "b"], [5, 20, 0, 5, 0], 5)
    assert [run.tolist() for run in runs] == [[2, 3], [1], [4, 0]]


def test_autocorrelation_of_no_error_is_nothing() -> None:
    found = autocorrelation(np.zeros((6, 1, 2)), [np.arange(6)], 3)
    np.testing.assert_array_equal(found[:, 0], [[1, 1], [0, 0], [0, 0], [0, 0]])


def test_missing_forecasts_cut_runs() -> None:
    residuals = correlated_residuals()[0]
    residuals[10, 3] = np.nan
    residuals[50] = np.nan
    stats = measured(residuals)
    assert [h.missing for h in stats.horizons] == [1, 1, 1, 2, 1]
    assert [len(run.values) for run in stats.residuals] == [10, 39, 49, 50, 50]
    assert [run.clip for run in stats.residuals] == ["clip0", "clip0", "clip1", "clip2", "clip3"]
    with pytest.raises(RequestError, match="no sequence"):
        measured(np.full((200, 5, 2), np.nan))


def test_runs_hold_the_residuals(stats: PredictorErrorStats) -> None:
    runs = np.concatenate([np.array(run.values) for run in stats.residuals])
    np.testing.assert_allclose(runs, correlated_residuals()[0], atol=0.5e-6)
    assert {run.subject for run in stats.residuals[:2]} == {"subject0"}
    assert measured(keep_runs=False).residuals == ()


def test_file_gives_back_what_was_written(stats: PredictorErrorStats, tmp_path: Path) -> None:
    path = tmp_path / "new" / "error_stats.json"
    save_predictor_error_stats(path, stats)
    assert load_predictor_error_stats(path) == stats
    save_predictor_error_stats(path, replace(stats, footage="[ 1,  2 ] grid"))
    assert load_predictor_error_stats(path).footage == "[ 1,  2 ] grid"
    assert [p.name for p in path.parent.iterdir()] == ["error_stats.json"]
    stored = json.loads(path.read_text())
    assert (stored["schema"], stored["version"]) == ("error_stats", 1)
    assert '"quantile_levels": [0.01, 0.05, 0.25' in path.read_text()  # side by side


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=10, deadline=None)
def test_any_measured_file_is_valid(tmp_path_factory: pytest.TempPathFactory, seed: int) -> None:
    residuals = np.random.default_rng(seed).standard_cauchy((200, 5, 2)) * 1e-3
    path = tmp_path_factory.mktemp("stats") / "error_stats.json"
    stats = measured(residuals)
    save_predictor_error_stats(path, stats)
    assert load_predictor_error_stats(path) == stats


Change = Callable[[dict[str, Any]], object]


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (
            lambda s: s.update(schema="face_track"),
            "schema 'face_track' version 1, this release reads",
        ),
        (lambda s: s.update(version=2), "version 2"),
        (lambda s: s.pop("fps"), "fps: is missing"),
        (lambda s: s.update(colour="red"), "unknown name 'colour'"),
        (lambda s: s.update(fps="30"), "fps: must be a number, not '30'"),
        (lambda s: s.update(fps=-30.0), "'fps' must be positive"),
        (lambda s: s.update(fps=True), "fps: must be a number, not true"),
        (lambda s: s.update(predictor=""), "'predictor'"),
        (lambda s: s.update(stride_frames=0), "stride_frames 0: must be 1 or more"),
        (lambda s: s.update(subjects=0), "subjects 0: must be 1 or more"),
        (lambda s: s.update(data_sha256="abc"), "'data_sha256'"),
        (lambda s: s.update(equations=["dx = dU"]), "'equations'"),
        (lambda s: s.update(quantile_levels=[0.5, 0.05]), "'quantile_levels'"),
        (lambda s: s.update(camera=None), "camera: must be an object, not null"),
        (lambda s: s["camera"].pop("depth_m"), "camera.depth_m: is missing"),
        (lambda s: s["camera"].update(fov_x_deg=190), "fov_x_deg 190"),
        (lambda s: s["camera"].update(depth_m=0.6), "'horizons[0].mean_abs_m' does not follow"),
        (lambda s: s.update(horizons={}), "horizons: must be a list, not an object"),
        (lambda s: s.update(horizons=[]), "'horizons' must be"),
        (lambda s: s["horizons"].pop(0), "'horizons' must be 1, 2"),
        (lambda s: s["horizons"][2].pop("bias"), "horizons[2].bias: is missing"),
        (lambda s: s["horizons"][2].update(bias=[9, 9]), "'horizons[2].bias' must not exceed"),
        (lambda s: s["horizons"][1].update(var_abs=[-1e-9, 0.0]), "'horizons[1].var_abs'"),
        (
            lambda s: s["horizons"][1].update(var_abs=[1e-9]),
            "'horizons[1].var_abs' must be finite, of shape (2)",
        ),
        (
            lambda s: s["horizons"][1].update(mean_abs=["x", 1]),
            "horizons[1].mean_abs[0]: must be",
        ),
        (lambda s: s["horizons"][1].update(mean_abs=[float("nan"), 1]), "NaN is no finite number"),
        (lambda s: s["horizons"][4]["quantiles"][1].reverse(), "'horizons[4].quantiles'"),
        (lambda s: s["horizons"][4]["quantiles"][1].pop(), "'horizons[4].quantiles' has rows"),
        (lambda s: s["horizons"][0].update(forecasts=7), "'horizons[0].forecasts'"),
        (lambda s: s["covariance"].pop(), "'covariance'"),
        (lambda s: s["covariance"][0].__setitem__(1, 9.0), "'covariance' must be symmetric"),
        (lambda s: s["covariance"][0].__setitem__(0, -9.0), "'covariance' must be symmetric"),
        (lambda s: s["autocorrelation"][0].pop(), "'autocorrelation'"),
        (
            lambda s: s["residuals"][1].update(values=[[1.0]]),
            "residuals[1].values[0][0]: must",
        ),
        (lambda s: s["residuals"][1].update(values=[[[1.0, 2.0]]]), "'residuals[1]' must be"),
    ],
)
def test_broken_file_is_refused_by_name(
    stats: PredictorErrorStats, tmp_path: Path, change: Change, told: str
) -> None:
    path = tmp_path / "error_stats.json"
    save_predictor_error_stats(path, stats)
    stored = json.loads(path.read_text())
    change(stored)
    path.write_text(json.dumps(stored))
    with pytest.raises(RequestError) as error:
        load_predictor_error_stats(path)
    assert told in str(error.value)
    assert str(path) in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("content", ["", "{", "[]", "3", '{"schema": 1}', "\xff\xfe"])
def test_what_is_no_such_file_is_refused(tmp_path: Path, content: str) -> None:
    path = tmp_path / "error_stats.json"
    path.write_bytes(content.encode("latin-1"))
    with pytest.raises(RequestError, match=r"error_stats\.json"):
        load_predictor_error_stats(path)
    with pytest.raises(RequestError, match="cannot read"):
        load_predictor_error_stats(tmp_path / "absent.json")


def test_failed_write_leaves_the_old_file(
    stats: PredictorErrorStats, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "error_stats.json"
    save_predictor_error_stats(path, stats)

    def fail(*_: object) -> None:
        raise OSError("disk full")

    monkeypatch.setattr("robo_manip_baselines.runs.files.os.fsync", fail)
    with pytest.raises(OSError, match="disk full"):
        save_predictor_error_stats(path, replace(stats, predictor="other"))
    assert load_predictor_error_stats(path) == stats
    assert [p.name for p in tmp_path.iterdir()] == ["error_stats.json"]


def test_hash_tells_values_shapes_and_types_apart() -> None:
    one = np.arange(6.0)
    assert data_hash(one) == data_hash(one.copy())
    assert data_hash(one) == data_hash(one.astype(">f8"))
    assert data_hash(one[::2]) == data_hash(one[::2].copy())
    others = [one.reshape(2, 3), one.astype(np.float32), one + 1e-12, one[:5]]
    assert len({data_hash(a) for a in [one, *others]}) == 5
    assert data_hash(one, one) != data_hash(one)


def test_lengths_must_agree() -> None:
    residuals, clips, subjects, starts = correlated_residuals()
    with pytest.raises(RequestError, match="199 starts"):
        measure_error_stats(
            MouthResiduals(residuals, clips, subjects, starts[1:], 1, "p", "0" * 64), "f"
        )
