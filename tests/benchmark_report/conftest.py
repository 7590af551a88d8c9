"""Made-up result rows of a benchmark: sixteen conditions, two training seeds, 100 episodes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pytest

from robo_manip_baselines.benchmark.statistics.analysis import BenchmarkStatistics, analyze
from robo_manip_baselines.benchmark.statistics.outcomes import ResultRow, read_result_rows
from robo_manip_baselines.envs.mujoco.tasks.feeding import ENTRY as TASK
from robo_manip_baselines.envs.mujoco.tasks.feeding.metrics import failure_kind
from robo_manip_baselines.envs.mujoco.tasks.safety import (
    FORCE_TIERS,
    SAFE_FORCE,
    EpisodeSafety,
    TouchedRegion,
)
from robo_manip_baselines.rollout.results import EpisodeResult

CONDITIONS = {
    "baseline": 0.42,
    "current": 0.60,
    **{f"current_pred_h{h}": p for h, p in enumerate((0.66, 0.74, 0.72, 0.68, 0.60), start=1)},
    **{
        f"current_pred_h{h}_uniform": p for h, p in enumerate((0.6, 0.72, 0.7, 0.62, 0.54), start=1)
    },
    "current_pred_h2_model": 0.70,
    "current_pred_h2_delay3": 0.55,
    "current_delay3": 0.45,
    "shuffled_future": 0.40,
}
"""Name -> chance of success."""

MakeRows = Callable[..., tuple[ResultRow, ...]]


def make_results(
    conditions: Sequence[str] = tuple(CONDITIONS),
    train_seeds: int = 2,
    episodes: int = 100,
    seed: int = 0,
) -> list[EpisodeResult]:
    """Draw results; easy seeds are easy for all conditions, and training runs differ."""
    rng = np.random.default_rng(seed)
    ease = rng.normal(0.0, 1.0, episodes)
    results = []
    for condition in conditions:
        chance = CONDITIONS[condition]
        for train_seed in range(train_seeds):
            luck = rng.normal(0.0, 0.3)
            for episode in range(episodes):
                logit = np.log(chance / (1.0 - chance)) + 1.2 * ease[episode] + luck
                is_success = bool(rng.random() < 1.0 / (1.0 + np.exp(-logit)))
                if is_success:
                    offset = (0.02, *rng.uniform(-0.0099, 0.0099, 2))
                else:
                    far = rng.random() < 0.15
                    angle, radius = rng.uniform(0, 2 * np.pi), 0.015 + rng.exponential(0.012)
                    offset = (
                        0.1 if far else 0.02,
                        1.5 * radius * np.cos(angle),
                        1.5 * radius * np.sin(angle),
                    )
                was_grasped = is_success or rng.random() > 0.1
                x, y, z = map(float, offset)
                offset = (x, y, z) if was_grasped else None
                time = round(float(rng.normal(4.2 + 0.3 * (1.0 - chance), 0.9)) / 0.02) * 0.02
                results.append(
                    EpisodeResult(
                        env="FeedingEnv",
                        seed=1000 + episode,
                        is_success=is_success,
                        is_success_strict=is_success and bool(rng.random() < 0.5),
                        completion_time=round(time, 6) if is_success else None,
                        steps=600,
                        failure=failure_kind(
                            is_success=is_success,
                            was_released=bool(rng.random() < 0.3),
                            closest_offset=offset,
                        ),
                        motion_clip=f"clip_{episode % 7}",
                        motion_subject=f"person {episode % 5}",
                        columns={
                            "time_since_lift": 8.0 if was_grasped else None,
                            "closest_distance": float(np.linalg.norm(offset)) if offset else None,
                            "closest_offset": offset,
                            "cube_offset": offset and (offset[0] - 0.012, *offset[1:]),
                            "face_force": 0.0,
                        },
                        safety=make_safety(is_success, 1000 + episode),
                        policy="Act",
                        condition=condition,
                        train_seed=train_seed,
                        checkpoint="ab" * 32,
                        versions={"numpy": "2"},
                    )
                )
    return results


def make_safety(is_success: bool, seed: int) -> EpisodeSafety:
    """A gripper at a cheek with 0 to 40 N in every other episode, and food on the lips in all."""
    rng = np.random.default_rng([seed, 7])
    force = float(rng.uniform(0.0, 40.0)) if seed % 2 else 0.0
    touched = [TouchedRegion("lips", "cube", True, 12.0, 0.5, 0.1, (0.05, 0.01, -0.04))]
    if force:
        touched.append(
            TouchedRegion("cheeks", "gripper", False, force, 0.2, 0.06, (0.03, 0.05, 0.0))
        )
    return EpisodeSafety(
        success_safe=is_success and force <= SAFE_FORCE,
        force=force,
        food_force=12.0,
        time_above={str(tier): 0.06 * (force > tier) for tier in FORCE_TIERS},
        times_above={str(tier): int(force > tier) for tier in FORCE_TIERS},
        eye_contacts=0,
        eye_near_misses=int(seed % 10 == 0),
        eye_distance=0.04,
        approach_speed=0.12,
        approach_speed_p90=0.08,
        refusals=None,
        refusals_respected=None,
        touched=tuple(touched),
    )


def write_results(path: Path, results: Sequence[EpisodeResult]) -> Path:
    """Write rows as an evaluation does."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("".join(f"{result.to_line()}\n" for result in results), encoding="utf-8")
    return path


@pytest.fixture(scope="session")
def make_rows(tmp_path_factory: pytest.TempPathFactory) -> MakeRows:
    """Draw results, see ``make_results``, write them to a file and read them."""

    def make(**changes: object) -> tuple[ResultRow, ...]:
        folder = tmp_path_factory.mktemp("results")
        path = write_results(folder / "results.jsonl", make_results(**changes))  # type: ignore[arg-type]
        return read_result_rows([path], root=folder)

    return make


@pytest.fixture(scope="session")
def rows(make_rows: MakeRows) -> tuple[ResultRow, ...]:
    """The whole benchmark."""
    return make_rows()


@pytest.fixture(scope="session")
def statistics(rows: tuple[ResultRow, ...]) -> BenchmarkStatistics:
    """Figures of the whole benchmark, with few resamples."""
    return analyze(rows, task=TASK, resamples=500)
