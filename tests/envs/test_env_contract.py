"""Contract of every registered environment (after dm_control's suite tests)."""

from __future__ import annotations

import contextlib
import copy
import pickle
from collections.abc import Callable, Iterator
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import robo_manip_baselines  # noqa: F401  (registers the environments)
from robo_manip_baselines.data.schema import EpisodeSchema
from robo_manip_baselines.envs.mujoco.cell.scene import CONTROL_PERIOD
from robo_manip_baselines.envs.mujoco.tasks.face_env import world_of
from robo_manip_baselines.envs.mujoco.tasks.face_rows import episode_row
from robo_manip_baselines.envs.mujoco.tasks.registry import make_env, task_entry, task_names
from robo_manip_baselines.observation import MAX_HORIZON
from robo_manip_baselines.runs.errors import RequestError
from robo_manip_baselines.runs.ranges import MAX_SEED

STEPS = 40

# Warnings are errors. The one exception is advice, not a finding: actions are joint targets in
# radians within the arm's published limits, which are neither symmetric nor within [-1, 1].
ADVICE = "ignore:.*For Box action spaces, we recommend using a symmetric and normalized space"

VARIANTS: dict[str, dict[str, Any]] = {
    "baseline": {"obs": "baseline"},
    "current": {"obs": "current"},
    "current_pred": {"obs": "current_pred", "horizon": 5},
    "history": {"obs": "history", "corruption": {"delay": 2}},
    "both arms": {
        "obs": "current_pred",
        "horizon": 24,
        "arms": "both",
        "motion": "recorded+tremor",
    },
    "physical face": {"obs": "current", "face": "physical", "motion": "recorded+turn_away"},
    "after lift": {"obs": "current", "face_motion": "after_lift"},
}


@pytest.fixture(params=sorted(task_names()))
def name(request: pytest.FixtureRequest) -> str:
    return str(request.param)


@pytest.fixture(params=sorted(VARIANTS))
def env(name: str, request: pytest.FixtureRequest) -> Iterator[gymnasium.Env[Any, Any]]:
    env = make_env(name, cameras=(), **VARIANTS[request.param])
    yield env
    env.close()


def wander(env: gymnasium.Env[Any, Any], seed: int, steps: int = STEPS) -> list[dict[str, Any]]:
    """Reset, then act at random around the present pose; return what was observed."""
    rng = np.random.default_rng(seed)
    observation, _ = env.reset(seed=seed)
    observations = [observation]
    low, high = env.action_space.low, env.action_space.high
    for _ in range(steps):
        action = rng.uniform(low, high).astype(np.float32)
        observation, *_ = env.step(action)
        observations.append(observation)
    return observations


@pytest.mark.filterwarnings(ADVICE)
def test_check_env_has_nothing_to_say(env: gymnasium.Env[Any, Any]) -> None:
    check_env(env.unwrapped, skip_render_check=True)


def test_observations_fit_the_space_and_are_finite(env: gymnasium.Env[Any, Any]) -> None:
    for observation in wander(env, seed=3):
        assert env.observation_space.contains(observation)
        for key, value in observation.items():
            assert np.isfinite(value).all(), key


def test_same_seed_same_trajectory_bit_for_bit(env: gymnasium.Env[Any, Any]) -> None:
    first, other, second = wander(env, seed=5), wander(env, seed=6), wander(env, seed=5)
    for a, b in zip(first, second, strict=True):
        for key in a:
            np.testing.assert_array_equal(a[key], b[key])
    assert any((first[-1][key] != other[-1][key]).any() for key in first[-1])


def test_observations_share_no_memory(env: gymnasium.Env[Any, Any]) -> None:
    observations = wander(env, seed=1, steps=2)
    for key in observations[0]:
        assert not np.shares_memory(observations[0][key], observations[1][key]), key
        assert not np.shares_memory(observations[1][key], observations[2][key]), key


def test_no_element_of_an_observation_is_constant(env: gymnasium.Env[Any, Any]) -> None:
    seen = [wander(env, seed) for seed in range(4)]
    for key in seen[0][0]:
        values = np.stack([observation[key] for run in seen for observation in run])
        constant = np.flatnonzero(np.ptp(values, axis=0) == 0.0)
        names = env.unwrapped.observation_spec.components(env.unwrapped.task.names)[key]
        assert not len(constant), f"{key}: {[names[i] for i in constant]}"


def test_every_component_is_named(env: gymnasium.Env[Any, Any]) -> None:
    components = env.unwrapped.observation_spec.components(env.unwrapped.task.names)
    spaces = env.observation_space.spaces
    shapes = {key: (len(names),) for key, names in components.items()}
    assert shapes == {key: space.shape for key, space in spaces.items()}
    for names in components.values():
        assert len(set(names)) == len(names)


def test_the_start_is_really_random(env: gymnasium.Env[Any, Any]) -> None:
    world = env.unwrapped
    objects, mouths, segments = [], [], set()
    for seed in range(20):
        env.reset(seed=seed)
        objects.append(world.object_position())
        mouths.append(world.mouth_track[0])
        segments.add(world.segment.index)
    # Of a uniform spread of 0.1 m, twenty draws cover less than half with odds below 1e-5.
    assert (np.ptp(objects, axis=0)[..., :2] > 0.05).all()
    assert (np.ptp(mouths, axis=0) > 0.05).all()
    assert len(segments) > 15


def test_info_has_what_every_task_promises(env: gymnasium.Env[Any, Any]) -> None:
    world = env.unwrapped
    _, info = env.reset(seed=0)
    _, _, _, _, later = env.step(env.action_space.sample())
    for given in (info, later):
        assert given["is_success"] is False
        assert given["is_success_strict"] is False
        assert given["completion_time"] is None
        assert given["phase"] in world.phase_names
        assert given["face_contacts"] == ()
        assert given["face_proximity"] is None
        assert given["is_refusing"] is (False if "turn_away" in str(world.motion) else None)
    world.measures_proximity = True
    near = env.step(env.action_space.sample())[-1]["face_proximity"]
    np.testing.assert_allclose(near.mouth, world.mouth_track[0], atol=1e-9)
    np.testing.assert_array_equal(near.grippers[1], world.gripper_position)


def test_an_entry_describes_its_environment(name: str) -> None:
    task = task_entry(name)
    has_objects = bool(task.names.objects)
    with contextlib.closing(make_env(name, cameras=(), object_pose=has_objects)) as env:
        world = world_of(env)
        observation, info = env.reset(seed=0)
        assert env.spec is not None
        assert (env.spec.id, env.spec.max_episode_steps) == (task.env_id, task.max_episode_steps)
        assert world.task is task
        assert world.object_position().shape == (len(task.names.objects), 3)
        assert world.target_track().shape == (MAX_HORIZON + 1, 3)
        schema = EpisodeSchema.of(task)
        row = {**episode_row(world), "action": env.action_space.sample()}
        held = set(schema.by_name) - {"is_success", "is_success_strict"}
        optional = {field.name for field in schema.fields if field.is_optional}
        assert held - optional <= set(row) <= held
        given = {item.name for item in task.attributes}
        assert given <= set(world.start_attributes())
        state = observation["state"]
        np.testing.assert_array_equal(state, world.vector[: len(state)])
        metrics = task.make_metrics()
        metrics.update(info)
        failure, columns = metrics.result(info)
        assert failure in task.failures
        assert set(columns) == {column.name for column in task.columns}
        for expert in task.experts:
            actor = task.make_expert(expert, world)
            actor.reset()
            assert env.action_space.contains(actor.act())


def test_truncates_at_the_time_limit(name: str) -> None:
    env = make_env(name, cameras=())
    env.reset(seed=0)
    world = env.unwrapped
    stay = np.array([world.data.actuator(name).ctrl[0] for name in world.action_names], np.float32)
    limit = task_entry(name).max_episode_steps
    for step in range(1, limit + 1):
        _, _, terminated, truncated, _ = env.step(stay)
        assert not terminated
        assert truncated is (step == limit)
    assert world.time == pytest.approx(limit * CONTROL_PERIOD)
    env.close()


def test_actions_are_bounded_and_checked(env: gymnasium.Env[Any, Any]) -> None:
    env.reset(seed=0)
    space = env.action_space
    assert np.isfinite(space.low).all()
    assert np.isfinite(space.high).all()
    with pytest.raises(ValueError, match="finite numbers"):
        env.unwrapped.step(np.full(space.shape, np.nan))
    with pytest.raises(ValueError, match="finite numbers"):
        env.unwrapped.step(np.zeros(3))


@pytest.mark.parametrize(
    ("action", "message"),
    [
        ({2: np.nan}, "nan in element 2, (right|left)/elbow: must be"),
        ({1: -np.inf}, "-inf in element 1, (right|left)/shoulder: must be"),
        (np.zeros((1, 3)), r"shape \(1, 3\): must be \((7|14),\) finite numbers"),
        (0.0, r"shape \(\): must be"),
        (None, "action None: must be"),
        ("up", "action 'up': must be"),
        ([[0.0], [0.0, 0.0]], "action .*: must be"),
        (np.zeros(3, complex), "action .*: must be"),
    ],
)
def test_wrong_actions_get_one_clear_line(name: str, action: Any, message: str) -> None:
    with contextlib.closing(make_env(name, cameras=())) as env:
        env.reset(seed=0)
        before = env.unwrapped.data.qpos.copy()
        if isinstance(action, dict):  # elements of an action that is right otherwise
            wrong, action = action, np.zeros(env.action_space.shape)
            action[list(wrong)] = list(wrong.values())
        with pytest.raises(ValueError, match=message) as caught:
            env.unwrapped.step(action)
        assert "\n" not in str(caught.value)
        np.testing.assert_array_equal(env.unwrapped.data.qpos, before)


@pytest.mark.parametrize("seed", [-1, 1.0, "3", True, 2**63, np.int64(-1), [1]])
def test_wrong_seeds_are_refused(name: str, seed: Any) -> None:
    with (
        contextlib.closing(make_env(name, cameras=())) as env,
        pytest.raises(RequestError, match=r"^seed .*: must be 0 to 9007199254740991"),
    ):
        env.reset(seed=seed)


def test_integers_of_numpy_are_seeds(name: str) -> None:
    with contextlib.closing(make_env(name, cameras=())) as env:
        first, _ = env.reset(seed=3)
        for seed in (np.int64(3), np.uint8(3)):
            again, _ = env.reset(seed=seed)  # type: ignore[arg-type]
            np.testing.assert_array_equal(again["state"], first["state"])
            np.testing.assert_array_equal(env.unwrapped.vector, first["state"])
        env.reset(seed=MAX_SEED)


def test_options_of_an_episode_are_not_ignored(name: str) -> None:
    with contextlib.closing(make_env(name, cameras=())) as env:
        env.reset(seed=0, options={})
        with pytest.raises(RequestError, match=r"^reset option clip, x: unknown"):
            env.reset(seed=0, options={"clip": "clm_cap12", "x": 1})


def test_use_before_reset_and_after_close_says_so(name: str) -> None:
    env = make_env(name, cameras=(), render_mode="rgb_array")
    action, world = env.action_space.sample(), env.unwrapped
    for use in (lambda: env.step(action), lambda: world.step(action), world.render):
        with pytest.raises(gymnasium.error.ResetNeeded, match="reset"):
            use()
    env.reset(seed=0)
    env.close()
    env.close()
    for use in (env.reset, lambda: env.step(action), world.render):
        with pytest.raises(gymnasium.error.ClosedEnvironmentError, match="after close"):
            use()


COPIES: dict[str, Callable[[Any], Any]] = {
    "deepcopy": copy.deepcopy,
    "pickle": lambda env: pickle.loads(pickle.dumps(env)),
}


@pytest.mark.parametrize("how", COPIES)
@pytest.mark.parametrize("error", ["none", "uniform", "gaussian", "empirical"])
def test_a_copy_goes_on_as_the_original_does(name: str, how: str, error: str) -> None:
    corruption = {"error": error, "delay": 2, "face_dropout": 0.2}
    env = make_env(name, cameras=(), obs="current_pred", corruption=corruption)
    wander(env, seed=2, steps=3)
    twin = COPIES[how](env)
    for _ in range(3):
        action = env.action_space.sample()
        ours, theirs = env.step(action), twin.step(action)
        np.testing.assert_array_equal(ours[0]["prediction"], theirs[0]["prediction"])
        np.testing.assert_array_equal(ours[0]["state"], theirs[0]["state"])
    env.close()
    np.testing.assert_array_equal(twin.reset()[0]["state"].shape, ours[0]["state"].shape)
    twin.close()


@pytest.mark.parametrize("how", COPIES)
def test_a_copy_remembers_the_past(name: str, how: str) -> None:
    with contextlib.closing(make_env(name, cameras=(), obs="history")) as env:
        wander(env, seed=2, steps=3)
        twin = COPIES[how](env)
        for _ in range(12):
            action = env.action_space.sample()
            ours, theirs = env.step(action)[0], twin.step(action)[0]
            np.testing.assert_array_equal(ours["history"], theirs["history"])
        twin.close()


@pytest.mark.gl
@pytest.mark.parametrize("how", COPIES)
def test_a_copy_draws_with_a_context_of_its_own(name: str, how: str) -> None:
    env = make_env(name, cameras="top", image_size=(24, 32), render_size=(48, 64))
    env.reset(seed=2)
    twin = COPIES[how](env)
    action = env.action_space.sample()
    ours, theirs = env.step(action)[0], twin.step(action)[0]
    env.close()
    np.testing.assert_array_equal(ours["images/top"], theirs["images/top"])
    assert theirs["images/top"].std() > 10
    again = twin.step(action)[0]["images/top"]
    assert again.shape == (24, 32, 3)
    twin.close()


@pytest.mark.parametrize("mode", ["sync", "async"])
def test_vector_environments_give_what_single_ones_give(name: str, mode: str) -> None:
    options: dict[str, Any] = {"cameras": (), "obs": "current"}
    vector = gymnasium.make_vec(
        task_entry(name).env_id, num_envs=2, vectorization_mode=mode, **options
    )
    single = make_env(name, **options)
    together, _ = vector.reset(seed=[7, 8])
    rng = np.random.default_rng(0)
    low, high = vector.action_space.low, vector.action_space.high  # (2, A)
    actions = rng.uniform(low, high, (5, *low.shape))
    for action in actions.astype(np.float32):
        together, *_ = vector.step(action)
    for row, seed in enumerate((7, 8)):
        alone, _ = single.reset(seed=seed)
        for action in actions.astype(np.float32):
            alone, *_ = single.step(action[row])
        for key in alone:
            np.testing.assert_array_equal(alone[key], together[key][row])
    vector.close()
    single.close()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"obs": "currant"}, "unknown observation preset 'currant' .*did you mean 'current'"),
        ({"obs": 3}, "unknown observation preset '3'; valid: baseline"),
        ({"cameras": ("wrist",)}, "unknown camera 'wrist'.*valid: angle, front_close, top"),
        ({"cameras": "wrist"}, "unknown camera 'wrist'.*valid: angle, front_close, top"),
        ({"cameras": ("top", "top")}, "each may be named once"),
        ({"cameras": None}, "cameras None: must be names of cameras.*valid: top, angle"),
        ({"cameras": [1]}, r"cameras \[1\]: must be names of cameras"),
        ({"horizon": 0}, "horizon 0: must be 1 to 24"),
        ({"horizon": 25}, "horizon 25: must be 1 to 24"),
        ({"horizon": "2"}, "horizon '2': must be 1 to 24"),
        ({"horizon": 2.5}, "horizon 2.5: must be 1 to 24"),
        ({"image_size": (0, 640)}, "image size"),
        ({"image_size": 240}, r"image size 240: must be height and width.*\(240, 320\)"),
        ({"image_size": (240.5, 320)}, "image size .*two whole numbers from 1 to 4096"),
        ({"image_size": (240, 320, 3)}, "image size .*two whole numbers"),
        ({"render_size": (240, 320)}, "image size 480x640: must be no larger than .* 240x320"),
        ({"render_size": "big"}, "render size 'big': must be height and width"),
        ({"object_pose": "yes"}, "object_pose 'yes': must be True or False"),
        ({"corruption": {"error": "cosmic"}}, "unknown error model 'cosmic'"),
        ({"corruption": {"delay": 3}}, "shows nothing"),
        ({"corruption": "uniform"}, r"corruption 'uniform': .*\{'error': 'uniform'\}"),
        ({"corruption": ["uniform"]}, r"corruption \['uniform'\]: .*\{'error': 'uniform'\}"),
        ({"corruption": {"delay": "3"}}, "delay: must be a whole number, not '3'"),
        ({"corruption": {"delay": float("nan")}}, "delay: must be a whole number, not nan"),
        ({"corruption": {"face_dropout": "a"}}, "face_dropout: must be a number, not 'a'"),
        ({"corruption": {"delay": object()}}, "corruption: a value of type object"),
        ({"corruption": {"seed": 1.5}}, "seed: must be a whole number, not 1.5"),
        ({"corruption": {"sped": 1}}, "corruption: unknown name 'sped'"),
        ({"arms": "left"}, "unknown arms 'left'; valid: both, right"),
        ({"arms": None}, "unknown arms 'None'; valid: both, right"),
        ({"face_motion": "never"}, "unknown face motion 'never'"),
        ({"people": "some"}, "unknown people 'some'; valid: all, test, train"),
        ({"clips": ("nobody",)}, "unknown clip 'nobody'"),
        ({"clips": "nobody"}, "unknown clip 'nobody'"),
        ({"clips": ()}, r"clips \(\): must be ids of clips, at least one"),
        ({"motion_library": "nowhere.npz"}, "'nowhere.npz' does not exist"),
        ({"motion_library": 5}, "motion_library 5: must be the path of a file"),
        ({"shadows": "yes"}, "shadows 'yes': must be True or False"),
        ({"multisamples": 10**9}, "multisamples 1000000000: must be 0 to 64"),
        (
            {"camera": "top"},
            "unknown argument 'camera' .*'cameras'.*valid: arms, camera_latency, cameras, clips",
        ),
        (
            {"colour": "red"},
            "unknown argument 'colour'; valid: arms, camera_latency, cameras, clips",
        ),
    ],
)
def test_bad_arguments_get_one_clear_line(
    name: str, arguments: dict[str, Any], message: str
) -> None:
    with pytest.raises(RequestError, match=message) as caught:
        make_env(name, **{"cameras": (), **arguments}).unwrapped  # noqa: B018
    assert "\n" not in str(caught.value)
    assert isinstance(caught.value, ValueError)


def test_one_name_is_a_list_of_one(name: str) -> None:
    with contextlib.closing(make_env(name, cameras="top", clips="clm_cap12")) as env:
        assert env.unwrapped.observation_spec.cameras == ("top",)
        assert set(env.observation_space.spaces) == {"state", "images/top"}
        assert env.unwrapped.clips == ("clm_cap12",)


def test_unknown_environments_are_named() -> None:
    with pytest.raises(RequestError, match=r"unknown environment 'FeedinEnv' .*'FeedingEnv'"):
        make_env("FeedinEnv")


@pytest.mark.gl
def test_cameras_are_drawn_in_the_asked_size(name: str) -> None:
    env = make_env(name, cameras=("top", "front_close"), image_size=(48, 64))
    observation, _ = env.reset(seed=0)
    assert set(observation) == {"state", "images/top", "images/front_close"}
    for key in ("images/top", "images/front_close"):
        assert observation[key].shape == (48, 64, 3)
        assert observation[key].dtype == np.uint8
        assert observation[key].std() > 10  # something is to be seen
    moved, *_ = env.step(env.action_space.high)
    assert not np.shares_memory(observation["images/top"], moved["images/top"])
    env.close()


@pytest.mark.gl
@pytest.mark.filterwarnings(ADVICE)
def test_check_env_with_cameras_and_rendering(name: str) -> None:
    env = make_env(name, cameras=("top",), image_size=(24, 32), render_mode="rgb_array")
    check_env(env.unwrapped, skip_render_check=True)
    frame = env.unwrapped.render()
    assert frame.shape == (24, 32, 3)
    env.close()
