"""A streaming predictor says what the predictor would of the whole history, to the last bit."""

from __future__ import annotations

import weakref
from dataclasses import replace

import numpy as np
import pytest

from face_prediction.dataset.histories import dataset_image
from face_prediction.dataset.sequences import SequenceSettings
from face_prediction.forecast.extrapolation import ConstantVelocity
from face_prediction.live.streaming import (
    LandmarkForecaster,
    LiveForecast,
    NetworkForecaster,
    StreamingPredictor,
)
from face_prediction.prediction.interface import Forecast, ImageNeeds
from face_prediction.tracking.geometry import Crop, crop_around
from robo_manip_baselines.runs.errors import RequestError

torch = pytest.importorskip("torch", reason="PyTorch is not installed (extra train)")
pytestmark = pytest.mark.long

SIZE = (320, 240)
SETTINGS = SequenceSettings(history=8, future=5, crop_size=64)


def toy(history: int = 8, pictures: int = 5, landmarks: bool = True):
    """A network whose every sum is of whole numbers: the same whatever is computed together."""
    from face_prediction.models.interface import Output, PredictorModel

    class Toy(PredictorModel):
        def __init__(self) -> None:
            super().__init__()
            self.history, self.horizon = history, 5
            self.needs = ImageNeeds(pictures, 32)
            self.weight = torch.nn.Parameter(torch.tensor(1e-7, dtype=torch.float64))
            self.encoded: list[int] = []

        def encode(self, landmarks, pictures):
            self.encoded.append(pictures.shape[1])
            whole = pictures.double().sum(dim=(2, 3, 4))  # (B, N)
            place = (landmarks[:, :, 13, 0].double() * 1000).round()
            return torch.stack([whole, 3 * place], dim=-1)

        def decode(self, landmarks, features, make_images=True):
            assert landmarks.shape[1:] == (history, 468, 2)
            assert features.shape[1] == pictures
            order = torch.arange(1, features.shape[1] + 1, dtype=torch.float64)
            mixed = (features * order[None, :, None]).sum(dim=(1, 2))
            ahead = landmarks[:, -1:] + (landmarks[:, -1:] - landmarks[:, :1])
            steps = torch.arange(1, 6, dtype=torch.float64)[None, :, None, None]
            moved = (ahead.double() + self.weight * mixed[:, None, None, None] * steps).float()
            return Output(landmarks=moved if landmarks_there else None)

        def loss(self, history, future):
            raise NotImplementedError

    landmarks_there = landmarks
    return Toy()


def sway(make_track, frames: int, amplitude: float = 0.01):
    time = np.arange(frames)[:, None] / 30
    path = np.array([0.0, 0.0, -0.5]) + amplitude * np.sin(
        2 * np.pi * time * [1.0, 0.7, 0.0] + [0.3, 0.0, 0.0]
    )
    return make_track(path, image_size=SIZE).landmarks


def pictures(frames: int) -> list[np.ndarray]:
    """Images of smooth random colours, each another."""
    import cv2

    rng = np.random.default_rng(7)
    small = rng.integers(0, 256, size=(frames, 12, 16, 3), dtype=np.uint8)
    return [np.asarray(cv2.resize(image, SIZE)) for image in small]


def batch(model, landmarks, images, now: int, crop: Crop) -> np.ndarray:
    """Forecast of the network from the whole history at once, in a crop."""
    from face_prediction.models.interface import History

    rows = np.maximum(np.arange(now - SETTINGS.history + 1, now + 1), 0)
    seen = crop.normalise(landmarks[rows], SIZE)[..., :2].astype(np.float32)
    shown = [dataset_image(images[i], crop, SETTINGS, 32) for i in rows[-model.needs.frames :]]
    with torch.inference_mode():
        output = model(
            History(torch.tensor(seen)[None, -model.history :], torch.tensor(np.stack(shown))[None])
        )
    assert output.landmarks is not None
    return output.landmarks[0].numpy()


def in_crop(forecast: LiveForecast) -> np.ndarray:
    """Undo the way to the image, which is in float64."""
    crop = forecast.crop
    return ((forecast.landmarks * SIZE - [crop.left, crop.top]) / crop.side).astype(np.float32)


@pytest.mark.parametrize("history", [8, 6])
def test_it_is_the_batch_predictor_to_the_last_bit(make_track, history: int) -> None:
    model = toy(history=history)
    stream = StreamingPredictor(NetworkForecaster(model, "toy"), SETTINGS)
    landmarks, images = sway(make_track, 40), pictures(40)
    laid = 0
    for now in range(40):
        forecast = stream.update(now / 30, landmarks[now], images[now])
        assert forecast is not None
        laid += forecast.is_new_crop
        expected = batch(model, landmarks, images, now, forecast.crop)
        np.testing.assert_array_equal(in_crop(forecast), expected)
        assert forecast.known == min(now + 1, 8)
    assert 1 <= laid <= 6  # the crop has held most of the time, and perhaps not all of it


def test_a_frame_costs_one_encoding_while_the_crop_holds(make_track) -> None:
    model = toy()
    stream = StreamingPredictor(NetworkForecaster(model, "toy"), SETTINGS)
    landmarks, images = sway(make_track, 30, amplitude=0.001), pictures(30)
    model.encoded.clear()
    for now in range(30):
        stream.update(now / 30, landmarks[now], images[now])
    assert model.encoded == [1] * 30


def test_a_new_crop_encodes_what_still_counts(make_track) -> None:
    model = toy(pictures=5)
    stream = StreamingPredictor(NetworkForecaster(model, "toy"), SETTINGS)
    landmarks, images = sway(make_track, 20, amplitude=0.0), pictures(20)
    landmarks[12:, :, 0] += 0.2  # at once to the side, out of the crop
    counts = []
    for now in range(20):
        model.encoded.clear()
        forecast = stream.update(now / 30, landmarks[now], images[now])
        assert forecast is not None
        counts.append((forecast.is_new_crop, len(model.encoded)))
        expected = batch(model, landmarks, images, now, forecast.crop)
        np.testing.assert_array_equal(in_crop(forecast), expected)
    assert counts[:12] == [(True, 1)] + [(False, 1)] * 11
    assert counts[12] == (True, 5)
    # the crop around both places is too large once the first one is forgotten
    assert [count for count in counts[13:] if count[0]] == [(True, 5)]


def test_only_images_that_may_be_looked_at_again_are_kept(make_track) -> None:
    stream = StreamingPredictor(
        NetworkForecaster(toy(history=60, pictures=4), "toy"), replace(SETTINGS, history=60)
    )
    landmarks, images = sway(make_track, 50, amplitude=0.001), pictures(50)
    kept = [weakref.ref(image) for image in images]
    for now in range(50):
        stream.update(now / 30, landmarks[now], images.pop(0))
    # four, and those that a camera at another rate might need: a tenth of a second more
    assert [i for i, image in enumerate(kept) if image() is not None] == list(range(43, 50))


def test_the_crop_is_laid_around_the_history(make_track) -> None:
    landmarks, images = sway(make_track, 20), pictures(20)
    stream = StreamingPredictor(NetworkForecaster(toy(), "toy"), SETTINGS)
    held = None
    for now in range(20):
        forecast = stream.update(now / 30, landmarks[now], images[now])
        assert forecast is not None
        fresh = crop_around(landmarks[max(now - 7, 0) : now + 1], SIZE, SETTINGS.margin)
        assert forecast.crop == (fresh if forecast.is_new_crop else held)
        newest = forecast.crop.normalise(landmarks[now], SIZE)[:, :2]
        assert newest.min() >= 0.0
        assert newest.max() <= 1.0
        assert 0.8 <= forecast.crop.side / fresh.side <= 1.25
        held = forecast.crop


def test_a_face_that_drifts_away_stays_in_its_crop(make_track) -> None:
    landmarks = np.repeat(sway(make_track, 1), 40, axis=0)
    landmarks[:, :, 1] += 0.005 * np.arange(40)[:, None]
    stream = StreamingPredictor(
        LandmarkForecaster(Still(), 5), replace(SETTINGS, history=4, margin=0.05)
    )
    laid = 0
    for now in range(40):
        forecast = stream.update(now / 30, landmarks[now], np.zeros((240, 320, 3), np.uint8))
        assert forecast is not None
        inside = forecast.crop.normalise(landmarks[now], SIZE)[:, :2]
        assert inside.min() >= 0.0
        assert inside.max() <= 1.0
        laid += forecast.is_new_crop
    assert 3 <= laid <= 20


@pytest.mark.parametrize(
    ("scale", "is_new"), [(1.2, False), (1.35, True), (0.85, False), (0.7, True)]
)
def test_a_face_that_comes_nearer_or_goes_needs_another_crop(scale: float, is_new: bool) -> None:
    rng = np.random.default_rng(0)
    small = 0.5 + 0.1 * (rng.uniform(size=(468, 3)) - 0.5)
    stream = StreamingPredictor(
        LandmarkForecaster(Still(), 5), replace(SETTINGS, history=1, margin=0.4)
    )
    image = np.zeros((SIZE[1], SIZE[0], 3), dtype=np.uint8)
    assert stream.update(0.0, small, image) is not None
    forecast = stream.update(1 / 30, 0.5 + scale * (small - 0.5), image)
    assert forecast is not None
    assert forecast.is_new_crop == is_new


class Still:
    """The last frame again."""

    name = "still"
    memory = None
    needs = ImageNeeds(0, 0)

    def predict(self, landmarks, images, horizon: int) -> Forecast:
        assert images is None
        return Forecast(np.repeat(landmarks[:, -1:], horizon, axis=1))


def test_a_baseline_needs_no_picture(make_track) -> None:
    from face_prediction.evaluation.predictors import BaselinePredictor

    predictor = BaselinePredictor(ConstantVelocity())
    stream = StreamingPredictor(LandmarkForecaster(predictor, 5), SETTINGS)
    landmarks = sway(make_track, 30)
    image = np.zeros((SIZE[1], SIZE[0], 3), dtype=np.uint8)
    for now in range(30):
        forecast = stream.update(now / 30, landmarks[now], image)
        assert forecast is not None
        step = landmarks[now, :, :2] - landmarks[max(now - 1, 0), :, :2]
        expected = landmarks[now, :, :2] + 3 * step
        np.testing.assert_allclose(forecast.landmarks[2], expected, atol=1e-6)  # float32 in a crop


def test_a_camera_at_another_rate_is_brought_to_thirty(make_track) -> None:
    shown: list[np.ndarray] = []

    class Watching(Still):
        def predict(self, landmarks, images, horizon: int) -> Forecast:
            shown.append(landmarks[0])
            return super().predict(landmarks, images, horizon)

    image = np.zeros((SIZE[1], SIZE[0], 3), dtype=np.uint8)
    for rate in (25.0, 60.0):
        stream = StreamingPredictor(LandmarkForecaster(Watching(), 5), SETTINGS)
        shown.clear()
        times = np.arange(40) / rate
        forecast = None
        base = sway(make_track, 1)[0]
        for time in times:
            moved = base.copy()
            moved[:, 0] += 0.05 * time  # steadily to the right
            forecast = stream.update(float(time), moved, image)
        assert forecast is not None
        steps = np.diff(shown[-1][:, 0, 0]) * forecast.crop.side / SIZE[0]
        np.testing.assert_allclose(steps, 0.05 / 30, atol=1e-6)
        assert forecast.known == 8


@pytest.mark.parametrize(("lost", "known"), [(1, 8), (2, 8), (3, 1), (20, 1)])
def test_a_face_that_is_gone_for_a_tenth_of_a_second_is_forgotten(
    make_track, lost: int, known: int
) -> None:
    landmarks, images = sway(make_track, 40), pictures(40)
    stream = StreamingPredictor(NetworkForecaster(toy(), "toy"), SETTINGS)
    for now in range(12):
        stream.update(now / 30, landmarks[now], images[now])
    for now in range(12, 12 + lost):
        assert stream.update(now / 30, None, images[now]) is None
    now = 12 + lost
    forecast = stream.update(now / 30, landmarks[now], images[now])
    assert forecast is not None
    assert forecast.known == known
    assert forecast.is_new_crop == (known == 1)


def test_a_reset_forgets_everything(make_track) -> None:
    landmarks, images = sway(make_track, 20), pictures(20)
    stream = StreamingPredictor(NetworkForecaster(toy(), "toy"), SETTINGS)
    first = [stream.update(i / 30, landmarks[i], images[i]) for i in range(10)]
    stream.reset()
    second = [stream.update(i / 30, landmarks[i], images[i]) for i in range(10)]
    for before, after in zip(first, second, strict=True):
        assert before is not None
        assert after is not None
        np.testing.assert_array_equal(before.landmarks, after.landmarks)
        assert before.crop == after.crop


def test_a_frame_of_the_past_is_refused(make_track) -> None:
    stream = StreamingPredictor(LandmarkForecaster(Still(), 5), SETTINGS)
    landmarks, image = sway(make_track, 1)[0], np.zeros((240, 320, 3), dtype=np.uint8)
    stream.update(1.0, landmarks, image)
    with pytest.raises(ValueError, match=r"a frame at 1.0 s after one at 1.0 s"):
        stream.update(1.0, landmarks, image)


def test_a_network_without_landmarks_is_refused() -> None:
    with pytest.raises(RequestError, match="blind: forecasts images and no landmarks"):
        NetworkForecaster(toy(landmarks=False), "blind")
