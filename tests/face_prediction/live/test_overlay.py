"""Drawing over a frame, and the times of each stage."""

from __future__ import annotations

import numpy as np
import pytest

from face_prediction.live.loop import (
    FAR,
    GREEN,
    NEAR,
    LiveStatistics,
    captions,
    draw_mouth,
    draw_text,
    run_loop,
)
from face_prediction.live.streaming import LiveForecast
from face_prediction.tracking.geometry import Crop
from face_prediction.tracking.video import VideoFrame

pytestmark = pytest.mark.long

SIZE = (320, 240)


def colour_at(image: np.ndarray, x: float, y: float) -> tuple[int, ...]:
    return tuple(image[int(y), int(x)].tolist())


def test_the_mouth_is_drawn_where_it_is_and_will_be(landmarks) -> None:
    image = np.full((480, 640, 3), 60, dtype=np.uint8)
    ahead = np.repeat(landmarks[None, :, :2], 5, axis=0)
    ahead[..., 0] += np.arange(1, 6)[:, None] * 0.03  # 19 pixels a frame
    draw_mouth(image, landmarks, ahead)
    x, y = landmarks[[13, 14], :2].mean(axis=0) * (640, 480)
    assert colour_at(image, x, y) == GREEN
    assert colour_at(image, x + 0.03 * 640, y) == NEAR
    assert colour_at(image, x + 0.15 * 640, y) == FAR
    assert (image[:100, :100] == 60).all()
    # magnified at the lower right, the mouth in the middle
    inset = image[-163:, -163:]
    assert colour_at(inset, 81, 81) == GREEN


def test_a_mouth_at_the_edge_is_no_trouble(landmarks) -> None:
    for shift in (-0.6, 0.0, 0.6, 30.0):
        image = np.zeros((120, 160, 3), dtype=np.uint8)
        moved = landmarks + np.array([shift, -shift, 0.0])
        draw_mouth(image, moved, np.repeat(moved[None, :, :2], 5, axis=0))


@pytest.mark.parametrize("shape", [(1080, 1920), (240, 320), (1280, 720), (120, 160)])
def test_text_fits_its_image(shape: tuple[int, int]) -> None:
    image = np.full((*shape, 3), 200, dtype=np.uint8)
    draw_text(image, [("residual: mouth now (green) and in 1 to 5 frames", GREEN)] * 4)
    touched = np.flatnonzero((image != 200).any(axis=(0, 2)))
    assert touched.max() <= shape[1] - 1
    ink = np.flatnonzero((image[..., 1] > 200).any(axis=0))
    assert ink.max() < shape[1] - 2  # the last letter is whole
    empty = np.full((8, 8, 3), 200, dtype=np.uint8)
    draw_text(empty, [])
    assert (empty == 200).all()


def test_times_are_of_the_last_second_or_so() -> None:
    statistics = LiveStatistics()
    statistics.seconds["detector"] += [1.0] * 50 + [0.02] * 30
    assert "| detector | 80 | 632.5 | 1000.0 | 1.6 |" in statistics.times_table()
    assert "predictor" not in statistics.times_table()
    lines = [text for text, _ in captions(statistics, None, "line", 70)]
    assert lines == ["detector 20.0 ms, 50 a second", "face lost"]


def test_each_stage_is_timed_on_its_own(landmarks) -> None:
    now = iter(np.cumsum([0.0, 0.010, 0.004, 0.001] * 3))  # found, forecast, shown, next image

    class Fixed:
        def update(self, time, landmarks, image) -> LiveForecast:
            ahead = np.repeat(landmarks[None, :, :2], 5, axis=0)
            return LiveForecast(ahead, Crop(0, 0, 100), False, 70)

    frames = [VideoFrame(i / 30, np.zeros((240, 320, 3), dtype=np.uint8)) for i in range(3)]
    statistics = LiveStatistics()
    run_loop(
        frames,
        lambda image, time: landmarks,
        Fixed(),  # pyright: ignore[reportArgumentType]
        lambda image, time: True,
        "fixed",
        70,
        statistics,
        clock=lambda: float(next(now)),
    )
    seconds = statistics.seconds
    assert seconds["detector"] == pytest.approx([0.010] * 3)
    assert seconds["predictor"] == pytest.approx([0.004] * 3)
    assert seconds["whole"] == pytest.approx([0.015] * 3)
    assert (statistics.frames, statistics.faces, statistics.crops) == (3, 3, 0)
