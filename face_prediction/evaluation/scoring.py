"""Scores of every predictor on every sequence: errors, SSIM and coverage, batch by batch.

Legend: B sequences of images, N sequences, H horizon, S side of the images; the last axis of
residuals and levels holds U and V. NaN stands for a missing forecast.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from face_prediction.dataset.image_batches import SequenceBatch
from face_prediction.evaluation.predictors import Role, find_landmarks
from face_prediction.evaluation.setup import EvaluationSetup, SequenceSelection
from face_prediction.prediction.errors import mouth_residuals, normalised_mean_errors
from face_prediction.prediction.interface import Forecast, ImageNeeds
from robo_manip_baselines.runs.errors import RequestError
from robo_manip_baselines.runs.extras import install_command
from robo_manip_baselines.runs.progress import ProgressBar

Floats = NDArray[np.float64]

BATCH = 8
"""Sequences at once: of these, 70 images of 256 x 256 each are 110 MB."""
TRUE_IMAGES = "detector on the true pictures"
"""Row of the landmarks that the detector finds in true images: as well as images can do."""
SSIM_SIGMA = 1.5
"""Standard deviation (pixels) of the Gaussian window of Wang et al. 2004, which scikit-image cuts
off at 3.5 of them: 11 pixels across, as in that paper."""
SSIM_WINDOW = 11
"""Side (pixels) of that window: the smallest image that has a similarity."""
LEVELS = tuple(round(0.05 * step, 2) for step in range(1, 20))
"""Nominal coverages that are compared with observed ones: 0.05 to 0.95."""


def similarities(forecast: NDArray[np.uint8], truth: NDArray[np.uint8]) -> Floats:
    """SSIM (B, H) of images (B, H, S, S, 3): the mean over the image and the three colours.

    Of scikit-image, with the settings of Wang, Bovik, Sheikh and Simoncelli (2004): a Gaussian
    window with a standard deviation of 1.5 pixels, and population covariances.

    Raises:
        RequestError: scikit-image is not installed, the shapes differ, or the images are smaller
            than the window.
    """
    if forecast.shape != truth.shape or truth.ndim != 5 or truth.shape[2] < SSIM_WINDOW:
        raise RequestError(
            f"images of shape {forecast.shape} against {truth.shape}; expected the same "
            f"(sequences, horizon, size, size, 3), of {SSIM_WINDOW} pixels or more"
        )
    try:
        from skimage.metrics import structural_similarity
    except ImportError as error:
        raise RequestError(
            f"SSIM needs scikit-image ({error}); run: {install_command('face-prediction')}"
        ) from None
    wang = {"gaussian_weights": True, "sigma": SSIM_SIGMA, "use_sample_covariance": False}
    ours, true = forecast.astype(np.float32), truth.astype(np.float32)
    result = np.empty(truth.shape[:2])
    for place in np.ndindex(result.shape):
        pair = ours[place], true[place]
        result[place] = structural_similarity(*pair, data_range=255, channel_axis=-1, **wang)
    return result


def area_average(images: NDArray[np.uint8], size: int) -> NDArray[np.uint8]:
    """Images (B, H, S, S, 3) at side ``size``: each pixel the mean of those that it covers.

    Raises:
        RequestError: S is no multiple of ``size``.
    """
    side = images.shape[2]
    if side == size:
        return images
    if size < 1 or side % size:
        raise RequestError(f"images of {side} pixels cannot be averaged to {size}")
    step = side // size
    blocks = images.reshape(*images.shape[:2], size, step, size, step, 3)
    return np.rint(blocks.astype(np.float32).mean(axis=(3, 5))).astype(np.uint8)


def interval_levels(
    residuals: NDArray[np.floating],
    scale: NDArray[np.floating],
    degrees_of_freedom: NDArray[np.floating],
) -> Floats:
    """The level (N, H, 2) of the central interval that just reaches each true value, 0 to 1.

    An interval of nominal coverage p covers where this is at most p.

    Args:
        residuals: (N, H, 2) forecast minus truth.
        scale: (N, H, 2) of a Student-t error, in the same unit.
        degrees_of_freedom: (H, 2) or (N, H, 2) of it; infinite: a Gaussian.

    Raises:
        RequestError: shapes differ, or a scale or a number of degrees is not positive.
    """
    from scipy import stats  # not at the top: the command line starts without it

    shapes = (residuals.shape, residuals.shape[1:])
    if scale.shape != residuals.shape or degrees_of_freedom.shape not in shapes:
        raise RequestError(
            f"scale {scale.shape} and degrees of freedom {degrees_of_freedom.shape} for residuals "
            f"of shape {residuals.shape}"
        )
    if not (np.all(scale > 0) and np.all(degrees_of_freedom > 0)):
        raise RequestError("intervals: a scale or a number of degrees of freedom is not positive")
    distance = np.abs(np.asarray(residuals, dtype=np.float64)) / scale
    return np.asarray(2 * stats.t.cdf(distance, degrees_of_freedom) - 1)


def coverage(levels: NDArray[np.floating], nominal: tuple[float, ...] = LEVELS) -> Floats:
    """Share (..., K) of U and V inside the interval of each ``nominal`` coverage: 0, 1/2 or 1.

    Args:
        levels: (..., 2) from `interval_levels`.
        nominal: K levels.
    """
    inside = np.mean(levels[..., None] <= np.array(nominal), axis=-2)
    known = np.isfinite(levels).all(axis=-1)
    return np.where(np.expand_dims(known, -1), inside, np.nan)


@dataclass(frozen=True)
class PredictorScores:
    """Scores of one row of the tables; NaN where it has no such forecast.

    Attributes:
        name: of the row, and its ``role``.
        image_size: side of the images that it makes; 0: none.
        residuals: (N, H, 2) forecast minus truth of the mouth centre, in crops.
        shuffled_residuals: (N, H, 2) with the images of other sequences.
        levels: (N, H, 2) levels of `interval_levels`.
        nme: (N, H) normalised mean error over all landmarks.
        similarity: (N, H) SSIM at the side that all rows are compared at.
        own_similarity: (N, H) SSIM at its own side, where that is larger.
    """

    name: str
    role: Role
    image_size: int
    residuals: Floats
    shuffled_residuals: Floats
    levels: Floats
    nme: Floats
    similarity: Floats
    own_similarity: Floats

    @classmethod
    def empty(cls, name: str, role: Role, size: int, shape: tuple[int, int]) -> PredictorScores:
        """NaN for ``shape`` (N, H)."""
        pairs = [np.full((*shape, 2), np.nan) for _ in range(3)]
        return cls(name, role, size, *pairs, *(np.full(shape, np.nan) for _ in range(3)))


@dataclass(frozen=True)
class EvaluationScores:
    """Scores of all rows on the same N sequences.

    Attributes:
        selection: the sequences.
        rows: one for each predictor, and for a detector on the true images.
        common_size: side of the images at which all rows are compared.
        copies: SSIM (N, H) of copies of the last image, for each larger side of images made.
    """

    selection: SequenceSelection
    rows: tuple[PredictorScores, ...]
    common_size: int
    copies: Mapping[int, Floats]

    def row(self, name: str) -> PredictorScores:
        """The row of that name."""
        return next(row for row in self.rows if row.name == name)


def score_forecasts(setup: EvaluationSetup, progress: bool = False) -> EvaluationScores:
    """Forecast every sequence by every predictor, and compare with the truth.

    Raises:
        RequestError: a forecast is not as it should be, or the dataset is damaged.
    """
    dataset, selection = setup.dataset, setup.selection
    shape = (len(selection), dataset.manifest.settings.future)
    rows = [PredictorScores.empty(p.name, p.role, p.image_size, shape) for p in setup.predictors]
    true_images = PredictorScores.empty(TRUE_IMAGES, "reference", 0, shape)
    last_images = {size: ImageNeeds(1, size) for size in setup.sizes}
    copies = {size: np.full(shape, np.nan) for size in setup.sizes if size > setup.common_size}
    needs = [needs for predictor in setup.predictors for needs in predictor.needs]
    needs += last_images.values()
    total = len(selection) * len(rows)
    with ProgressBar(total, "forecast", shown=progress, keep=False) as bar:
        for places in selection.batches(BATCH):
            indices = selection.indices[places].tolist()
            batch = SequenceBatch(dataset, indices, needs, setup.sizes)
            for predictor, row in zip(setup.predictors, rows, strict=True):
                forecast = predictor.forecast(selection.rows_at(places), batch)
                _score(row, places, forecast, batch, setup.common_size)
                bar.advance(len(places))
            for size, copied in copies.items():
                last = batch.images(last_images[size])
                assert last is not None
                last = np.repeat(last, shape[1], axis=1)
                copied[places] = similarities(last, batch.future_images(size))
            if setup.detector is not None:
                images = batch.future_images(setup.detected_size)
                found = Forecast(find_landmarks(images, setup.detector))
                _score(true_images, places, found, batch, setup.common_size)
    if setup.detector is not None:
        rows.append(true_images)
    return EvaluationScores(selection, tuple(rows), setup.common_size, copies)


def score_shuffled_images(
    setup: EvaluationSetup,
    scores: EvaluationScores,
    partners: NDArray[np.integer],
    progress: bool = False,
) -> None:
    """Fill in ``shuffled_residuals`` of every network that looks at images.

    Landmarks stay a sequence's own; images are those of the sequences at ``partners`` (N,).
    """
    indices, networks = setup.selection.indices, setup.image_networks
    needs = [needs for network in networks for needs in network.needs]
    total = len(indices) * len(networks)
    with ProgressBar(total, "forecast", shown=progress, keep=False) as bar:
        for places in setup.selection.batches(BATCH):
            own, images_of = indices[places].tolist(), indices[partners[places]].tolist()
            batch = SequenceBatch(setup.dataset, own, needs, images_of=images_of)
            for network in networks:
                forecast = network.forecast(setup.selection.rows_at(places), batch)
                residuals = mouth_residuals(forecast.landmarks, batch.future)
                scores.row(network.name).shuffled_residuals[places] = residuals
                bar.advance(len(places))


def _score(
    row: PredictorScores,
    places: NDArray[np.intp],
    forecast: Forecast,
    batch: SequenceBatch,
    common_size: int,
) -> None:
    row.residuals[places] = mouth_residuals(forecast.landmarks, batch.future)
    row.nme[places] = normalised_mean_errors(forecast.landmarks, batch.future)
    if forecast.mouth_scale is not None:
        degrees = forecast.degrees_of_freedom
        if degrees is None:
            degrees = np.full(forecast.mouth_scale.shape[1:], np.inf)
        row.levels[places] = interval_levels(row.residuals[places], forecast.mouth_scale, degrees)
    if forecast.images is not None:
        truth = batch.future_images(row.image_size)
        # the truth is brought to the common side by the same way, so that no row gains by it
        row.similarity[places] = similarities(
            area_average(forecast.images, common_size), area_average(truth, common_size)
        )
        if row.image_size > common_size:
            row.own_similarity[places] = similarities(forecast.images, truth)
