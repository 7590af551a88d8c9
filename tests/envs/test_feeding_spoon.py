"""Feeding with a spoon: food that can be spilled, lips that take it, a tool that counts."""

from __future__ import annotations

import itertools
import json
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import mujoco
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from robo_manip_baselines.commands import rollout
from robo_manip_baselines.data import EpisodeReader, list_episodes
from robo_manip_baselines.envs.mujoco.face.contact import REGIONS, ROBOT_PARTS, toucher_of
from robo_manip_baselines.envs.mujoco.tasks.feeding import ENTRY
from robo_manip_baselines.envs.mujoco.tasks.feeding.env import FeedingEnv
from robo_manip_baselines.envs.mujoco.tasks.feeding.metrics import FeedingMetrics
from robo_manip_baselines.envs.mujoco.tasks.feeding.spoon import (
    BOWL,
    FOOD_SIZE,
    RIM,
    SPOON,
    TAKING_STEPS,
    is_on_spoon,
)
from robo_manip_baselines.envs.mujoco.tasks.feeding.success import FACE_FORCE
from robo_manip_baselines.envs.mujoco.tasks.registry import make_env
from robo_manip_baselines.runs.errors import RequestError

EPSILON = 1e-6
"""m and N, far above rounding and far below anything that matters."""

MIDDLE = FOOD_SIZE / 2 - RIM
"""m, height of the food's centre above the rim while it lies on the floor of the bowl."""


@pytest.fixture
def world() -> Iterator[FeedingEnv]:
    with closing(make_env("FeedingEnv", cameras=(), utensil="spoon", object_pose=True)) as env:
        assert isinstance(env.unwrapped, FeedingEnv)
        env.unwrapped.reset(seed=0)
        yield env.unwrapped


def still(world: FeedingEnv) -> np.ndarray:
    return np.array([world.data.actuator(name).ctrl[0] for name in world.action_names], np.float32)


def feed(world: FeedingEnv, expert: str, seed: int) -> FeedingMetrics:
    """Play an episode."""
    actor, metrics, is_over = ENTRY.make_expert(expert, world), FeedingMetrics(), False
    world.reset(seed=seed)
    actor.reset()
    while not is_over and world.step_count < ENTRY.max_episode_steps:
        _, _, is_over, _, info = world.step(actor.act())
        metrics.update(info)
    return metrics


def test_the_choices_are_those_of_the_entry() -> None:
    assert tuple(FACE_FORCE) == ENTRY.choices["utensil"]


def test_the_gripper_is_the_default_and_its_model_is_as_ever() -> None:
    hashes = {}
    for name, kwargs in (("default", {}), ("gripper", {"utensil": "gripper"})):
        with closing(FeedingEnv(cameras=(), **kwargs)) as env:
            hashes[name] = env.xml_hash
            assert env.touch.touchers[-1] == "cube"
    with closing(FeedingEnv(cameras=(), utensil="spoon")) as env:
        assert env.xml_hash not in hashes.values()
    assert len(set(hashes.values())) == 1


@pytest.mark.filterwarnings("ignore:.*symmetric and normalized space")
def test_gymnasium_finds_nothing_to_complain_about() -> None:
    env = make_env("FeedingEnv", cameras=(), utensil="spoon", object_pose=True)
    check_env(env.unwrapped, skip_render_check=True)
    env.close()


@pytest.mark.parametrize(
    ("offset", "expected"),
    [
        ((0.0, 0.0, MIDDLE), True),
        ((BOWL[0] - EPSILON, 0.0, MIDDLE), True),
        ((BOWL[0] + EPSILON, 0.0, MIDDLE), False),
        ((-BOWL[0] - EPSILON, 0.0, MIDDLE), False),
        ((0.0, BOWL[1] - EPSILON, MIDDLE), True),
        ((0.0, -BOWL[1] - EPSILON, MIDDLE), False),
        ((0.0, 0.0, MIDDLE + FOOD_SIZE / 2 - EPSILON), True),
        ((0.0, 0.0, MIDDLE + FOOD_SIZE / 2 + EPSILON), False),
        ((0.0, 0.0, MIDDLE - FOOD_SIZE / 2 - EPSILON), False),
    ],
)
def test_on_the_spoon(offset: tuple[float, float, float], expected: bool) -> None:
    assert is_on_spoon(np.array(offset)) is expected


def test_food_lies_level_on_the_spoon_from_the_start(world: FeedingEnv) -> None:
    starts = []
    for seed in range(5):
        world.reset(seed=seed)
        starts.append(world.cube_position - world.utensil_position)
        for _ in range(10):
            world.step(still(world))
        moved = world.cube_position - world.utensil_position - starts[-1]
        assert np.abs(moved).max() < 1.5e-3  # m; it settles
        assert world.progress.lift_time == pytest.approx(0.02)
        assert world.info()["phase"] == "carry"
        assert world.data.site(SPOON).xmat[8] > np.cos(np.radians(1.0))
    assert (np.ptp(starts, axis=0)[:2] > 0.5e-3).all()


def test_food_that_slides_off_is_spilled(world: FeedingEnv) -> None:
    action = still(world)
    action[5] = np.pi / 2  # the wrist turns about the spoon's axis
    metrics = FeedingMetrics()
    for _ in range(100):
        _, reward, _, _, info = world.step(action)
        metrics.update(info)
        assert reward == 0.0
    assert info["phase"] == "release"
    assert world.cube_position[2] < world.utensil_position[2] - 0.05
    assert metrics.result(info)[0] == "dropped"


def test_fingers_that_open_do_not_drop_the_spoon(world: FeedingEnv) -> None:
    action, before = still(world), world.utensil_position
    action[6] = 0.057
    for _ in range(20):
        world.step(action)
    np.testing.assert_allclose(world.utensil_position, before, atol=1e-3)


@pytest.mark.parametrize(
    ("inside", "is_taken"),
    [
        ([True] * (TAKING_STEPS - 1), False),
        ([True] * TAKING_STEPS, True),
        ([*[True] * (TAKING_STEPS - 1), False, True], False),
        ([False, *[True] * TAKING_STEPS, False], True),
    ],
)
def test_lips_close_on_food_that_stays(
    world: FeedingEnv, inside: list[bool], is_taken: bool
) -> None:
    meal = world.meal
    assert meal is not None
    for is_inside in inside:
        meal.advance(world.model, world.data, is_inside=is_inside)
    assert meal.is_taken is is_taken
    assert meal.is_on_spoon(world.data) is not is_taken


def test_food_that_is_not_on_the_spoon_is_not_taken(world: FeedingEnv) -> None:
    meal = world.meal
    assert meal is not None
    world.data.joint("cube").qpos[:3] += (0.0, 0.1, 0.0)
    mujoco.mj_forward(world.model, world.data)
    for _ in range(2 * TAKING_STEPS):
        meal.advance(world.model, world.data, is_inside=True)
    assert not meal.is_taken


def test_taken_food_goes_with_the_mouth_until_the_next_episode(world: FeedingEnv) -> None:
    feed(world, "servo", seed=0)
    progress, meal = world.progress, world.meal
    assert meal is not None
    assert meal.is_taken
    assert progress.is_success_strict
    assert progress.is_clear
    assert progress.completion_time is not None
    offsets = []
    for _ in range(20):
        world.step(still(world))
        offsets.append(world.cube_offset)
    # The food is where the last physics step found the mouth, which moves at 0.1 m/s or so.
    assert np.ptp(offsets, axis=0).max() < 1e-3
    assert np.linalg.norm(world.cube_position - world.utensil_position) > 0.1
    world.reset(seed=0)
    assert meal.is_on_spoon(world.data)
    world.step(still(world))
    assert "cube" in {world.model.geom(g).name for pair in world.touch.pairs for g in pair}


@pytest.mark.parametrize(
    ("utensil", "force", "touches"),
    list(
        zip(
            itertools.chain.from_iterable([name] * 3 for name in ENTRY.choices["utensil"]),
            (0.0, EPSILON, 1.0, 1.0, 10.0, 10.0 + EPSILON),
            (False, True, True, False, False, True),
            strict=True,
        )
    ),
)
def test_force_that_costs_strict_success(utensil: str, force: float, touches: bool) -> None:
    with closing(FeedingEnv(cameras=(), utensil=utensil)) as env:
        env.reset(seed=0)
        env._face_force = force
        assert env._measure().touches_face is touches


@pytest.mark.parametrize("face", ["visual", "physical"])
def test_geoms_of_the_spoon_are_told_apart_from_the_gripper(face: str) -> None:
    with closing(FeedingEnv(cameras=(), utensil="spoon", face=face)) as env:
        model, objects = env.model, env.touch.touchers[len(ROBOT_PARTS) :]
        assert objects == ("cube", SPOON)
        own = [g for g in range(model.ngeom) if model.geom(g).name.startswith("spoon/")]
        assert {toucher_of(model, geom, objects) for geom in own} == {SPOON}


def test_the_spoon_is_what_touched_a_chin_that_it_hits(world: FeedingEnv) -> None:
    model, data = world.model, world.data
    chin = data.geom("face/chin").xpos
    data.mocap_pos[:] += world.utensil_position - chin - (0.025, 0.0, 0.0)
    mujoco.mj_step(model, data)
    world.touch.clear()
    world.touch.read(model, data)
    world.watch_contacts()
    touched = {(contact.toucher, contact.is_food) for contact in world.touch.contacts}
    assert (SPOON, False) in touched
    assert world.face_force > 0.0
    force = world.touch.row()["region_force"]
    assert force.shape == (len(REGIONS), len(world.touch.touchers))
    assert force[:, -1].max() > 0.0


@pytest.mark.parametrize("expert", sorted(ENTRY.experts))
def test_experts_bring_the_spoon_level(world: FeedingEnv, expert: str) -> None:
    actor = ENTRY.make_expert(expert, world)
    world.reset(seed=2)
    actor.reset()
    tilts = []
    while world.progress.release_time is None and world.step_count < 600:
        world.step(actor.act())
        tilts.append(np.arccos(min(world.data.site(SPOON).xmat[8], 1.0)))
    assert world.progress.is_success
    assert world.progress.released_inside
    assert np.degrees(max(tilts)) < 3.0


@pytest.mark.slow
@pytest.mark.parametrize("expert", sorted(ENTRY.experts))
def test_at_least_45_of_50_episodes_succeed(world: FeedingEnv, expert: str) -> None:
    outcomes = []
    for seed in range(50):
        feed(world, expert, seed)
        outcomes.append(world.progress)
    assert sum(progress.is_success for progress in outcomes) >= 45
    assert sum(progress.released_inside for progress in outcomes) >= 45


def test_unknown_utensils_are_refused() -> None:
    with pytest.raises(RequestError, match=r"unknown utensil 'fork'.*gripper, spoon"):
        FeedingEnv(cameras=(), utensil="fork")
    with pytest.raises(RequestError, match="unknown utensil 'spoon'"):
        make_env("BimanualFeedingEnv", cameras=(), utensil="spoon")
    with pytest.raises(RequestError, match="unknown argument 'utensil'"):
        make_env("DrinkingEnv", cameras=(), utensil="spoon")


@pytest.mark.parametrize(
    ("env", "utensil", "message"),
    [
        ("FeedingEnv", "fork", "unknown utensil 'fork'"),
        ("DrinkingEnv", "spoon", "utensil spoon: DrinkingEnv has no such choice"),
    ],
)
def test_the_command_refuses_them_too(tmp_path: Path, env: str, utensil: str, message: str) -> None:
    out = ["--out", str(tmp_path / "out")]
    with pytest.raises(RequestError, match=message):
        rollout.main([env, "--scripted", "--cameras", "none", "--utensil", utensil, *out])
    assert not (tmp_path / "out").exists()


def test_episodes_say_with_what_they_were_recorded(tmp_path: Path) -> None:
    options = "FeedingEnv --scripted --expert servo --cameras none --num_episodes 1 --preview 0"
    out = tmp_path / "spoon"
    rollout.main([*options.split(), "--workers", "1", "--utensil", "spoon", "--out", str(out)])
    assert json.loads((out / "summary.json").read_text())["successes"] == 1
    with EpisodeReader(list_episodes(out)[0]) as episode:
        assert episode.attributes["env_kwargs"]["utensil"] == "spoon"


def test_a_policy_feeds_with_what_it_was_trained_with(tmp_path: Path) -> None:
    options = "FeedingEnv --policy Act --checkpoint shipped:baseline --obs baseline --cameras none"
    more = ["--object_pose", "--num_episodes", "1", "--out", str(tmp_path / "out")]
    message = "was trained with utensil gripper, not spoon"
    with pytest.raises(RequestError, match=message):
        rollout.main([*options.split(), *more, "--utensil", "spoon"])
