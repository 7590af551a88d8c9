"""Forecasts that know nothing of the future."""

from __future__ import annotations

from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

from robo_manip_baselines.benchmark.forecasts import FORECASTS, write_library
from robo_manip_baselines.envs.mujoco.face.motion import MotionLibrary
from robo_manip_baselines.envs.mujoco.tasks.registry import make_env


@pytest.fixture(scope="module")
def library() -> MotionLibrary:
    return MotionLibrary.load()


def true_moves(library: MotionLibrary) -> np.ndarray:
    """(N, 24, 3) by loops; within a run, held at its end."""
    moves = np.zeros((len(library.mouth), 24, 3))
    for start, length in zip(library.run_start, library.run_length, strict=True):
        for frame in range(start, start + length):
            for k in range(1, 25):
                later = min(frame + k, start + length - 1)
                moves[frame, k - 1] = library.mouth[later] - library.mouth[frame]
    return moves


def test_persistence_says_that_nothing_moves(library: MotionLibrary) -> None:
    forecast = FORECASTS["persistence"](library)
    assert forecast.shape == (len(library.mouth), 24, 3)
    for k in range(24):
        np.testing.assert_array_equal(forecast[:, k], library.mouth)


def test_shuffled_moves_as_fast_and_says_nothing(library: MotionLibrary) -> None:
    told = FORECASTS["shuffled"](library) - library.mouth[:, None]
    true = true_moves(library)
    # The same moves, each of them at another time.
    for k in range(24):
        np.testing.assert_allclose(np.sort(told[:, k, 0]), np.sort(true[:, k, 0]), atol=1e-9)
    for axis in range(3):
        correlation = np.corrcoef(told[:, 4, axis], true[:, 4, axis])[0, 1]
        # A correlation of 0.1 would explain one hundredth of the variance.
        assert abs(correlation) < 0.1


@pytest.mark.parametrize("name", FORECASTS)
def test_a_library_with_a_forecast_can_be_replayed(
    name: str, library: MotionLibrary, tmp_path: Path
) -> None:
    path, again = tmp_path / "a.npz", tmp_path / "b.npz"
    write_library(path, None, name)
    write_library(again, path, name)
    assert path.read_bytes() == again.read_bytes()
    read = MotionLibrary.load(path)
    assert read.predicted is not None
    np.testing.assert_allclose(read.predicted, FORECASTS[name](library), atol=1e-6)  # float32
    np.testing.assert_array_equal(read.mouth, library.mouth)


@pytest.mark.long
def test_the_policy_is_shown_the_frozen_forecast(tmp_path: Path) -> None:
    path = tmp_path / "frozen.npz"
    write_library(path, None, "persistence")
    shown: dict[str, list[np.ndarray]] = {"model": [], "none": []}
    for error, seen in shown.items():
        env = make_env(
            "FeedingEnv",
            obs="current_pred",
            horizon=5,
            cameras=(),
            motion_library=str(path),
            corruption={"error": error},
        )
        with closing(env):
            observation, _ = env.reset(seed=3)
            for _ in range(200):
                told = observation["prediction"][: 4 * 6].reshape(6, 4)[:, 1:]
                seen.append(told[5] - told[0])
                observation, *_ = env.step(env.action_space.sample() * 0)
    frozen, true = (np.abs(shown[error]).max(axis=1) for error in ("model", "none"))
    assert true.max() > 3e-3  # the head does move
    # Steps 0, 5, 10, ... are at video frames; at others the motion since the last is added.
    np.testing.assert_allclose(frozen[::5], 0.0, atol=1e-6)
    assert np.median(frozen) < 0.3 * np.median(true)
