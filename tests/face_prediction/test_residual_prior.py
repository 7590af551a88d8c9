"""The adaptive prior of residual prediction: no look-ahead, and it learns the face it watches."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from face_prediction.forecast import LandmarkSequences, mouth_centre
from face_prediction.models.residual.prior import (
    BLOCKS,
    AdaptivePrior,
    adapted,
    features,
    fit_people,
    learning_weights,
    outcomes,
)

H = 5
pytestmark = pytest.mark.long


def people(count: int, frames: int = 75, seed: int = 0) -> NDArray[np.float32]:
    """Faces (count, frames, 468, 2) that sway and talk, each in a way of its own."""
    rng = np.random.default_rng(seed)
    shape = rng.uniform(0.2, 0.8, (468, 2))
    time = np.arange(frames) / 30
    result = np.empty((count, frames, 468, 2))
    for i in range(count):
        sway = np.zeros((frames, 2))
        for _ in range(3):
            phase, rate = rng.uniform(0, 2 * np.pi), rng.uniform(0.5, 3.0)
            sway += rng.normal(0, 0.01, 2) * np.sin(2 * np.pi * rate * time + phase)[:, None]
        stretch = 1 + 0.05 * np.sin(2 * np.pi * rng.uniform(1, 4) * time)[:, None, None]
        result[i] = 0.5 + (shape - 0.5) * stretch + sway[:, None]
    return (result + rng.normal(0, 1e-4, result.shape)).astype(np.float32)


@pytest.fixture(scope="module")
def prior() -> AdaptivePrior:
    fitted = AdaptivePrior(H, 8)
    fitted.fit(LandmarkSequences(people(12), tuple(f"p{i}" for i in range(12))))
    return fitted


def forecast(prior: AdaptivePrior, landmarks: NDArray[np.float32], origins: list[int]):
    mouth, shapes = prior.series(torch.tensor(landmarks))
    return prior(mouth, shapes, torch.tensor(origins))


def test_what_comes_after_the_origin_is_not_looked_at(prior: AdaptivePrior) -> None:
    landmarks = people(2, seed=1)
    changed = landmarks.copy()
    changed[:, 50:] = 0.3
    there = forecast(prior, landmarks, [30, 49])
    again = forecast(prior, changed, [30, 49])
    torch.testing.assert_close(there.mouth, again.mouth, rtol=0, atol=0)
    torch.testing.assert_close(there.error, again.error, rtol=0, atol=0)


def test_an_origin_is_forecast_as_if_the_history_ended_there(prior: AdaptivePrior) -> None:
    landmarks = people(2, seed=2)
    together = forecast(prior, landmarks, [20, 45, 69])
    for place, origin in enumerate([20, 45, 69]):
        alone = forecast(prior, landmarks[:, : origin + 1], [origin])
        # sums over more frames are added up in another order
        torch.testing.assert_close(together.mouth[:, place], alone.mouth[:, 0], rtol=0, atol=1e-5)


def test_people_of_a_batch_do_not_touch_one_another(prior: AdaptivePrior) -> None:
    landmarks = people(3, seed=3)
    together = forecast(prior, landmarks, [60]).mouth
    alone = forecast(prior, landmarks[1:2], [60]).mouth
    torch.testing.assert_close(together[1:2], alone, rtol=0, atol=1e-6)


@pytest.mark.parametrize("frames", [1, 2, 5, 6, 7, 12])
def test_short_histories_are_enough(prior: AdaptivePrior, frames: int) -> None:
    result = forecast(prior, people(1, frames=frames), [frames - 1])
    assert torch.isfinite(result.mouth).all()
    assert torch.isfinite(result.error).all()
    if frames == 1:  # nothing has moved: nothing is expected to
        assert result.mouth.abs().max() == 0


def test_a_face_at_rest_is_expected_to_stay(prior: AdaptivePrior) -> None:
    still = np.repeat(people(1, frames=1), 70, axis=1)
    result = forecast(prior, still, [69])
    assert result.mouth.abs().max() < 1e-6
    assert result.error.min() > 0


def test_it_beats_the_best_fixed_expert_on_a_face_unlike_the_others(prior: AdaptivePrior) -> None:
    """A camera that repeats every sixth frame: the people fitted to had none that did."""
    smooth = people(8, frames=120, seed=5)
    shown = np.arange(120) - np.arange(120) % 6 // 5  # frame 5, 11, ... shows the one before
    landmarks = smooth[:, shown][:, :75]
    mouth, shapes = prior.series(torch.tensor(landmarks))
    origins = torch.tensor([67, 68, 69])
    mixed = prior(mouth, shapes, origins).mouth
    truth = outcomes(mouth, shapes, H)[:, origins].unflatten(-1, (H, -1))[..., :2]
    error = (mixed - truth).abs().mean()
    x = [features(b, mouth, shapes)[:, origins] / prior.get_buffer(f"scale_{i}")
         for i, b in enumerate(BLOCKS)]  # fmt: skip
    fixed = [
        (v @ prior.get_buffer(f"people_{i}")).unflatten(-1, (H, -1))[..., :2]
        for i, v in enumerate(x)
    ]
    best = min(float((f - truth).abs().mean()) for f in [*fixed, torch.zeros_like(truth)])
    assert float(error) < 0.9 * best


def test_adaptation_is_a_ridge_regression_of_what_was_wrong() -> None:
    rng = np.random.default_rng(0)
    x, wrong = rng.normal(size=(1, 20, 3)), rng.normal(size=(1, 20, 4))
    now, weight, shrink = rng.normal(size=(1, 2, 3)), rng.uniform(size=(2, 20)), 2.0
    result = adapted(*(torch.tensor(v) for v in (x, wrong, now, weight)), shrink)
    for o in range(2):
        w = np.diag(weight[o])
        power = (weight[o] * (x[0] ** 2).mean(axis=1)).sum() + 1e-6
        gram = x[0].T @ w @ x[0] + shrink * power * np.eye(3)
        expected = now[0, o] @ np.linalg.solve(gram, x[0].T @ w @ wrong[0])
        np.testing.assert_allclose(result[0, o], expected, rtol=1e-9)


def test_rows_count_once_their_outcomes_are_seen() -> None:
    weight = learning_weights(torch.tensor([10]), 12, H, 0.25)[0]
    expected = [0.25] * 12
    expected[4] = 1.0  # 10 - 4 is a period
    expected[6:] = [0.0] * 6  # 10 - 6 < 5: frame 11 of row 6's outcome is not there yet
    assert weight.tolist() == expected


def test_features_and_outcomes_meet_at_the_newest_frame() -> None:
    time = torch.arange(12.0)
    mouth = torch.stack([time**2, -(time**2)], dim=-1)[None]
    shapes = torch.zeros(1, 12, 8)
    x = features(BLOCKS[3], mouth, shapes)[0]  # the mouth's last four steps
    assert x.shape == (12, 8)
    assert x[6, :4].tolist() == [3**2 - 2**2 + 2 * k for k in range(4)]  # 5, 7, 9, 11
    assert x[1, :4].tolist() == [0, 0, 0, 1]  # at rest before the first frame
    y = outcomes(mouth, shapes, H)[0].unflatten(-1, (H, -1))
    assert y[3, :, 0].tolist() == [(3 + h) ** 2 - 9 for h in range(1, H + 1)]


def test_people_are_fitted_for_least_absolute_error() -> None:
    """Of outcomes that are 1, 1, 1 or 9 times the feature, 1 is the median's, 3 the mean's."""
    rng = np.random.default_rng(1)
    x = rng.uniform(0.5, 1.5, (4000, 1))
    times = rng.choice([1.0, 1.0, 1.0, 9.0], size=(4000, 1))
    y = np.tile(x * times, (1, 10))
    coefficient = fit_people(x, y, np.ones(4000), H)
    assert np.all(np.abs(coefficient - 1.0) < 0.1)


def test_series_are_the_mouth_centre_and_orthonormal_shapes(prior: AdaptivePrior) -> None:
    landmarks = people(1, frames=3, seed=6)
    mouth, shapes = prior.series(torch.tensor(landmarks))
    np.testing.assert_allclose(mouth, mouth_centre(landmarks), atol=1e-6)
    gram = prior.basis @ prior.basis.T
    kept = int((gram.diagonal() > 0.5).sum())
    torch.testing.assert_close(gram[:kept, :kept], torch.eye(kept), rtol=0, atol=1e-5)
    assert shapes.shape == (1, 3, 8)
