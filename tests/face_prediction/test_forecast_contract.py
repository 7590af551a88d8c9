"""Contract of every registered forecaster."""

from __future__ import annotations

import numpy as np
import pytest

from face_prediction.forecast import (
    FORECASTERS,
    Forecaster,
    LandmarkSequences,
    fit_forecaster,
    restore_forecaster,
)
from robo_manip_baselines.runs.errors import RequestError

HORIZON = 5


def wandering_faces(count: int, frames: int, seed: int) -> np.ndarray:
    """Faces (count, frames, 468, 2) that drift smoothly, change shape and tremble."""
    rng = np.random.default_rng(seed)
    face = rng.uniform(0.3, 0.7, (468, 2))
    shape = rng.normal(0, 1, (468, 2))
    motion = np.zeros((count, frames, 3))
    for t in range(1, frames):
        motion[:, t] = 0.8 * motion[:, t - 1] + rng.normal(0, 2e-3, (count, 3))
    place = np.cumsum(motion, axis=1)
    landmarks = face + place[:, :, None, :2] + place[:, :, 2, None, None] * 0.2 * shape
    return landmarks + rng.normal(0, 2e-4, landmarks.shape)


@pytest.fixture(scope="module", params=list(FORECASTERS))
def forecaster(request: pytest.FixtureRequest) -> Forecaster:
    subjects = tuple(f"subject{i % 4}" for i in range(12))
    return fit_forecaster(request.param, LandmarkSequences(wandering_faces(12, 40, 1), subjects))


@pytest.fixture(scope="module")
def sequences() -> np.ndarray:
    return wandering_faces(6, 60, 2)


def test_nothing_after_the_history_is_looked_at(
    forecaster: Forecaster, sequences: np.ndarray
) -> None:
    # the history is a view, so that a forecaster that reached past its end would find these frames
    other = sequences.copy()
    other[:, 40:] = np.nan
    expected = forecaster.predict(sequences[:, :40], HORIZON)
    np.testing.assert_array_equal(forecaster.predict(other[:, :40], HORIZON), expected)


def test_history_is_left_alone_and_not_shared(
    forecaster: Forecaster, sequences: np.ndarray
) -> None:
    history = sequences[:, :40].copy()
    before = history.copy()
    forecast = forecaster.predict(history, HORIZON)
    np.testing.assert_array_equal(history, before)
    forecast[:] = 9.0
    np.testing.assert_array_equal(history, before)
    assert not np.shares_memory(forecast, history)


def test_last_frames_count(forecaster: Forecaster, sequences: np.ndarray) -> None:
    changed = sequences[:, :40].copy()
    changed[:, -1] += 0.01
    moved = forecaster.predict(changed, 1) - forecaster.predict(sequences[:, :40], 1)
    assert np.all(np.abs(moved) > 1e-3)


def test_frames_count_up_to_the_memory(forecaster: Forecaster, sequences: np.ndarray) -> None:
    # where all count, the first of four still weighs enough to be seen
    history = sequences[:, :40] if forecaster.memory else sequences[:, :4]
    oldest = history.shape[1] - (forecaster.memory or 4)
    expected = forecaster.predict(history, HORIZON)
    changed = history.copy()
    changed[:, :oldest] += 0.3
    np.testing.assert_array_equal(forecaster.predict(changed, HORIZON), expected)
    changed[:, oldest] += np.linspace(0, 0.3, 468)[:, None]
    assert np.any(np.abs(forecaster.predict(changed, HORIZON) - expected) > 1e-6)


def test_when_it_happens_does_not_matter(forecaster: Forecaster, sequences: np.ndarray) -> None:
    # the same frames at another place of a longer sequence: only frames, not their index, count
    later = np.concatenate([sequences[:, 50:], sequences[:, :40], sequences[:, 40:45]], axis=1)
    np.testing.assert_array_equal(
        forecaster.predict(later[:, 10:50], HORIZON), forecaster.predict(sequences[:, :40], HORIZON)
    )


def test_rows_of_a_batch_are_independent(forecaster: Forecaster, sequences: np.ndarray) -> None:
    history = sequences[:, :40]
    whole = forecaster.predict(history, HORIZON)
    for index in range(len(history)):
        alone = forecaster.predict(history[index], HORIZON)
        assert alone.shape == (HORIZON, 468, 2)
        # sums over landmarks may be taken in another order in a batch: a few units in 1e-16
        np.testing.assert_allclose(alone, whole[index], rtol=0, atol=1e-13)
    stacked = forecaster.predict(history.reshape(2, 3, 40, 468, 2), HORIZON)
    np.testing.assert_array_equal(stacked, whole.reshape(2, 3, HORIZON, 468, 2))


def test_moved_face_gives_moved_forecast(forecaster: Forecaster, sequences: np.ndarray) -> None:
    offset = np.array([0.25, -0.125])
    np.testing.assert_allclose(
        forecaster.predict(sequences[:, :40] + offset, HORIZON),
        forecaster.predict(sequences[:, :40], HORIZON) + offset,
        rtol=0,
        atol=1e-12,
    )


def test_shorter_horizon_is_a_part_of_a_longer_one(
    forecaster: Forecaster, sequences: np.ndarray
) -> None:
    longer = forecaster.predict(sequences[:, :40], HORIZON)
    for horizon in range(1, HORIZON):
        shorter = forecaster.predict(sequences[:, :40], horizon)
        np.testing.assert_allclose(shorter, longer[:, :horizon], rtol=0, atol=1e-13)


def test_still_face_stays(forecaster: Forecaster, sequences: np.ndarray) -> None:
    still = np.repeat(sequences[:, :1], 40, axis=1)
    forecast = forecaster.predict(still, HORIZON)
    np.testing.assert_allclose(forecast, still[:, :HORIZON], rtol=0, atol=1e-12)


@pytest.mark.parametrize("frames", [1, 2, 3])
def test_short_history_is_enough(
    forecaster: Forecaster, sequences: np.ndarray, frames: int
) -> None:
    forecast = forecaster.predict(sequences[:, :frames], HORIZON)
    assert forecast.shape == (6, HORIZON, 468, 2)
    assert np.all(np.isfinite(forecast))
    if frames == 1:
        last = np.repeat(sequences[:, :1], HORIZON, axis=1)
        np.testing.assert_allclose(forecast, last, rtol=0, atol=1e-12)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_dtype_is_that_of_the_history(
    forecaster: Forecaster, sequences: np.ndarray, dtype: type
) -> None:
    forecast = forecaster.predict(sequences[:, :40].astype(dtype), HORIZON)
    assert forecast.dtype == dtype
    exact = forecaster.predict(sequences[:, :40], HORIZON)
    # float32 resolves 6e-8 of coordinates below 1; five steps ahead magnify that somewhat
    np.testing.assert_allclose(forecast, exact, rtol=0, atol=2e-6)


def test_parameters_come_back_from_arrays(forecaster: Forecaster, sequences: np.ndarray) -> None:
    again = restore_forecaster(forecaster.name, forecaster.arrays())
    np.testing.assert_array_equal(
        again.predict(sequences[:, :40], HORIZON), forecaster.predict(sequences[:, :40], HORIZON)
    )
    with pytest.raises(RequestError, match="parameters"):
        restore_forecaster(forecaster.name, {**forecaster.arrays(), "other": np.zeros(1)})


@pytest.mark.parametrize(
    ("history", "horizon", "told"),
    [
        (np.zeros((40, 467, 2)), 5, "467"),
        (np.zeros((40, 468, 3)), 5, "468, 3"),
        (np.zeros((468, 2)), 5, "expected"),
        (np.zeros((0, 468, 2)), 5, "0 frames"),
        (np.zeros((40, 468, 2)), 0, "horizon 0"),
        (np.full((40, 468, 2), np.nan), 5, "NaN"),
        (np.full((40, 468, 2), np.inf), 5, "NaN or infinity"),
        (np.full((40, 468, 2), [np.inf, -np.inf]), 5, "NaN or infinity"),
    ],
)
def test_wrong_request_is_named(
    forecaster: Forecaster, history: np.ndarray, horizon: int, told: str
) -> None:
    with pytest.raises(RequestError, match=told):
        forecaster.predict(history, horizon)


def test_unknown_name_lists_the_known_ones() -> None:
    with pytest.raises(RequestError, match=r"'psychic'.*kalman.*persistence"):
        restore_forecaster("psychic", {})


@pytest.mark.parametrize(
    ("shape", "subjects", "told"),
    [
        ((2, 40, 467, 2), ("a", "b"), "467"),
        ((2, 40, 468), ("a", "b"), "expected"),
        ((0, 40, 468, 2), (), "expected"),
        ((2, 40, 468, 2), ("a",), "1 subjects for 2"),
    ],
)
def test_sequences_are_checked(
    shape: tuple[int, ...], subjects: tuple[str, ...], told: str
) -> None:
    with pytest.raises(RequestError, match=told):
        LandmarkSequences(np.zeros(shape), subjects)


def test_sequences_with_nan_are_refused() -> None:
    landmarks = np.zeros((2, 40, 468, 2))
    landmarks[1, 3, 7, 0] = np.nan
    with pytest.raises(RequestError, match="NaN"):
        LandmarkSequences(landmarks, ("a", "b"))
