"""Files of error statistics that are made up, and truths without a simulator."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from robo_manip_baselines.observation import (
    ObservationSpec,
    ObservedNames,
    State,
    TargetObservation,
)

PERIOD = 0.02

NAMES = ObservedNames("mouth", ("cube",))


def made_up_stats(
    *,
    stride: int = 1,
    horizons: int = 5,
    runs: int = 12,
    length: int = 120,
    crop: float = 1.0,
    seed: int = 0,
) -> dict[str, Any]:
    """The content of a file whose errors are autoregressive on the axes of their covariance."""
    rng = np.random.default_rng(seed)
    size = 2 * horizons
    axes, _ = np.linalg.qr(rng.normal(size=(size, size)))
    gain = axes * np.linspace(0.004, 0.012, size)  # shares of a crop
    persistence = np.linspace(0.1, 0.8, size)  # from forecast to forecast
    bias = rng.normal(size=size) * 0.001
    values = []
    for _ in range(runs):
        state = rng.normal(size=size)
        rows = []
        for _ in range(length):
            rows.append(bias + gain @ state)
            state = persistence * state + np.sqrt(1 - persistence**2) * rng.normal(size=size)
        values.append(np.array(rows).reshape(length, horizons, 2))
    covariance = gain @ gain.T
    variance = np.diag(covariance)
    camera = {"fov_x_deg": 75.0, "fov_y_deg": 47.0, "depth_m": 0.5}
    camera |= {"crop_width": crop, "crop_height": crop}
    view = np.array([2 * 0.5 * np.tan(np.radians(angle / 2)) for angle in (75.0, 47.0)])
    mean_abs = np.abs(np.concatenate(values)).mean(axis=0)
    return {
        "schema": "error_stats",
        "version": 1,
        "predictor": "made up",
        "fps": 30.0,
        "stride_frames": stride,
        "camera": camera,
        "horizons": [
            {
                "frames": h + 1,
                "bias": of_bias.tolist(),
                "mean_abs_m": (of_all * view * crop).tolist(),
            }
            for h, (of_bias, of_all) in enumerate(zip(bias.reshape(-1, 2), mean_abs, strict=True))
        ],
        "covariance": ((covariance + covariance.T) / 2).tolist(),
        "autocorrelation": [
            (((gain**2) @ persistence**lag) / variance).reshape(-1, 2).tolist() for lag in range(4)
        ],
        "residuals": [
            {"clip": f"c{i}", "subject": f"s{i}", "values": run.tolist()}
            for i, run in enumerate(values)
        ],
    }


def write_stats(folder: Path, content: dict[str, Any]) -> Path:
    """Write them under a name of their own."""
    text = json.dumps(content)
    path = folder / f"stats_{hashlib.sha256(text.encode()).hexdigest()[:8]}.json"
    path.write_text(text)
    return path


def wandering_truth(steps: int, seed: int = 0, *, predicted: bool = False) -> State:
    """An episode in which gripper and mouth wander about, (T, ...)."""
    rng = np.random.default_rng(seed)
    arm = rng.normal(size=(steps, 1, 6))
    return State(
        time=np.arange(steps) * PERIOD,
        joint_position=arm,
        joint_velocity=arm,
        gripper_position=arm[..., 0],
        gripper_velocity=arm[..., 0],
        end_effector_position=rng.normal(size=(steps, 3)),
        target_position=rng.normal(size=(steps, 6, 3)),
        object_position=rng.normal(size=(steps, 1, 3)),
        predicted_target=rng.normal(size=(steps, 5, 3)) if predicted else None,
    )


def step_of(truth: State, index: int | slice | tuple[int, ...]) -> State:
    """One step of an episode or of a batch, or some."""
    return State(**{k: None if v is None else v[index] for k, v in vars(truth).items()})


def observe(
    spec: ObservationSpec, state: State, target: TargetObservation | None = None
) -> dict[str, np.ndarray]:
    """The vectors of an observation by key; without a target, nothing was reported before."""
    if target is None and spec.past_frames:
        now = state.target_position
        past = np.repeat(now[..., :1, :], spec.past_frames, axis=-2)
        target = TargetObservation(state.time, now, past)
    return spec.split(spec.pack(state, target), NAMES)


@pytest.fixture(scope="session")
def stats_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_stats(tmp_path_factory.mktemp("stats"), made_up_stats())
