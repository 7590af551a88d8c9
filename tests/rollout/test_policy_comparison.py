"""The comparison of policies: what is done is read, and rates are over training seeds."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from types import ModuleType

import pytest

from robo_manip_baselines.rollout.results import (
    MANIFEST,
    RESULTS,
    SCHEMA,
    EpisodeResult,
    Proportion,
)
from robo_manip_baselines.runs.documents import read_json
from robo_manip_baselines.runs.errors import RequestError
from robo_manip_baselines.runs.files import write_json
from robo_manip_baselines.training.config import write_config

SEED = {"first_seed": 1000}


@pytest.fixture(scope="module")
def policies(load_script: Callable[[str], ModuleType]) -> ModuleType:
    return load_script("benchmarks/policies.py")


def result(policy: str, train_seed: int, seed: int, *, is_success: bool) -> EpisodeResult:
    times = 4.0 if is_success else None
    failure = "" if is_success else "never_grasped"
    names = "time_since_lift", "closest_distance", "closest_offset", "cube_offset"
    return EpisodeResult(
        *("FeedingEnv", seed, is_success, is_success, times, 300, failure, "a clip", "someone"),
        columns={**dict.fromkeys(names), "face_force": 0.0},
        policy=policy,
        condition="current_pred_h2",
        train_seed=train_seed,
    )


def write(policies: ModuleType, out: Path, policy: str, train_seed: int, wins: set[int]) -> None:
    """Ten episodes, of which those of some seeds succeed."""
    seeds = range(1000, 1010)
    results = [result(policy, train_seed, s, is_success=s in wins) for s in seeds]
    share = Proportion.of(len(wins), 10)
    row = policies.Row(
        *(policy, "default", train_seed, 1000, 60.0 + train_seed, (3.0, 0.5)),
        *(share, share, None, 10),
        seed=1000,
    )
    (out / "rows").mkdir(parents=True, exist_ok=True)
    write_json(out / "rows" / f"{row.name}.json", asdict(row))
    folder = out / "episodes" / row.name
    folder.mkdir(parents=True)
    lines = "".join(f"{x.to_line()}\n" for x in results)
    (folder / RESULTS).write_text(lines, encoding="utf-8")


def test_rates_are_over_training_seeds_and_differences_are_paired(
    policies: ModuleType, tmp_path: Path
) -> None:
    first, half = set(range(1000, 1009)), set(range(1000, 1005))
    for seed in (0, 1):
        write(policies, tmp_path, "Act", seed, first)
        write(policies, tmp_path, "Flow", seed, half)
    page = policies.page(tmp_path)
    act, flow = (line for line in page.splitlines() if line.count("|") > 10 and "default" in line)
    assert act.startswith("| Act | default | 2 | 10 | 90 (")
    assert flow.startswith("| Flow | default | 2 | 10 | 50 (")
    # 4 of 10 seeds in each of two trainings: 8 pairs, all to the first policy.
    assert "| -40 (" in flow
    assert f"| {2 * 0.5**8:.2g} | 1,000 | 60 | 3.0 | 0.5 |" in flow
    assert "| Flow | default | 1 | 10 | 50 (24 to 76) | 50 (24 to 76) | - |" in page


def test_what_is_done_is_not_done_again(policies: ModuleType, tmp_path: Path) -> None:
    write(policies, tmp_path, "Mlp", 3, {1000})
    options = policies.Options(tmp_path / "none", policies=("Mlp",), num_episodes=10, out=tmp_path)
    row = policies.run(options, "Mlp", "default", 3)
    assert (row.success.count, row.parameters, row.milliseconds) == (1, 1000, (3.0, 0.5))
    fewer = replace(options, num_episodes=5)
    assert policies.run(fewer, "Mlp", "default", 3) == row
    more = replace(options, num_episodes=20)
    with pytest.raises(RequestError, match="none"):  # there are no demonstrations to go on with
        policies.run(more, "Mlp", "default", 3)


def test_other_settings_are_refused(policies: ModuleType, tmp_path: Path) -> None:
    write(policies, tmp_path, "Mlp", 3, {1000})
    words = {"steps": 100, "num_episodes": 10, "out": tmp_path}
    options = policies.Options(tmp_path / "none", policies=("Mlp",), **words)
    config = policies.configure(options, "Mlp", "default", 3)
    config.folder.mkdir(parents=True)
    write_config(config.folder, config)
    write_json(tmp_path / "episodes/mlp_default_seed3" / MANIFEST, SCHEMA.to_json() | SEED)
    assert policies.run(options, "Mlp", "default", 3).episodes == 10
    for name, changes in {
        "holds a run with delay 0, not 2": {"delay": 2},
        "holds a run with steps 100, not 200; choose another --out": {"steps": 200},
        "holds episodes from seed 1000 on, not 2000": {"seed": 2000},
        "other": {"dataset": tmp_path / "other"},  # there are no demonstrations to compare
    }.items():
        with pytest.raises(RequestError, match=name):
            policies.run(replace(options, **changes), "Mlp", "default", 3)
    policies.require_same_delay(tmp_path, 0)
    with pytest.raises(RequestError, match="has delay 0, not 4; choose another --out"):
        policies.require_same_delay(tmp_path, 4)  # whatever the policies


def test_rows_of_earlier_versions_are_measured_again(policies: ModuleType, tmp_path: Path) -> None:
    write(policies, tmp_path, "Mlp", 3, {1000})
    file = tmp_path / "rows/mlp_default_seed3.json"
    row = read_json(file)
    del row["seed"]
    write_json(file, row)
    options = policies.Options(tmp_path / "none", policies=("Mlp",), num_episodes=10, out=tmp_path)
    with pytest.raises(RequestError, match="none"):  # there are no demonstrations
        policies.run(options, "Mlp", "default", 3)
    assert "| Mlp | default | 3 | 10 |" in policies.page(tmp_path)


def test_unknown_names_are_refused(policies: ModuleType, tmp_path: Path) -> None:
    with pytest.raises(RequestError, match="Sarnn"):
        policies.Options(tmp_path, policies=("Sarn",))
    with pytest.raises(RequestError, match="forecast_both_now"):
        policies.Options(tmp_path, observations=("forecast_both",))
