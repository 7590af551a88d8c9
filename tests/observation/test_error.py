"""Drawn errors have the statistics of the file that they are drawn from."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from robo_manip_baselines.observation.error_models import (
    BLOCK_FRAMES,
    DRAWN_ERRORS,
    WORLD_FROM_IMAGE,
)
from robo_manip_baselines.observation.error_stats import ErrorStats, load_error_stats
from robo_manip_baselines.runs.errors import RequestError

from .conftest import made_up_stats, write_stats

FRAMES = 60_000
SLOWEST = 0.85
"""Correlation from frame to frame of what is drawn here, at most, but for strides above 1."""

CLOSE = 5.0 / np.sqrt(FRAMES * (1 - SLOWEST) / (1 + SLOWEST))
"""Five standard errors of a mean, in standard deviations, of values that remember so long."""


@pytest.fixture(scope="module", params=[1, 3])
def stats(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> ErrorStats:
    folder = tmp_path_factory.mktemp("stats")
    return load_error_stats(write_stats(folder, made_up_stats(stride=request.param)))


def draw(name: str, stats: ErrorStats, frames: int = FRAMES, seed: int = 1) -> np.ndarray:
    return DRAWN_ERRORS[name](stats)(np.random.default_rng(seed), frames)


def correlation(values: np.ndarray, lag: int) -> np.ndarray:
    about = values - values.mean(axis=0)
    return (about[lag:] * about[: len(about) - lag]).mean(axis=0) / (about**2).mean(axis=0)


def covariance(values: np.ndarray) -> np.ndarray:
    return np.cov(values.reshape(len(values), -1).T, bias=True)


def assert_covariances_agree(values: np.ndarray, wanted: np.ndarray, slack: float) -> None:
    """Compare in units of the standard deviations, with the standard errors of a covariance."""
    deviation = np.sqrt(np.diag(wanted))
    difference = (covariance(values) - wanted) / np.outer(deviation, deviation)
    assert np.abs(difference).max() < np.sqrt(2) * slack


def test_uniform_is_the_papers() -> None:
    """Within the bounds of equations 6 and 7, evenly, each number on its own."""
    stats = load_error_stats()
    drawn = draw("uniform", stats)
    assert drawn.shape == (FRAMES, 24, 2)
    share = drawn / stats.mean_abs
    five = 5.0 / np.sqrt(FRAMES)
    assert 0.999 < np.abs(share).max() <= 1.0
    np.testing.assert_allclose(share.mean(axis=0), 0.0, atol=five / np.sqrt(3))
    np.testing.assert_allclose(np.abs(share).mean(axis=0), 0.5, atol=five / np.sqrt(12))
    np.testing.assert_allclose((share**2).mean(axis=0), 1 / 3, atol=five * 0.3)
    np.testing.assert_allclose(correlation(share, 1), 0.0, atol=five)
    between = np.corrcoef(share.reshape(FRAMES, -1).T)
    assert np.abs(between - np.eye(48)).max() < five


def test_gaussian_has_the_files_statistics(stats: ErrorStats) -> None:
    drawn = draw("gaussian", stats)
    slow = CLOSE * np.sqrt(stats.stride)
    deviation = np.sqrt(np.diag(stats.covariance)).reshape(-1, 2)
    np.testing.assert_allclose((drawn.mean(axis=0) - stats.bias) / deviation, 0.0, atol=slow)
    assert_covariances_agree(drawn, stats.covariance, slow)
    found = correlation(drawn, stats.stride)
    np.testing.assert_allclose(found, stats.autocorrelation[1], atol=slow)
    # Normal: the mean absolute error follows, and a twentieth is beyond 1.96 deviations.
    beyond = np.abs(drawn - stats.bias) > 1.96 * deviation
    np.testing.assert_allclose(beyond.mean(axis=0), 0.05, atol=slow / 4)
    # The runs of the file have that mean up to their own sampling error.
    np.testing.assert_allclose(np.abs(drawn).mean(axis=0) / stats.mean_abs, 1.0, atol=0.25)


def test_empirical_has_the_statistics_of_the_files_runs(stats: ErrorStats) -> None:
    drawn, pool = draw("empirical", stats), np.concatenate(stats.runs)
    slow = CLOSE * np.sqrt(stats.stride)
    bias = (drawn.mean(axis=0) - pool.mean(axis=0)) / pool.std(axis=0)
    np.testing.assert_allclose(bias, 0.0, atol=slow)
    ratio = np.abs(drawn).mean(axis=0) / np.abs(pool).mean(axis=0)
    np.testing.assert_allclose(ratio, 1.0, atol=slow)
    for phase in range(stats.stride):  # the same between forecasts as at them
        part = drawn[phase :: stats.stride]
        np.testing.assert_allclose(part.var(axis=0) / pool.var(axis=0), 1.0, atol=np.sqrt(2) * slow)
    at_forecasts = drawn[:: stats.stride]
    assert_covariances_agree(at_forecasts, covariance(pool), slow)
    length = -(-BLOCK_FRAMES // stats.stride)
    followed = np.mean([correlation(run, 1) for run in stats.runs], axis=0)
    wanted = followed * (length - 1) / length
    np.testing.assert_allclose(correlation(at_forecasts, 1), wanted, atol=slow + 0.05)


def test_empirical_plays_whole_blocks_of_what_was_measured(stats: ErrorStats) -> None:
    drawn = draw("empirical", stats, 1800)[:: stats.stride]
    length = BLOCK_FRAMES // stats.stride
    known = {
        tuple(np.round(row.ravel(), 12)): (i, j)
        for i, run in enumerate(stats.runs)
        for j, row in enumerate(run)
    }
    places = [known[tuple(np.round(row.ravel(), 12))] for row in drawn]
    blocks = [places[i : i + length] for i in range(0, len(places), length)]
    for block in blocks:
        (run, start), size = block[0], len(stats.runs[block[0][0]])
        assert block == [(run, (start + i) % size) for i in range(len(block))]
    assert len({block[0] for block in blocks}) > len(blocks) / 2


def test_gaussian_follows_the_shipped_file() -> None:
    """Errors of overlapping forecasts are no mixture of AR(1): the largest are met best."""
    stats = load_error_stats()
    drawn = draw("gaussian", stats)
    # Errors 24 frames ahead last for seconds: too few of them are drawn to measure a covariance.
    _, gain, _ = DRAWN_ERRORS["gaussian"](stats).args
    np.testing.assert_allclose(gain @ gain.T, stats.covariance, rtol=1e-9, atol=1e-15)
    apart = np.abs(correlation(drawn, stats.stride) - stats.autocorrelation[1])
    assert apart.max() < 0.4
    assert apart[-2:].max() < 0.15


@pytest.mark.long
@settings(max_examples=40)
@given(
    st.sampled_from(sorted(DRAWN_ERRORS)),
    st.sampled_from([1, 2, 7, 15, 100]),
    st.integers(1, 200),
    st.integers(0, 200),
)
def test_more_frames_begin_with_the_same(
    stats_file: Path, name: str, stride: int, frames: int, more: int
) -> None:
    """Bit for bit, so that an episode may be drawn piece by piece."""
    loaded = load_error_stats(stats_file)
    stats = ErrorStats(**{**vars(loaded), "stride": stride})
    short, long = draw(name, stats, frames), draw(name, stats, frames + more)
    assert short.shape == (frames, 5, 2)
    np.testing.assert_array_equal(long[:frames], short)


def test_other_draws_are_others() -> None:
    stats = load_error_stats()
    for name in DRAWN_ERRORS:
        assert not np.array_equal(draw(name, stats, 50, 1), draw(name, stats, 50, 2))


def test_without_memory_or_spread(tmp_path: Path) -> None:
    """One lag says nothing of memory; an error that never varies is its bias."""
    content = made_up_stats()
    content["autocorrelation"] = content["autocorrelation"][:1]
    white = draw("gaussian", load_error_stats(write_stats(tmp_path, content)))
    np.testing.assert_allclose(correlation(white, 1), 0.0, atol=5.0 / np.sqrt(FRAMES))
    content = made_up_stats()
    content["covariance"] = np.zeros((10, 10)).tolist()
    still = load_error_stats(write_stats(tmp_path, content))
    drawn = draw("gaussian", still, 20)
    np.testing.assert_array_equal(drawn, np.tile(still.bias, (20, 1, 1)))


def test_without_residuals_there_is_nothing_to_play(tmp_path: Path) -> None:
    stats = load_error_stats(write_stats(tmp_path, {**made_up_stats(), "residuals": []}))
    with pytest.raises(RequestError, match=r"hold no residuals.*gaussian or uniform"):
        DRAWN_ERRORS["empirical"](stats)
    draw("uniform", stats, 10)


def test_the_image_plane_lies_across_the_face() -> None:
    """The camera looks at the face, along -x: its right is +y, its down is -z, its depth x."""
    forward, up = np.array([-1.0, 0.0, 0.0]), np.array([0.0, 0.0, 1.0])
    np.testing.assert_array_equal(WORLD_FROM_IMAGE[0], np.cross(forward, up))
    np.testing.assert_array_equal(WORLD_FROM_IMAGE[1], -up)
