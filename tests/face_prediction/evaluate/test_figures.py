"""Figures and the video of ``evaluate``: there, drawn, and the truth where it belongs."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import av
import cv2
import numpy as np
import pytest

from face_prediction.dataset.clip_file import open_clip, read_array
from face_prediction.dataset.reader import FaceDataset
from face_prediction.evaluation import figures
from face_prediction.evaluation.tracks import TRACK_GROUPS, TrackScores
from face_prediction.evaluation.video import (
    FORECASTS,
    PAUSE,
    forecast_timeline,
    timeline_images,
)
from face_prediction.forecast.interface import mouth_centre

from .conftest import SIZE, red_dots, run

pytestmark = pytest.mark.long


def shown(path: Path) -> np.ndarray:
    image = cv2.imread(str(path))
    assert image is not None
    return np.asarray(image)


def test_figures_and_video(dataset: Path, tmp_path: Path, toys) -> None:
    options = {"figures": True, "kinds": ("natural",)}
    run(dataset, tmp_path, "reader_0", "reader_1", "careless_0", "careless_1", **options)
    drawn = sorted(path.name for path in tmp_path.iterdir() if path.suffix in (".png", ".mp4"))
    assert drawn == [
        "calibration.png", "errors.png", "forecast.mp4", "forecast_natural_persistence.png",
        "forecast_natural_reader.png",
    ]  # fmt: skip
    for name in drawn[:2] + drawn[3:]:
        assert shown(tmp_path / name).std() > 10
    # mouth landmarks are drawn in green
    image = shown(tmp_path / "forecast_natural_reader.png")
    assert np.sum((image[..., 1] > 200) & (image[..., 0] < 60) & (image[..., 2] < 60)) > 100
    with av.open(str(tmp_path / "forecast.mp4")) as video:
        assert video.streams.video[0].codec_context.name == "h264"
        frames = sum(1 for _ in video.decode(video=0))
    # six sequences four frames apart: eight frames, four each, the five forecast at the end
    assert frames == 8 + 5 * 4 + 5


@pytest.mark.parametrize("people", [3, figures.MOST_NAMES + 1])
def test_gains_of_a_few_people_have_their_names(tmp_path: Path, monkeypatch, people: int) -> None:
    drawn = []
    monkeypatch.setattr(figures, "_save_png", lambda figure, path: drawn.append(figure))
    errors = np.ones((people, 2, len(TRACK_GROUPS)))
    errors[:, 1] = np.linspace(0.5, 1.5, people)[:, None]
    names = tuple(f"p{i}" for i in range(people))
    frames, rows = np.full(people, 90), (("persistence", "baseline"), ("net", "network"))
    counts, inside = (
        np.ones((people, len(TRACK_GROUPS))),
        np.full((people, 2, len(TRACK_GROUPS), 2), np.nan),
    )
    smooth = np.linspace(0.1, 0.9, people)
    scores = TrackScores("natural", names, frames, smooth, rows, errors, counts, inside)
    figures.draw_gains(tmp_path / "gains.png", [scores])
    (axes,) = drawn[0].axes
    places = np.asarray(axes.collections[0].get_offsets())
    np.testing.assert_allclose(places, np.c_[smooth, np.linspace(-50, 50, people)])
    shown = {text.get_text(): text.xy for text in axes.texts}
    assert list(shown) == list(names if people == 3 else ())
    for name, place in shown.items():
        np.testing.assert_allclose(place, places[names.index(name)])
    assert axes.get_title().startswith("net: each person")


def test_the_timeline_of_a_clip_is_in_its_own_pixels(dataset: Path) -> None:
    with FaceDataset(dataset) as opened:
        indices = [i for i in range(len(opened)) if opened.entry(i).clip == "two"]
        path = dataset / "clips" / "two.h5"
        with open_clip(path) as file:
            landmarks = read_array(path, file, "frames/landmarks")
        true = mouth_centre(landmarks) * SIZE
        exact, off = np.zeros((len(indices), 5, 2)), np.array([0.1, -0.2])
        timeline = forecast_timeline(opened, indices, [("exact", exact), ("off", exact + off)])
    np.testing.assert_allclose(timeline.mouth, true[timeline.frames], atol=1e-3)
    assert timeline.frames.tolist() == list(range(33))
    assert timeline.origins.tolist() == [7, 11, 15, 19, 23, 27]
    forecasts = timeline.forecasts[0][1]
    for origin, ahead in zip(timeline.origins, forecasts, strict=True):
        np.testing.assert_allclose(ahead, true[origin + 1 : origin + 6], atol=1e-3)
    for crop, apart in zip(
        timeline.crops[7::4], timeline.forecasts[1][1] - forecasts, strict=False
    ):
        np.testing.assert_allclose(apart, np.tile(crop.side * off, (5, 1)))
    # and the images lie where they were cut: the dot is at the mouth
    for frame, image, crop in zip(timeline.frames, timeline.images, timeline.crops, strict=True):
        dot = red_dots(image) * crop.side + (crop.left, crop.top)
        np.testing.assert_allclose(dot, true[frame], atol=1.5)
    timeline = replace(timeline, forecasts=timeline.forecasts[:1])
    images = list(timeline_images(timeline))
    assert [image.shape for image in images] == [(560, 1280, 3)] * 33
    # a forecast appears in the plots at the frame it is made at, not before; the truth then comes
    # to lie on it, since this one is exact
    orange = [np.all(image[:, 560:] == FORECASTS[0], axis=-1).sum() for image in images]
    assert orange[0] == orange[6] < orange[8] < orange[7]
    assert orange[-1] == orange[0]
    # and where there is time, the video stops at each
    sparse = [(name, forecast[::2]) for name, forecast in timeline.forecasts]
    slow = replace(timeline, origins=timeline.origins[::2], forecasts=sparse)
    assert sum(1 for _ in timeline_images(slow)) == 33 + 3 * PAUSE
