"""Predictors of people that they were not fitted to: trained networks, and baselines fitted here.

Legend: B histories, T frames of history, H horizon, L = 468 landmarks, S side of the images.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from face_prediction.dataset.image_batches import SequenceBatch
from face_prediction.dataset.manifest import MANIFEST_NAME, SequenceRow
from face_prediction.dataset.reader import FaceDataset
from face_prediction.dataset.split import DatasetSplit, split_dataset
from face_prediction.forecast import FORECASTERS, Forecaster, LandmarkSequences, fit_forecaster
from face_prediction.prediction.interface import Forecast, ImageNeeds, Predictor
from face_prediction.tracking.detector import FaceDetector
from face_prediction.tracking.tracks import NUM_LANDMARKS
from robo_manip_baselines.runs.errors import RequestError, require_choice
from robo_manip_baselines.runs.files import file_digest

if TYPE_CHECKING:
    from face_prediction.models.learned import CheckpointRecord

Role = Literal["baseline", "network", "reference"]
"""baseline: fitted here. network: trained before. reference: no forecast, but what one is compared
with."""

DETECTOR_SIDE = 256
"""Images are enlarged to at least this side (pixels), the one that the detector's second network
works at: what it does itself with a small image loses more (the mouth of 64-pixel crops is found
within 0.002 of a crop instead of 0.006)."""
UNFITTED = ("persistence", "constant_velocity", "line")
"""Baselines without parameters."""
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
    """A predictor, and the ``subjects`` whose footage shaped it and whom it must not meet.

    There are none where windows are kept apart, and not people.

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
    """Weights of one kind from their folders, or one baseline fitted here; exactly one is given.

    Raises:
        RequestError: both or neither is given, or one of them cannot be used.
    """
    if bool(checkpoints) == (baseline is not None):
        raise RequestError(
            "give either --checkpoints (shipped, or one folder for each fold) or --baseline "
            f"({', '.join(FORECASTERS)})"
        )
    split = split_dataset(dataset)
    if baseline is not None:
        return fit_baselines(dataset, [baseline], split.used, split)[0]
    digest = file_digest(dataset.folder / MANIFEST_NAME)
    loaded = [load_network(folder, digest, split) for folder in checkpoints]
    name = loaded[0].predictor.name
    for other in loaded:
        if other.predictor.name != name:
            raise RequestError(
                f"{other.folder}: is '{other.predictor.name}', {checkpoints[0]} is '{name}'; give "
                "checkpoints of one kind"
            )
    return _one_for_each_fold(name, loaded, split.used)


def load_network(folder: Path, dataset_sha256: str, split: DatasetSplit) -> FittedPredictor:
    """The weights in ``folder``, or those shipped.

    Those trained with the dataset whose ``dataset.json`` has that hash are for its test fold, or
    for the test part of a split by sequence. Others are for everybody, as long as they know nobody:
    their ``test_fold`` is None.

    Raises:
        RequestError: there are none, or they were trained with this dataset under another split.
    """
    from face_prediction.models.loading import SHIPPED, checkpoint_folder, load_predictor

    network, record = load_predictor(folder)
    tested = record.folds["test"]
    is_of_dataset = record.dataset_sha256 == dataset_sha256 and bool(tested)
    path = checkpoint_folder(folder)
    if is_of_dataset:
        _require_same_split(path, record, split)
    is_by_window = is_of_dataset and split.by == "sequence"
    subjects = frozenset() if is_by_window else frozenset(record.train_subjects)
    entry = {
        "folder": SHIPPED if str(folder) == SHIPPED else path.resolve().name,
        "name": network.name,
        "preset": record.preset,
        "test_fold": tested[0] if is_of_dataset else None,
        "split": record.split,
        "train_subjects": len(record.train_subjects),
        "sha256": file_digest(path / "model.safetensors"),
    }
    shared = {"settings": record.settings, "training": record.training, "dataset": record.dataset}
    return FittedPredictor(network, subjects, path, entry, shared)


def _require_same_split(folder: Path, record: CheckpointRecord, split: DatasetSplit) -> None:
    """Raise RequestError if weights of this dataset were trained under another split of it."""
    if record.split == split.by == "sequence" and record.windows_sha256 != split.windows_sha256:
        raise RequestError(
            f"{folder}: the windows of its parts are not those of this dataset's split by "
            "sequence; train it again"
        )
    if record.split != split.by:
        whom = {"person": "people", "sequence": "windows"}
        raise RequestError(
            f"{folder}: was trained with --split {record.split}, which leaves out "
            f"{whom[record.split]}, so that it is judged by face-prediction evaluate --split "
            f"{record.split} alone, not by --split {split.by}"
        )


def group_networks(
    loaded: Sequence[FittedPredictor], folds: Sequence[int]
) -> list[EvaluatedPredictor]:
    """Weights, those of one name and preset as one evaluated predictor, for ``folds`` at most.

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
        _one_for_each_fold(name if names.count(name) == 1 else f"{name} ({preset})", group, folds)
        for (name, preset), group in groups.items()
    ]


def require_strangers(dataset: FaceDataset, fitted: FittedPredictor) -> str:
    """Require that weights from elsewhere were trained on nobody in ``dataset``, by their names.

    Returns:
        A sentence for readers of tables.

    Raises:
        RequestError: they were.
    """
    people = {clip.subject for clip in dataset.manifest.clips if clip.sequences}
    if known := sorted(people & fitted.subjects):
        names = ", ".join(known[:5] + ["..."] * (len(known) > 5))
        raise RequestError(
            f"{fitted.folder}: was trained on {len(known)} of the {len(people)} people of "
            f"{dataset.folder} ({names}), and is judged only on people whom it never saw; leave "
            "them out, or give weights of this dataset's folds (face-prediction fit --test_fold)"
        )
    record = fitted.checkpoint or {}
    return (
        f"{record.get('name')} from {record.get('folder')} was trained on {len(fitted.subjects)} "
        f"people, of whose names none is among the {len(people)} here."
    )


def dataset_landmarks(dataset: FaceDataset, indices: NDArray[np.integer]) -> LandmarkSequences:
    """The landmarks of sequences.

    Raises:
        RequestError: there is none.
    """
    if not len(indices):
        raise RequestError(f"{dataset.folder}: no sequence of anybody to fit to")
    # copies of u and v: a view would keep the depth in memory, too
    numbers = indices.tolist()
    landmarks = np.stack([dataset.landmarks(index)[..., :2].copy() for index in numbers])
    return LandmarkSequences(landmarks, tuple(dataset.entry(index).subject for index in numbers))


def fit_baselines(
    dataset: FaceDataset, names: Iterable[str], folds: Sequence[int], split: DatasetSplit
) -> list[EvaluatedPredictor]:
    """Each baseline, fitted for each of ``folds`` to what may be trained on where it is left out.

    Raises:
        RequestError: there is no forecaster of a name, or nobody in other folds to fit it to.
    """
    by_fold = {require_choice("baseline", name, FORECASTERS): {} for name in names}
    fitted = [name for name in by_fold if name not in UNFITTED]
    landmarks = dataset_landmarks(dataset, np.arange(len(dataset)))
    for fold in folds:
        known = split.training({fold}).tolist()
        if fitted and not known:
            raise RequestError(
                f"{dataset.folder}: all its people are in fold {fold}, so nobody is left to fit "
                f"{', '.join(fitted)} to; build it with --folds 2 or more, give --baselines_from, "
                f"or --baselines {' '.join(UNFITTED)}"
            )
        subjects = tuple(landmarks.subjects[index] for index in known)
        for name, rows in by_fold.items():
            if name in UNFITTED:
                predictor = BaselinePredictor(fit_forecaster(name, landmarks))
                rows[fold] = FittedPredictor(predictor, frozenset())
                continue
            others = LandmarkSequences(landmarks.landmarks[known], subjects)
            predictor = BaselinePredictor(fit_forecaster(name, others))
            people = frozenset(subjects) if split.by == "person" else frozenset[str]()
            rows[fold] = FittedPredictor(predictor, people)
    return [EvaluatedPredictor(name, rows, "baseline") for name, rows in by_fold.items()]


def baselines_from(
    source: Path, names: Iterable[str], folds: Sequence[int], dataset: FaceDataset
) -> list[EvaluatedPredictor]:
    """Baselines with parameters, fitted to all people of another dataset, or shipped.

    Args:
        source: folder made by build-dataset; ``shipped``; or a folder written by fit.
        names: of baselines; those without parameters are left out.
        folds: of the dataset that they are judged on.
        dataset: that one.

    Raises:
        RequestError: the source is neither, or holds somebody of the dataset.
    """
    from face_prediction.models.loading import load_baselines

    wanted = [name for name in names if name not in UNFITTED]
    if (source / MANIFEST_NAME).is_file():
        with FaceDataset(source) as other:
            sequences = dataset_landmarks(other, np.arange(len(other)))
        forecasters = [fit_forecaster(name, sequences) for name in wanted]
        subjects = frozenset(sequences.subjects)
    else:
        stored, subjects = load_baselines(source)
        forecasters = [forecaster for forecaster in stored if forecaster.name in wanted]
    people = {clip.subject for clip in dataset.manifest.clips if clip.sequences}
    if known := sorted(people & subjects):
        some = ", ".join(known[:5] + ["..."] * (len(known) > 5))
        raise RequestError(
            f"--baselines_from {source}: is fitted to {len(known)} of the {len(people)} people of "
            f"{dataset.folder} ({some}); give a dataset of others, or leave it out"
        )
    result: list[EvaluatedPredictor] = []
    for forecaster in forecasters:
        fitted = FittedPredictor(BaselinePredictor(forecaster), subjects, source)
        name = f"{forecaster.name} ({source.name})"
        result.append(EvaluatedPredictor(name, dict.fromkeys(folds, fitted), "baseline"))
    return result


def batch_size(needs: ImageNeeds) -> int:
    """Number of histories to forecast at once."""
    one = needs.frames * needs.size**2 * 3
    return _LANDMARK_BATCH if one == 0 else int(np.clip(_IMAGE_BYTES // one, 1, _LANDMARK_BATCH))


def _one_for_each_fold(
    name: str, networks: Sequence[FittedPredictor], folds: Sequence[int]
) -> EvaluatedPredictor:
    by_fold: dict[int, FittedPredictor] = {}
    for fitted in networks:
        fold = (fitted.checkpoint or {})["test_fold"]
        for own in folds if fold is None else [fold]:
            first = by_fold.setdefault(own, fitted)
            if first.folder != fitted.folder:
                raise RequestError(
                    f"{first.folder} and {fitted.folder} are both {name} for test fold {own}; give "
                    "one checkpoint for each fold, or one that was trained on nobody here"
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
