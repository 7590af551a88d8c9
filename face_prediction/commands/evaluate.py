"""``face-prediction evaluate``: Tables I and II, figures and a video, on people never seen."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tqdm import tqdm
from tqdm.contrib.logging import logging_redirect_tqdm

from face_prediction.dataset.manifest import MANIFEST_NAME
from face_prediction.dataset.reader import FaceDataset
from face_prediction.dataset.sequences import KINDS
from face_prediction.evaluation.scoring import Verdict, judge, judge_exchanged, steps
from face_prediction.evaluation.setup import (
    LineUp,
    Selection,
    baselines,
    common_folds,
    exchange_pictures,
    line_up,
    load_checkpoint,
    networks,
    notes,
    provenance,
    require_unseen,
    select,
)
from face_prediction.evaluation.statistics import KindSummary, summarise
from face_prediction.evaluation.tables import Evaluation, table_1, write_results
from face_prediction.evaluation.video import draw_pictures, draw_plots, draw_video
from face_prediction.forecast import FORECASTERS
from face_prediction.tracking.detector import DetectorSettings, FaceDetector, find_model
from robo_manip_baselines.runs.errors import RequestError
from robo_manip_baselines.runs.files import file_digest

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class EvaluateOptions:
    """Judge trained networks beside the baselines, on people that they never saw.

    Every sequence is forecast by the checkpoint whose test fold holds its person; checkpoints of
    one network for different folds are one row. Baselines are fitted to all other folds.

    Example: face-prediction evaluate --dataset face_dataset --checkpoints checkpoints/residual_*
    """

    #: Folder made by build-dataset.
    dataset: Path
    #: Folders written by train; none: baselines only.
    checkpoints: tuple[Path, ...] = ()
    #: Baselines to fit: all, or names; persistence is always there.
    baselines: tuple[str, ...] = ("all",)
    #: Kinds of footage to report on, each by itself.
    kinds: tuple[str, ...] = KINDS
    #: Folder for tables and figures.
    out: Path = Path("results/faces")
    #: MediaPipe's face_landmarker.task, for networks that forecast pictures only. By default the
    #: one in ~/.cache/face_prediction (or $XDG_CACHE_HOME/face_prediction).
    detector_model: Path | None = None
    #: Of the bootstrap, of what --max_sequences draws and of what --shuffle_pictures exchanges.
    seed: int = 0
    #: Sequences of each kind, at most; None: all.
    max_sequences: int | None = None
    #: Resamples of the bootstrap.
    resamples: int = 2000
    #: Also show every network the pictures of other sequences, and say how much worse it gets.
    shuffle_pictures: bool = False
    #: Draw figures and a video. They show people's faces: do not publish them.
    figures: bool = True
    #: Show a progress bar.
    progress: bool = True


def run_evaluate(options: EvaluateOptions) -> int:
    """Forecast, judge, write.

    Raises:
        RequestError: dataset, checkpoints and options do not go together.
    """
    check_options(options)
    with ExitStack() as stack:
        dataset = stack.enter_context(FaceDataset(options.dataset))
        stack.enter_context(logging_redirect_tqdm())
        dataset_sha256 = file_digest(options.dataset / MANIFEST_NAME)
        checkpoints = [load_checkpoint(path, dataset_sha256) for path in options.checkpoints]
        trained = networks([(item.folder, item.predictor) for item in checkpoints])
        require_unseen(dataset, trained)
        folds = common_folds(trained) if trained else tuple(range(dataset.manifest.folds))
        selection = select(dataset, folds, options.kinds, options.max_sequences, options.seed)
        names = tuple(FORECASTERS) if "all" in options.baselines else options.baselines
        logger.info("fitting the baselines to the people of other folds")
        field = line_up(
            dataset,
            [*baselines(dataset, names, folds), *trained],
            lambda: stack.enter_context(open_detector(options.detector_model)),
        )
        verdict, summaries = judged(options, dataset, selection, field)
        record = {
            **provenance(dataset, dataset_sha256, checkpoints, option_record(options)),
            "notes": notes(trained, folds, dataset.manifest.folds, options.max_sequences),
        }
        history = dataset.manifest.settings.history
        write_results(options.out, Evaluation(summaries, history, folds, record))
        logger.info("%s: tables.md, table1.csv, table2.csv, results.json", options.out)
        if options.figures:
            draw_plots(options.out, summaries)
            draw_pictures(options.out, dataset, verdict, field)
            draw_video(options.out / "forecast.mp4", dataset, verdict, summaries)
            logger.info("%s: figures and a video, which show people's faces", options.out)
    for summary in summaries:
        print(f"\n{summary.kind}, {summary.sequences} sequences")  # noqa: T201
        print("\n".join(table_1(summary)[2:-1]))  # noqa: T201
    return 0


def judged(
    options: EvaluateOptions, dataset: FaceDataset, selection: Selection, field: LineUp
) -> tuple[Verdict, tuple[KindSummary, ...]]:
    """Forecast everything, and sum up each kind of footage."""
    partner = None
    if options.shuffle_pictures:
        partner = exchange_pictures(selection.kinds, selection.subjects, options.seed)
    total = steps(selection, field, partner is not None)
    with tqdm(total=total, unit="forecast", leave=False, disable=not options.progress) as bar:
        verdict = judge(dataset, selection, field, bar)
        exchanged = {}
        if partner is not None:
            exchanged = judge_exchanged(dataset, selection, field, partner, bar)
    return verdict, tuple(
        summarise(verdict, kind, exchanged, seed=options.seed, resamples=options.resamples)
        for kind in KINDS
        if kind in selection.kinds
    )


def option_record(options: EvaluateOptions) -> dict[str, Any]:
    """The options that the numbers depend on."""
    names = ("seed", "max_sequences", "resamples", "shuffle_pictures")
    return {name: getattr(options, name) for name in names}


def check_options(options: EvaluateOptions) -> None:
    """Check what can be checked before anything is read.

    Raises:
        RequestError: an option is out of its range.
    """
    for kind in options.kinds:
        if kind not in KINDS:
            raise RequestError(f"--kinds {kind}; there are {', '.join(KINDS)}")
    for name, least in (("seed", 0), ("resamples", 1), ("max_sequences", 2)):
        value = getattr(options, name)
        if value is not None and value < least:
            raise RequestError(f"--{name} {value}: {least} or more")
    model = options.detector_model
    if model is not None and not model.is_file():
        raise RequestError(f"--detector_model {model}: no such file")
    if options.out.exists() and not options.out.is_dir():
        raise RequestError(f"--out {options.out}: is a file; name a folder")


@contextmanager
def open_detector(model: Path | None) -> Iterator[FaceDetector]:
    """A detector that looks for one face, since a crop holds one."""
    with FaceDetector(find_model(model), DetectorSettings(num_faces=1)) as detector:
        yield detector
