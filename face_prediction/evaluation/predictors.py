"""Predictors of people that they were not fitted to: trained networks, and baselines fitted here.

Legend: B histories, T frames of history, H horizon, L = 468 landmarks, S side of the images.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from face_prediction.dataset.image_batches import SequenceBatch
from face_prediction.dataset.manifest import MANIFEST_NAME, SequenceRow
from face_prediction.dataset.reader import FaceDataset
from face_prediction.forecast import FORECASTERS, Forecaster, LandmarkSequences, fit_forecaster
from face_prediction.prediction.interface import Forecast, ImageNeeds, Predictor
from face_prediction.tracking.detector import FaceDetector
from face_prediction.tracking.tracks import NUM_LANDMARKS
from robo_manip_baselines.runs.errors import RequestError, require_choice
from robo_manip_baselines.runs.files import file_digest

Role = Literal["baseline", "network", "reference"]
"""baseline: fitted here. network: trained before. reference: no forecast, but what one is compared
with."""

DETECTOR_SIDE = 256
"""Images are enlarged to at least this side (pixels), the one that the detector's second network
works at: what it does itself with a small image loses more (the mouth of 64-pixel crops is found
within 0.002 of a crop instead of 0.006)."""
_IMAGE_BYTES = 64 << 20  # of images that are given to a predictor at once
_LANDMARK_BATCH = 64  # histories at once where there are no images


class BaselinePredictor:
    """Forecasts landmarks as ``forecaster`` does, and images as copies of the last one.

    ``image_size`` is the side of the images; 0: it makes none.
    """

    def __init__(self, forecaster: Forecaster, image_size: int = 0) -> None:
        self.forecaster, self.name, self.memory = forecaster, forecaster.name, forecaster.memory
        self.needs = ImageNeeds(frames=1 if image_size else 0, size=image_size)

    def predict(
        self, landmarks: NDArray[np.floating], images: NDArray[np.uint8] | None, horizon: int
    ) -> Forecast:
        """Forecast ``horizon`` frames; see `Predictor`."""
        if landmarks.ndim != 4:
            raise RequestError(f"landmarks of shape {landmarks.shape}; expected (B, T, 468, 2)")
        forecast = self.forecaster.predict(landmarks, horizon).astype(np.float32, copy=False)
        if not self.needs.frames:
            return Forecast(forecast)
        expected = (len(landmarks), 1, self.needs.size, self.needs.size, 3)
        if images is None or images.shape != expected:
            given = None if images is None else images.shape
            raise RequestError(f"{self.name}: images of shape {given}; expected {expected}")
        return Forecast(forecast, np.repeat(images, horizon, axis=1))


def find_landmarks(images: NDArray[np.uint8], detector: FaceDetector) -> NDArray[np.float32]:
    """Landmarks (B, H, L, 2) in images (B, H, S, S, 3), normalised to them; NaN without a face.

    Of several faces the largest counts.
    """
    import cv2  # not needed unless images are forecast

    result = np.full((*images.shape[:2], NUM_LANDMARKS, 2), np.nan, dtype=np.float32)
    for place in np.ndindex(result.shape[:2]):
        image = images[place]
        if len(image) < DETECTOR_SIDE:
            size = (DETECTOR_SIDE, DETECTOR_SIDE)
            image = np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_CUBIC), np.uint8)
        faces = [face.landmarks for face in detector.detect(image, 0.0)]
        if faces:
            result[place] = max(faces, key=lambda face: np.ptp(face[:, 1]))[:, :2]
    return result


@dataclass(frozen=True)
class FittedPredictor:
    """A predictor, and the ``subjects`` whose footage shaped it.

    Attributes:
        folder: of a trained network.
        checkpoint: of a trained network, as in ``results.json``: folder, name, preset, test fold,
            number of subjects, SHA-256 of the weights.
        shared: settings of a trained network that all folds of one evaluated predictor have.
    """

    predictor: Predictor
    subjects: frozenset[str]
    folder: Path | None = None
    checkpoint: Mapping[str, Any] | None = None
    shared: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)


@dataclass(frozen=True)
class EvaluatedPredictor:
    """A predictor fitted several times, each time without the people of one fold.

    Attributes:
        name: in tables; one of its own.
        by_fold: for each fold the one that was fitted without its people.
        role: kind of row in the tables.
        image_size: side of the images that it forecasts; 0: none.
        detector: finds the landmarks in its images, if it forecasts no others.
    """

    name: str
    by_fold: Mapping[int, FittedPredictor]
    role: Role = "network"
    image_size: int = 0
    detector: FaceDetector | None = None

    @property
    def needs(self) -> list[ImageNeeds]:
        """Images that it needs, for each fold."""
        return [fitted.predictor.needs for fitted in self.by_fold.values()]

    def predictor_for(self, fold: int | None, subject: str) -> Predictor:
        """The predictor for a person of ``fold``.

        Raises:
            RequestError: there is none for the fold, or it was fitted to this person.
        """
        if fold is None:
            raise RequestError(
                f"{self.name}: subject '{subject}' is in no fold of the dataset; add their clips"
            )
        if fold not in self.by_fold:
            known = ", ".join(map(str, sorted(self.by_fold)))
            raise RequestError(
                f"{self.name}: subject '{subject}' is of fold {fold}, and only the folds {known} "
                "are forecast; give a checkpoint with that test fold"
            )
        fitted = self.by_fold[fold]
        if subject in fitted.subjects:
            raise RequestError(
                f"{self.name}: the predictor of fold {fold} was trained on subject '{subject}', "
                "who is in that fold; train on the same dataset as is given here"
            )
        return fitted.predictor

    def forecast(self, rows: Sequence[SequenceRow], batch: SequenceBatch) -> Forecast:
        """Forecast a batch of sequences, all of one fold, after a check of every subject.

        Raises:
            RequestError: as `predictor_for` does, or the landmarks have another shape.
        """
        predictor, *_ = [self.predictor_for(row.fold, row.subject) for row in rows]
        expected = batch.future.shape
        forecast = predictor.predict(batch.history, batch.images(predictor.needs), expected[1])
        if self.detector is not None and forecast.images is not None:
            forecast = replace(forecast, landmarks=find_landmarks(forecast.images, self.detector))
        if forecast.landmarks.shape != expected:
            raise RequestError(
                f"{self.name}: landmarks of shape {forecast.landmarks.shape}; expected {expected}"
            )
        return forecast


def cross_fit(
    dataset: FaceDataset, checkpoints: Sequence[Path], baseline: str | None
) -> EvaluatedPredictor:
    """Networks of one kind from their folders, or one baseline fitted here; exactly one is given.

    Raises:
        RequestError: both or neither is given, or one of them cannot be used.
    """
    if bool(checkpoints) == (baseline is not None):
        raise RequestError(
            "give either --checkpoints (one folder for each fold) or --baseline "
            f"({', '.join(FORECASTERS)})"
        )
    if baseline is not None:
        clips = dataset.manifest.clips
        folds = sorted({clip.fold for clip in clips if clip.sequences and clip.fold is not None})
        return fit_baselines(dataset, [baseline], folds)[0]
    digest = file_digest(dataset.folder / MANIFEST_NAME)
    loaded = [load_network(folder, digest) for folder in checkpoints]
    name = loaded[0].predictor.name
    for other in loaded:
        if other.predictor.name != name:
            raise RequestError(
                f"{other.folder}: is '{other.predictor.name}', {checkpoints[0]} is '{name}'; give "
                "checkpoints of one kind"
            )
    return _one_for_each_fold(name, loaded)


def load_network(folder: Path, dataset_sha256: str) -> FittedPredictor:
    """The network in ``folder``, trained with the dataset whose ``dataset.json`` has that hash.

    Raises:
        RequestError: there is none, or it was trained with another dataset.
    """
    from face_prediction.models.learned import LearnedPredictor  # PyTorch only where it is needed

    network = LearnedPredictor.load(folder)
    trained_with = network.record.dataset_sha256
    if trained_with != dataset_sha256:
        raise RequestError(
            f"{folder}: was trained with another dataset ({MANIFEST_NAME} of SHA-256 "
            f"{trained_with[:12]}, not {dataset_sha256[:12]}), whose folds are of other people; "
            "give that one, or train again"
        )
    record = {
        "folder": folder.resolve().name,
        "name": network.name,
        "preset": network.record.preset,
        "test_fold": network.test_fold,
        "train_subjects": len(network.record.train_subjects),
        "sha256": file_digest(folder / "model.safetensors"),
    }
    shared = {
        "settings": network.record.settings,
        "training": network.record.training,
        "dataset": network.record.dataset,
    }
    subjects = frozenset(network.record.train_subjects)
    return FittedPredictor(network, subjects, folder, record, shared)


def group_networks(loaded: Sequence[FittedPredictor]) -> list[EvaluatedPredictor]:
    """Trained networks, those of one name and preset as one evaluated predictor.

    The preset is part of the name in tables where there are several of a network's name.

    Raises:
        RequestError: two are of the same name, preset and fold, or of other settings.
    """
    groups: dict[tuple[str, str], list[FittedPredictor]] = {}
    for fitted in loaded:
        record = fitted.checkpoint or {}
        groups.setdefault((record["name"], record["preset"]), []).append(fitted)
    names = [name for name, _ in groups]
    return [
        _one_for_each_fold(name if names.count(name) == 1 else f"{name} ({preset})", group)
        for (name, preset), group in groups.items()
    ]


def fit_baselines(
    dataset: FaceDataset, names: Iterable[str], folds: Sequence[int]
) -> list[EvaluatedPredictor]:
    """Each baseline, fitted for each of ``folds`` to the people of all the others.

    Raises:
        RequestError: there is no forecaster of a name, or nobody in other folds to fit it to.
    """
    by_fold = {require_choice("baseline", name, FORECASTERS): {} for name in names}
    # copies of u and v: a view would keep the depth in memory, too
    frames = [dataset.landmarks(index)[..., :2].copy() for index in range(len(dataset))]
    for fold in folds:
        known = dataset.indices(folds={*range(dataset.manifest.folds)} - {fold}).tolist()
        if not known:
            raise RequestError(
                f"{dataset.folder}: all its people are in fold {fold}, so nobody is left to fit "
                "the baselines to; build it with --folds 2 or more"
            )
        subjects = tuple(dataset.entry(index).subject for index in known)
        sequences = LandmarkSequences(np.stack([frames[index] for index in known]), subjects)
        for name, fitted in by_fold.items():
            predictor = BaselinePredictor(fit_forecaster(name, sequences))
            fitted[fold] = FittedPredictor(predictor, frozenset(subjects))
    return [EvaluatedPredictor(name, fitted, "baseline") for name, fitted in by_fold.items()]


def batch_size(needs: ImageNeeds) -> int:
    """Number of histories to forecast at once."""
    one = needs.frames * needs.size**2 * 3
    return _LANDMARK_BATCH if one == 0 else int(np.clip(_IMAGE_BYTES // one, 1, _LANDMARK_BATCH))


def _one_for_each_fold(name: str, networks: Sequence[FittedPredictor]) -> EvaluatedPredictor:
    by_fold: dict[int, FittedPredictor] = {}
    for fitted in networks:
        fold = (fitted.checkpoint or {})["test_fold"]
        first = by_fold.setdefault(fold, fitted)
        if first.folder != fitted.folder:
            raise RequestError(
                f"{first.folder} and {fitted.folder} are both {name} for test fold {fold}; give "
                "one checkpoint for each fold"
            )
        _require_same_settings(name, networks[0], fitted)
    return EvaluatedPredictor(name, dict(sorted(by_fold.items())))


def _require_same_settings(name: str, one: FittedPredictor, other: FittedPredictor) -> None:
    """Raise RequestError if the networks of two folds were trained with different settings."""
    for part in one.shared:
        ours, theirs = one.shared[part], other.shared[part]
        for key in sorted({*ours, *theirs}):
            if ours.get(key) != theirs.get(key):
                raise RequestError(
                    f"{one.folder} and {other.folder} are both {name}, with {part} {key} "
                    f"{ours.get(key)} and {theirs.get(key)}; a row of the tables is of one "
                    "network: train all folds alike"
                )
