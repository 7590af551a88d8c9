"""Causal forecasters of the mouth, and a control that knows nothing of it.

They know the mouth in video frames of 1/30 s up to the newest one seen, without noise. All but two
are linear: a matrix of weights for each horizon, applied to the frames seen. ``residual`` is a
predictor that keeps learning from the mouth that it follows, of another package (`perception`), and
``shuffled`` moves as in another episode. What is fitted, is fitted for each motion to episodes that
neither demonstrations nor evaluations use; of recorded motion these are other starts in the same
recordings, and with people apart, in those of the people of demonstrations.

Legend: H frames ahead at most, N frames seen, E episodes, T frames of a path or control steps of an
episode, K frames from now to the longest one known, D state.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from robo_manip_baselines.envs.mujoco.cell.scene import CONTROL_PERIOD
from robo_manip_baselines.envs.mujoco.face.motion import (
    SEGMENT_DURATION,
    MotionLibrary,
    MotionSegment,
)
from robo_manip_baselines.envs.mujoco.face.motions import FaceMotion, parse_motion
from robo_manip_baselines.envs.mujoco.face.perception import PathPredictor, find_path_predictor
from robo_manip_baselines.envs.mujoco.face.replay import FRAMES_AHEAD
from robo_manip_baselines.observation import FORECASTERS, FRAME_PERIOD, MAX_HORIZON
from robo_manip_baselines.runs.autoregression import forecast, moments, solve
from robo_manip_baselines.runs.errors import RequestError, require_choice
from robo_manip_baselines.runs.seeds import derive_seed

Floats = NDArray[np.float64]
Path3D = Callable[[ArrayLike], Floats]
"""The mouth, (..., 3) m, at times (...) s."""

MAX_LEAD = MAX_HORIZON
"""H, frames ahead that a forecast is asked for at most."""

FIT_EPISODES = 48
"""E, of which the first three quarters are fitted to and the others choose what is fitted."""

FIT_HORIZON = 8
"""Frames ahead at which the error of forecasts is least for the settings that are chosen."""

ORDERS = (2, 4, 8, 16)
"""Orders of autoregression to choose from."""

KALMAN_MEMORY = 45
"""Frames that a Kalman filter looks back; its gains are those of an endless past."""

NOISE_RATIOS = tuple(10.0 ** np.arange(-5.0, 5.0))
"""Process noise by measurement noise, in frames, to choose from."""

STEPS_TO_MEET, FRAMES_TO_MEET = 5, 3
"""Control steps and video frames, 0.1 s each, after which the two clocks meet again."""


@dataclass(frozen=True, eq=False)
class LinearForecaster:
    """Forecast that is linear in the frames seen.

    Attributes:
        weights: (H + 1, N, 3, 3): the mouth h frames ahead is the sum over k of
            ``weights[h, k] @ mouth[k]``, the newest frame being k = 0.
    """

    weights: Floats

    def __call__(self, mouth: Path3D, seen: float, ahead: float) -> Floats:
        """Return the mouth (3,) m, ``ahead`` s after the newest frame, seen at ``seen`` s.

        Between two horizons it is interpolated.

        Raises:
            ValueError: it is further ahead than H frames.
        """
        frames = mouth(seen - FRAME_PERIOD * np.arange(self.weights.shape[1]))
        return np.einsum("nij,nj->i", self._weights_at(ahead / FRAME_PERIOD), frames)

    def ahead_of(self, paths: Floats, horizon: int) -> Floats:
        """Return forecasts (E, T - N + 1, 3) m, ``horizon`` frames ahead of paths (E, T, 3) m.

        The first one is that of the first frame with N - 1 others before it.
        """
        count = self.weights.shape[1]
        seen = np.lib.stride_tricks.sliding_window_view(paths, count, axis=1)[..., ::-1]
        return np.einsum("nij,etjn->eti", self.weights[horizon], seen, optimize=True)

    def error(self, paths: Floats, horizon: int) -> float:
        """Return the root mean square, m, of the error of `ahead_of`."""
        first = self.weights.shape[1] - 1 + horizon
        error = self.ahead_of(paths, horizon)[:, : paths.shape[1] - first] - paths[:, first:]
        return math.sqrt(float((error**2).sum(axis=-1).mean()))

    def _weights_at(self, frames: float) -> Floats:
        last = len(self.weights) - 1
        # A millionth of a frame for times that are meant to be those of frames.
        if not -1e-6 <= frames <= last + 1e-6:
            raise ValueError(f"{frames} frames ahead: must be 0 to {last}")
        low = min(max(math.floor(frames + 1e-6), 0), last)
        share = frames - low
        if abs(share) < 1e-5:
            return self.weights[low]
        return (1.0 - share) * self.weights[low] + share * self.weights[low + 1]


def _each_axis(weights: Floats) -> LinearForecaster:
    """Return the forecaster that applies weights (H + 1, N) to each axis by itself."""
    return LinearForecaster(weights[:, :, None, None] * np.eye(3))


def persistence() -> LinearForecaster:
    """Make the forecast that the mouth stays where it was seen."""
    return _each_axis(np.ones((MAX_LEAD + 1, 1)))


def constant_velocity() -> LinearForecaster:
    """Make the forecast that the mouth goes on as from the last frame to the newest."""
    ahead = np.arange(MAX_LEAD + 1.0)
    return _each_axis(np.stack([1.0 + ahead, -ahead], axis=1))


def autoregression(coefficients: Floats) -> LinearForecaster:
    """Make a vector autoregression on displacements, see `runs.autoregression`.

    Args:
        coefficients: (P, 3, 3).
    """
    order = len(coefficients)
    # The response to a displacement of 1 m, k frames ago, along each axis.
    unit = np.eye(3 * order).reshape(order, 3, order, 3)[:, :, ::-1]
    moved = forecast(coefficients, unit.reshape(3 * order, order, 3), MAX_LEAD).cumsum(axis=1)
    response = moved.reshape(order, 3, MAX_LEAD, 3).transpose(2, 0, 3, 1)
    weights = np.zeros((MAX_LEAD + 1, order + 1, 3, 3))
    weights[1:, :-1] = response
    weights[1:, 1:] -= response
    weights[:, 0] += np.eye(3)
    return LinearForecaster(weights)


def kalman(size: int, noise_ratio: float) -> LinearForecaster:
    """Make a Kalman filter in its steady state, for each axis by itself.

    The state of an axis is position and velocity, or these and the acceleration; the derivative of
    the last one is white noise of density q, and frames have noise of variance r (Bar-Shalom, Li
    and Kirubarajan 2001, sections 6.2.2 and 6.2.3). The forecast is the state without noise.

    Args:
        size: D, 2 for constant velocity, 3 for constant acceleration.
        noise_ratio: q / r, time counted in frames.
    """
    from scipy.linalg import solve_discrete_are  # slow to import

    powers = np.subtract.outer(-np.arange(size), -np.arange(size))  # j - i
    factorial = np.array([math.factorial(n) for n in range(size)], dtype=np.float64)
    step = np.where(powers >= 0, 1.0 / factorial[np.abs(powers)], 0.0)
    # Integral over a frame of what noise in the highest derivative adds: t^(D-1-i) / (D-1-i)!
    up = size - 1 - np.arange(size)
    sums = np.add.outer(up, up) + 1.0
    noise = noise_ratio / (sums * np.multiply.outer(factorial[up], factorial[up]))
    seen = np.eye(1, size)
    covariance = solve_discrete_are(step.T, seen.T, noise, np.eye(1))
    gain = covariance[:, 0] / (covariance[0, 0] + 1.0)
    # The filter is run on each frame's part alone: column k for the frame that is k old.
    state = np.zeros((size, KALMAN_MEMORY))
    state[0, -1] = 1.0
    for age in range(KALMAN_MEMORY - 2, -1, -1):
        state = step @ state
        innovation = -state[0]
        innovation[age] += 1.0
        state += gain[:, None] * innovation
    ahead = np.arange(MAX_LEAD + 1.0)[:, None] ** np.arange(size) / factorial
    return _each_axis(ahead @ state)


def fit_autoregression(paths: Floats) -> LinearForecaster:
    """Fit an autoregression to paths (E, T, 3) m, of the order with the least error."""
    fitted, held_out = _split(paths)
    sums = moments(np.diff(fitted, axis=1), max(ORDERS))
    # Rounded, so that the number of threads of BLAS, which sums in another order, changes nothing.
    made = [autoregression(solve(sums, order, 3).round(6)) for order in ORDERS]
    return min(made, key=lambda forecaster: forecaster.error(held_out, FIT_HORIZON))


def fit_kalman(paths: Floats) -> LinearForecaster:
    """Choose the Kalman filter with the least error on paths (E, T, 3) m."""
    _, held_out = _split(paths)
    made = [kalman(size, ratio) for size in (2, 3) for ratio in NOISE_RATIOS]
    return min(made, key=lambda forecaster: forecaster.error(held_out, FIT_HORIZON))


def _split(paths: Floats) -> tuple[Floats, Floats]:
    count = 3 * len(paths) // 4
    return paths[:count], paths[count:]


@dataclass(frozen=True)
class MotionForecasters:
    """Forecasters of one motion of the face.

    Fitted parameters are a function of the motion, of the recordings it is drawn from, and of
    nothing else; a process fits each of them once.

    Attributes:
        motion: of the face.
        people: of whom nobody is evaluated, and whose motion is fitted to: ``all`` or ``train``.
        recordings: digest of the recorded motion; empty where the motion has none.
        library: of recorded motion.
    """

    motion: FaceMotion
    people: str
    recordings: str
    library: MotionLibrary = field(compare=False, repr=False)

    @classmethod
    def of(cls, motion: FaceMotion, library: MotionLibrary, people: str) -> MotionForecasters:
        """Return those of an environment with these arguments.

        Both parts of people are forecast by what was fitted to those of demonstrations.
        """
        recordings = library.motion_sha256 if motion.recorded else ""
        return cls(motion, "all" if people == "all" else "train", recordings, library)

    @classmethod
    def of_kwargs(cls, kwargs: Mapping[str, Any]) -> MotionForecasters:
        """Return those of an environment with arguments as episode files hold them.

        Raises:
            RequestError: the motion waits for its start, or the motion library is missing or
                another one.
        """
        require_no_waiting(kwargs.get("face_motion", "episode"))
        motion = parse_motion(kwargs.get("motion", "recorded"))
        if motion.recorded:
            library = MotionLibrary.load(kwargs.get("motion_library"))
            library.require(kwargs.get("motion_sha256"))
        else:
            library = MotionLibrary.load()  # of which nothing is used
        return cls.of(motion, library, kwargs.get("people", "all"))

    def linear(self, name: str) -> LinearForecaster:
        """Return a linear forecaster, fitted to the motion.

        Args:
            name: a key of ``LINEAR``.
        """
        return _fitted(name, self)

    def paths(self) -> Floats:
        """Draw the displacement of the mouth in episodes to fit to, (E, T, 3) m, in frames."""
        time = np.arange(round(SEGMENT_DURATION / FRAME_PERIOD)) * FRAME_PERIOD
        drawn = [self._draw(derive_seed(0, "fit", n)) for n in range(FIT_EPISODES)]
        return np.stack([segment.displacement_at(time) for segment in drawn])

    def another_episode(self, seed: int) -> MotionSegment:
        """Draw the motion of another episode than the one of ``seed``, for ``shuffled``."""
        return self._draw(derive_seed(seed, "shuffled"))

    def forecast_track(self, name: str, track: Floats, seed: int) -> Floats:
        """Return the forecasts, (T, H, 3) m, made at each control step of an episode.

        See `forecast_tracks`.
        """
        return self.forecast_tracks(name, [track], [seed])[0]

    def forecast_tracks(
        self, name: str, tracks: Sequence[Floats], seeds: Sequence[int]
    ) -> list[Floats]:
        """Return the forecasts, (T, H, 3) m, made at each control step of episodes.

        They are made of the mouth until then: the same whether a track is of an environment or of
        an episode file, whatever others are forecast with it, and up to any step whatever follows.
        Until as many frames have been seen as a forecaster uses, the mouth is forecast to stay
        where it is.

        Args:
            name: one of ``FORECASTERS``.
            tracks: (T, K, 3) m, the true mouth at each control step now, and in the frames to come,
                of which those are used that have passed when a forecast is made.
            seeds: of the episodes.

        Raises:
            RequestError: there is no such forecaster, or its package is missing.
        """
        require_choice("forecaster", name, FORECASTERS)
        if name == "residual":
            made = follow_tracks(_fitted_predictor(self), tracks)
        elif name == "shuffled":
            made = [self._shuffled(*episode) for episode in zip(tracks, seeds, strict=True)]
        else:
            made = [linear_forecasts(self.linear(name).weights, track) for track in tracks]
        # The face stands still after its motion, and so does the forecast.
        last = round(SEGMENT_DURATION / CONTROL_PERIOD)
        return [own[np.minimum(np.arange(len(own)), last)] for own in made]

    def require(self, name: str) -> None:
        """Require what a forecaster needs.

        Raises:
            RequestError: its package is missing.
        """
        if name == "residual":
            find_path_predictor()

    def _shuffled(self, track: Floats, seed: int) -> Floats:
        time = _step_times(len(track)) + FRAMES_AHEAD
        other = self.another_episode(seed).displacement_at(time)
        return track[:, :1] + other[:, 1:] - other[:, :1]

    def _draw(self, seed: int) -> MotionSegment:
        rng = np.random.default_rng(seed)
        return self.motion.draw(rng, self.library, seed=seed, people=self.people)


LINEAR: Mapping[str, Callable[[MotionForecasters], LinearForecaster]] = {
    "persistence": lambda _: persistence(),
    "constant_velocity": lambda _: constant_velocity(),
    "autoregression": lambda made: fit_autoregression(made.paths()),
    "kalman": lambda made: fit_kalman(made.paths()),
}
"""Name of a linear forecaster -> what makes it for a motion."""


@cache
def _fitted(name: str, forecasters: MotionForecasters) -> LinearForecaster:
    return LINEAR[name](forecasters)


@cache
def _fitted_predictor(forecasters: MotionForecasters) -> PathPredictor:
    return find_path_predictor()(forecasters.paths())


def linear_forecasts(weights: Floats, track: Floats) -> Floats:
    """Return the forecasts, (T, H, 3) m, of a linear forecaster at each control step.

    Args:
        weights: of `LinearForecaster`.
        track: (T, K, 3) m, as of `MotionForecasters.forecast_tracks`.
    """
    seen = frames_seen(track, weights.shape[1])
    # Summed by NumPy itself in a fixed order: BLAS rounds otherwise for another T.
    made = np.einsum("hnij,tnj->thi", weights[1:], seen)
    # A mouth that seems to start at once is no motion that anything was fitted to.
    is_early = _step_times(len(track))[:, 0] < (weights.shape[1] - 1) * FRAME_PERIOD - 1e-6
    made[is_early] = track[is_early, :1]
    return made


def follow_tracks(predictor: PathPredictor, tracks: Sequence[Floats]) -> list[Floats]:
    """Return the forecasts, (T, H, 3) m, of a predictor that follows the mouths of episodes.

    It takes in every video frame, and forecasts at every control step from the frames seen.

    Args:
        predictor: of paths.
        tracks: (T, K, 3) m, as of `MotionForecasters.forecast_tracks`.
    """
    longest = max(map(len, tracks))
    held = np.stack([track[np.minimum(np.arange(longest), len(track) - 1)] for track in tracks])
    seen = np.stack([frames_seen(track, predictor.recent)[:, ::-1] for track in held], axis=1)
    follower, frame = predictor.follow(len(tracks)), 0
    made = np.empty((len(tracks), longest, MAX_LEAD, 3))
    for step, recent in enumerate(seen):
        while STEPS_TO_MEET * frame <= FRAMES_TO_MEET * step:
            meeting, later = divmod(frame, FRAMES_TO_MEET)
            follower.update(held[:, STEPS_TO_MEET * meeting, later])
            frame += 1
        made[:, step] = follower.forecast(recent, MAX_LEAD)
    return [own[: len(track)] for own, track in zip(made, tracks, strict=True)]


def _step_times(count: int) -> NDArray[np.floating[Any]]:
    """Return (T, 1) s, the times of control steps."""
    return np.arange(count)[:, None] * CONTROL_PERIOD


def frames_seen(track: Floats, count: int) -> Floats:
    """Return the mouth in the frames seen at each control step, (T, N, 3) m, the newest first.

    The newest is that of the step itself, the others 1/30 s apart. The mouth was where it is first
    seen before the episode began.

    Args:
        track: (T, K, 3) m, the mouth at each control step now and in the next frames, K 3 or more.
        count: N.
    """
    lag, step = np.arange(count), np.arange(len(track))[:, None]
    meetings = -(-lag // FRAMES_TO_MEET)  # since then, rounded up: a step that knew the frame
    row = step - STEPS_TO_MEET * meetings
    seen = track[np.maximum(row, 0), np.where(row < 0, 0, FRAMES_TO_MEET * meetings - lag)]
    # Frames of the first 0.1 s that no step knew lie between those of the first step.
    fifths = np.where(row < 0, FRAMES_TO_MEET * step - STEPS_TO_MEET * lag, 0)  # of a frame
    early = fifths > 0
    low, part = np.divmod(fifths[early], STEPS_TO_MEET)
    before, after = track[0, low], track[0, low + 1]
    seen[early] = before + (part / STEPS_TO_MEET)[:, None] * (after - before)
    return seen


def require_no_waiting(face_motion: str) -> None:
    """Require that a motion starts with its episode, so that it has a past.

    Raises:
        RequestError: it does not.
    """
    if face_motion != "episode":
        raise RequestError(
            f"face_motion '{face_motion}': forecasters need a motion that starts with the episode; "
            "choose face_motion episode, or the prediction truth"
        )
