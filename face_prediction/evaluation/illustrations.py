"""Which figures an evaluation draws, and of which sequences.

They show people's faces.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from face_prediction.dataset.reader import FaceDataset
from face_prediction.evaluation.batches import Batch, PicturePlan
from face_prediction.evaluation.clip_story import clip_story, telling_run
from face_prediction.evaluation.clip_video import write_clip_video
from face_prediction.evaluation.contestants import PERSISTENCE
from face_prediction.evaluation.curves import draw_calibration, draw_errors
from face_prediction.evaluation.figures import Shown, draw_forecast
from face_prediction.evaluation.judge import Verdict, forecast_of
from face_prediction.evaluation.line_up import LineUp
from face_prediction.evaluation.mouth_errors import mouth_distances
from face_prediction.evaluation.summary import KindSummary

logger = logging.getLogger(__name__)

#: Of the sequences of a kind, the one shown is where so large a share moves less: with the usual
#: sequence there would be little to see.
_LIVELIER_THAN = 0.9


def draw_plots(folder: Path, summaries: Sequence[KindSummary]) -> None:
    """``errors.png`` and, where there are intervals, ``calibration.png``: nobody's picture."""
    draw_errors(folder / "errors.png", summaries)
    with_intervals = [summary for summary in summaries if any(summary.has_intervals)]
    if with_intervals:
        draw_calibration(folder / "calibration.png", with_intervals)


def draw_pictures(folder: Path, dataset: FaceDataset, verdict: Verdict, line_up: LineUp) -> None:
    """``forecast_KIND_ROW.png`` of each row that makes pictures; of one sequence for each kind."""
    settings, selection = dataset.manifest.settings, verdict.selection
    frames = range(settings.history + 1, settings.length + 1)
    for kind in dict.fromkeys(selection.kinds):
        place = telling_sequence(verdict, kind)
        fold, subject = int(selection.folds[place]), selection.subjects[place]
        for contestant in line_up.contestants:
            size = line_up.picture_sizes[contestant.name]
            if not size:
                continue
            predictor = contestant.fit.of(fold, subject)
            plan = PicturePlan.of([predictor.needs], [size])
            batch = Batch(dataset, [int(selection.indices[place])], plan)
            forecast = forecast_of(
                predictor, batch.history, batch.shown(predictor.needs), settings.future
            )
            if forecast.pictures is None:
                continue
            draw_forecast(
                folder / f"forecast_{kind}_{_file_name(contestant.name)}.png",
                f"{contestant.name}, {kind}: clip {selection.clips[place]}",
                frames,
                Shown(batch.coming(size)[0], batch.future[0]),
                Shown(forecast.pictures[0], forecast.landmarks[0]),
            )


def draw_video(
    path: Path, dataset: FaceDataset, verdict: Verdict, summaries: Sequence[KindSummary]
) -> None:
    """The best network, or else the best baseline, and what it is compared with, on one clip."""
    summary = summaries[0]
    settings = dataset.manifest.settings
    run = telling_run(verdict, summary.kind, settings.stride, settings.fps)
    distance = summary.numbers["pooled_distance"].value
    networks = [i for i, role in enumerate(summary.roles) if role == "network"]
    names = [summary.best_baseline]
    if networks and np.isfinite(distance[networks]).any():
        names.insert(0, summary.rows[networks[int(np.nanargmin(distance[networks]))]])
    elif summary.best_baseline != PERSISTENCE:
        names.append(PERSISTENCE)
    shown = [(name, verdict.row(name).residuals[run]) for name in names]
    write_clip_video(path, clip_story(dataset, verdict.selection.indices[run].tolist(), shown))


def telling_sequence(verdict: Verdict, kind: str) -> int:
    """The place of a sequence with more motion than most of its kind."""
    places = verdict.selection.of_kind(kind)
    last = mouth_distances(verdict.row(PERSISTENCE).residuals[places])[:, -1]
    return int(places[np.argsort(last, kind="stable")[int(_LIVELIER_THAN * (len(last) - 1))]])


def _file_name(name: str) -> str:
    return re.sub(r"\W+", "_", name).strip("_")
