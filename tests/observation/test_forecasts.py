"""Forecasters in place of the true future: causal, and the same live, from files and anywhere."""

from __future__ import annotations

import hashlib
import math
import os
import subprocess
import sys
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from robo_manip_baselines.data.demonstrations import load_demonstrations
from robo_manip_baselines.data.episode import EpisodeReader
from robo_manip_baselines.envs.mujoco.face import perception
from robo_manip_baselines.envs.mujoco.face.forecasters import (
    FIT_EPISODES,
    LINEAR,
    MotionForecasters,
    follow_tracks,
    frames_seen,
)
from robo_manip_baselines.envs.mujoco.face.motion import MotionLibrary
from robo_manip_baselines.envs.mujoco.face.motions import parse_motion
from robo_manip_baselines.envs.mujoco.face.replay import FRAMES_AHEAD
from robo_manip_baselines.envs.mujoco.tasks.face_env import world_of
from robo_manip_baselines.envs.mujoco.tasks.registry import make_env, task_entry
from robo_manip_baselines.observation import (
    FORECASTERS,
    FRAME_PERIOD,
    Corruption,
    CorruptionPipeline,
    ObservationSpec,
    State,
)
from robo_manip_baselines.rollout.demonstrate import Collection, collect
from robo_manip_baselines.runs.errors import RequestError
from robo_manip_baselines.runs.seeds import derive_seed

NAMES = task_entry("FeedingEnv").names
SEED = 4
MOTIONS = ("recorded", "dyskinetic")
CUT = 200  # a control step, 4 s
EXACT = 1e-12  # m: rounding of positions of a metre


def forecasters(motion: str, people: str = "all") -> MotionForecasters:
    return MotionForecasters.of(parse_motion(motion), MotionLibrary.load(), people)


def track_of(displacement: Any, steps: int = 601) -> np.ndarray:
    """(T, K, 3) m, of a function of time, which is held before the start."""
    return displacement(np.arange(steps)[:, None] * 0.02 + FRAMES_AHEAD)


def motion_of(motion: str, seed: int = SEED) -> Any:
    rng = np.random.default_rng(seed)
    return parse_motion(motion).draw(rng, MotionLibrary.load(), seed=seed).displacement_at


@pytest.fixture(scope="module", params=MOTIONS)
def recorded(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with one demonstration of a motion, which was recorded without any forecast."""
    folder = tmp_path_factory.mktemp("demos") / request.param
    kwargs = {"cameras": (), "motion": request.param}
    collect(Collection("FeedingEnv", folder, "servo", range(SEED, SEED + 1), kwargs))
    return folder


@pytest.mark.long
@pytest.mark.parametrize("name", FORECASTERS)
@pytest.mark.parametrize("delay", [0, 4])
def test_training_sees_what_evaluation_sees(recorded: Path, name: str, delay: int) -> None:
    corruption = Corruption(prediction=name, delay=delay)
    spec = ObservationSpec("current_pred", 20, cameras=(), corruption=corruption, relative=True)
    loaded = load_demonstrations(recorded, spec)
    with EpisodeReader(loaded.paths[0]) as episode:
        actions = episode.array("action")[:90]
    shown = []
    kwargs = {**spec.env_kwargs(), "motion": recorded.name}
    with closing(make_env("FeedingEnv", **kwargs)) as env:
        observation, _ = env.reset(seed=SEED)
        for action in actions:
            shown.append(np.concatenate([observation[key] for key in spec.components(NAMES)]))
            observation, *_ = env.step(action)
    exact = [not name.startswith("distance") for name in spec.vector_names(NAMES)]
    file = loaded.state[: len(shown)]
    np.testing.assert_array_equal(file[:, exact], np.array(shown)[:, exact])
    np.testing.assert_allclose(
        file, shown, rtol=3e-7
    )  # one float32 ulp, see test_corrupted_episode
    truth = load_demonstrations(
        recorded, ObservationSpec("current_pred", 20, cameras=(), relative=True)
    )
    assert (loaded.state != truth.state).any()


@pytest.mark.parametrize("name", FORECASTERS)
@pytest.mark.parametrize("motion", MOTIONS)
def test_another_future_changes_no_forecast(name: str, motion: str) -> None:
    true, end = motion_of(motion), CUT * 0.02

    def other(time: np.ndarray) -> np.ndarray:
        late = np.maximum(time - end, 0.0)[..., None]
        # At once, and to some lasting place.
        return true(time) + np.where(late > 1e-9, 0.02 + 0.1 * np.sin(3.0 * late), 0.0)

    made = forecasters(motion)
    shown = {}
    for key, path in (("true", true), ("other", other)):
        track = track_of(path)
        forecast = made.forecast_track(name, track, SEED)
        assert forecast.shape == (601, 24, 3)
        # A shorter episode, as a file may hold, begins with the same forecasts, bit for bit.
        short = made.forecast_track(name, track[:CUT].copy(), SEED)
        np.testing.assert_array_equal(short, forecast[:CUT])
        shown[key] = track, forecast
    before, after = shown["true"][1], shown["other"][1]
    np.testing.assert_array_equal(after[: CUT + 1], before[: CUT + 1])
    assert (after[CUT + 1] != before[CUT + 1]).any()
    for delay in (0, 4, 8):
        pipeline = CorruptionPipeline(Corruption(prediction=name, delay=delay), 24)
        seen = [pipeline.observe_episode(state_of(*s), SEED).position for s in shown.values()]
        unseen = CUT + int(delay * FRAME_PERIOD / 0.02) + 1  # the first step from which it is
        np.testing.assert_array_equal(seen[0][:unseen, 1:], seen[1][:unseen, 1:])
        assert (seen[0][unseen + 2, 1:] != seen[1][unseen + 2, 1:]).any()


def state_of(track: np.ndarray, forecast: np.ndarray | None) -> State:
    steps = len(track)
    return State(
        time=np.asarray(np.arange(steps) * 0.02, np.float64),
        joint_position=np.zeros((steps, 1, 6)),
        joint_velocity=np.zeros((steps, 1, 6)),
        gripper_position=np.zeros((steps, 1)),
        gripper_velocity=np.zeros((steps, 1)),
        end_effector_position=np.zeros((steps, 3)),
        target_position=track,
        object_position=np.zeros((steps, 0, 3)),
        predicted_target=forecast,
    )


@pytest.mark.parametrize("name", LINEAR)
@pytest.mark.parametrize("motion", MOTIONS)
def test_forecasts_are_those_of_the_mouth_at_frames(name: str, motion: str) -> None:
    path, made = motion_of(motion), forecasters(motion)
    forecast, linear = made.forecast_track(name, track_of(path), SEED), made.linear(name)
    used = (linear.weights.shape[1] - 1) * FRAME_PERIOD
    for step in (0, 1, 2, 3, 4, 5, 7, 26, 27, 41, 600):
        for ahead in (1, 2, 24):
            wanted = linear(path, step * 0.02, ahead * FRAME_PERIOD)
            if step * 0.02 < used - 1e-6:  # not as many frames yet
                wanted = path(np.array(step * 0.02))
            # Weights of up to a hundred enlarge the rounding.
            np.testing.assert_allclose(forecast[step, ahead - 1], wanted, atol=100 * EXACT)


def test_frames_seen_are_those_of_the_past() -> None:
    path = motion_of("dyskinetic")
    seen = frames_seen(track_of(path), 20)
    for step in range(601):
        wanted = path(np.maximum(step * 0.02 - np.arange(20) * FRAME_PERIOD, 0.0))
        np.testing.assert_allclose(seen[step], wanted, atol=EXACT)


def test_after_the_motion_the_last_forecast_is_held() -> None:
    path, made = motion_of("dyskinetic"), forecasters("dyskinetic")
    track = track_of(path)
    longer = np.concatenate([track, np.repeat(track[-1:], 30, axis=0)])
    forecast = made.forecast_track("autoregression", longer, SEED)
    np.testing.assert_array_equal(
        forecast[:601], made.forecast_track("autoregression", track, SEED)
    )
    np.testing.assert_array_equal(forecast[600:], np.repeat(forecast[600:601], 31, axis=0))


@pytest.mark.parametrize("delay", [0, 1, 3, 4, 8])
def test_a_late_forecast_is_read_off_at_the_times_shown(delay: int) -> None:
    """A mouth of constant velocity is forecast exactly, whenever it was seen."""
    velocity = np.array([0.01, -0.04, 0.02])
    made = forecasters("dyskinetic")

    def line(time: np.ndarray) -> np.ndarray:
        return np.multiply.outer(np.asarray(time), velocity)

    track = track_of(line)
    state = state_of(track, made.forecast_track("constant_velocity", track, SEED))
    shown = CorruptionPipeline(Corruption(prediction="constant_velocity", delay=delay), 24)
    target = shown.observe_episode(state, SEED)
    late = slice(40, None)  # the velocity is known since 0.1 s
    np.testing.assert_allclose(target.time[late], state.time[late] - delay * FRAME_PERIOD)
    wanted = line(target.time[late, None] + FRAMES_AHEAD)
    np.testing.assert_allclose(target.position[late], wanted, atol=EXACT)
    frozen = CorruptionPipeline(Corruption(prediction="persistence", delay=delay), 24)
    state = state_of(track, made.forecast_track("persistence", track, SEED))
    held = frozen.observe_episode(state, SEED)
    last = np.floor(target.time[late] / 0.02 + 1e-6) * 0.02  # control step until then
    for k in (1, 12, 24):
        np.testing.assert_allclose(held.position[late, k], line(last), atol=EXACT)


def test_a_state_without_forecasts_has_nothing_to_show() -> None:
    pipeline = CorruptionPipeline(Corruption(prediction="kalman"), 2)
    with pytest.raises(ValueError, match="the state has none"):
        pipeline.observe_episode(state_of(track_of(motion_of("recorded")), None), SEED)


def test_errors_are_those_of_the_shown_motion() -> None:
    """An honest forecaster is better than persistence near by, and shuffled is worse."""
    for motion in MOTIONS:
        track, made = track_of(motion_of(motion)), forecasters(motion)
        error = {
            name: float(np.abs(made.forecast_track(name, track, SEED) - track[:, 1:])[:, 4].mean())
            for name in FORECASTERS
        }
        assert error["autoregression"] < error["persistence"] < error["shuffled"], motion


def test_an_autoregression_forecasts_what_is_computed() -> None:
    """On people whom it was not fitted to, once it has seen as many frames as it uses."""
    made = forecasters("dyskinetic", "test")
    squares: dict[str, list[float]] = {name: [] for name in (*LINEAR, "residual")}
    for seed in range(1000, 1006):
        rng = np.random.default_rng(seed)
        path = made.motion.draw(rng, made.library, seed=seed, people="test").displacement_at
        track = track_of(path)
        for name, own in squares.items():
            error = made.forecast_track(name, track, seed) - track[:, 1:]
            own.append(float((error[40:, 11] ** 2).mean()))
    mean = {name: np.mean(own) for name, own in squares.items()}
    fitted = {name: mean.pop(name) for name in ("autoregression", "residual")}
    assert max(fitted.values()) < 0.1 * min(mean.values())


def test_shuffled_has_the_motion_of_another_episode() -> None:
    track, made = track_of(motion_of("dyskinetic")), forecasters("dyskinetic")
    other = track_of(made.another_episode(SEED).displacement_at)
    moved = made.forecast_track("shuffled", track, SEED) - track[:, :1]
    np.testing.assert_allclose(moved, other[:, 1:] - other[:, :1], atol=EXACT)
    true = track[:, 1:] - track[:, :1]
    assert 0.5 < moved.std() / true.std() < 2.0
    assert abs(np.corrcoef(moved.ravel(), true.ravel())[0, 1]) < 0.4


def test_both_parts_of_people_have_the_forecasters_of_demonstrations() -> None:
    for motion in MOTIONS:
        everybody, train, test = (
            forecasters(motion, people) for people in ("all", "train", "test")
        )
        assert train == test != everybody
        assert train.linear("autoregression") is test.linear("autoregression")
        assert (train.paths()[0] != everybody.paths()[0]).any()
    ours = MotionLibrary.load().part("train")
    drawn = {forecasters("recorded", "test").another_episode(n).subject for n in range(20)}
    assert drawn <= set(ours.run_subject)


def test_what_is_fitted_to_is_no_episode_of_anybody_else() -> None:
    """Seeds of demonstrations start at 0, those of evaluations at 1000."""
    assert min(derive_seed(0, "fit", n) for n in range(FIT_EPISODES)) > 10**9
    assert min(derive_seed(seed, "shuffled") for seed in range(2000)) > 10**9


DIGEST = """
import hashlib, sys
from robo_manip_baselines.envs.mujoco.face.forecasters import MotionForecasters
made = MotionForecasters.of_kwargs({"motion": sys.argv[1], "people": "train"})
for name in ("autoregression", "kalman"):
    print(hashlib.sha256(made.linear(name).weights.tobytes()).hexdigest())
track = made.paths()[0, :240].reshape(60, 4, 3)  # any numbers, of which four are known at a time
print(hashlib.sha256(made.forecast_track("residual", track, 0).tobytes()).hexdigest())
"""


@pytest.mark.long
@pytest.mark.parametrize("motion", ["dyskinetic", "tremor"])
@pytest.mark.parametrize("threads", ["1", "2"])
def test_fits_are_the_same_in_every_process(threads: str, motion: str) -> None:
    variables = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
    result = subprocess.run(
        [sys.executable, "-c", DIGEST, motion],
        env={**os.environ, **dict.fromkeys(variables, threads)},
        capture_output=True,
        text=True,
        check=True,
    )
    made = forecasters(motion, "test")
    names = ("autoregression", "kalman")
    here = [made.linear(name).weights for name in names]
    here.append(made.forecast_track("residual", made.paths()[0, :240].reshape(60, 4, 3), 0))
    wanted = [hashlib.sha256(numbers.tobytes()).hexdigest() for numbers in here]
    assert result.stdout.split() == wanted


def test_a_predictor_takes_in_frames_and_forecasts_at_control_steps() -> None:
    class Predictor:
        recent = 3

        def __init__(self) -> None:
            self.taken: list[np.ndarray] = []
            self.asked: list[tuple[int, np.ndarray]] = []

        def follow(self, mouths: int) -> Predictor:
            assert mouths == 2
            return self

        def update(self, mouths: np.ndarray) -> None:
            self.taken.append(mouths[0])

        def forecast(self, recent: np.ndarray, horizon: int) -> np.ndarray:
            self.asked.append((len(self.taken), recent[0]))
            return np.full((2, horizon, 3), float(len(self.asked)))

    path, predictor = motion_of("dyskinetic"), Predictor()
    made, shorter = follow_tracks(predictor, [track_of(path, 101), track_of(path, 80)])
    np.testing.assert_array_equal(made[:, 0, 0], np.arange(1, 102))
    np.testing.assert_array_equal(shorter, made[:80])
    frames = np.arange(61) * FRAME_PERIOD  # until 2 s
    np.testing.assert_allclose(predictor.taken, path(frames), atol=EXACT)
    for step, (taken, recent) in enumerate(predictor.asked):
        assert taken == math.floor(step * 0.02 / FRAME_PERIOD + 1e-6) + 1
        then = step * 0.02 - np.array([2, 1, 0]) * FRAME_PERIOD
        np.testing.assert_allclose(recent, path(np.maximum(then, 0.0)), atol=EXACT)


def test_residual_without_its_package_is_refused_before_any_work(
    recorded: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(perception, "PATH_PREDICTOR", "no_such_package.paths:fit")
    corruption = Corruption(prediction="residual")
    spec = ObservationSpec("current_pred", 8, cameras=(), corruption=corruption)
    for opened in (
        lambda: make_env("FeedingEnv", **spec.env_kwargs()),
        lambda: load_demonstrations(recorded, spec),
    ):
        with pytest.raises(RequestError, match=r"prediction residual: .*face-prediction"):
            opened()


def test_without_a_seed_forecasts_go_with_the_episode() -> None:
    kwargs = {"obs": "current_pred", "cameras": (), "corruption": {"prediction": "shuffled"}}
    with closing(make_env("FeedingEnv", **kwargs)) as env:
        env.reset(seed=3)
        world, shown = world_of(env), []
        for _ in range(2):
            env.reset()
            forecast = world.state().predicted_target
            assert forecast is not None
            shown.append(forecast - world.mouth_track[0])
        assert not np.allclose(*shown)


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        (
            {"corruption": {"prediction": "psychic"}},
            "prediction 'psychic'.*constant_velocity.*truth",
        ),
        ({"corruption": {"prediction": "kalman", "error": "uniform"}}, "goes without an error"),
        ({"corruption": {"prediction": "kalman", "error": "model"}}, "goes without an error"),
        ({"obs": "current", "corruption": {"prediction": "kalman"}}, "'current' shows none"),
        ({"obs": "history", "corruption": {"prediction": "kalman"}}, "the prediction truth"),
        ({"obs": "baseline", "corruption": {"prediction": "kalman"}}, "'kalman' corrupts"),
        (
            {"face_motion": "after_lift", "corruption": {"prediction": "kalman"}},
            "face_motion 'after_lift': forecasters need .* choose face_motion episode",
        ),
    ],
)
def test_what_cannot_be_forecast_is_refused(kwargs: dict[str, Any], message: str) -> None:
    with pytest.raises(RequestError, match=message):
        make_env("FeedingEnv", **{"obs": "current_pred", "cameras": (), **kwargs})


def test_files_whose_motion_is_not_at_hand_are_refused() -> None:
    with pytest.raises(RequestError, match="after_lift"):
        MotionForecasters.of_kwargs({"face_motion": "after_lift"})
    with pytest.raises(RequestError, match=r"'gone\.npz' does not exist"):
        MotionForecasters.of_kwargs({"motion_library": "gone.npz"})
    with pytest.raises(RequestError, match="holds other motion"):
        MotionForecasters.of_kwargs({"motion_sha256": "0" * 64})
    with pytest.raises(RequestError, match="forecaster 'truth'"):
        forecasters("dyskinetic").forecast_track("truth", np.zeros((2, 25, 3)), 0)
    # A computed motion needs no recording.
    assert MotionForecasters.of_kwargs({"motion": "sway", "motion_library": "gone.npz"})
