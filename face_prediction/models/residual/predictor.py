"""Residual prediction as a `Predictor`: histories, whole tracks, or one face as it is watched.

Everything is in face sides, the side of the crop that would be laid around the face of the first
frame, so that neither the size of an image nor of a crop changes a forecast.

Shapes: B histories, T frames, L = 468 landmarks, D series, H frames ahead, W recent frames.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from face_prediction.forecast.interface import mouth_centre
from face_prediction.models.residual.adaptive import (
    BANDS,
    FaceState,
    LinearFit,
    PeopleFit,
    StateForecast,
)
from face_prediction.models.residual.experts import (
    EXPERTS,
    SERIES,
    SHAPES,
    Floats,
    frames_needed,
)
from face_prediction.models.residual.intervals import (
    LEVELS,
    SIGNS,
    IntervalFit,
    IntervalTracker,
)
from face_prediction.prediction.interface import Forecast, ImageNeeds, TrackForecast
from face_prediction.tracking.geometry import LIPS
from face_prediction.tracking.tracks import NUM_LANDMARKS
from robo_manip_baselines.runs.errors import RequestError

HORIZON = 24
"""Most frames ahead."""
_LIPS = list(LIPS)
_MARGIN = 0.1  # of a crop around a face, as `SequenceSettings.margin`
_HISTORIES = 64  # followed at once: a bound on memory


def face_side(landmarks: NDArray[np.floating]) -> Floats:
    """Side (...) of the crop around landmarks (..., L, 2), in their unit."""
    return np.ptp(landmarks, axis=-2).max(axis=-1).astype(np.float64) * (1 + 2 * _MARGIN)


def face_series(landmarks: NDArray[np.floating], basis: Floats) -> Floats:
    """Series (..., D) of landmarks (..., L, 2): mouth centre, and coefficients of shapes."""
    flat = landmarks.reshape(*landmarks.shape[:-2], -1).astype(np.float64)
    return np.concatenate([mouth_centre(landmarks), flat @ basis.T], axis=-1)


@dataclass(frozen=True)
class ResidualFit:
    """All numbers of residual prediction.

    Attributes:
        basis: (K, 2 L) orthonormal principal shapes.
        people: experts' coefficients and errors.
        intervals: sizes of errors.
    """

    basis: Floats
    people: PeopleFit
    intervals: IntervalFit

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Return the numbers by name, for a file; `from_arrays` undoes it."""
        people, intervals = self.people, self.intervals
        result: dict[str, NDArray[Any]] = {
            "basis": self.basis,
            "horizons": people.horizons,
            "usual": people.usual,
            "pace": np.array([people.pace]),
            "size": intervals.size,
            "quantiles": intervals.quantiles,
        }
        for index, fit in enumerate(people.linear):
            result |= {f"scale_{index}": fit.scale, f"people_{index}": fit.people}
            if fit.precision is not None:
                result[f"precision_{index}"] = fit.precision
        return {name: np.ascontiguousarray(array) for name, array in result.items()}

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, NDArray[Any]]) -> ResidualFit:
        """Undo `arrays`.

        Raises:
            RequestError: they are not those of this release's experts.
        """
        wanted = array_shapes(len(arrays.get("horizons", ())))
        found = {name: array.shape for name, array in arrays.items()}
        if found != wanted:
            names = sorted(n for n in {*found, *wanted} if found.get(n) != wanted.get(n))
            raise RequestError(
                f"weights of residual: {', '.join(names)} not as expected; fit it again"
            )
        linear = tuple(
            LinearFit(
                expert,
                arrays[f"scale_{index}"],
                arrays[f"people_{index}"],
                arrays.get(f"precision_{index}"),
            )
            for index, expert in enumerate(EXPERTS)
        )
        people = PeopleFit(
            arrays["horizons"].astype(np.int64),
            linear,
            arrays["usual"],
            float(arrays["pace"][0]),
        )
        return cls(arrays["basis"], people, IntervalFit(arrays["size"], arrays["quantiles"]))


def array_shapes(knots: int) -> dict[str, tuple[int, ...]]:
    """Shapes of `ResidualFit.arrays` with ``knots`` horizons."""
    shapes: dict[str, tuple[int, ...]] = {
        "basis": (SHAPES, 2 * NUM_LANDMARKS),
        "horizons": (knots,),
        "usual": (len(EXPERTS) + 1, knots, 2),
        "pace": (1,),
        "size": (knots, 2, SIGNS + 1),
        "quantiles": (knots, 2, len(LEVELS)),
    }
    for index, expert in enumerate(EXPERTS):
        shapes |= {
            f"scale_{index}": (expert.size,),
            f"people_{index}": (knots, expert.size, SERIES),
        }
        if not expert.iterated:
            shapes[f"precision_{index}"] = (len(BANDS), expert.size, expert.size)
    return shapes


class FollowedFaces:
    """State of faces that are seen for the first time together: experts and intervals.

    Args:
        fit: of the training people.
        faces: how many.
        horizon: frames ahead that are forecast.
    """

    def __init__(self, fit: ResidualFit, faces: int, horizon: int = HORIZON) -> None:
        people = fit.people.until(horizon)
        self.knots = people.horizons
        self._state = FaceState(people, faces)
        self._intervals = IntervalTracker(
            fit.intervals.until(len(self.knots)), faces, int(self.knots[-1])
        )
        self._horizon = horizon

    def keep(self, faces: int) -> None:
        """Go on with the first so many faces."""
        self._state.keep(faces)
        self._intervals.keep(faces)

    def take(self, series: Floats) -> StateForecast:
        """Take in the next frame (B, D) in face sides; return the forecast from it."""
        self._state.take(series)
        ages = self._state.mixture.known()
        if len(ages):
            made, truth = self._state.outcomes()
            self._intervals.learn(made - truth, ages)
        forecast = self._state.forecast()
        self._state.remember(forecast)
        self._intervals.remember(forecast.signs)
        return forecast

    def from_recent(self, recent: Floats) -> StateForecast:
        """Forecast from recent frames (B, W, D) that need not be those that were taken in."""
        return self._state.forecast(recent)

    def moved(self, forecast: StateForecast) -> Floats:
        """Displacements (B, H, D) of every frame ahead."""
        return every_frame(forecast.moved, self.knots, self._horizon)

    def student_t(self, forecast: StateForecast) -> tuple[Floats, Floats]:
        """Scale and degrees of freedom (B, H, 2) of the mouth's error in every frame ahead."""
        scale, freedom = self._intervals.student_t(forecast.signs)
        return (
            every_frame(scale, self.knots, self._horizon),
            every_frame(freedom, self.knots, self._horizon),
        )


def every_frame(values: Floats, knots: NDArray[np.int64], horizon: int) -> Floats:
    """Values (B, H, ...) in every frame ahead, linear between those (B, K, ...) at knots (K,)."""
    frames = np.arange(1, horizon + 1)
    after = np.searchsorted(knots, frames)
    before = np.maximum(after - 1, 0)
    width = np.maximum(knots[after] - knots[before], 1)
    share = 1 - (knots[after] - frames) / width
    share = share.reshape(-1, *[1] * (values.ndim - 2))
    return (1 - share) * values[:, before] + share * values[:, after]


class ResidualPredictor:
    """`StatefulPredictor` on the fitted numbers.

    Attributes:
        fit: the numbers.
    """

    name = "residual"
    memory = None
    needs = ImageNeeds(frames=0, size=0)
    horizon = HORIZON
    recent = frames_needed(EXPERTS)

    def __init__(self, fit: ResidualFit) -> None:
        self.fit = fit

    def predict(
        self, landmarks: NDArray[np.floating], images: NDArray[np.uint8] | None, horizon: int
    ) -> Forecast:
        """Forecast ``horizon`` frames after histories; see `Predictor`. Images are not used.

        Raises:
            RequestError: a shape is another one, landmarks hold NaN or infinity, or the horizon is
                longer than 24.
        """
        landmarks = np.asarray(landmarks)
        if landmarks.ndim != 4 or landmarks.shape[2:] != (NUM_LANDMARKS, 2) or not landmarks.size:
            expected = f"(histories, frames, {NUM_LANDMARKS}, 2)"
            raise RequestError(f"landmarks of shape {landmarks.shape}; expected {expected}")
        require_horizon(horizon)
        if not np.all(np.isfinite(landmarks)):
            raise RequestError("landmarks: NaN or infinity; leave out frames without a face")
        parts = [
            self._predict(landmarks[first : first + _HISTORIES], horizon)
            for first in range(0, len(landmarks), _HISTORIES)
        ]
        ahead, scale, freedom = (np.concatenate(part) for part in zip(*parts, strict=True))
        return Forecast(
            ahead.astype(np.float32), None, scale.astype(np.float32), freedom.astype(np.float64)
        )

    def _predict(
        self, landmarks: NDArray[np.floating], horizon: int
    ) -> tuple[Floats, Floats, Floats]:
        """Landmarks (B, H, L, 2), scale and degrees of freedom (B, H, 2)."""
        side = face_side(landmarks[:, 0])[:, None, None]
        series = face_series(landmarks, self.fit.basis) / side
        faces = FollowedFaces(self.fit, len(landmarks), horizon)
        for frame in range(series.shape[1] - 1):
            faces.take(series[:, frame])
        forecast = faces.take(series[:, -1])
        moved = faces.moved(forecast) * side
        scale, freedom = faces.student_t(forecast)
        return moved_landmarks(landmarks[:, -1], moved, self.fit.basis), scale * side, freedom

    def forecast_tracks(
        self, tracks: Sequence[NDArray[np.floating]], horizon: int
    ) -> list[TrackForecast]:
        """Forecast the mouth from every frame of tracks; see `StatefulPredictor`.

        Raises:
            RequestError: the horizon is longer than 24.
        """
        require_horizon(horizon)
        sides = [float(face_side(track[0])) for track in tracks]
        series = [
            face_series(track, self.fit.basis) / side
            for track, side in zip(tracks, sides, strict=True)
        ]
        shapes = [(len(track), horizon, 2) for track in tracks]
        result = [TrackForecast(*(np.empty(shape) for _ in range(3))) for shape in shapes]
        for frame, numbers, faces, forecast in follow_tracks(self.fit, series, horizon):
            moved, (scale, freedom) = faces.moved(forecast), faces.student_t(forecast)
            for place, number in enumerate(numbers):
                made, side = result[number], sides[number]
                made.mouth[frame] = side * moved[place, :, :2]
                assert made.scale is not None
                assert made.degrees_of_freedom is not None
                made.scale[frame] = side * scale[place]
                made.degrees_of_freedom[frame] = freedom[place]
        return result

    def follow(self) -> FollowedFace:
        """Return the state of a face that is seen for the first time."""
        return FollowedFace(self.fit)


class FollowedFace:
    """`FaceFollower` of residual prediction."""

    def __init__(self, fit: ResidualFit) -> None:
        self._fit, self._faces, self._side = fit, FollowedFaces(fit, 1), 0.0

    def update(self, landmarks: NDArray[np.floating]) -> None:
        """Take in the next frame, (L, 2)."""
        self._side = self._side or float(face_side(landmarks))
        self._faces.take(face_series(landmarks[None], self._fit.basis) / self._side)

    def forecast(self, recent: NDArray[np.floating], horizon: int) -> Floats:
        """Forecast (H, L, 2) from recent frames (W, L, 2); see `FaceFollower`."""
        require_horizon(horizon)
        series = face_series(recent[None], self._fit.basis) / self._side
        moved = self._faces.moved(self._faces.from_recent(series))[:, :horizon] * self._side
        return moved_landmarks(recent[None, -1], moved, self._fit.basis)[0]


def follow_tracks(
    fit: ResidualFit, series: Sequence[Floats], horizon: int
) -> Iterator[tuple[int, list[int], FollowedFaces, StateForecast]]:
    """Follow tracks (T, D), in face sides, side by side.

    Yields:
        Number of the frame, numbers of the tracks that have it, their state, and the forecast.
    """
    order = sorted(range(len(series)), key=lambda number: -len(series[number]))
    for first in range(0, len(order), _HISTORIES):
        chosen = order[first : first + _HISTORIES]
        faces = FollowedFaces(fit, len(chosen), horizon)
        for frame in range(len(series[chosen[0]])):
            alive = [number for number in chosen if len(series[number]) > frame]
            if len(alive) < len(chosen):
                faces.keep(len(alive))
                chosen = alive
            forecast = faces.take(np.stack([series[number][frame] for number in alive]))
            yield frame, alive, faces, forecast


def moved_landmarks(landmarks: NDArray[np.floating], moved: Floats, basis: Floats) -> Floats:
    """Landmarks (B, H, L, 2) of the last ones (B, L, 2) and displacements (B, H, D), in one unit.

    The mouth of the shapes is not quite the one that is forecast: the lips go the rest of the way
    as one piece.
    """
    last = landmarks.astype(np.float64)[:, None]
    ahead = last + (moved[..., 2:] @ basis).reshape(*moved.shape[:2], NUM_LANDMARKS, 2)
    rest = mouth_centre(last) + moved[..., :2] - mouth_centre(ahead)
    ahead[..., _LIPS, :] += rest[..., None, :]
    return ahead


def require_horizon(horizon: int) -> None:
    """Raise RequestError unless ``horizon`` frames can be forecast."""
    if not 1 <= horizon <= HORIZON:
        raise RequestError(f"horizon {horizon}: residual forecasts 1 to {HORIZON}")
