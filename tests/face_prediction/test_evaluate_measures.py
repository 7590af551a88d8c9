"""SSIM, calibration, detected landmarks and the baselines' adapter, each against an oracle."""

from __future__ import annotations

from dataclasses import dataclass
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import ndimage, stats

from face_prediction.evaluation.predictors import (
    DETECTOR_SIDE,
    BaselinePredictor,
    EvaluatedPredictor,
    FittedPredictor,
    find_landmarks,
)
from face_prediction.evaluation.scoring import (
    LEVELS,
    area_average,
    coverage,
    interval_levels,
    similarities,
)
from face_prediction.forecast.extrapolation import ConstantVelocity, Persistence
from face_prediction.prediction.interface import Forecast, ImageNeeds
from face_prediction.tracking.detector import FaceDetection
from robo_manip_baselines.runs.errors import RequestError


def pictures(seed: int, size: int = 24) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return rng.integers(0, 256, (2, 3, size, size, 3), dtype=np.uint8)


def textbook_ssim(a: np.ndarray, b: np.ndarray) -> float:
    """Equation 13 of Wang et al. 2004 on one channel, borders of half a window left out."""

    def smooth(x: np.ndarray) -> np.ndarray:
        return ndimage.gaussian_filter(x, 1.5, truncate=3.5)

    a, b = a.astype(float), b.astype(float)
    ma, mb = smooth(a), smooth(b)
    va, vb, cov = smooth(a * a) - ma**2, smooth(b * b) - mb**2, smooth(a * b) - ma * mb
    c1, c2 = (0.01 * 255) ** 2, (0.03 * 255) ** 2
    result = (2 * ma * mb + c1) * (2 * cov + c2) / ((ma**2 + mb**2 + c1) * (va + vb + c2))
    return float(result[5:-5, 5:-5].mean())


def test_ssim_is_the_textbooks() -> None:
    a, b = pictures(0), pictures(1)
    b = (0.7 * a + 0.3 * b).astype(np.uint8)
    found = similarities(a, b)
    assert found.shape == (2, 3)
    for place in np.ndindex(2, 3):
        expected = np.mean([textbook_ssim(a[place][..., c], b[place][..., c]) for c in range(3)])
        assert found[place] == pytest.approx(expected, abs=1e-4)  # float32
    np.testing.assert_allclose(similarities(a, a), 1.0)


def test_ssim_refuses_what_it_cannot_compare() -> None:
    with pytest.raises(RequestError, match="expected the same"):
        similarities(pictures(0), pictures(0, 32))
    with pytest.raises(RequestError, match="of 11 pixels or more"):
        similarities(pictures(0, 8), pictures(0, 8))


def test_area_average_is_the_mean_of_blocks() -> None:
    whole = pictures(2)
    half = area_average(whole, 12)
    assert half.shape == (2, 3, 12, 12, 3)
    np.testing.assert_array_equal(half[1, 2, 3, 4], np.rint(whole[1, 2, 6:8, 8:10].mean((0, 1))))
    assert area_average(whole, 24) is whole
    with pytest.raises(RequestError, match="24 pixels cannot be averaged to 7"):
        area_average(whole, 7)


@pytest.mark.parametrize("freedom", [3.0, 12.0, np.inf])
def test_intervals_hold_what_they_promise(freedom: float) -> None:
    """Errors drawn from the very distribution are covered as often as it says."""
    rng = np.random.default_rng(5)
    scale = rng.uniform(0.5, 2.0, (20000, 2, 2))
    noise = rng.standard_normal(scale.shape)
    if np.isfinite(freedom):
        noise = rng.standard_t(freedom, scale.shape)
    levels = interval_levels(noise * scale, scale, np.full((2, 2), freedom))
    share = coverage(levels).mean(axis=(0, 1))
    # 80 000 draws: a standard error of 0.002 or less
    np.testing.assert_allclose(share, LEVELS, atol=0.008)


def test_an_interval_ends_where_the_distribution_says() -> None:
    edge = stats.t.ppf(0.95, 4.0)  # of the central 90 %
    residuals = 0.01 * np.array([[[edge - 1e-6, -edge + 1e-6]], [[edge + 1e-6, -edge - 1e-6]]])
    levels = interval_levels(residuals, np.full((2, 1, 2), 0.01), np.full((1, 2), 4.0))
    np.testing.assert_array_equal(coverage(levels, (0.9,))[:, 0, 0], [1.0, 0.0])
    normal = interval_levels(residuals, np.full((2, 1, 2), 0.01), np.full((1, 2), np.inf))
    np.testing.assert_allclose(normal, 2 * stats.norm.cdf(100 * np.abs(residuals)) - 1)


def test_half_of_u_and_v_may_be_covered_and_what_is_missing_is_not_counted() -> None:
    levels = np.array([[[0.2, 0.8]], [[np.nan, np.nan]]])
    np.testing.assert_array_equal(coverage(levels, (0.5, 0.9)), [[[0.5, 1.0]], [[np.nan] * 2]])


def test_intervals_need_positive_scales() -> None:
    zero, one = np.zeros((2, 3, 2)), np.ones((2, 3, 2))
    with pytest.raises(RequestError, match="not positive"):
        interval_levels(zero, zero, np.ones((3, 2)))
    with pytest.raises(RequestError, match="not positive"):
        interval_levels(zero, one, np.zeros((3, 2)))
    with pytest.raises(RequestError, match="degrees of freedom"):
        interval_levels(zero, one, np.ones((2, 2)))


@given(st.floats(0.01, 0.99), st.floats(1.0, 50.0))
def test_levels_and_quantiles_are_inverse(level: float, freedom: float) -> None:
    edge = stats.t.ppf((1 + level) / 2, freedom)
    found = interval_levels(np.full((1, 1, 2), -edge), np.ones((1, 1, 2)), np.full((1, 2), freedom))
    np.testing.assert_allclose(found, level, atol=1e-9)


@dataclass
class BrightestPixel:
    """A detector: all landmarks at the brightest pixel; a dark picture has no face."""

    sides: list[int]

    def detect(self, image: np.ndarray, time: float) -> list[FaceDetection]:
        self.sides.append(image.shape[0])
        if image.max() < 128:
            return []
        row, column = np.argwhere(image[..., 0] > 200).mean(axis=0) + 0.5
        small = np.full((468, 3), 0.5)
        face = np.full((468, 3), [column / image.shape[1], row / image.shape[0], 0.0])
        face[0, 1] -= 0.01  # a height, larger than the other's
        return [FaceDetection(small, np.eye(4)), FaceDetection(face, np.eye(4))]


def test_landmarks_are_where_the_detector_finds_them_in_the_crop() -> None:
    shown = np.zeros((2, 2, 64, 64, 3), dtype=np.uint8)
    shown[0, 1, 16:24, 40:48] = 255
    detector = BrightestPixel([])
    found = find_landmarks(shown, detector)
    assert found.shape == (2, 2, 468, 2)
    np.testing.assert_allclose(found[0, 1, 1:], [[44 / 64, 20 / 64]] * 467, atol=0.005)
    assert np.isnan(found[[0, 1, 1], [0, 0, 1]]).all()
    assert set(detector.sides) == {DETECTOR_SIDE}
    find_landmarks(np.zeros((1, 1, 512, 512, 3), dtype=np.uint8), detector)
    assert detector.sides[-1] == 512


class Blind:
    """Forecasts images only: the last one, with what is bright moved by eight pixels a frame."""

    name = "blind"
    memory = 1
    needs = ImageNeeds(1, 64)

    def predict(self, landmarks, images, horizon: int) -> Forecast:
        moved = [np.roll(images[:, -1], 8 * (h + 1), axis=2) for h in range(horizon)]
        nothing = np.full((len(landmarks), horizon, 468, 2), np.nan, dtype=np.float32)
        return Forecast(nothing, np.stack(moved, axis=1))


def test_a_predictor_of_pictures_gets_the_detectors_landmarks() -> None:
    shown = np.zeros((1, 1, 64, 64, 3), dtype=np.uint8)
    shown[0, 0, 16:24, 8:16] = 255
    fitted = {0: FittedPredictor(Blind(), frozenset())}
    predictor = EvaluatedPredictor("blind", fitted, image_size=64, detector=BrightestPixel([]))
    assert predictor.needs == [ImageNeeds(1, 64)]
    history, future = np.zeros((1, 4, 468, 2)), np.zeros((1, 3, 468, 2))
    batch = SimpleNamespace(history=history, future=future, images=lambda needs: shown)
    forecast = predictor.forecast([SimpleNamespace(fold=0, subject="ann")], batch)
    np.testing.assert_allclose(
        forecast.landmarks[0, :, 5, 0], (12 + 8 * np.arange(1, 4)) / 64, atol=0.005
    )
    assert forecast.images is not None
    assert forecast.images.shape == (1, 3, 64, 64, 3)


def test_a_baseline_copies_the_last_picture_and_forecasts_as_ever() -> None:
    rng = np.random.default_rng(0)
    history = rng.uniform(0.2, 0.8, (2, 6, 468, 2)).astype(np.float32)
    plain = BaselinePredictor(ConstantVelocity())
    assert (plain.name, plain.memory, plain.needs.frames) == ("constant_velocity", 2, 0)
    forecast = plain.predict(history, None, 4)
    np.testing.assert_array_equal(forecast.landmarks, ConstantVelocity().predict(history, 4))
    assert forecast.images is None
    copying = BaselinePredictor(Persistence(), 16)
    assert copying.needs == ImageNeeds(1, 16)
    shown = rng.integers(0, 256, (2, 1, 16, 16, 3), dtype=np.uint8)
    copied = copying.predict(history, shown, 4).images
    assert copied is not None
    assert copied.shape == (2, 4, 16, 16, 3)
    np.testing.assert_array_equal(copied[:, 3], shown[:, 0])
    for wrong in (None, shown[:1], shown[:, :, :8]):
        with pytest.raises(RequestError, match="persistence: images of shape"):
            copying.predict(history, wrong, 4)
