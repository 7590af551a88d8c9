"""Residual prediction of a mouth in metres: axes, units, rest, learning, refusals."""

from __future__ import annotations

import numpy as np
import pytest

from face_prediction.models.residual.adaptive import FaceState
from face_prediction.models.residual.paths import FACE_SIDE, PathPredictor, fit_paths, path_series
from robo_manip_baselines.runs.errors import RequestError


def swaying(people: int, frames: int = 200, seed: int = 0) -> np.ndarray:
    """Mouths (people, frames, 3) m that sway at 0.4 to 1 Hz along every axis."""
    rng = np.random.default_rng(seed)
    rate, phase = rng.uniform(0.4, 1.0, (2, people, 1, 3)) * [[[[1.0]]], [[[6.0]]]]
    return 0.02 * np.sin(2 * np.pi * rate * np.arange(frames)[:, None] / 30 + phase)


@pytest.fixture(scope="module")
def predictor() -> PathPredictor:
    """Fitted to eight people."""
    return fit_paths(swaying(8))


def forecasts(predictor: PathPredictor, *paths: np.ndarray) -> np.ndarray:
    """Forecasts (T, 24, 3) m from every frame of a path (T, 3) m; of several, one after another."""
    together = np.stack(paths)
    follower, recent = predictor.follow(len(paths)), predictor.recent
    rested = np.concatenate([np.repeat(together[:, :1], recent - 1, axis=1), together], axis=1)
    made = []
    for frame in range(together.shape[1]):
        follower.update(together[:, frame])
        made.append(follower.forecast(rested[:, frame : frame + recent], 24))
    return np.concatenate(np.stack(made, axis=1))


def test_axes_are_followed_each_by_the_same_people(predictor: PathPredictor) -> None:
    """Depth is forecast as the same numbers are across, and neither disturbs the other."""
    path = swaying(1, 80, seed=1)[0]
    both = forecasts(predictor, path)
    depth, across = path * [1, 0, 0], path * [0, 1, 1]
    np.testing.assert_allclose(forecasts(predictor, depth)[..., 0], both[..., 0], atol=1e-12)
    np.testing.assert_allclose(forecasts(predictor, across)[..., 1:], both[..., 1:], atol=1e-12)
    turned = np.roll(depth, 1, axis=1)
    np.testing.assert_allclose(forecasts(predictor, turned)[..., 1], both[..., 0], atol=1e-12)
    mirrored = forecasts(predictor, -path)
    np.testing.assert_allclose(mirrored, -both, atol=1e-9)


def test_a_mouth_across_is_a_face_of_that_side(predictor: PathPredictor) -> None:
    path = swaying(1, 60, seed=2)[0]
    state = FaceState(predictor.people, 1)
    for series in path_series(path[None])[0]:
        state.take(series[None])
        made = state.forecast()
        state.remember(made)
    moved = FACE_SIDE * made.moved[0, :, :2]
    at_knots = forecasts(predictor, path)[-1, predictor.people.horizons - 1, 1:]
    np.testing.assert_allclose(at_knots, path[-1, 1:] + moved)


def test_another_place_is_no_other_motion(predictor: PathPredictor) -> None:
    path = swaying(1, 60, seed=3)[0]
    place = np.array([0.4, -0.2, 0.3])
    there = forecasts(predictor, path + place) - place
    np.testing.assert_allclose(there, forecasts(predictor, path), atol=1e-9)


def test_mouths_are_followed_side_by_side_as_alone(predictor: PathPredictor) -> None:
    """Bit for bit: what a training reads is what the environment forecasts."""
    paths = swaying(5, 50, seed=7)
    alone = np.concatenate([forecasts(predictor, path) for path in paths])
    np.testing.assert_array_equal(forecasts(predictor, *paths), alone)


def test_a_still_mouth_stays(predictor: PathPredictor) -> None:
    path = np.tile([0.1, 0.2, 0.3], (40, 1))
    np.testing.assert_allclose(forecasts(predictor, path), path[:, None].repeat(24, 1), atol=1e-12)


def test_nothing_later_changes_a_forecast(predictor: PathPredictor) -> None:
    path = swaying(1, 60, seed=4)[0]
    np.testing.assert_array_equal(forecasts(predictor, path[:40]), forecasts(predictor, path)[:40])


def test_a_face_is_learnt(predictor: PathPredictor) -> None:
    """The longer it is watched, the better it is forecast; a far better forecast than rest."""
    paths = swaying(6, seed=5)
    error, rest = (np.empty((6, len(paths[0]) - 8)) for _ in range(2))
    for number, path in enumerate(paths):
        made = forecasts(predictor, path)[:-8, 7]
        error[number] = np.linalg.norm(made - path[8:], axis=1)
        rest[number] = np.linalg.norm(path[:-8] - path[8:], axis=1)
    assert error[:, 100:].mean() < 0.5 * error[:, 5:50].mean()
    assert error[:, 100:].mean() < 0.1 * rest.mean()


def test_a_mouth_in_motion_is_no_mouth_that_starts(predictor: PathPredictor) -> None:
    """It stays until it has a past, and is forecast well, between knots too, once it has one."""
    path = swaying(1, 60, seed=6)[0]
    made, first = forecasts(predictor, path), predictor.recent - 1
    np.testing.assert_array_equal(made[:first], path[:first, None].repeat(24, 1))
    for ahead in (5, 8, 10, 12):
        origins = np.arange(first, 60 - ahead)
        error = np.linalg.norm(made[origins, ahead - 1] - path[origins + ahead], axis=1)
        rest = np.linalg.norm(path[origins] - path[origins + ahead], axis=1)
        assert error.mean() < 0.08 * rest.mean()


def test_too_few_people_or_too_far_ahead_are_refused(predictor: PathPredictor) -> None:
    with pytest.raises(RequestError, match="paths of 3 people; residual needs 4"):
        fit_paths(swaying(3))
    with pytest.raises(RequestError, match="horizon 25"):
        predictor.follow().forecast(np.zeros((1, 9, 3)), 25)
