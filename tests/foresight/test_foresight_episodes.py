"""Episodes that branch, their rows, and the execution of plans."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from robo_manip_baselines.benchmark.foresight.episodes import (
    CHUNK_SIZE,
    Cell,
    EpisodePlayer,
    ForesightRow,
    Request,
    make_execution,
    plan_age,
)
from robo_manip_baselines.envs.mujoco.expert.servo import ServoConfig
from robo_manip_baselines.envs.mujoco.tasks.feeding.env import FeedingEnv
from robo_manip_baselines.envs.mujoco.tasks.feeding.expert import FeedingServo
from robo_manip_baselines.runs.errors import RequestError

LATE = Cell("dyskinetic", 4, "direct", "truth", 0)
AHEAD = LATE._replace(lead=7)
CHUNKED = Cell("dyskinetic", 0, "ensemble", "truth", 12)


def play(player: EpisodePlayer, seed: int, *cells: Cell) -> list[ForesightRow]:
    return player(Request("dyskinetic", seed, cells))


@pytest.mark.long
def test_golden_rows(player: EpisodePlayer) -> None:
    """Seed 3: late it misses, ahead of the delay and the lag it feeds without a touch."""
    late, ahead, chunked = play(player, 3, LATE, AHEAD, CHUNKED)
    assert (late.is_success, late.is_success_strict, late.steps) == (False, False, 307)
    assert (ahead.is_success, ahead.is_success_strict, ahead.steps) == (True, True, 301)
    assert (chunked.is_success, chunked.is_success_strict, chunked.steps) == (True, True, 328)
    errors = [row.tracking_error or 0.0 for row in (late, ahead, chunked)]
    # Rounding of another CPU is amplified by contacts with the cube.
    np.testing.assert_allclose(errors, [0.0106382, 0.0013386, 0.0040736], rtol=1e-2)
    assert [row.face_force for row in (late, ahead, chunked)] == [0.0, 0.0, 0.0]


@pytest.mark.long
def test_a_branch_is_the_whole_episode(player: EpisodePlayer, dyskinetic: FeedingEnv) -> None:
    """The same numbers, bit for bit, as an episode from its start with these settings."""
    row = play(player, 5, AHEAD, LATE, CHUNKED)[1]
    actor = FeedingServo(dyskinetic, ServoConfig(lead=0, delay=4))
    dyskinetic.reset(seed=5)
    actor.reset()
    force, info = 0.0, dyskinetic.info()
    for _ in range(600):
        *_, terminated, _, info = dyskinetic.step(actor.act())
        force = max(force, info["face_force"])
        if terminated:
            break
    whole = (info["is_success"], info["is_success_strict"], info["completion_time"], force)
    assert force > 1.0
    assert (row.is_success, row.is_success_strict, row.completion_time, row.face_force) == whole


@pytest.mark.long
def test_rows_depend_neither_on_other_cells_nor_on_their_order(player: EpisodePlayer) -> None:
    both = play(player, 1, CHUNKED, AHEAD)
    assert both == [*play(player, 1, CHUNKED), *play(player, 1, AHEAD)]
    assert play(player, 1, AHEAD, CHUNKED) == both[::-1]


@pytest.mark.long
def test_persistence_is_a_lead_of_zero(player: EpisodePlayer) -> None:
    late, persistent = play(player, 5, LATE, AHEAD._replace(forecaster="persistence"))
    assert replace(persistent, forecaster="truth", lead=0) == late


def test_rows_are_read_as_they_were_written() -> None:
    row = ForesightRow(
        **AHEAD._asdict(),
        seed=7,
        is_success=True,
        is_success_strict=False,
        completion_time=3.5,
        face_force=0.25,
        tracking_error=None,
        steps=301,
    )
    assert ForesightRow.from_line(row.to_line()) == row
    values = json.loads(row.to_line())
    for name, value, problem in (
        ("version", 2, "version 2; this release reads 1"),
        ("execution", "queue", "unknown execution in row 'queue'"),
        ("forecaster", "oracle", "unknown forecaster in row 'oracle'"),
        ("face_force", -1.0, "face_force"),
        ("seed", "one", "seed"),
    ):
        with pytest.raises(RequestError, match=problem):
            ForesightRow.from_line(json.dumps({**values, name: value}))


def test_an_ensemble_is_as_late_as_the_mean_age_of_its_plans() -> None:
    """Plans that stay at the number of the step they are made in, over two chunks of steps."""
    execute, last = make_execution("ensemble"), 2 * CHUNK_SIZE - 1
    found = [execute(np.full((CHUNK_SIZE, 3), float(number))) for number in range(last + 1)]
    late = (last - found[-1]) / 50.0 * 30.0  # frames
    np.testing.assert_allclose(late, plan_age(), atol=1e-5)
    assert plan_age() == pytest.approx(9.15, abs=0.01)
