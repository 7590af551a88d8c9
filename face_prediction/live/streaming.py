"""Forecasts from every new frame, whatever the camera's rate.

Everything is counted back from the newest frame, so that nothing waits for a later one: the
history is the landmarks 0, 1, 2, ... thirtieths of a second before it, between two frames on the
straight line, and before the first frame at rest.

Legend: N frames with the face, T frames of history, H horizon, L = 468 landmarks, P images at the
end of the history, S their side.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from face_prediction.dataset.histories import dataset_image
from face_prediction.dataset.sequences import SequenceSettings, nearest
from face_prediction.prediction.interface import (
    FaceFollower,
    ImageNeeds,
    Predictor,
    StatefulPredictor,
)
from face_prediction.tracking.extract import MAX_GAP, SAME_TIME
from face_prediction.tracking.geometry import Crop, crop_around, image_points
from face_prediction.tracking.tracks import NUM_LANDMARKS
from robo_manip_baselines.runs.errors import RequestError

if TYPE_CHECKING:
    import torch

    from face_prediction.models.interface import PredictorModel

SIZE_CHANGE = 1.25
"""A new crop is laid when the side of the old one is this many times what it would be now, or one
such part of it."""


def times_back(now: float, count: int, fps: float) -> NDArray[np.float64]:
    """The last ``count`` times (T,) of a history that ends at ``now``, the newest last."""
    return now - np.arange(count - 1, -1, -1) / fps


def landmarks_at(
    wanted: NDArray[np.floating], times: NDArray[np.float64], landmarks: NDArray[np.floating]
) -> NDArray[np.float64]:
    """Landmarks (T, L, C) at ``wanted`` (T,) s, of those (N, L, C) at increasing ``times`` (N,) s.

    None is wanted after the last; a time less than a millisecond from a frame's is that frame's.
    """
    after = np.clip(np.searchsorted(times, wanted - SAME_TIME), 0, len(times) - 1)
    before = np.maximum(after - 1, 0)
    gap = times[after] - times[before]
    weight = np.divide(wanted - times[before], gap, out=np.ones_like(wanted), where=gap > 0)
    # a time at a frame takes nothing from its neighbour, and one before the first has none
    weight = np.where(times[after] - wanted < SAME_TIME, 1.0, np.clip(weight, 0.0, 1.0))
    result = landmarks[after].astype(np.float64)
    made = weight < 1.0
    part = weight[made, None, None]
    result[made] = (1 - part) * landmarks[before[made]] + part * result[made]
    return result


@dataclass(frozen=True)
class LandmarkForecaster:
    """Forecasts of a predictor that looks at no images."""

    predictor: Predictor
    horizon: int
    needs = ImageNeeds(frames=0, size=0)

    def forecast(self, landmarks: NDArray[np.float32]) -> NDArray[np.float32]:
        """Landmarks (H, L, 2) after those (T, L, 2)."""
        return self.predictor.predict(landmarks[None], None, self.horizon).landmarks[0]


@dataclass(frozen=True)
class FollowingForecaster:
    """Forecasts of a predictor that keeps learning from the face for as long as it is watched."""

    predictor: StatefulPredictor
    horizon: int
    needs = ImageNeeds(frames=0, size=0)


class NetworkForecaster:
    """Features and forecasts of one network on its device; each image is encoded once.

    Raises:
        RequestError: the network forecasts no landmarks.
    """

    def __init__(self, network: PredictorModel, name: str) -> None:
        self._network, self._name = network.eval(), name
        self._device = next(network.parameters()).device
        self.needs = network.needs
        # a first run, which takes longer than others, before a camera waits for it
        still = np.zeros((network.history, NUM_LANDMARKS, 2), dtype=np.float32)
        black = np.zeros((self.needs.size, self.needs.size, 3), dtype=np.uint8)
        self.forecast(still, [self.features(still[0], black)] * self.needs.frames)

    def features(self, landmarks: NDArray[np.float32], image: NDArray[np.uint8]) -> torch.Tensor:
        """Features (1, 1, ...) of one frame, from its landmarks (L, 2) and image (S, S, 3)."""
        import torch

        with torch.inference_mode():
            return self._network.encode(self._tensor(landmarks[None]), self._tensor(image[None]))

    def forecast(
        self, landmarks: NDArray[np.float32], features: list[torch.Tensor]
    ) -> NDArray[np.float32]:
        """Landmarks (H, L, 2) after those (T, L, 2), with the features of P frames."""
        import torch

        with torch.inference_mode():
            seen = self._tensor(landmarks[-self._network.history :])
            joined = torch.cat(features, dim=1)
            ahead = self._network.decode(seen, joined, make_images=False).landmarks
        if ahead is None:
            raise RequestError(f"{self._name}: forecasts images and no landmarks; use another")
        return ahead[0].float().cpu().numpy()

    def _tensor(self, values: NDArray[Any]) -> torch.Tensor:
        """A batch of one, on the network's device."""
        import torch

        return torch.from_numpy(np.ascontiguousarray(values))[None].to(self._device)


AnyForecaster = LandmarkForecaster | FollowingForecaster | NetworkForecaster


@dataclass
class _Frame:
    """One frame with the face.

    Attributes:
        time: s.
        landmarks: (L, 3) normalised image coordinates.
        box: (2, 2) least and largest x, y of them.
        image: None where nobody looks at it, or not any more.
        cut: (S, S, 3) of it at the present crop, once needed, and ``features`` of the network.
    """

    time: float
    landmarks: NDArray[np.floating]
    box: NDArray[np.floating]
    image: NDArray[np.uint8] | None
    cut: NDArray[np.uint8] | None = None
    features: Any = None


@dataclass(frozen=True)
class LiveForecast:
    """Forecast from the newest frame.

    Attributes:
        landmarks: (H, L, 2) normalised image coordinates.
        crop: the part of the image that the predictor sees.
        is_new_crop: the crop was laid with this frame.
        known: frames of the history that were seen, T when it is whole.
    """

    landmarks: NDArray[np.float64]
    crop: Crop
    is_new_crop: bool
    known: int


class StreamingPredictor:
    """Forecasts from every frame, as the predictor would from the whole history.

    The crop is laid around the faces of the history and then stands still: while it does, the
    features of past frames stay true, and a new frame costs one encoding. Another one is laid when
    the face leaves it, or when its size has become wrong (`SIZE_CHANGE`); images are then cut out
    and encoded again, of all frames that still count.

    A face that is gone for more than `MAX_GAP` seconds is forgotten, with its history. Between
    frames further apart than that nothing is known either.

    Settings are of the sequences that the forecaster was trained on: history, rate, margin, images.
    """

    def __init__(self, forecaster: AnyForecaster, settings: SequenceSettings) -> None:
        self._forecaster, self._settings = forecaster, settings
        self.reset()

    def reset(self) -> None:
        """Forget everything."""
        self._frames: deque[_Frame] = deque()
        self._crop: Crop | None = None
        self._follower: FaceFollower | None = None
        self._followed = 0.0  # s, until when the follower is up to date

    def update(
        self, time: float, landmarks: NDArray[np.floating] | None, image: NDArray[np.uint8]
    ) -> LiveForecast | None:
        """Take one frame in, and forecast the next ones; None: there is no face.

        Args:
            time: s, later than that of the frame before.
            landmarks: (L, 3) normalised image coordinates of the face; None: it was not found.
            image: (rows, columns, 3) uint8 RGB.

        Raises:
            ValueError: the time is not later.
        """
        if self._frames and time <= self._frames[-1].time:
            raise ValueError(f"a frame at {time} s after one at {self._frames[-1].time} s")
        if self._frames and time - self._frames[-1].time > MAX_GAP + SAME_TIME:
            self.reset()
        frames = self._frames
        if landmarks is None:
            return None
        needs = self._forecaster.needs
        box = np.stack([landmarks[:, :2].min(axis=0), landmarks[:, :2].max(axis=0)])
        frames.append(_Frame(time, landmarks, box, image if needs.frames else None))
        wanted = times_back(time, self._settings.history, self._settings.fps)
        while len(frames) > 1 and frames[1].time < wanted[0] - SAME_TIME:
            frames.popleft()  # no time of the history lies next to it any more
        times = np.array([frame.time for frame in frames])
        points = np.stack([frame.landmarks for frame in frames])
        size = (image.shape[1], image.shape[0])
        crop, is_new = self._lay_crop(float(wanted[0]), size)
        known = int(np.sum(wanted >= times[0] - SAME_TIME))
        if isinstance(self._forecaster, FollowingForecaster):
            ahead = self._follow(self._forecaster, times, points, size) / size
            return LiveForecast(ahead, crop, is_new, known)
        history = crop.normalise(landmarks_at(wanted, times, points), size)
        history = history[..., :2].astype(np.float32)
        if isinstance(self._forecaster, LandmarkForecaster):
            ahead = self._forecaster.forecast(history)
        else:
            features = self._features(self._forecaster, crop, wanted, times, size)
            ahead = self._forecaster.forecast(history, features)
            for frame in frames:  # too old to be looked at again, whatever the crop will be
                if frame.time < wanted[-needs.frames] - MAX_GAP - SAME_TIME:
                    frame.image = frame.cut = None
        return LiveForecast(image_points(crop, ahead, size), crop, is_new, known)

    def _follow(
        self,
        forecaster: FollowingForecaster,
        times: NDArray[np.float64],
        points: NDArray[np.floating],
        size: tuple[int, int],
    ) -> NDArray[np.floating]:
        """Landmarks (H, L, 2) ahead in pixels, by what was learnt at a constant rate so far.

        The predictor learns on a clock of its own, which began with the face; it forecasts from
        frames counted back from the newest one.
        """
        period, predictor = 1 / self._settings.fps, forecaster.predictor
        if self._follower is None:
            self._follower, self._followed = predictor.follow(), times[-1] - period
        ticks = int((times[-1] + SAME_TIME - self._followed) / period)
        due = self._followed + period * np.arange(1, ticks + 1)
        for landmarks in landmarks_at(due, times, points):
            self._follower.update(landmarks[:, :2] * size)
        self._followed += period * ticks
        back = times_back(float(times[-1]), predictor.recent, self._settings.fps)
        recent = landmarks_at(back, times, points)[..., :2] * size
        return self._follower.forecast(recent, forecaster.horizon)

    def _lay_crop(self, oldest: float, size: tuple[int, int]) -> tuple[Crop, bool]:
        """The old crop, or one around the faces since ``oldest``; whether it is new."""
        boxes = [frame.box for frame in self._frames if frame.time > oldest - SAME_TIME]
        fresh = crop_around(np.stack(boxes), size, self._settings.margin)
        if self._crop is not None:
            corners = np.pad(boxes[-1], ((0, 0), (0, 1)))  # a depth, which does not count
            newest = self._crop.normalise(corners, size)[:, :2]
            inside = bool(np.all((newest >= 0.0) & (newest <= 1.0)))
            if inside and 1 / SIZE_CHANGE <= self._crop.side / fresh.side <= SIZE_CHANGE:
                return self._crop, False
        self._crop = fresh
        for frame in self._frames:
            frame.cut = frame.features = None
        return fresh, True

    def _features(
        self,
        network: NetworkForecaster,
        crop: Crop,
        wanted: NDArray[np.float64],
        times: NDArray[np.float64],
        size: tuple[int, int],
    ) -> list[Any]:
        """Features of the frames nearest to the last P of the ``wanted`` times."""
        chosen = nearest(wanted[-network.needs.frames :], times).tolist()
        for number in sorted(set(chosen)):
            frame = self._frames[number]
            if frame.features is None:
                points = crop.normalise(frame.landmarks, size)[:, :2].astype(np.float32)
                frame.features = network.features(points, self._cut(frame, crop))
        return [self._frames[number].features for number in chosen]

    def _cut(self, frame: _Frame, crop: Crop) -> NDArray[np.uint8]:
        """The image (S, S, 3) of a frame that the network sees."""
        if frame.cut is None:
            assert frame.image is not None
            size = self._forecaster.needs.size
            frame.cut = dataset_image(frame.image, crop, self._settings, size)
        return frame.cut
