"""The landmarks seen so far at the predictor's rate, whatever the camera's is.

Everything is counted back from the newest frame, so that nothing waits for a later one: the
history is what was seen 0, 1, 2, ... thirtieths of a second before it, between two frames on the
straight line, and before the first frame at rest.

Legend: N frames seen, T frames of history, L = 468 landmarks.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from numpy.typing import NDArray

from face_prediction.dataset.histories import dataset_picture
from face_prediction.dataset.sequences import SequenceSettings
from face_prediction.prediction.interface import PictureNeeds, Predictor
from face_prediction.tracking.extract import MAX_GAP, SAME_TIME
from face_prediction.tracking.geometry import Crop, crop_around, image_points
from face_prediction.tracking.tracks import NUM_LANDMARKS
from robo_manip_baselines.runs.errors import RequestError

if TYPE_CHECKING:
    import torch

    from face_prediction.models.interface import PredictorModel


def times_back(now: float, count: int, fps: float) -> NDArray[np.float64]:
    """The last ``count`` times (T,) of a history that ends at ``now``, the newest last."""
    return now - np.arange(count - 1, -1, -1) / fps


def landmarks_at(
    wanted: NDArray[np.float64],
    times: NDArray[np.float64],
    landmarks: NDArray[np.floating],
) -> NDArray[np.float64]:
    """Landmarks (T, L, C) at ``wanted`` (T,), none later than the last of ``times``.

    Args:
        wanted: s; a time less than a millisecond from a frame's is that frame's.
        times: (N,) s, increasing.
        landmarks: (N, L, C).
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


def nearest(wanted: NDArray[np.float64], times: NDArray[np.float64]) -> NDArray[np.int64]:
    """Index (T,) of the frame nearest to each of ``wanted`` (T,); of two as near, the earlier."""
    after = np.clip(np.searchsorted(times, wanted), 0, len(times) - 1)
    before = np.maximum(after - 1, 0)
    is_later = wanted - times[before] > times[after] - wanted + SAME_TIME
    return np.where(is_later, after, before)


#: A crop is laid anew when its side is this many times, or one such part of, what it would be.
SIZE_CHANGE = 1.25


class Forecasting(Protocol):
    """What makes forecasts of a history, and features of its pictures, each picture once."""

    @property
    def needs(self) -> PictureNeeds:
        """Which pictures it looks at."""
        ...

    @property
    def span(self) -> int:
        """K."""
        ...

    def features(self, landmarks: NDArray[np.float32], pictures: NDArray[np.uint8]) -> Any:
        """Features of one frame, from landmarks (K, L, 2) and pictures (K, S, S, 3) up to it."""
        ...

    def forecast(
        self,
        landmarks: NDArray[np.float32],
        features: list[Any],
        last_picture: NDArray[np.uint8] | None,
    ) -> NDArray[np.float32]:
        """Landmarks (H, L, 2) after those (T, L, 2), with P - K + 1 frames' features."""
        ...


@dataclass(frozen=True)
class LandmarkForecasting:
    """A predictor that looks at no pictures."""

    predictor: Predictor
    horizon: int
    span: int = 1

    @property
    def needs(self) -> PictureNeeds:
        """None."""
        return PictureNeeds(frames=0, size=0)

    def features(self, landmarks: NDArray[np.float32], pictures: NDArray[np.uint8]) -> Any:
        """There are none."""
        raise NotImplementedError

    def forecast(
        self,
        landmarks: NDArray[np.float32],
        features: list[Any],
        last_picture: NDArray[np.uint8] | None,
    ) -> NDArray[np.float32]:
        """Landmarks (H, L, 2) after those (T, L, 2)."""
        return self.predictor.predict(landmarks[None], None, self.horizon).landmarks[0]


@dataclass
class _Seen:
    """One frame with the face; picture and features at the present crop, once they were needed.

    The image is None where nobody looks at it, or not any more.
    """

    time: float
    landmarks: NDArray[np.floating]  # (L, 3) normalised image coordinates
    box: NDArray[np.floating]  # (2, 2) least and largest x, y of them
    image: NDArray[np.uint8] | None
    picture: NDArray[np.uint8] | None = None
    features: Any = None


@dataclass(frozen=True)
class LiveForecast:
    """What is forecast from the newest frame."""

    #: (H, L, 2) normalised image coordinates
    landmarks: NDArray[np.float64]
    #: what the predictor sees of the image
    crop: Crop
    #: the crop was laid anew with this frame
    is_new_crop: bool
    #: frames of the history that were seen, T when it is whole
    known: int


class StreamingPredictor:
    """Forecasts from every frame, as the predictor would from the whole history.

    The crop is laid around the faces of the history and then stands still: while it does, the
    features of past frames stay true, and a new frame costs one encoding. It is laid anew when the
    face leaves it, or when its size has become wrong (`SIZE_CHANGE`); pictures and features of the
    frames that still count are then made again, at once.

    A face that is gone for more than `MAX_GAP` seconds is forgotten, with its history. Between
    frames further apart than that nothing is known either.

    Args:
        forecasting: what makes the forecasts.
        settings: of the sequences that it was trained on: history, rate, margin, pictures.
    """

    def __init__(self, forecasting: Forecasting, settings: SequenceSettings) -> None:
        self._forecasting = forecasting
        self._settings = settings
        self._seen: deque[_Seen] = deque()
        self._crop: Crop | None = None

    def reset(self) -> None:
        """Forget everything."""
        self._seen.clear()
        self._crop = None

    def update(
        self, time: float, landmarks: NDArray[np.floating] | None, image: NDArray[np.uint8]
    ) -> LiveForecast | None:
        """Take one frame in, and forecast what comes after it; None: there is no face.

        Args:
            time: s, later than that of the frame before.
            landmarks: (L, 3) normalised image coordinates of the face; None: it was not found.
            image: (rows, columns, 3) uint8 RGB.

        Raises:
            ValueError: the time is not later.
        """
        if self._seen and time <= self._seen[-1].time:
            raise ValueError(f"a frame at {time} s after one at {self._seen[-1].time} s")
        if self._seen and time - self._seen[-1].time > MAX_GAP + SAME_TIME:
            self.reset()
        if landmarks is None:
            return None
        needs = self._forecasting.needs
        across = landmarks[:, :2]
        box = np.stack([across.min(axis=0), across.max(axis=0)])
        self._seen.append(_Seen(time, landmarks, box, image if needs.frames else None))
        wanted = times_back(time, self._settings.history, self._settings.fps)
        self._drop_before(float(wanted[0]))
        times = np.array([frame.time for frame in self._seen])
        points = np.stack([frame.landmarks for frame in self._seen])
        history = landmarks_at(wanted, times, points)
        size = (image.shape[1], image.shape[0])
        is_new = self._lay_crop(float(wanted[0]), size)
        assert self._crop is not None
        shown = self._crop.normalise(history, size)[..., :2].astype(np.float32)
        features: list[Any] = []
        picture = None
        if needs.frames:
            features = self._features(wanted[-needs.frames :], times, points, size)
            picture = self._picture(len(self._seen) - 1)
            self._drop_images_before(float(wanted[-needs.frames]) - MAX_GAP)
        ahead = self._forecasting.forecast(shown, features, picture)
        return LiveForecast(
            landmarks=image_points(self._crop, ahead, size),
            crop=self._crop,
            is_new_crop=is_new,
            known=int(np.sum(wanted >= times[0] - SAME_TIME)),
        )

    def _drop_before(self, oldest: float) -> None:
        """Drop frames that no time from ``oldest`` on lies next to."""
        while len(self._seen) > 1 and self._seen[1].time < oldest - SAME_TIME:
            self._seen.popleft()

    def _drop_images_before(self, oldest: float) -> None:
        """Drop images that are too old to be looked at again, whatever the crop will be."""
        for frame in self._seen:
            if frame.time >= oldest - SAME_TIME:
                return
            frame.image = frame.picture = None

    def _lay_crop(self, oldest: float, size: tuple[int, int]) -> bool:
        """Keep the crop or lay one around the faces since ``oldest``; whether it is new."""
        boxes = [frame.box for frame in self._seen if frame.time > oldest - SAME_TIME]
        fresh = crop_around(np.stack(boxes), size, self._settings.margin)
        if self._crop is not None:
            corners = np.pad(boxes[-1], ((0, 0), (0, 1)))  # a depth, of which nothing is asked
            newest = self._crop.normalise(corners, size)[:, :2]
            inside = bool(np.all((newest >= 0.0) & (newest <= 1.0)))
            ratio = self._crop.side / fresh.side
            if inside and 1 / SIZE_CHANGE <= ratio <= SIZE_CHANGE:
                return False
        self._crop = fresh
        for frame in self._seen:
            frame.picture = frame.features = None
        return True

    def _features(
        self,
        wanted: NDArray[np.float64],
        times: NDArray[np.float64],
        points: NDArray[np.floating],
        size: tuple[int, int],
    ) -> list[Any]:
        """Features of the frames nearest to the times (P,) that pictures are wanted of."""
        assert self._crop is not None
        span = self._forecasting.span
        chosen = nearest(wanted[span - 1 :], times).tolist()
        for number in sorted(set(chosen)):
            frame = self._seen[number]
            if frame.features is None:
                back = times_back(frame.time, span, self._settings.fps)
                near = self._crop.normalise(landmarks_at(back, times, points), size)
                pictures = [self._picture(n) for n in nearest(back, times).tolist()]
                frame.features = self._forecasting.features(
                    near[..., :2].astype(np.float32), np.stack(pictures)
                )
        return [self._seen[number].features for number in chosen]

    def _picture(self, number: int) -> NDArray[np.uint8]:
        """The picture (S, S, 3) of one of the frames seen, at the present crop."""
        frame = self._seen[number]
        if frame.picture is None:
            assert self._crop is not None
            assert frame.image is not None
            size = self._forecasting.needs.size
            frame.picture = dataset_picture(frame.image, self._crop, self._settings, size)
        return frame.picture


class NetworkForecasting:
    """Features and forecasts of one network, in eval mode.

    Args:
        network: on its device.
        name: what messages call it.

    Raises:
        RequestError: the network forecasts no landmarks.
    """

    def __init__(self, network: PredictorModel, name: str) -> None:
        self._network = network.eval()
        self._device = next(network.parameters()).device
        needs = network.needs
        # a first run, which takes longer than others, before a camera waits for it
        still = np.zeros((network.history, NUM_LANDMARKS, 2), dtype=np.float32)
        black = np.zeros((network.span, needs.size, needs.size, 3), dtype=np.uint8)
        features = self.features(still[: network.span], black)
        ahead = self._decode(still, [features] * (needs.frames - network.span + 1), black[-1])
        if ahead is None:
            raise RequestError(f"{name}: forecasts pictures and no landmarks; use another network")

    @property
    def needs(self) -> PictureNeeds:
        """Which pictures it looks at."""
        return self._network.needs

    @property
    def span(self) -> int:
        """K."""
        return self._network.span

    def features(self, landmarks: NDArray[np.float32], pictures: NDArray[np.uint8]) -> Any:
        """Features (1, 1, ...) of one frame, from landmarks (K, L, 2) and pictures (K, S, S, 3)."""
        import torch

        with torch.inference_mode():
            return self._network.encode(self._tensor(landmarks), self._tensor(pictures))

    def forecast(
        self,
        landmarks: NDArray[np.float32],
        features: list[Any],
        last_picture: NDArray[np.uint8] | None,
    ) -> NDArray[np.float32]:
        """Landmarks (H, L, 2) after those (T, L, 2), with P - K + 1 frames' features."""
        assert last_picture is not None
        ahead = self._decode(landmarks[-self._network.history :], features, last_picture)
        assert ahead is not None
        return ahead

    def _decode(
        self,
        landmarks: NDArray[np.float32],
        features: list[Any],
        last_picture: NDArray[np.uint8],
    ) -> NDArray[np.float32] | None:
        import torch

        with torch.inference_mode():
            output = self._network.decode(
                self._tensor(landmarks),
                torch.cat(features, dim=1),
                self._tensor(last_picture),
                make_pictures=False,
            )
        return None if output.landmarks is None else output.landmarks[0].float().cpu().numpy()

    def _tensor(self, values: NDArray[Any]) -> torch.Tensor:
        """A batch of one, on the network's device."""
        import torch

        return torch.from_numpy(np.ascontiguousarray(values))[None].to(self._device)
