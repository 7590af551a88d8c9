"""error_stats.json as the robot's side reads it: metres, digests, refusals."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from robo_manip_baselines.observation.error_stats import DEFAULT_STATS, load_error_stats
from robo_manip_baselines.runs.errors import RequestError

from .conftest import made_up_stats, write_stats


def test_metres_follow_the_papers_equations(tmp_path: Path) -> None:
    """0.015 and 0.017 of the paper's picture at 0.5 m are 0.0115 and 0.0074 m (section IV.C)."""
    content = made_up_stats(crop=1.0)
    content["horizons"][0]["bias"] = [0.015, 0.017]
    stats = load_error_stats(write_stats(tmp_path, content))
    np.testing.assert_allclose(stats.bias[0], [0.0115, 0.0074], atol=5e-5)  # as printed
    wide = load_error_stats(write_stats(tmp_path, {**content, "covariance": np.eye(10).tolist()}))
    view = np.array([0.7673, 0.4348])  # m, what that camera sees at 0.5 m
    np.testing.assert_allclose(np.diag(wide.covariance), np.tile(view, 5) ** 2, rtol=1e-3)
    run = np.array(content["residuals"][3]["values"])
    np.testing.assert_allclose(stats.runs[3], run * view, rtol=1e-3)


def test_a_crop_is_smaller_than_the_picture(tmp_path: Path) -> None:
    files = (write_stats(tmp_path, made_up_stats(crop=crop)) for crop in (1.0, 0.25))
    whole, part = map(load_error_stats, files)
    for name, power in (("mean_abs", 1), ("bias", 1), ("covariance", 2)):
        smaller = getattr(whole, name) * 0.25**power
        np.testing.assert_allclose(getattr(part, name), smaller, rtol=1e-12)
    np.testing.assert_allclose(part.runs[0], whole.runs[0] * 0.25, rtol=1e-12)


def test_the_shipped_file_is_read_and_small() -> None:
    stats = load_error_stats()
    assert stats.horizons == 24
    assert len(stats.runs) > 1
    assert stats.source == DEFAULT_STATS
    assert DEFAULT_STATS.stat().st_size < 1_000_000
    # Errors grow with the horizon and are those of a forecast of a face half a metre away.
    assert (np.diff(stats.mean_abs, axis=0) > 0).all()
    assert 1e-4 < stats.mean_abs.min() < stats.mean_abs.max() < 0.05


def test_another_file_than_before_is_refused(tmp_path: Path) -> None:
    path = write_stats(tmp_path, made_up_stats())
    digest = load_error_stats(path).sha256
    load_error_stats(path, digest)
    path.write_text(path.read_text() + "\n")
    with pytest.raises(RequestError, match=f"not {digest[:12]}.*give the file that was"):
        load_error_stats(path, digest)


def spoil(**changes: Any) -> Callable[[dict[str, Any]], dict[str, Any]]:
    return lambda content: {**content, **changes}


def without(name: str) -> Callable[[dict[str, Any]], dict[str, Any]]:
    return lambda content: {key: value for key, value in content.items() if key != name}


CAMERA = {"fov_x_deg": 75, "fov_y_deg": 47, "depth_m": 0.5, "crop_width": 0, "crop_height": 1}


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (spoil(schema="face_track"), "schema 'face_track' version 1, this release reads"),
        (spoil(version=2), "schema 'error_stats' version 2, this release reads"),
        (spoil(fps=25.0), "fps 25: must be 30"),
        (spoil(stride_frames=0), "stride_frames 0"),
        (spoil(horizons=[]), "horizons: must have 1 elements or more"),
        (without("covariance"), "covariance: is missing"),
        (without("camera"), "camera: is missing"),
        (spoil(camera=CAMERA), "camera.crop_width 0: must be more than 0"),
        (spoil(covariance=np.eye(8).tolist()), "'covariance' must be 10 x 10 numbers"),
        (spoil(covariance=(-np.eye(10)).tolist()), "'covariance' must be symmetric without"),
        (spoil(covariance=np.triu(np.ones((10, 10))).tolist()), "must be symmetric without"),
        (spoil(autocorrelation=[[1.0]]), "autocorrelation.0..0.: must be a list, not 1.0"),
        (
            spoil(residuals=[{"values": [[[1, 2]], [[1]]]}]),
            "residuals.0..values.1..0..1.: is missing",
        ),
        (spoil(residuals=[{"values": []}]), "residuals.0..values: must have 1 elements or more"),
        (spoil(residuals=[{"values": [[[float("inf"), 0]] * 5]}]), "Infinity is no finite number"),
        (spoil(residuals=7), "residuals: must be a list, not 7"),
        (lambda content: [content], "must be an object, not a list of 1"),
    ],
)
def test_damage_is_told_in_one_line(
    tmp_path: Path, damage: Callable[[dict[str, Any]], Any], message: str
) -> None:
    path = tmp_path / "bad.json"
    path.write_text(json.dumps(damage(made_up_stats(runs=2, length=5))))
    with pytest.raises(RequestError, match=message) as caught:
        load_error_stats(path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("content", [b"", b"{", b"\xff\xfe", b"null"])
def test_what_is_no_json_is_refused(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "bad.json"
    path.write_bytes(content)
    with pytest.raises(RequestError, match="export-stats"):
        load_error_stats(path)
    with pytest.raises(RequestError, match=r"cannot read '.*nowhere\.json'"):
        load_error_stats(tmp_path / "nowhere.json")
