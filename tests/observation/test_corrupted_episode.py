"""Training and evaluation are shown the same: a file read with a corruption is what the environment
shows with it.
"""

from __future__ import annotations

from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from robo_manip_baselines.data import EpisodeReader
from robo_manip_baselines.data.demonstrations import load_demonstrations
from robo_manip_baselines.envs.mujoco.cell.scene import MOUTH_BASE
from robo_manip_baselines.envs.mujoco.face.motion import (
    DEFAULT_LIBRARY,
    WORLD_FROM_CAMERA,
    MotionLibrary,
)
from robo_manip_baselines.envs.mujoco.tasks.face_env import world_of
from robo_manip_baselines.envs.mujoco.tasks.registry import make_env
from robo_manip_baselines.observation import Corruption, ObservationSpec
from robo_manip_baselines.rollout.demonstrate import Collection, collect
from robo_manip_baselines.rollout.workers import EnvConfig
from robo_manip_baselines.runs.errors import RequestError

from .conftest import NAMES

pytestmark = pytest.mark.long

SEED = 4
FRAMES_AHEAD = 5


def write_library(path: Path, *, error: float | None) -> Path:
    """The shipped motion, with predictions that are wrong by so many metres, or without any."""
    with np.load(DEFAULT_LIBRARY, allow_pickle=False) as archive:
        content = {name: archive[name] for name in archive.files}
    content.pop("predicted_mouth", None)
    if error is not None:
        mouth = content["mouth"]
        ends = np.repeat(content["run_start"] + content["run_length"], content["run_length"])
        later = np.arange(len(mouth))[:, None] + np.arange(1, FRAMES_AHEAD + 1)
        rows = np.minimum(later, ends[:, None] - 1)
        noise = np.random.default_rng(0).normal(0.0, 1.0, (len(mouth), FRAMES_AHEAD, 3))
        content["predicted_mouth"] = (mouth[rows] + error * noise).astype(np.float32)
    np.savez_compressed(path, **content)
    return path


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("demos")


@pytest.fixture(scope="module")
def library(folder: Path) -> Path:
    return write_library(folder / "library.npz", error=0.005)


@pytest.fixture(scope="module")
def recorded(folder: Path, library: Path) -> Path:
    """A folder with one demonstration, with predictions."""
    kwargs = {"cameras": (), "motion_library": str(library)}
    collect(Collection("FeedingEnv", folder / "d", "reactive", range(SEED, SEED + 1), kwargs))
    return folder / "d"


@pytest.mark.parametrize(
    ("obs", "corruption"),
    [
        ("current_pred", Corruption("uniform")),
        ("current_pred", Corruption("empirical", delay=2, face_dropout=0.3, face_dropout_length=5)),
        ("current_pred", Corruption("gaussian", detector_rate=12.0, seed=2)),
        ("current_pred", Corruption("model")),
        ("current_pred", Corruption("model", delay=4, face_dropout=0.2, detector_rate=15.0)),
        ("current", Corruption(delay=3, face_dropout=0.2, detector_rate=20.0)),
        ("current_pred", Corruption(delay=12, face_dropout=0.2)),
        ("history", Corruption(delay=3)),
        ("history", Corruption(delay=3, face_dropout=0.2, detector_rate=20.0)),
    ],
)
def test_training_sees_what_evaluation_sees(
    recorded: Path, library: Path, obs: str, corruption: Corruption
) -> None:
    horizon = 24 if corruption.error == "none" else 5
    spec = ObservationSpec(obs, horizon, cameras=(), object_pose=True, corruption=corruption)
    loaded = load_demonstrations(recorded, spec)
    assert loaded.spec == replace(spec, corruption=corruption.pinned())
    with EpisodeReader(loaded.paths[0]) as episode:
        actions = episode.array("action")
    config = EnvConfig("FeedingEnv", loaded.spec, {"motion_library": str(library)})
    shown = []
    with closing(config.make()) as env:
        observation, _ = env.reset(seed=SEED)
        for action in actions:
            shown.append(np.concatenate([observation[key] for key in spec.components(NAMES)]))
            observation, *_ = env.step(action)
    names = spec.vector_names(NAMES)
    # Sums of squares may be added up in another order for a batch: one float32 ulp.
    exact = [not name.startswith("distance") for name in names]
    rows = np.array(shown)
    np.testing.assert_array_equal(loaded.state[:, exact], rows[:, exact])
    np.testing.assert_allclose(loaded.state, rows, rtol=3e-7)
    plain = load_demonstrations(recorded, replace(spec, corruption=Corruption())).state
    told = [name[:2] in ("x_", "y_", "z_") or name.startswith("mouth") for name in names]
    assert (loaded.state[:, told] != plain[:, told]).mean() > 0.4
    felt = [not t and not n.startswith(("t_", "dist")) for t, n in zip(told, names, strict=True)]
    np.testing.assert_array_equal(loaded.state[:, felt], plain[:, felt])


def test_the_world_is_the_same_with_and_without(library: Path) -> None:
    """Observations differ, dynamics do not: no draw is taken from the world's generator."""
    tracks = []
    for corruption in (None, {"error": "uniform", "face_dropout": 0.2}):
        kwargs = {"obs": "current_pred", "cameras": (), "corruption": corruption}
        with closing(make_env("FeedingEnv", **kwargs)) as env:
            env.reset(seed=9)
            rows = []
            for _ in range(20):
                _, _, _, _, info = env.step(np.asarray(env.action_space.low))
                rows.append([*info["mouth_position"], *info["gripper_position"]])
            tracks.append(rows)
    np.testing.assert_array_equal(tracks[0], tracks[1])


def test_the_recorded_prediction_is_shown_in_step_with_the_face(library: Path) -> None:
    kwargs = {"obs": "current_pred", "horizon": 5, "cameras": (), "motion_library": str(library)}
    corruption = {"error": "model"}
    with closing(make_env("FeedingEnv", **kwargs, corruption=corruption)) as env:
        observation, _ = env.reset(seed=1)
        world = world_of(env)
        motion = MotionLibrary.load(library)
        assert motion.predicted is not None
        start = MOUTH_BASE + world.face_offset
        for step in range(60):
            if step % 5 == 0:  # a video frame
                frame = world.segment.index + 3 * step // 5
                moved = motion.predicted[frame] - motion.mouth[world.segment.index]
                wanted = start + moved @ WORLD_FROM_CAMERA.T
                told = observation["prediction"][:24].reshape(6, 4)[1:, 1:]
                np.testing.assert_allclose(told, wanted, atol=1e-6)
            assert world.state().predicted_target is not None
            observation, *_ = env.step(np.asarray(env.action_space.low))


def test_a_perfect_predictor_shows_the_truth(tmp_path: Path) -> None:
    library = write_library(tmp_path / "perfect.npz", error=0.0)
    kwargs = {"obs": "current_pred", "horizon": 5, "cameras": (), "motion_library": str(library)}
    shown = []
    for corruption in (None, {"error": "model"}):
        with closing(make_env("FeedingEnv", **kwargs, corruption=corruption)) as env:
            env.reset(seed=2)
            rows = [env.step(np.asarray(env.action_space.low))[0] for _ in range(40)]
            shown.append([row["prediction"] for row in rows])
    np.testing.assert_allclose(shown[1], shown[0], atol=1e-6)


def test_without_predictions_the_model_is_refused_in_one_line(tmp_path: Path) -> None:
    library = write_library(tmp_path / "plain.npz", error=None)
    message = r"plain.npz' holds no predicted mouth, .*face_prediction predict"
    kwargs = {"cameras": (), "motion_library": str(library)}
    with pytest.raises(RequestError, match=message):
        make_env("FeedingEnv", obs="current_pred", corruption={"error": "model"}, **kwargs)
    collect(Collection("FeedingEnv", tmp_path / "d", "reactive", range(SEED, SEED + 1), kwargs))
    spec = ObservationSpec(obs="current_pred", cameras=(), corruption=Corruption("model"))
    with pytest.raises(RequestError, match=r"episode_000004.hdf5' holds no predicted mouth"):
        load_demonstrations(tmp_path / "d", spec)
    assert load_demonstrations(tmp_path / "d", replace(spec, corruption=Corruption("uniform")))


def test_an_episode_without_a_seed_has_errors_of_its_own() -> None:
    kwargs = {"obs": "current_pred", "cameras": (), "corruption": {"error": "uniform"}}
    with closing(make_env("FeedingEnv", **kwargs)) as env:
        env.reset(seed=3)
        added = []
        for _ in range(2):
            observation, _ = env.reset()
            told = observation["prediction"][:12].reshape(3, 4)[1:, 1:]
            added.append(told - world_of(env).mouth_track[1:3])
    assert not np.allclose(added[0], added[1])
