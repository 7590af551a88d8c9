"""Errors of every baseline forecaster on sequences of 75 frames cut from face tracks.

Subjects are dealt into folds; each fold is forecast by baselines fitted to the others, so that
nobody is forecast by what was learnt from them. Footage kinds are reported apart::

    face-prediction extract clips/*.mp4 --out face_tracks
    python benchmarks/forecast_baselines.py face_tracks --attribution clips.csv

prints Markdown tables. ``--stats FOLDER`` writes ``error_stats_FORECASTER_KIND.json`` as well.
"""

from __future__ import annotations

import argparse
import time
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from face_prediction.dataset.sequences import (
    KINDS,
    SequenceSettings,
    clip_frames,
    find_sequences,
    kind_of,
)
from face_prediction.evaluation.error_stats import (
    MouthResiduals,
    data_hash,
    measure_error_stats,
    save_predictor_error_stats,
)
from face_prediction.evaluation.statistics import bootstrap_mean
from face_prediction.forecast import FORECASTERS, LandmarkSequences, fit_forecaster
from face_prediction.forecast.interface import subject_folds
from face_prediction.motion.library import read_attributions
from face_prediction.prediction.errors import (
    mouth_distances,
    mouth_errors,
    mouth_residuals,
    normalised_mean_errors,
)
from face_prediction.tracking.tracks import load_track
from robo_manip_baselines.runs.command import run_command
from robo_manip_baselines.runs.errors import RequestError

PERSISTENCE = "persistence"
FOLDS = 5


@dataclass(frozen=True)
class Windows:
    """N sequences of T frames: landmarks (N, T, L, 2), and where each is from."""

    landmarks: np.ndarray
    clips: np.ndarray
    subjects: np.ndarray
    kinds: np.ndarray
    starts: np.ndarray
    dropped: Counter[str]


@dataclass(frozen=True)
class Scores:
    """Of one forecaster: residuals (N, H, 2), NME (N, H), seconds, and what each fold fitted."""

    residuals: np.ndarray
    nme: np.ndarray
    forecasts: np.ndarray
    fit_seconds: float
    predict_seconds: float
    fitted: tuple[str, ...]


def cut_windows(folder: Path, table: Path | None, settings: SequenceSettings) -> Windows:
    """Every sequence of every track in ``folder``; a clip that is in no table is its own person.

    Raises:
        RequestError: there is none, or a track or the table cannot be read.
    """
    rows = read_attributions(table) if table else {}
    kinds = {clip: kind_of(row) for clip, row in rows.items()}
    parts: list[np.ndarray] = []
    clips: list[str] = []
    starts: list[int] = []
    dropped: Counter[str] = Counter()
    for path in sorted(folder.glob("*.npz")):
        track = load_track(path)
        if not track.valid.any():
            dropped["clips without a face"] += 1
            continue
        frames = clip_frames(track, settings)
        found = find_sequences(frames, settings)
        dropped.update(found.dropped)
        for start, crop in zip(found.start, found.crops, strict=True):
            shown = frames.landmarks[start : start + settings.length]
            parts.append(crop.normalise(shown, frames.image_size)[..., :2].astype(np.float32))
        clips += [path.stem] * len(found)
        starts += found.start.tolist()
    if not parts:
        raise RequestError(f"'{folder}': no sequence of {settings.length} frames in its tracks")
    return Windows(
        landmarks=np.stack(parts),
        clips=np.array(clips),
        subjects=np.array([rows[clip].subject if clip in rows else clip for clip in clips]),
        kinds=np.array([kinds.get(clip, "natural") for clip in clips]),
        starts=np.array(starts),
        dropped=dropped,
    )


def score(name: str, windows: Windows, fold: np.ndarray, history: int) -> Scores:
    """Forecast each fold's people with what was fitted to the other folds."""
    truth = windows.landmarks[:, history:]
    forecasts = np.empty_like(truth)
    fit_seconds = predict_seconds = 0.0
    fitted: list[str] = []
    for f in range(fold.max() + 1):
        others = fold != f
        known = LandmarkSequences(windows.landmarks[others], tuple(windows.subjects[others]))
        began = time.perf_counter()
        forecaster = fit_forecaster(name, known)
        fit_seconds += time.perf_counter() - began
        began = time.perf_counter()
        shown = windows.landmarks[~others, :history]
        forecasts[~others] = forecaster.predict(shown, truth.shape[1])
        predict_seconds += time.perf_counter() - began
        fitted.append(describe(forecaster.arrays()))
    return Scores(
        residuals=mouth_residuals(forecasts, truth),
        nme=normalised_mean_errors(forecasts, truth),
        forecasts=forecasts,
        fit_seconds=fit_seconds / (fold.max() + 1),
        predict_seconds=predict_seconds,
        fitted=tuple(fitted),
    )


def describe(arrays: dict[str, np.ndarray]) -> str:
    """Hyperparameters of a fit: order x components, or the filter's ratio of variances."""
    if "coefficients" in arrays:
        return " x ".join(str(n) for n in arrays["coefficients"].shape[:2])
    if "process" in arrays:
        ratios = arrays["process"] / arrays["measurement"]
        return f"q/r {ratios[0]:.2g} {ratios[1]:.2g}"
    return ""


def print_kind(kind: str, windows: Windows, scores: dict[str, Scores], resamples: int) -> None:
    """The tables of one kind of footage."""
    rows = windows.kinds == kind
    subjects = windows.subjects[rows].tolist()
    print(
        f"\n### {kind}: {rows.sum()} sequences, {len(set(windows.clips[rows]))} clips, "
        f"{len(set(subjects))} subjects\n"
    )
    print(f"Clips: {', '.join(sorted(set(windows.clips[rows])))}.\n")
    horizons = range(scores[PERSISTENCE].residuals.shape[1])
    print("Mean of abs dU and abs dV of the mouth centre, in crops, by frame ahead; and over all")
    print("frames, with a 95 % interval.\n")
    print("| | " + " | ".join(str(h + 1) for h in horizons) + " | all | 95 % interval |")
    print("|---|" + "---|" * (len(horizons) + 2))
    for name, result in scores.items():
        size = np.abs(result.residuals[rows]).mean(axis=2)  # (N, H)
        interval = bootstrap_mean(size.mean(axis=1), subjects, resamples=resamples)
        cells = " | ".join(f"{value:.4f}" for value in size.mean(axis=0))
        print(
            f"| {name} | {cells} | {float(interval.value):.4f} "
            f"| {float(interval.low):.4f}–{float(interval.high):.4f} |"
        )
    print("\n| | mean dU | var dU | mean dV | var dV | NME | skill 1 | skill 3 | skill 5 |")
    print("|---|" + "---|" * 8)
    reference = mouth_distances(scores[PERSISTENCE].residuals[rows])
    for name, result in scores.items():
        errors = mouth_errors(result.residuals[rows])
        (u, v), (var_u, var_v) = errors.pooled_mean, errors.pooled_variance
        distances = mouth_distances(result.residuals[rows])
        both = np.isfinite(distances) & np.isfinite(reference)
        ours, theirs = (np.where(both, size, 0.0).sum(axis=0) for size in (distances, reference))
        gained = 1 - ours / theirs
        skills = " | ".join(f"{gained[h]:+.2f}" for h in (0, len(gained) // 2, len(gained) - 1))
        print(
            f"| {name} | {u:.4f} | {var_u:.2e} | {v:.4f} | {var_v:.2e} | "
            f"{result.nme[rows].mean():.4f} | {skills} |"
        )


def write_stats(
    folder: Path, windows: Windows, scores: dict[str, Scores], settings: SequenceSettings
) -> None:
    """``error_stats.json`` of each forecaster on each kind of footage."""
    for name, result in scores.items():
        for kind in sorted(set(windows.kinds)):
            rows = windows.kinds == kind
            residuals = MouthResiduals(
                result.residuals[rows],
                windows.clips[rows].tolist(),
                windows.subjects[rows].tolist(),
                windows.starts[rows].tolist(),
                stride_frames=settings.stride,
                predictor=name,
                data_sha256=data_hash(
                    windows.landmarks[rows, settings.history :], result.forecasts[rows]
                ),
            )
            stats = measure_error_stats(residuals, kind, fps=settings.fps)
            save_predictor_error_stats(folder / f"error_stats_{name}_{kind}.json", stats)


def main() -> None:
    """Cut, forecast, print."""
    parser = argparse.ArgumentParser(description="Errors of the baselines on face tracks.")
    parser.add_argument("tracks", type=Path, help="folder of face tracks (.npz)")
    parser.add_argument("--attribution", type=Path, help="table that names each clip's subject")
    parser.add_argument("--stride", type=int, default=15, help="frames between sequences")
    parser.add_argument("--crop_from", choices=("history", "sequence"), default="history")
    parser.add_argument("--resamples", type=int, default=2000, help="of the bootstrap")
    parser.add_argument("--stats", type=Path, help="folder for error_stats files")
    options = parser.parse_args()
    settings = SequenceSettings(stride=options.stride, crop_from=options.crop_from)
    windows = cut_windows(options.tracks, options.attribution, settings)
    fold = subject_folds(windows.subjects.tolist(), FOLDS)
    print(
        f"{len(windows.landmarks)} sequences of {settings.length} frames, "
        f"{len(set(windows.subjects))} subjects in {fold.max() + 1} folds, stride "
        f"{settings.stride}, crop from the {settings.crop_from}; dropped: "
        + ", ".join(f"{count} {reason}" for reason, count in windows.dropped.items())
    )
    scores = {name: score(name, windows, fold, settings.history) for name in FORECASTERS}
    for kind in KINDS:
        if kind in windows.kinds:
            print_kind(kind, windows, scores, options.resamples)
    print("\n### Time, and what was fitted\n")
    print("| | fit, s a fold | predict, ms a sequence | chosen in each fold |")
    print("|---|---|---|---|")
    for name, result in scores.items():
        each = 1000 * result.predict_seconds / len(windows.landmarks)
        chosen = "; ".join(result.fitted) if any(result.fitted) else ""
        print(f"| {name} | {result.fit_seconds:.2f} | {each:.2f} | {chosen} |")
    if options.stats:
        write_stats(options.stats, windows, scores, settings)


if __name__ == "__main__":
    run_command(main)
