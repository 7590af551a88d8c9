"""What each contestant makes, found out before the whole evaluation is run."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from face_prediction.cross_fit import CrossFit, Fitted
from face_prediction.dataset.reader import FaceDataset
from face_prediction.evaluation.baseline_predictor import BaselinePredictor
from face_prediction.evaluation.batches import Batch, PicturePlan, reduction
from face_prediction.evaluation.contestants import PERSISTENCE, Contestant
from face_prediction.evaluation.detected import DetectedPredictor, Detector
from face_prediction.predictor import PictureNeeds, Predictor


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
