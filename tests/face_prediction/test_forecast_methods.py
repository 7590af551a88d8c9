"""Each forecaster against an oracle of its own."""

from __future__ import annotations

import numpy as np
import pytest

from face_prediction.forecast import LandmarkSequences, mouth_centre
from face_prediction.forecast.autoregression import (
    LandmarkAutoregression,
    MouthAutoregression,
    held_out_errors,
    least_error,
    principal_shapes,
)
from face_prediction.forecast.extrapolation import ConstantVelocity, LineFit, Persistence
from face_prediction.forecast.interface import subject_folds
from face_prediction.tracking.geometry import LIPS
from robo_manip_baselines.runs.autoregression import (
    forecast,
    moments,
    solve,
    spectral_radius,
    stabilised,
)
from robo_manip_baselines.runs.errors import RequestError

FACE = np.random.default_rng(5).uniform(0.2, 0.8, (468, 2))
AHEAD = np.arange(1, 6)[:, None, None]
#: x[t] = 0.9 x[t-1] - 0.3 x[t-2], and some of u goes into v
TRUE_AR = np.array([[[0.9, 0.2], [0.0, 0.7]], [[-0.3, 0.0], [0.1, -0.2]]])


def ar_process(coefficients: np.ndarray, count: int, frames: int, seed: int) -> np.ndarray:
    """(count, frames, D) of the process with unit noise, after 100 frames to settle."""
    rng = np.random.default_rng(seed)
    order, components = coefficients.shape[:2]
    x = np.zeros((count, frames + 100, components))
    for t in range(order, frames + 100):
        expected = sum(x[:, t - k] @ coefficients[k - 1] for k in range(1, order + 1))
        x[:, t] = expected + rng.normal(size=(count, components))
    return x[:, 100:]


def faces_moved(steps: np.ndarray) -> np.ndarray:
    """`FACE` (N, T + 1, 468, 2) carried along by displacements (N, T, 2)."""
    place = np.cumsum(np.pad(steps, ((0, 0), (1, 0), (0, 0))), axis=1)
    return FACE + place[:, :, None]


def uniform_motion(frames: int) -> np.ndarray:
    """Every landmark at a velocity of its own: (frames, 468, 2)."""
    velocity = np.random.default_rng(6).normal(0, 0.01, (468, 2))
    return FACE + np.arange(frames)[:, None, None] * velocity


def test_mouth_centre_is_the_mean_of_the_lips() -> None:
    expected = [sum(FACE[i, axis] for i in LIPS) / 40 for axis in range(2)]
    np.testing.assert_allclose(mouth_centre(FACE), expected, rtol=1e-14)
    with_depth = np.concatenate([FACE, np.ones((468, 1))], axis=1)
    np.testing.assert_array_equal(
        mouth_centre(with_depth[None, None]), mouth_centre(FACE)[None, None]
    )


def test_persistence_repeats_the_last_frame() -> None:
    history = uniform_motion(7)
    expected = np.stack([history[-1]] * 5)
    np.testing.assert_array_equal(Persistence().predict(history, 5), expected)


@pytest.mark.parametrize(
    "method", [ConstantVelocity(), ConstantVelocity(window=4), LineFit(), LineFit(frames=8)]
)
@pytest.mark.parametrize("frames", [2, 3, 12])
def test_uniform_motion_is_forecast_exactly(
    method: ConstantVelocity | LineFit, frames: int
) -> None:
    truth = uniform_motion(frames + 5)
    np.testing.assert_allclose(method.predict(truth[:frames], 5), truth[frames:], atol=1e-14)


def test_velocity_is_taken_over_the_window() -> None:
    history = FACE + np.array([0.0, 0.1, 0.4, 0.9, 1.6])[:, None, None]  # squares of time / 10
    for window, velocity in ((1, 0.7), (2, 0.6), (3, 0.5), (4, 0.4), (9, 0.4)):
        expected = history[-1] + AHEAD * velocity
        np.testing.assert_allclose(ConstantVelocity(window).predict(history, 5), expected)


def test_line_is_that_of_polyfit() -> None:
    history = FACE + np.random.default_rng(7).normal(0, 0.01, (9, 468, 2))
    slope, level = np.polyfit(np.arange(5), history[-5:].reshape(5, -1), 1)
    expected = level + np.arange(5, 10)[:, None] * slope
    np.testing.assert_allclose(LineFit().predict(history, 5), expected.reshape(5, 468, 2))


@pytest.mark.parametrize(("kind", "value"), [(ConstantVelocity, 0), (LineFit, 1)])
def test_useless_window_is_refused(kind: type, value: int) -> None:
    with pytest.raises(RequestError, match=str(value)):
        kind(value)


def test_autoregression_finds_the_coefficients_of_a_process() -> None:
    series = ar_process(TRUE_AR, 400, 100, 8)
    found = solve(moments(series, 2), 2, 2)
    # a coefficient's standard error is about 1 / sqrt(40000 rows) = 0.005
    np.testing.assert_allclose(found, TRUE_AR, atol=0.02)


def test_least_squares_are_those_of_statsmodels(statsmodels) -> None:
    api = statsmodels("tsa.api")
    series = ar_process(TRUE_AR, 1, 500, 9)
    theirs = api.VAR(series[0]).fit(2, trend="n").coefs  # (P, D, D), for columns
    ours = solve(moments(series, 2), 2, 2)
    # the ridge of a millionth
    np.testing.assert_allclose(ours, theirs.transpose(0, 2, 1), atol=1e-5)


def test_lower_orders_are_parts_of_the_moments_of_higher_ones() -> None:
    series = ar_process(TRUE_AR, 10, 60, 10)
    longer = solve(moments(series, 5), 2, 2)
    # the same rows: those that have five frames before them
    np.testing.assert_allclose(longer, solve(moments(series[:, 3:], 2), 2, 2), rtol=1e-5)


def test_expectation_is_computed_step_by_step() -> None:
    recent = ar_process(TRUE_AR, 3, 10, 11)
    x = list(np.moveaxis(recent, 1, 0))
    for _ in range(4):
        x.append(x[-1] @ TRUE_AR[0] + x[-2] @ TRUE_AR[1])
    np.testing.assert_allclose(forecast(TRUE_AR, recent, 4), np.stack(x[-4:], axis=1))


def test_missing_past_is_rest() -> None:
    recent = ar_process(TRUE_AR, 3, 1, 12)
    padded = np.concatenate([np.zeros((3, 1, 2)), recent], axis=1)
    np.testing.assert_array_equal(forecast(TRUE_AR, recent, 4), forecast(TRUE_AR, padded, 4))


def test_spectral_radius_of_known_roots() -> None:
    # (1 - 0.9 z)(1 - 0.5 z) = 1 - 1.4 z + 0.45 z^2
    assert spectral_radius(np.array([[[1.4]], [[-0.45]]])) == pytest.approx(0.9)
    # roots 1.2 and 0.5; all are scaled alike
    unstable = np.array([[[1.7]], [[-0.6]]])
    tame = stabilised(unstable, 0.99)
    assert spectral_radius(tame) == pytest.approx(0.99)
    np.testing.assert_allclose(np.roots([1, *-tame[:, 0, 0]]), [0.99, 0.5 * 0.99 / 1.2])
    np.testing.assert_array_equal(stabilised(TRUE_AR), TRUE_AR)


def test_explosive_faces_give_a_stable_forecast() -> None:
    grown = np.cumprod(np.full((4, 20, 2), 1.2), axis=1) * 1e-3
    grown *= np.array([1.0, -1.0, 0.5, 2.0])[:, None, None]
    fitted = MouthAutoregression.fit(LandmarkSequences(faces_moved(grown), tuple("abcd")), order=1)
    assert spectral_radius(fitted.coefficients) <= 0.99 + 1e-12
    far = fitted.predict(faces_moved(grown), 2000)
    assert np.abs(far[:, -1] - far[:, -2]).max() < 1e-6  # it has come to rest


def test_order_is_chosen_on_other_people() -> None:
    series = ar_process(TRUE_AR, 200, 60, 13) * 1e-3
    subjects = tuple(f"s{i % 10}" for i in range(200))
    pairs = [(order, 2) for order in (1, 2, 12)]
    errors = held_out_errors(series, series, np.eye(2), subjects, pairs, 5)
    assert least_error(errors) == (2, 2)


def test_held_out_errors_are_those_of_a_slow_loop() -> None:
    series = ar_process(TRUE_AR, 6, 30, 27)
    mouth = series + np.random.default_rng(28).normal(0, 0.1, series.shape)
    readout = np.array([[0.5, 0.1], [-0.2, 2.0]])
    subjects = ("a", "b", "c", "a", "b", "c")  # three folds
    found = held_out_errors(series, mouth, readout, subjects, [(1, 1), (2, 2)], 5)
    for order, components in found:
        errors = []
        for i, subject in enumerate(subjects):
            others = series[[s != subject for s in subjects]][..., :components]
            # every candidate is fitted to the rows that the longest has
            coefficients = solve(moments(others[:, 2 - order :], order), order, components)
            for origin in (25, 15, 5):
                recent = series[i : i + 1, :origin, :components]
                ahead = (forecast(coefficients, recent, 5) @ readout[:components])[0]
                for frame in range(5):
                    true = mouth[i, origin : origin + frame + 1].sum(axis=0)
                    errors += list(np.abs(ahead[: frame + 1].sum(axis=0) - true))
        assert found[order, components] == pytest.approx(np.mean(errors), rel=1e-6)


def test_order_that_only_suits_its_own_people_is_not_chosen() -> None:
    # with 6 short sequences sixteen lags fit their people by heart, and others badly
    noise = np.random.default_rng(14).normal(size=(6, 24, 2))
    subjects = ("a", "a", "a", "b", "b", "b")
    errors = held_out_errors(noise, noise, np.eye(2), subjects, [(1, 2), (16, 2)], 5)
    assert least_error(errors) == (1, 2)


def test_one_person_needs_an_order() -> None:
    sequences = LandmarkSequences(faces_moved(ar_process(TRUE_AR, 3, 39, 15) * 1e-3), ("a",) * 3)
    for kind in (MouthAutoregression, LandmarkAutoregression):
        with pytest.raises(RequestError, match="1 subject"):
            kind.fit(sequences)
        assert len(kind.fit(sequences, order=3).coefficients) == 3


@pytest.mark.parametrize("order", [0, 39, 40])
def test_impossible_order_is_refused(order: int) -> None:
    sequences = LandmarkSequences(faces_moved(ar_process(TRUE_AR, 2, 39, 15) * 1e-3), ("a", "b"))
    with pytest.raises(RequestError, match=rf"order {order}.*1 to 38.*40 frames"):
        MouthAutoregression.fit(sequences, order=order)


def test_sequences_too_short_to_choose_are_refused() -> None:
    sequences = LandmarkSequences(faces_moved(ar_process(TRUE_AR, 2, 5, 15) * 1e-3), ("a", "b"))
    with pytest.raises(RequestError, match="6 frames"):
        MouthAutoregression.fit(sequences)


def test_mouth_autoregression_shifts_the_whole_face() -> None:
    steps = ar_process(TRUE_AR, 60, 80, 16) * 1e-3
    subjects = tuple(f"s{i % 6}" for i in range(60))
    fitted = MouthAutoregression.fit(LandmarkSequences(faces_moved(steps), subjects), order=2)
    history = faces_moved(steps)[:, :50]
    shift = fitted.predict(history, 5) - history[:, -1:]
    np.testing.assert_allclose(shift, np.broadcast_to(shift[:, :, :1], shift.shape), atol=1e-12)
    expected = np.cumsum(forecast(fitted.coefficients, steps[:, :49], 5), axis=1)
    np.testing.assert_allclose(shift[:, :, 0], expected, atol=1e-12)
    np.testing.assert_allclose(fitted.coefficients, TRUE_AR, atol=0.1)


def test_principal_shapes_are_those_that_were_put_in() -> None:
    rng = np.random.default_rng(17)
    shapes = np.linalg.qr(rng.normal(size=(936, 3)))[0].T
    weights = rng.normal(size=(5, 50, 3)) * np.array([0.3, 0.1, 0.03])
    landmarks = FACE + (weights @ shapes).reshape(5, 50, 468, 2)
    found = principal_shapes(landmarks, 3)
    np.testing.assert_allclose(found @ found.T, np.eye(3), atol=1e-12)
    assert np.abs(found[0] @ shapes[0]) > 0.98  # sampled weights are not quite uncorrelated
    np.testing.assert_allclose(found @ shapes.T @ shapes @ found.T, np.eye(3), atol=1e-8)
    assert np.all(found[range(3), np.abs(found).argmax(axis=1)] > 0)


def test_landmark_autoregression_sees_a_change_of_shape() -> None:
    # a mode that opens the mouth and leaves the rest, going on at 0.9 of its speed
    mode = np.zeros((468, 2))
    mode[list(LIPS)[::2], 1] = 1.0
    rng = np.random.default_rng(18)
    speed = ar_process(np.array([[[0.9]]]), 120, 60, 18)[..., 0] * 1e-3
    drift = ar_process(np.array([[[0.5]]]), 120, 60, 19)[..., 0] * 1e-3
    opened = np.cumsum(speed, axis=1)[..., None, None] * mode
    moved = np.cumsum(drift, axis=1)[..., None, None] * np.array([1.0, 0.0])
    landmarks = FACE + opened + moved + rng.normal(0, 1e-6, (120, 60, 468, 2))
    subjects = tuple(f"s{i % 5}" for i in range(120))
    fitted = LandmarkAutoregression.fit(LandmarkSequences(landmarks, subjects))
    history = landmarks[:, :50]
    shift = fitted.predict(history, 5) - history[:, -1:]
    # the expectation of both processes; fitted coefficients are off by about 0.01
    powers = np.cumsum(0.9 ** np.arange(1, 6))
    lip, nose = LIPS[0], 1
    assert nose not in LIPS
    np.testing.assert_allclose(shift[..., lip, 1], speed[:, 49:50] * powers, atol=6e-4)
    np.testing.assert_allclose(shift[..., nose, 1], 0.0, atol=1e-4)
    np.testing.assert_allclose(
        shift[..., nose, 0], drift[:, 49:50] * np.cumsum(0.5 ** np.arange(1, 6)), atol=6e-4
    )


def test_folds_never_share_a_subject() -> None:
    subjects = ["a"] * 7 + ["b"] * 3 + ["c"] * 3 + ["d"] + ["e"]
    fold = subject_folds(subjects, 3)
    for subject in "abcde":
        assert len({f for f, s in zip(fold, subjects, strict=True) if s == subject}) == 1
    assert sorted(np.bincount(fold).tolist()) == [4, 4, 7]
    assert subject_folds(["x", "y"], 5).tolist() == [0, 1]
    order = np.random.default_rng(26).permutation(len(subjects))
    np.testing.assert_array_equal(subject_folds([subjects[i] for i in order], 3), fold[order])
