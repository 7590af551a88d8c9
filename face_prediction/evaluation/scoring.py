"""Runs predictors over sequences and keeps what they are judged by.

Legend: N sequences, B of them at once, H horizon, L = 468 landmarks, S side of the pictures; the
last axis of residuals holds U and V.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from face_prediction.dataset.reader import FaceDataset
from face_prediction.evaluation.batches import Batch, PicturePlan, find_landmarks
from face_prediction.evaluation.calibration import interval_levels
from face_prediction.evaluation.errors import (
    area_average,
    mouth_residuals,
    normalised_mean_errors,
    similarities,
)
from face_prediction.evaluation.setup import Contestant, LineUp, Role, Selection
from face_prediction.prediction.interface import Forecast, Predictor
from face_prediction.tracking.tracks import NUM_LANDMARKS
from robo_manip_baselines.runs.errors import RequestError

Floats = NDArray[np.float64]

#: Sequences at once: of these, 70 pictures of 256 x 256 each are 110 MB.
BATCH = 8
#: What the detector finds in pictures that were not forecast: as well as pictures can do.
TRUE_PICTURES = "detector on the true pictures"


@dataclass(frozen=True)
class Judged:
    """How one row of the tables did; NaN where it has no such forecast."""

    name: str
    role: Role
    #: (N, H, 2) forecast minus truth of the mouth centre, in crops
    residuals: Floats
    #: (N, H) normalised mean error over all landmarks
    nme: Floats
    #: (N, H) SSIM at the side that all rows are compared at
    similarity: Floats
    #: (N, H) SSIM at its own side, where that is larger
    own_similarity: Floats
    #: (N, H, 2) levels of `interval_levels`
    levels: Floats
    #: side of the pictures that it makes; 0: none
    picture_size: int

    @classmethod
    def blank(cls, name: str, role: Role, picture_size: int, shape: tuple[int, int]) -> Judged:
        """Nothing known yet of ``shape`` (N, H)."""
        none = np.full(shape, np.nan)
        pair = np.full((*shape, 2), np.nan)
        return cls(name, role, pair, none, none.copy(), none.copy(), pair.copy(), picture_size)


@dataclass(frozen=True)
class Verdict:
    """All rows on the same N sequences."""

    selection: Selection
    rows: tuple[Judged, ...]
    #: side of the pictures at which all rows are compared
    common_size: int
    #: for each larger side that pictures were made at, SSIM (N, H) of copies of the last one
    copies: Mapping[int, Floats]

    def row(self, name: str) -> Judged:
        """The row of that name."""
        return next(row for row in self.rows if row.name == name)


def judge(dataset: FaceDataset, selection: Selection, line_up: LineUp, bar: tqdm) -> Verdict:
    """Forecast every sequence by every contestant, and compare with what came.

    Args:
        dataset: where the sequences are.
        selection: N of them.
        line_up: the contestants.
        bar: advanced by one for each sequence and contestant.

    Raises:
        RequestError: a forecast is not as it should be, or the dataset is damaged.
    """
    settings = dataset.manifest.settings
    shape = (len(selection), settings.future)
    rows = {
        contestant.name: Judged.blank(
            contestant.name, contestant.role, line_up.picture_sizes[contestant.name], shape
        )
        for contestant in line_up.contestants
    }
    sizes = line_up.sizes
    if line_up.detector is not None:
        rows[TRUE_PICTURES] = Judged.blank(TRUE_PICTURES, "reference", 0, shape)
    copies = {size: np.full(shape, np.nan) for size in sizes if size > line_up.common_size}
    plan = PicturePlan.of(line_up.needs(), sizes)
    for places in batches(selection):
        batch = Batch(dataset, selection.indices[places].tolist(), plan)
        for contestant in line_up.contestants:
            predictor = _predictor_of(contestant, selection, places)
            forecast = forecast_of(predictor, batch.history, batch.shown(predictor.needs), shape[1])
            _score(rows[contestant.name], places, forecast, batch, line_up.common_size)
            bar.update(len(places))
        for size, copied in copies.items():
            last = np.repeat(batch.last(size), shape[1], axis=1)
            copied[places] = similarities(last, batch.coming(size))
        if line_up.detector is not None:
            found = find_landmarks(batch.coming(line_up.detected_size), line_up.detector)
            _score_landmarks(rows[TRUE_PICTURES], places, found, batch.future)
            bar.update(len(places))
    return Verdict(selection, tuple(rows.values()), line_up.common_size, copies)


def judge_exchanged(
    dataset: FaceDataset,
    selection: Selection,
    line_up: LineUp,
    partner: NDArray[np.int64],
    bar: tqdm,
) -> dict[str, Floats]:
    """Mouth residuals (N, H, 2) of every network that looks at pictures, shown others' pictures.

    Landmarks stay a sequence's own.

    Args:
        dataset: where the sequences are.
        selection: N of them.
        line_up: the contestants.
        partner: (N,) places in ``selection`` of those whose pictures are shown.
        bar: advanced by one for each sequence and network.
    """
    horizon = dataset.manifest.settings.future
    lookers = line_up.lookers
    residuals = {c.name: np.full((len(selection), horizon, 2), np.nan) for c in lookers}
    plan = PicturePlan.of((f.predictor.needs for c in lookers for f in c.fit.by_fold.values()), ())
    for places in batches(selection):
        shown = selection.indices[partner[places]].tolist()
        batch = Batch(dataset, selection.indices[places].tolist(), plan, shown)
        for contestant in lookers:
            predictor = _predictor_of(contestant, selection, places)
            forecast = forecast_of(predictor, batch.history, batch.shown(predictor.needs), horizon)
            residuals[contestant.name][places] = mouth_residuals(forecast.landmarks, batch.future)
            bar.update(len(places))
    return residuals


def steps(selection: Selection, line_up: LineUp, is_exchanged: bool) -> int:
    """How often the bar will be advanced."""
    rows = len(line_up.contestants) + (line_up.detector is not None)
    return len(selection) * (rows + (len(line_up.lookers) if is_exchanged else 0))


def batches(selection: Selection) -> list[NDArray[np.intp]]:
    """Places of sequences to forecast at once: `BATCH` or fewer of one fold."""
    result: list[NDArray[np.intp]] = []
    for fold in np.unique(selection.folds):
        places = np.flatnonzero(selection.folds == fold)
        result += [places[i : i + BATCH] for i in range(0, len(places), BATCH)]
    return result


def forecast_of(
    predictor: Predictor,
    history: NDArray[np.float32],
    pictures: NDArray[np.uint8] | None,
    horizon: int,
) -> Forecast:
    """A forecast whose landmarks are of the shape that was asked for.

    Raises:
        RequestError: they are not.
    """
    forecast = predictor.predict(history, pictures, horizon)
    expected = (len(history), horizon, NUM_LANDMARKS, 2)
    if forecast.landmarks.shape != expected:
        raise RequestError(
            f"{predictor.name}: landmarks of shape {forecast.landmarks.shape}; expected {expected}"
        )
    return forecast


def _predictor_of(
    contestant: Contestant, selection: Selection, places: NDArray[np.intp]
) -> Predictor:
    """The one for these sequences, all of one fold; none of their people shaped it."""
    fold = int(selection.folds[places[0]])
    checked = [contestant.fit.of(fold, selection.subjects[place]) for place in places.tolist()]
    return checked[0]


def _score(
    row: Judged, places: NDArray[np.intp], forecast: Forecast, batch: Batch, common: int
) -> None:
    _score_landmarks(row, places, forecast.landmarks, batch.future)
    if forecast.mouth_scale is not None:
        degrees = forecast.degrees_of_freedom
        if degrees is None:
            degrees = np.full(forecast.mouth_scale.shape[1:], np.inf)
        row.levels[places] = interval_levels(row.residuals[places], forecast.mouth_scale, degrees)
    if forecast.pictures is not None:
        truth = batch.coming(row.picture_size)
        # the truth is brought to the common side by the same way, so that no row gains by it
        row.similarity[places] = similarities(
            area_average(forecast.pictures, common), area_average(truth, common)
        )
        if row.picture_size > common:
            row.own_similarity[places] = similarities(forecast.pictures, truth)


def _score_landmarks(
    row: Judged,
    places: NDArray[np.intp],
    landmarks: NDArray[np.float32],
    truth: NDArray[np.float32],
) -> None:
    row.residuals[places] = mouth_residuals(landmarks, truth)
    row.nme[places] = normalised_mean_errors(landmarks, truth)
