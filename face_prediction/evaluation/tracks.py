"""Whole tracks: forecasts from every frame of a face that has been watched for a while.

The paper's protocol shows a predictor 70 frames and asks for five. A robot watches a face for as
long as it is there and, with its latency, needs to know more than five frames. Here every frame
after a warm-up, which is as long as the paper's history, is forecast from, up to 24 frames ahead. A
predictor that keeps a state sees the face's whole past; the others see their memory. Errors are in
crops around the last frames, as in the paper's protocol.

Legend: T frames of a track, N forecasts, R rows of the tables, H horizon, G groups of frames ahead,
P people; the last axis of errors holds U and V.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from face_prediction.dataset.manifest import Manifest
from face_prediction.dataset.sequences import SequenceSettings
from face_prediction.dataset.tracks import FaceStretch
from face_prediction.evaluation import statistics
from face_prediction.evaluation.predictors import EvaluatedPredictor
from face_prediction.evaluation.scoring import interval_levels
from face_prediction.evaluation.setup import PERSISTENCE
from face_prediction.forecast.interface import mouth_centre
from face_prediction.prediction.interface import Predictor, StatefulPredictor, TrackForecast
from robo_manip_baselines.runs.errors import RequestError
from robo_manip_baselines.runs.files import write_text
from robo_manip_baselines.runs.markdown import markdown_table
from robo_manip_baselines.runs.progress import ProgressBar

Floats = NDArray[np.float64]

HORIZON = 24
"""Frames ahead, 0.8 s: as far as the robot's side looks."""
TRACK_GROUPS: dict[str, tuple[int, int]] = {
    **{f"{first}–{last}": (first, last) for first, last in statistics.GROUPS},
    **{str(h): (h, h) for h in (8, 12, 18, 24)},
}
"""Frames ahead (from, to) that errors are the mean of: those of sequences, and farther ones."""
FAR = list(TRACK_GROUPS).index("3–5")
"""The group that the best baseline is chosen by, as in the paper's protocol."""
NOMINAL = (0.5, 0.9)
NONE = "–"
"""Cell of a number that there is none for."""
_HISTORIES = 64  # at once


@dataclass(frozen=True)
class TrackScores:
    """Mean absolute errors of every row, by person.

    Attributes:
        kind: of footage.
        subjects: P names.
        frames: (P,) forecasts of each person.
        smoothness: (P,) of the mouth's motion, see `smoothness`.
        rows: R names and roles.
        errors: (P, R, G) sums over a person's forecasts of the mean of abs dU and dV, in crops.
        counts: (P, G) forecasts with an outcome.
        inside: (P, R, G, 2) sums of the shares of U and V inside the intervals of `NOMINAL`; NaN
            where a row has none.
    """

    kind: str
    subjects: tuple[str, ...]
    frames: NDArray[np.int64]
    smoothness: Floats
    rows: tuple[tuple[str, str], ...]
    errors: Floats
    counts: Floats
    inside: Floats

    @property
    def best(self) -> int:
        """The baseline with the least error at frames 3-5."""
        sums = self.errors.sum(axis=0)
        baselines = [i for i, (_, role) in enumerate(self.rows) if role == "baseline"]
        return min(baselines, key=lambda i: sums[i, FAR])


def forecast_track(
    predictor: Predictor, landmarks: NDArray[np.floating], history: int, horizon: int
) -> TrackForecast:
    """Forecast the mouth from every frame of landmarks (T, L, 2), by the frames up to it.

    A predictor without a state sees at most the frames of its memory, and of ``history``.
    """
    if isinstance(predictor, StatefulPredictor):
        return predictor.forecast_tracks([landmarks], horizon)[0]
    memory = min(predictor.memory or history, history)
    mouth = mouth_centre(landmarks)
    moved = np.empty((len(landmarks), horizon, 2))
    for first in range(0, len(landmarks), _HISTORIES):
        frames = np.arange(first, min(first + _HISTORIES, len(landmarks)))
        rows = np.maximum(frames[:, None] - np.arange(memory - 1, -1, -1), 0)
        forecast = predictor.predict(landmarks[rows], None, horizon)
        moved[frames] = mouth_centre(forecast.landmarks) - mouth[frames, None]
    return TrackForecast(moved)


def forecast_stretches(
    evaluated: EvaluatedPredictor, stretches: Sequence[FaceStretch], history: int
) -> list[TrackForecast]:
    """Forecast every stretch up to `HORIZON`, by the fit to other people than its own.

    Stretches of a predictor that keeps a state are followed side by side, which is faster.
    """
    if evaluated.name == PERSISTENCE:  # whose predictor wants images, to copy them
        return [TrackForecast(np.zeros((len(stretch), HORIZON, 2))) for stretch in stretches]
    chosen = [evaluated.predictor_for(stretch.fold, stretch.subject) for stretch in stretches]
    made: dict[int, TrackForecast] = {}
    for predictor in {id(own): own for own in chosen}.values():
        numbers = [number for number, own in enumerate(chosen) if own is predictor]
        tracks = [stretches[number].landmarks for number in numbers]
        if isinstance(predictor, StatefulPredictor):
            forecasts = predictor.forecast_tracks(tracks, HORIZON)
        else:
            forecasts = [forecast_track(predictor, track, history, HORIZON) for track in tracks]
        made.update(zip(numbers, forecasts, strict=True))
    return [made[number] for number in range(len(stretches))]


def track_errors(
    made: TrackForecast, stretch: FaceStretch, settings: SequenceSettings, warm_up: int
) -> tuple[Floats, Floats | None]:
    """Errors (N, H, 2) in crops after the warm-up, and levels of intervals that just reach them.

    NaN where the track has ended before.
    """
    mouth, horizon = mouth_centre(stretch.landmarks), made.mouth.shape[1]
    first, last = warm_up, len(stretch)
    errors = np.full((last - first, horizon, 2), np.nan)
    for ahead in range(1, horizon + 1):
        count = last - first - ahead
        if count > 0:
            true = mouth[first + ahead :] - mouth[first : first + count]
            errors[:count, ahead - 1] = made.mouth[first : first + count, ahead - 1] - true
    levels = None
    if made.scale is not None and made.degrees_of_freedom is not None:
        levels = interval_levels(errors, made.scale[first:], made.degrees_of_freedom[first:])
    return errors / stretch.crop_sides(settings)[first:, None, None], levels


def smoothness(mouth: Floats) -> float:
    """Correlation of the mouth's steps (T, 2) with the next ones: 1 smooth, 0 at random."""
    steps = np.diff(mouth, axis=0)
    power = float((steps[:-1] ** 2).sum() * (steps[1:] ** 2).sum()) ** 0.5
    return float((steps[:-1] * steps[1:]).sum()) / power if power else 0.0


def score_tracks(
    manifest: Manifest,
    stretches: Sequence[FaceStretch],
    predictors: Sequence[EvaluatedPredictor],
    warm_up: int,
    progress: bool = False,
) -> list[TrackScores]:
    """Score predictors that look at no images, on every stretch, by kind of footage and person.

    `PERSISTENCE` counts among them: it copies landmarks and images alike.

    Args:
        manifest: of the dataset.
        stretches: of its tracks, each longer than the warm-up.
        predictors: rows.
        warm_up: frames at the beginning of each stretch that are not forecast from.
        progress: show a bar.
    """
    settings = manifest.settings
    shown = [p for p in predictors if p.name == PERSISTENCE or not any(n.frames for n in p.needs)]
    groups = [slice(first - 1, last) for first, last in TRACK_GROUPS.values()]
    result: list[TrackScores] = []
    with ProgressBar(len(stretches), "track", shown=progress, keep=False) as bar:
        for kind in dict.fromkeys(stretch.kind for stretch in stretches):
            own = [stretch for stretch in stretches if stretch.kind == kind]
            subjects = sorted({stretch.subject for stretch in own})
            shape = (len(subjects), len(shown), len(groups))
            errors, inside = np.zeros(shape), np.zeros((*shape, len(NOMINAL)))
            counts, frames = np.zeros((shape[0], shape[2])), np.zeros(shape[0], dtype=np.int64)
            smooth = np.zeros((shape[0], 2))
            forecasts = [forecast_stretches(p, own, settings.history) for p in shown]
            for number, stretch in enumerate(own):
                person = subjects.index(stretch.subject)
                frames[person] += len(stretch) - warm_up
                steps = smoothness(mouth_centre(stretch.landmarks))
                smooth[person] += (len(stretch) * steps, len(stretch))
                for row in range(len(shown)):
                    missed, levels = track_errors(
                        forecasts[row][number], stretch, settings, warm_up
                    )
                    size = np.abs(missed).mean(axis=-1)
                    for place, group in enumerate(groups):
                        errors[person, row, place] += np.nansum(size[:, group])
                        if row == 0:
                            counts[person, place] += np.isfinite(size[:, group]).sum()
                        if levels is None:
                            inside[person, row, place] = np.nan
                            continue
                        part = levels[:, group]
                        for k, nominal in enumerate(NOMINAL):
                            share = (part <= nominal).mean(axis=-1)
                            inside[person, row, place, k] += share.sum()
                bar.advance(1)
            rows = tuple((predictor.name, predictor.role) for predictor in shown)
            result.append(
                TrackScores(
                    kind,
                    tuple(subjects),
                    frames,
                    smooth[:, 0] / smooth[:, 1],
                    rows,
                    errors,
                    counts,
                    inside,
                )
            )
    return result


def person_resamples(people: int, resamples: int, seed: int) -> NDArray[np.int64]:
    """Times (W, P) that each person is in each resample, drawn from ``seed``.

    Raises:
        RequestError: there is nobody.
    """
    if people < 1:
        raise RequestError("no people to resample")
    drawn = np.random.default_rng(seed).integers(people, size=(resamples, people))
    return np.stack([np.bincount(row, minlength=people) for row in drawn])


def differences(scores: TrackScores, resamples: int, seed: int) -> Floats:
    """Percent (3, R, G) by which each row's error differs from the best baseline's at each group.

    The first is the value, the others the bounds of its 95 % interval over people. The best
    baseline of each group is taken, so that a row is never compared with a weak one. NaN where no
    forecast has an outcome.
    """
    _, roles = zip(*scores.rows, strict=True)
    baselines = [i for i, role in enumerate(roles) if role == "baseline"]
    weights = np.concatenate(
        [
            np.ones((1, len(scores.subjects))),
            person_resamples(len(scores.subjects), resamples, seed),
        ]
    )
    sums = np.einsum("wp,prg->wrg", weights, scores.errors)
    best = sums[0, baselines].argmin(axis=0)  # chosen once, on all people
    reference = np.stack([sums[:, baselines[b], g] for g, b in enumerate(best)], axis=-1)
    percent = 100 * (sums / np.maximum(reference[:, None], 1e-300) - 1)
    percent[..., scores.counts.sum(axis=0) == 0] = np.nan
    return np.stack([percent[0], *np.quantile(percent[1:], (0.025, 0.975), axis=0)])


def mean_errors(scores: TrackScores) -> Floats:
    """Mean absolute errors (R, G) in crops; NaN where no forecast has an outcome."""
    return scores.errors.sum(axis=0) / _outcomes(scores)


def coverages(scores: TrackScores) -> Floats:
    """Percent (R, G, 2) of U and V inside the intervals of `NOMINAL`.

    NaN without intervals, and where no forecast has an outcome.
    """
    return 100 * scores.inside.sum(axis=0) / _outcomes(scores)[:, None]


def _outcomes(scores: TrackScores) -> Floats:
    counts = scores.counts.sum(axis=0)
    return np.where(counts > 0, counts, np.nan)


def tracks_markdown(
    all_scores: Sequence[TrackScores], resamples: int, seed: int, warm_up: int
) -> str:
    """``tracks.md``: a section for each kind of footage."""
    parts = [
        "# Forecasts of whole tracks",
        f"Every frame of a face but the first {warm_up} is forecast from, up to 24 frames ahead. "
        "Predictors that keep a state see the face's whole past. Errors are the mean of abs dU and "
        "dV of the mouth centre, in crops. In brackets: 95 % intervals from resampling people.",
    ]
    for scores in all_scores:
        people = f"{len(scores.subjects)} people, {int(scores.frames.sum())} forecasts"
        parts.append(f"## {scores.kind}: {people}")
        head = ["", *(f"{name} ahead" for name in TRACK_GROUPS)]
        means = mean_errors(scores)
        rows = [
            [name, *(_cell(value, ".4f") for value in means[i])]
            for i, (name, _) in enumerate(scores.rows)
        ]
        parts.append(markdown_table(head, rows))
        value, low, high = differences(scores, resamples, seed)
        networks = [i for i, (_, role) in enumerate(scores.rows) if role == "network"]
        if networks:
            parts.append("### Against the baseline that is best at these frames")
            rows = [
                [
                    scores.rows[i][0],
                    *(
                        NONE
                        if np.isnan(value[i, g])
                        else f"{value[i, g]:+.1f} % ({low[i, g]:+.1f} to {high[i, g]:+.1f})"
                        for g in range(len(TRACK_GROUPS))
                    ),
                ]
                for i in networks
            ]
            parts.append(markdown_table(head, rows))
        covered = coverages(scores)
        rows = [
            [f"{scores.rows[i][0]}, {nominal:.0%}", *(_cell(v, ".1f") for v in covered[i, :, k])]
            for i in range(len(scores.rows))
            if np.isfinite(covered[i]).any()
            for k, nominal in enumerate(NOMINAL)
        ]
        if rows:
            parts.append("### Coverage of intervals, in percent")
            parts.append(markdown_table(head, rows))
        parts.append(f"### By person, frames 3–5, against {scores.rows[scores.best][0]}")
        head = ["person", "forecasts", "smoothness", scores.rows[scores.best][0]]
        head += [scores.rows[i][0] for i in networks]
        head += [f"{scores.rows[i][0]}, 90 % hold" for i in networks]
        parts.append(markdown_table(head, _person_rows(scores, networks)))
    return "\n\n".join(parts) + "\n"


def _cell(value: float, form: str) -> str:
    return NONE if np.isnan(value) else format(value, form)


def _person_rows(scores: TrackScores, networks: Sequence[int]) -> list[list[object]]:
    """Cells of the table of people."""
    rows: list[list[object]] = []
    for person, name in enumerate(scores.subjects):
        count = max(float(scores.counts[person, FAR]), 1.0)
        best = scores.errors[person, scores.best, FAR]
        row: list[object] = [name, int(scores.frames[person])]
        row += [f"{scores.smoothness[person]:.2f}", f"{best / count:.4f}"]
        gains = [100 * (scores.errors[person, i, FAR] / max(best, 1e-300) - 1) for i in networks]
        row += [f"{gain:+.1f} %" for gain in gains]
        shares = [100 * scores.inside[person, i, FAR, 1] / count for i in networks]
        row += [_cell(share, ".1f") for share in shares]
        rows.append(row)
    return rows


def people_csv(all_scores: Sequence[TrackScores]) -> str:
    """``people.csv``: a line for each kind, person and row."""
    stream = io.StringIO()
    table = csv.writer(stream, lineterminator="\n")
    groups = [name.replace("–", "_") for name in TRACK_GROUPS]
    head = ["kind", "subject", "forecasts", "smoothness", "row", "role"]
    table.writerow([*head, *(f"error_{g}" for g in groups), *(f"held_90_{g}" for g in groups)])
    for scores in all_scores:
        for person, subject in enumerate(scores.subjects):
            start = [scores.kind, subject, int(scores.frames[person])]
            start.append(f"{scores.smoothness[person]:.4g}")
            counts = np.maximum(scores.counts[person], 1)
            for i, (name, role) in enumerate(scores.rows):
                errors = scores.errors[person, i] / counts
                held = scores.inside[person, i, :, 1] / counts
                cells = [*errors.tolist(), *held.tolist()]
                table.writerow(
                    [*start, name, role, *("" if np.isnan(c) else f"{c:.6g}" for c in cells)]
                )
    return stream.getvalue()


def tracks_record(
    all_scores: Sequence[TrackScores], resamples: int, seed: int, warm_up: int
) -> Mapping[str, Any]:
    """The part ``tracks`` of ``results.json``."""
    result: dict[str, Any] = {
        "horizon_groups": list(TRACK_GROUPS.values()),
        "nominal": list(NOMINAL),
        "warm_up": warm_up,
    }
    for scores in all_scores:
        means = mean_errors(scores)
        value, low, high = differences(scores, resamples, seed)
        covered = coverages(scores)
        result[scores.kind] = {
            "people": len(scores.subjects),
            "forecasts": int(scores.frames.sum()),
            "rows": [
                {
                    "name": name,
                    "role": role,
                    "mean_abs": _rounded(means[i]),
                    "difference": _rounded(value[i]),
                    "difference_low": _rounded(low[i]),
                    "difference_high": _rounded(high[i]),
                    "held": [_rounded(covered[i, :, k]) for k in range(len(NOMINAL))],
                }
                for i, (name, role) in enumerate(scores.rows)
            ],
        }
    return result


def _rounded(values: Floats) -> list[float | None]:
    return [None if np.isnan(v) else float(f"{v:.6g}") for v in values.tolist()]


def write_tracks(
    folder: Path, all_scores: Sequence[TrackScores], resamples: int, seed: int, warm_up: int
) -> list[Path]:
    """Write ``tracks.md`` and ``people.csv``, each whole or not at all; return their paths."""
    texts = {
        "tracks.md": tracks_markdown(all_scores, resamples, seed, warm_up),
        "people.csv": people_csv(all_scores),
    }
    for name, text in texts.items():
        write_text(folder / name, text)
    return [folder / name for name in texts]
