"""``face-prediction evaluate``: Tables I and II, figures and a video, on people never seen."""

from __future__ import annotations

import logging
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro
from annotated_types import Interval
from tqdm.contrib.logging import logging_redirect_tqdm

from face_prediction.dataset.manifest import MANIFEST_NAME
from face_prediction.dataset.reader import FaceDataset
from face_prediction.dataset.sequences import KINDS
from face_prediction.dataset.split import SplitName, split_dataset
from face_prediction.dataset.tracks import FaceStretch, dataset_stretches
from face_prediction.evaluation.figures import draw_gains, write_figures
from face_prediction.evaluation.predictors import (
    UNFITTED,
    baselines_from,
    fit_baselines,
    group_networks,
    load_network,
    require_strangers,
)
from face_prediction.evaluation.scoring import score_forecasts, score_shuffled_images
from face_prediction.evaluation.setup import (
    PERSISTENCE,
    common_folds,
    notes_on_selection,
    prepare_evaluation,
    provenance,
    require_unseen,
    select_sequences,
    shuffled_partners,
)
from face_prediction.evaluation.statistics import summarise_kind
from face_prediction.evaluation.tables import (
    EVALUATION,
    EvaluationReport,
    earlier_files,
    list_files,
    markdown_table_1,
    write_evaluation_report,
)
from face_prediction.evaluation.tracks import (
    TrackScores,
    score_tracks,
    tracks_record,
    write_tracks,
)
from face_prediction.evaluation.video import write_forecast_video
from face_prediction.forecast import FORECASTERS
from face_prediction.tracking.detector import DetectorSettings, FaceDetector, find_model
from robo_manip_baselines.runs.errors import RequestError, require_choice
from robo_manip_baselines.runs.files import file_digest, locked, require_out_folder
from robo_manip_baselines.runs.ranges import Seed, require_ranges

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class EvaluateOptions:
    """Score trained networks beside the baselines, on people that they never saw.

    Every sequence is forecast by the checkpoint whose test fold holds its person; checkpoints of
    one network for different folds are one row. Weights of another dataset, such as those shipped,
    forecast everybody, as long as they were trained on nobody here. Baselines are fitted to all
    other folds, or to another dataset.

    Example: face-prediction evaluate --dataset my_faces --checkpoints shipped
    --baselines_from shipped

    Attributes:
        dataset: folder made by build-dataset.
        checkpoints: folders written by fit or train, or shipped; none: baselines only.
        baselines: baselines to fit: all, or names; persistence is always there. Of a dataset with
            one fold, only those without parameters can be.
        baselines_from: a dataset that baselines are fitted to as well, as rows of their own; or
            shipped: those that come with the shipped weights.
        split: person: nobody is forecast by what was trained on them. sequence: the paper's,
            windows that were not trained on, of people who were.
        tracks: also forecast whole tracks, from every frame, up to 24 frames ahead; by person only.
        warm_up: frames at the beginning of each track that are not forecast from; None: so many
            that the first forecast has seen as many frames as in a sequence (69).
        kinds: kinds of footage to report on, each by itself.
        out: folder for tables and figures.
        detector_model: MediaPipe's face_landmarker.task, for networks that forecast images only.
            By default the one in ~/.cache/face_prediction (or $XDG_CACHE_HOME/face_prediction).
        seed: of the bootstrap, of what --max_sequences draws and of the permutation of
            --shuffle_images.
        max_sequences: sequences of each kind, at most; None: all.
        resamples: resamples of the bootstrap.
        shuffle_images: ablation: also give every network the images of other sequences, and report
            how much worse it gets.
        figures: draw figures and a video. They show people's faces: do not publish them.
        progress: show a progress bar.
    """

    dataset: Path
    checkpoints: tuple[Path, ...] = ()
    baselines: tuple[str, ...] = ("all",)
    baselines_from: Path | None = None
    split: SplitName = "person"
    tracks: bool = True
    warm_up: Annotated[int, Interval(ge=0, le=10**6)] | None = None
    kinds: tuple[str, ...] = KINDS
    out: Path = Path("results/faces")
    detector_model: Path | None = None
    seed: Seed = 0
    max_sequences: Annotated[int, Interval(ge=2, le=10**9)] | None = None
    resamples: Annotated[int, Interval(ge=1, le=10**6)] = 2000
    shuffle_images: Annotated[bool, tyro.conf.arg(aliases=("--shuffle_pictures",))] = False
    figures: bool = True
    progress: bool = True


def run_evaluate(options: EvaluateOptions) -> int:
    """Forecast, score, write.

    Raises:
        RequestError: dataset, checkpoints and options do not go together.
    """
    check_evaluate_options(options)
    with locked(options.out, is_kept=False):
        return _evaluate(options)


def _evaluate(options: EvaluateOptions) -> int:
    earlier = earlier_files(options.out)
    with ExitStack() as stack:
        dataset = stack.enter_context(FaceDataset(options.dataset))
        stack.enter_context(logging_redirect_tqdm())
        dataset_sha256 = file_digest(options.dataset / MANIFEST_NAME)
        split = split_dataset(dataset, options.split)
        loaded = [load_network(folder, dataset_sha256, split) for folder in options.checkpoints]
        networks = group_networks(loaded, split.used)
        notes = [
            require_strangers(dataset, fitted)
            for fitted in loaded
            if (fitted.checkpoint or {})["test_fold"] is None
        ]
        require_unseen(dataset, split, networks)
        folds = common_folds(networks) if networks else tuple(split.used)
        selection = select_sequences(
            dataset, folds, options.kinds, options.max_sequences, options.seed, split
        )
        kinds = {row.kind for row in selection.rows}
        settings = dataset.manifest.settings
        warm_up = settings.history - 1 if options.warm_up is None else options.warm_up
        stretches: list[FaceStretch] = []
        if options.tracks and split.by == "person":
            found = dataset_stretches(dataset, folds, max(settings.length, warm_up + 2))
            if not (stretches := [stretch for stretch in found if stretch.kind in kinds]):
                raise RequestError(f"--warm_up {warm_up}: no track is longer")
        names, more = baseline_names(options, split.parts)
        notes += more
        logger.info("fitting the baselines")
        baselines = fit_baselines(dataset, (PERSISTENCE, *names), folds, split)
        if options.baselines_from is not None:
            wanted = FORECASTERS if "all" in options.baselines else options.baselines
            baselines += baselines_from(options.baselines_from, wanted, folds, dataset)
        require_unseen(dataset, split, baselines)
        setup = prepare_evaluation(
            dataset,
            selection,
            [*baselines, *networks],
            lambda: stack.enter_context(open_detector(options.detector_model)),
        )
        partners = None
        if options.shuffle_images:
            of_rows = [row.kind for row in selection.rows], [row.subject for row in selection.rows]
            partners = shuffled_partners(*of_rows, options.seed)
        scores = score_forecasts(setup, options.progress)
        if partners is not None:
            score_shuffled_images(setup, scores, partners, options.progress)
        summaries = tuple(
            summarise_kind(scores, kind, seed=options.seed, resamples=options.resamples)
            for kind in KINDS
            if kind in kinds
        )
        option_record = {
            "seed": options.seed,
            "max_sequences": options.max_sequences,
            "resamples": options.resamples,
            "shuffle_pictures": options.shuffle_images,
        }
        record = provenance(dataset, dataset_sha256, split, loaded, option_record)
        left_out = notes_on_selection(networks, folds, split, options.max_sequences)
        record["notes"] = [*notes, *left_out]
        tracks: list[TrackScores] = []
        if stretches:
            # not those of the setup: its persistence copies images, of which a track has none
            rows = [*baselines, *networks]
            tracks = score_tracks(dataset.manifest, stretches, rows, warm_up, options.progress)
            record["tracks"] = tracks_record(tracks, options.resamples, options.seed, warm_up)
        report = EvaluationReport(summaries, settings.history, folds, record)
        written = write_evaluation_report(options.out, report, earlier)
        logger.info("%s: tables.md, table1.csv, table2.csv, results.json", options.out)
        if tracks:
            written += write_tracks(options.out, tracks, options.resamples, options.seed, warm_up)
            logger.info("%s: tracks.md, people.csv", options.out)
        if options.figures:
            written += draw_gains(options.out / "gains.png", tracks)
            written += write_figures(options.out, setup, scores, summaries)
            written.append(options.out / "forecast.mp4")
            write_forecast_video(written[-1], dataset, scores, summaries[0])
            logger.info("%s: figures and a video, which show people's faces", options.out)
        list_files(options.out, report, written, earlier)
    for summary in summaries:
        print(f"\n{summary.kind}, {summary.sequences} sequences")  # noqa: T201
        print(markdown_table_1(summary))  # noqa: T201
    return 0


def baseline_names(options: EvaluateOptions, folds: int) -> tuple[list[str], list[str]]:
    """Baselines to fit to the people of other folds, and sentences on those that cannot be.

    Of a dataset with one fold those named that have parameters are left to ``baselines_from``.
    """
    named = list(FORECASTERS) if "all" in options.baselines else list(options.baselines)
    is_refused = "all" not in options.baselines and options.baselines_from is None
    if folds > 1 or is_refused:
        return named, []
    return [name for name in named if name in UNFITTED], [
        "One fold: only baselines without parameters are fitted to it."
    ]


def check_evaluate_options(options: EvaluateOptions) -> None:
    """Raise RequestError if an option is out of its range, before anything is read."""
    for kind in options.kinds:
        require_choice("kind of footage", kind, KINDS)
    for name in options.baselines:
        if name != "all":
            require_choice("baseline", name, FORECASTERS)
    require_ranges(options, "--{} {}")
    model = options.detector_model
    if model is not None and not model.is_file():
        raise RequestError(f"--detector_model {model}: no such file")
    require_out_folder(options.out, EVALUATION, [options.dataset, *options.checkpoints])


def open_detector(model: Path | None) -> FaceDetector:
    """A detector that looks for one face, since a crop holds one."""
    return FaceDetector(find_model(model), DetectorSettings(num_faces=1))
