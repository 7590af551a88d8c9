"""A baseline forecaster in the place of a trained network.

Legend: B histories, T frames of history, H horizon, L = 468 landmarks, S side of the pictures.
"""

from __future__ import annotations

import platform
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from face_prediction.dataset.manifest import MANIFEST_NAME
from face_prediction.dataset.reader import FaceDataset
from face_prediction.evaluation.batches import (
    Batch,
    DetectedPredictor,
    Detector,
    PicturePlan,
    reduction,
)
from face_prediction.forecast import FORECASTERS, Forecaster, LandmarkSequences, fit_forecaster
from face_prediction.prediction.interface import Forecast, PictureNeeds, Predictor
from robo_manip_baselines.runs.errors import RequestError
from robo_manip_baselines.runs.files import file_digest


@dataclass(frozen=True)
class BaselinePredictor:
    """Forecasts landmarks as ``forecaster`` does, and pictures as copies of the last one.

    Attributes:
        forecaster: a fitted baseline.
        picture_size: side of the pictures that are copied; 0: it makes none.
    """

    forecaster: Forecaster
    picture_size: int = 0

    @property
    def name(self) -> str:
        """The forecaster's."""
        return self.forecaster.name

    @property
    def memory(self) -> int | None:
        """The forecaster's."""
        return self.forecaster.memory

    @property
    def needs(self) -> PictureNeeds:
        """The last picture, where it is to be copied."""
        return PictureNeeds(frames=1 if self.picture_size else 0, size=self.picture_size)

    def predict(
        self,
        landmarks: NDArray[np.floating],
        pictures: NDArray[np.uint8] | None,
        horizon: int,
    ) -> Forecast:
        """Forecast ``horizon`` frames; see `Predictor`.

        Raises:
            RequestError: a shape is another one, or the horizon is 0 or less.
        """
        if landmarks.ndim != 4:
            raise RequestError(f"landmarks of shape {landmarks.shape}; expected (B, T, 468, 2)")
        forecast = self.forecaster.predict(landmarks, horizon).astype(np.float32, copy=False)
        if not self.picture_size:
            return Forecast(forecast)
        expected = (len(landmarks), 1, self.picture_size, self.picture_size, 3)
        if pictures is None or pictures.shape != expected:
            given = None if pictures is None else pictures.shape
            raise RequestError(f"{self.name}: pictures of shape {given}; expected {expected}")
        return Forecast(forecast, np.repeat(pictures, horizon, axis=1))


#: Bytes of pictures that are shown to a predictor at once.
_PICTURE_BYTES = 64 << 20
#: Histories at once where there are no pictures.
_LANDMARK_BATCH = 64


@dataclass(frozen=True)
class Fitted:
    """A predictor, everyone whose footage shaped it, and where it is kept, if anywhere."""

    predictor: Predictor
    subjects: frozenset[str]
    folder: Path | None = None


@dataclass(frozen=True)
class CrossFit:
    """One predictor fitted several times, each time without the people of one fold."""

    name: str
    by_fold: Mapping[int, Fitted]

    def of(self, fold: int | None, subject: str) -> Predictor:
        """The predictor for a person of ``fold``.

        Raises:
            RequestError: there is none for the fold, or it was fitted to this person.
        """
        if fold is None or fold not in self.by_fold:
            known = ", ".join(map(str, sorted(self.by_fold)))
            raise RequestError(
                f"{self.name}: subject '{subject}' is in no fold of the dataset; add their clips"
                if fold is None
                else f"{self.name}: subject '{subject}' is of fold {fold}, and only the folds "
                f"{known} are forecast; give a checkpoint with that test fold"
            )
        fitted = self.by_fold[fold]
        if subject in fitted.subjects:
            raise RequestError(
                f"{self.name}: what forecasts fold {fold} was trained on subject '{subject}', who "
                "is in that fold; train on the same dataset as is given here"
            )
        return fitted.predictor


def cross_fit(dataset: FaceDataset, checkpoints: Sequence[Path], baseline: str | None) -> CrossFit:
    """Networks from their folders, or one baseline fitted here; exactly one of both is given.

    Raises:
        RequestError: both or neither is given, or one of them cannot be used.
    """
    if bool(checkpoints) == (baseline is not None):
        raise RequestError(
            "give either --checkpoints (one folder for each fold) or --baseline "
            f"({', '.join(FORECASTERS)})"
        )
    if baseline is None:
        return load_networks(dataset, checkpoints)
    return fit_baselines(dataset, [baseline], folds_with_people(dataset))[baseline]


def load_networks(dataset: FaceDataset, folders: Sequence[Path]) -> CrossFit:
    """Trained networks of one kind, each of another test fold of ``dataset``.

    Raises:
        RequestError: a folder holds no checkpoint, one of another kind or of other data, or two
            have the same test fold.
    """
    from face_prediction.models.learned import LearnedPredictor  # PyTorch only where it is needed

    data = file_digest(dataset.folder / MANIFEST_NAME)
    by_fold: dict[int, Fitted] = {}
    names: list[str] = []
    for folder in folders:
        network = LearnedPredictor.load(folder)
        record = network.record
        if record.dataset_sha256 != data:
            raise RequestError(
                f"{folder}: was trained on another dataset than {dataset.folder}, whose folds are "
                "others; give the one it was trained on"
            )
        names.append(network.name)
        if network.name != names[0]:
            raise RequestError(
                f"{folder}: is '{network.name}', {folders[0]} is '{names[0]}'; give checkpoints "
                "of one kind"
            )
        for fold in record.folds["test"]:
            if fold in by_fold:
                raise RequestError(
                    f"{folder}: test fold {fold}, as {by_fold[fold].folder}; give one checkpoint "
                    "for each fold"
                )
            by_fold[fold] = Fitted(network, frozenset(record.train_subjects), folder)
    return CrossFit(names[0], by_fold)


def fit_baselines(
    dataset: FaceDataset, names: Sequence[str], folds: Sequence[int]
) -> dict[str, CrossFit]:
    """Each baseline, fitted for each of ``folds`` to the people of all the others.

    Raises:
        RequestError: there is no forecaster of a name, or nobody in other folds to fit it to.
    """
    for name in names:
        if name not in FORECASTERS:
            raise RequestError(f"baseline '{name}'; there are {', '.join(FORECASTERS)}")
    by_fold: dict[str, dict[int, Fitted]] = {name: {} for name in names}
    # copies of u and v: a view would keep the depth in memory, too
    frames = [dataset.landmarks(index)[..., :2].copy() for index in range(len(dataset))]
    for fold in folds:
        others = set(range(dataset.manifest.folds)) - {fold}
        known = dataset.indices(folds=others).tolist()
        if not known:
            raise RequestError(
                f"{dataset.folder}: all its people are in fold {fold}, so nobody is left to fit "
                "the baselines to; build it with --folds 2 or more"
            )
        subjects = tuple(dataset.entry(index).subject for index in known)
        sequences = LandmarkSequences(np.stack([frames[index] for index in known]), subjects)
        for name in names:
            predictor = BaselinePredictor(fit_forecaster(name, sequences))
            by_fold[name][fold] = Fitted(predictor, frozenset(subjects))
    return {name: CrossFit(name, fitted) for name, fitted in by_fold.items()}


def folds_with_people(dataset: FaceDataset) -> list[int]:
    """The folds that there are sequences of."""
    clips = dataset.manifest.clips
    return sorted({clip.fold for clip in clips if clip.sequences and clip.fold is not None})


def batch_size(needs: PictureNeeds) -> int:
    """How many histories to forecast at once."""
    one = needs.frames * needs.size**2 * 3
    return _LANDMARK_BATCH if one == 0 else int(np.clip(_PICTURE_BYTES // one, 1, _LANDMARK_BATCH))


#: baseline: fitted here. network: trained before. reference: no forecast at all, but what a
#: forecast is compared with.
Role = Literal["baseline", "network", "reference"]

#: What skill is measured against; its pictures are copies of the last one.
PERSISTENCE = "persistence"


class TrainedPredictor(Predictor, Protocol):
    """A network, and who it was trained on."""

    @property
    def test_fold(self) -> int:
        """The fold of people that it may be judged on."""
        ...

    @property
    def train_subjects(self) -> tuple[str, ...]:
        """Whom it was trained on."""
        ...

    @property
    def preset(self) -> str:
        """Its size."""
        ...


@dataclass(frozen=True)
class Contestant:
    """A row of the tables: a predictor fitted several times, each without the people of a fold."""

    fit: CrossFit
    role: Role

    @property
    def name(self) -> str:
        """What tables call it."""
        return self.fit.name

    @property
    def folds(self) -> tuple[int, ...]:
        """Those that it can be judged on."""
        return tuple(sorted(self.fit.by_fold))


def networks(trained: Sequence[tuple[Path, TrainedPredictor]]) -> list[Contestant]:
    """Trained networks, those of one name and preset as one contestant.

    The preset is part of a contestant's name where there are several of the network's name.

    Raises:
        RequestError: two are of the same name, preset and fold.
    """
    groups: dict[tuple[str, str], dict[int, tuple[Path, TrainedPredictor]]] = {}
    for folder, predictor in trained:
        group = groups.setdefault((predictor.name, predictor.preset), {})
        first, _ = group.setdefault(predictor.test_fold, (folder, predictor))
        if first != folder:
            raise RequestError(
                f"{first} and {folder} are both {predictor.name} ({predictor.preset}) for fold "
                f"{predictor.test_fold}; evaluate them one after the other"
            )
    names = [name for name, _ in groups]
    result: list[Contestant] = []
    for (name, preset), group in groups.items():
        by_fold = {
            fold: Fitted(predictor, frozenset(predictor.train_subjects))
            for fold, (_, predictor) in sorted(group.items())
        }
        label = name if names.count(name) == 1 else f"{name} ({preset})"
        result.append(Contestant(CrossFit(label, by_fold), "network"))
    return result


def common_folds(contestants: Sequence[Contestant]) -> tuple[int, ...]:
    """The folds that all contestants cover: rows are compared on the same sequences.

    Raises:
        RequestError: there is none.
    """
    covered = [set(contestant.folds) for contestant in contestants]
    common = sorted(set.intersection(*covered)) if covered else []
    if not common:
        given = "; ".join(f"{c.name}: {', '.join(map(str, c.folds))}" for c in contestants)
        raise RequestError(
            f"no fold is covered by all checkpoints ({given}); train them with the same --test_fold"
        )
    return tuple(common)


def require_unseen(dataset: FaceDataset, contestants: Sequence[Contestant]) -> None:
    """Check before anything is forecast that nobody meets a predictor that knows the person.

    Raises:
        RequestError: a contestant is for a fold that is not there, or learnt from somebody in it.
    """
    folds = dataset.manifest.folds
    for contestant in contestants:
        strange = [fold for fold in contestant.folds if fold not in range(folds)]
        if strange:
            raise RequestError(
                f"{contestant.name} is for fold {strange[0]}; {dataset.folder} has folds 0 to "
                f"{folds - 1}"
            )
        for clip in dataset.manifest.clips:
            if clip.sequences and clip.fold in contestant.fit.by_fold:
                contestant.fit.of(clip.fold, clip.subject)


def baselines(dataset: FaceDataset, names: Sequence[str], folds: Sequence[int]) -> list[Contestant]:
    """Each baseline, fitted for each of ``folds`` to the people of all the others.

    Persistence is always among them, and first.

    Raises:
        RequestError: there is no forecaster of a name, or nobody in other folds to fit it to.
    """
    wanted = [PERSISTENCE, *(name for name in dict.fromkeys(names) if name != PERSISTENCE)]
    fits = fit_baselines(dataset, wanted, folds)
    return [Contestant(fits[name], "baseline") for name in wanted]


@dataclass(frozen=True)
class LineUp:
    """Contestants that are ready to be judged side by side."""

    contestants: tuple[Contestant, ...]
    #: side of the pictures that each makes; 0: none
    picture_sizes: Mapping[str, int]
    #: side at which all pictures are compared: the smallest that a network makes
    common_size: int
    #: what finds the face in the pictures of those that forecast no landmarks; None: not needed
    detector: Detector | None = None
    #: the largest side of those pictures
    detected_size: int = 0

    @property
    def sizes(self) -> tuple[int, ...]:
        """Sides at which there are pictures to compare."""
        return tuple(sorted({size for size in self.picture_sizes.values() if size}))

    @property
    def lookers(self) -> tuple[Contestant, ...]:
        """The networks that look at pictures."""
        return tuple(
            contestant
            for contestant in self.contestants
            if contestant.role == "network"
            and any(fitted.predictor.needs.frames for fitted in contestant.fit.by_fold.values())
        )

    def needs(self) -> Iterator[PictureNeeds]:
        """Pictures of the past that somebody looks at, or that are copied to compare with."""
        for contestant in self.contestants:
            for fitted in contestant.fit.by_fold.values():
                yield fitted.predictor.needs
        for size in self.sizes:
            yield PictureNeeds(1, size)


def line_up(
    dataset: FaceDataset,
    contestants: Sequence[Contestant],
    open_detector: Callable[[], Detector],
) -> LineUp:
    """See what each contestant makes of one sequence of its first fold.

    Persistence is given pictures to copy, and those that forecast no landmarks the detector.

    Raises:
        RequestError: a contestant does not suit the dataset, or a detector is needed and there is
            none.
    """
    sizes: dict[str, int] = {}
    blind: set[str] = set()
    for contestant in contestants:
        fold = contestant.folds[0]
        sizes[contestant.name], has_landmarks = _try(
            contestant.fit.by_fold[fold].predictor, dataset, fold
        )
        if sizes[contestant.name] and not has_landmarks:
            blind.add(contestant.name)
    common = min(filter(None, sizes.values()), default=dataset.manifest.settings.crop_size)
    sizes[PERSISTENCE] = common
    detector = open_detector() if blind else None

    def ready(name: str, predictor: Predictor) -> Predictor:
        if name == PERSISTENCE and isinstance(predictor, BaselinePredictor):
            return replace(predictor, picture_size=common)
        if name in blind and detector is not None:
            return DetectedPredictor(predictor, detector)
        return predictor

    result: list[Contestant] = []
    for contestant in contestants:
        by_fold = {
            fold: Fitted(ready(contestant.name, fitted.predictor), fitted.subjects)
            for fold, fitted in contestant.fit.by_fold.items()
        }
        result.append(replace(contestant, fit=CrossFit(contestant.name, by_fold)))
    largest = max((sizes[name] for name in blind), default=0)
    return LineUp(tuple(result), sizes, common, detector, largest)


def _try(predictor: Predictor, dataset: FaceDataset, fold: int) -> tuple[int, bool]:
    """Side of the pictures that it makes (0: none), and whether it forecasts landmarks."""
    crop_size = dataset.manifest.settings.crop_size
    if predictor.needs.frames:
        reduction(crop_size, predictor.needs.size)
    first = dataset.indices(folds=(fold,))[:1].tolist()
    if not first:
        return 0, True
    batch = Batch(dataset, first, PicturePlan.of([predictor.needs], ()))
    forecast = predictor.predict(
        batch.history, batch.shown(predictor.needs), dataset.manifest.settings.future
    )
    if forecast.pictures is None:
        return 0, True
    size = forecast.pictures.shape[2]
    reduction(crop_size, size)
    return size, not np.isnan(forecast.landmarks).all()


@dataclass(frozen=True)
class Selection:
    """N sequences of a dataset, in its order."""

    #: (N,) their numbers in the dataset
    indices: NDArray[np.int64]
    #: N each: whose face, of which clip, what kind of footage
    subjects: tuple[str, ...]
    clips: tuple[str, ...]
    kinds: tuple[str, ...]
    #: (N,) fold, and first frame in the clip
    folds: NDArray[np.int64]
    starts: NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.indices)

    def of_kind(self, kind: str) -> NDArray[np.intp]:
        """Places in this selection of the sequences of one kind of footage."""
        return np.flatnonzero(np.array(self.kinds) == kind)


def select(
    dataset: FaceDataset,
    folds: Collection[int],
    kinds: Collection[str],
    max_sequences: int | None,
    seed: int,
) -> Selection:
    """The sequences of these folds and kinds, of each kind at most ``max_sequences``.

    Where there are more, so many are drawn at random from ``seed``.

    Raises:
        RequestError: there are none.
    """
    rng = np.random.default_rng([seed, *b"sequences"])
    parts: list[NDArray[np.int64]] = []
    for kind in kinds:
        found = dataset.indices(folds=folds, kinds=(kind,))
        if max_sequences is not None and len(found) > max_sequences:
            found = np.sort(rng.choice(found, max_sequences, replace=False))
        parts.append(found)
    indices = np.sort(np.concatenate([np.empty(0, dtype=np.int64), *parts]))
    if not len(indices):
        raise RequestError(
            f"{dataset.folder}: no sequence of kind {', '.join(kinds)} in fold "
            f"{', '.join(map(str, sorted(folds)))}"
        )
    table = dataset.rows()
    rows = [table[index] for index in indices.tolist()]
    return Selection(
        indices=indices,
        subjects=tuple(row.subject for row in rows),
        clips=tuple(row.clip for row in rows),
        kinds=tuple(row.kind for row in rows),
        folds=np.array([row.fold for row in rows], dtype=np.int64),
        starts=np.array([row.start for row in rows], dtype=np.int64),
    )


def exchange_pictures(
    kinds: Sequence[str], subjects: Sequence[str], seed: int
) -> NDArray[np.int64]:
    """For each of N sequences (N,) the place of the one whose pictures it is shown instead.

    A permutation within each kind of footage that leaves none its own; every one is shown another
    person's, too, unless one person has more than half of that kind.

    Raises:
        RequestError: there is only one sequence of a kind.
    """
    rng = np.random.default_rng([seed, *b"exchange"])
    result = np.empty(len(kinds), dtype=np.int64)
    for kind in dict.fromkeys(kinds):
        places = np.flatnonzero(np.array(kinds) == kind)
        if len(places) < 2:
            raise RequestError(
                f"{kind}: one sequence, so there is none to exchange pictures with; "
                "leave the kind out (--kinds), or give more sequences"
            )
        # people side by side, in random order: a step of the largest one's length leaves everybody
        names = [subjects[place] for place in places.tolist()]
        amounts = Counter(names)
        turn = dict(zip(sorted(amounts), rng.permutation(len(amounts)).tolist(), strict=True))
        drawn = rng.permutation(len(places)).tolist()
        order = places[np.array(sorted(drawn, key=lambda i: turn[names[i]]), dtype=np.int64)]
        step = max(amounts.values()) % len(places) or 1
        result[order] = np.roll(order, -step)
    return result


#: Packages that the numbers may depend on.
PACKAGES = (
    "numpy", "scipy", "scikit-image", "torch", "mediapipe", "opencv-python-headless", "h5py",
)  # fmt: skip
WEIGHTS_NAME = "model.safetensors"


@dataclass(frozen=True)
class Checkpoint:
    """A trained network and where it came from."""

    folder: Path
    predictor: TrainedPredictor
    #: of the weights
    sha256: str


def load_checkpoint(folder: Path, dataset_sha256: str) -> Checkpoint:
    """The network in ``folder``, trained with the dataset whose ``dataset.json`` has that hash.

    Raises:
        RequestError: there is none, or it was trained with another dataset.
    """
    from face_prediction.models.learned import LearnedPredictor  # PyTorch: only where needed

    predictor = LearnedPredictor.load(folder)
    trained_with = predictor.record.dataset_sha256
    if trained_with != dataset_sha256:
        raise RequestError(
            f"{folder}: was trained with another dataset ({MANIFEST_NAME} of SHA-256 "
            f"{trained_with[:12]}, not {dataset_sha256[:12]}), whose folds are of other people; "
            "give that one, or train again"
        )
    return Checkpoint(folder, predictor, file_digest(folder / WEIGHTS_NAME))


def provenance(
    dataset: FaceDataset,
    dataset_sha256: str,
    checkpoints: Sequence[Checkpoint],
    options: dict[str, Any],
) -> dict[str, Any]:
    """The part of ``results.json`` that says what the numbers are of."""
    manifest = dataset.manifest
    return {
        "dataset": {
            "sha256": dataset_sha256,
            "folds": manifest.folds,
            "sequences": len(dataset),
            "settings": manifest.settings.to_json(),
        },
        "checkpoints": [
            {
                "folder": item.folder.resolve().name,
                "name": item.predictor.name,
                "preset": item.predictor.preset,
                "test_fold": item.predictor.test_fold,
                "train_subjects": len(item.predictor.train_subjects),
                "sha256": item.sha256,
            }
            for item in checkpoints
        ],
        "options": options,
        "versions": versions(),
    }


def notes(
    trained: Sequence[Contestant],
    folds: Sequence[int],
    all_folds: int,
    max_sequences: int | None,
) -> list[str]:
    """What a reader of the tables must know of what was left out."""
    result: list[str] = []
    if len(folds) < all_folds:
        result.append(f"{len(folds)} of the dataset's {all_folds} folds are reported on.")
    for contestant in trained:
        more = [fold for fold in contestant.folds if fold not in folds]
        if more:
            result.append(
                f"{contestant.name} also has fold {', '.join(map(str, more))}, "
                "which not every network has; left out."
            )
    if max_sequences is not None:
        result.append(f"Of each kind at most {max_sequences} sequences, drawn at random.")
    return result


def versions() -> dict[str, str]:
    """Of Python and the packages that are installed."""
    found = {"python": platform.python_version()}
    for name in PACKAGES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            continue
    return found
