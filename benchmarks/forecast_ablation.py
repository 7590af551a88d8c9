"""Worth of each part of residual prediction: the error without it, on people never fitted to.

Every person is forecast by the fit of their fold, whole and with one part taken out: an expert, or
what weights experts and rows. Fits are not repeated: the rest makes up for a part only as far as
the mixture does. Errors are means of abs dU and dV after the first 69 frames of a track, as in
``face-prediction evaluate``; intervals are over people. Every line of ``--out`` is one part on one
fold: a run that was interrupted goes on where it stopped::

    face-prediction fit --dataset face_dataset --test_fold 0 --out checkpoints/residual_fold0
    python benchmarks/forecast_ablation.py --dataset face_dataset \
        --checkpoints checkpoints/residual_fold* --out ablation.jsonl

prints a Markdown table.
"""

from __future__ import annotations

import argparse
import json
from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np

from face_prediction.dataset.reader import FaceDataset
from face_prediction.dataset.tracks import FaceStretch, dataset_stretches
from face_prediction.evaluation.tracks import GROUPS, HORIZON, person_resamples, track_errors
from face_prediction.models.loading import load_predictor
from face_prediction.models.residual import adaptive
from face_prediction.models.residual.experts import EXPERTS
from face_prediction.models.residual.predictor import ResidualFit, ResidualPredictor

WHOLE = "nothing"
CONSTANTS: dict[str, dict[str, float]] = {
    "weights by errors (all experts alike)": {"SHARPNESS": 0.0},
    "caution at rest": {"CAUTION": 0.0, "FAR_CAUTION": 0.0},
    "robust weights of rows": {"ROBUST": 1e6},
    "rows of overlapping errors count less": {"OVERLAP": 0.0},
    "long memory of weights (40 frames)": {"WEIGHT_MEMORY": 40.0},
}
"""Parts that a constant of `adaptive` switches off, and its value then."""
LEARNING = "learning from the face"
SHRINKAGE = "covariance between people (plain ridge)"
_NEVER = 60.0  # logarithm of an expert's error that leaves it without weight


def variants() -> dict[str, int | None]:
    """Parts by name; for an expert its number."""
    names: dict[str, int | None] = {WHOLE: None, LEARNING: None, SHRINKAGE: None}
    names |= dict.fromkeys(CONSTANTS)
    return names | {f"`{expert!r}`": number for number, expert in enumerate(EXPERTS)}


@contextmanager
def without(name: str, fit: ResidualFit) -> Iterator[ResidualFit]:
    """Yield the fit without a part of `variants`."""
    people, number = fit.people, variants()[name]
    if number is not None:
        usual = people.usual.copy()
        usual[number, :, 0] = _NEVER
        people = replace(people, usual=usual)
    changed = []
    for part in people.linear:
        precision = part.precision
        if precision is not None and name == LEARNING:
            precision = 1e12 * precision
        elif precision is not None and name == SHRINKAGE:
            size = precision.shape[-1]
            mean = np.trace(np.linalg.inv(precision), axis1=1, axis2=2) / size
            precision = np.eye(size) / mean[:, None, None]
        changed.append(replace(part, precision=precision))
    constants = CONSTANTS.get(name, {})
    before = {key: getattr(adaptive, key) for key in constants}
    for key, value in constants.items():
        setattr(adaptive, key, value)
    try:
        yield replace(fit, people=replace(people, linear=tuple(changed)))
    finally:
        for key, value in before.items():
            setattr(adaptive, key, value)


def score(
    predictor: ResidualPredictor, stretches: list[FaceStretch], settings
) -> list[dict[str, object]]:
    """Sums of errors by group of frames ahead, and counts, of every track."""
    made = predictor.forecast_tracks([stretch.landmarks for stretch in stretches], HORIZON)
    found: list[dict[str, object]] = []
    for stretch, forecast in zip(stretches, made, strict=True):
        size = np.abs(track_errors(forecast, stretch, settings)[0]).mean(axis=-1)
        parts = [size[:, first - 1 : last] for first, last in GROUPS.values()]
        found.append(
            {
                "subject": stretch.subject,
                "kind": stretch.kind,
                "sums": [float(np.nansum(part)) for part in parts],
                "counts": [int(np.isfinite(part).sum()) for part in parts],
            }
        )
    return found


def table(lines: list[dict], resamples: int) -> str:
    """Markdown: percent by which the error grows without each part, with 95 % over people."""
    sums: dict = defaultdict(lambda: defaultdict(lambda: np.zeros(len(GROUPS))))
    for line in lines:
        for track in line["tracks"]:
            sums[track["kind"]][line["without"], track["subject"]] += np.array(track["sums"])
    shown = [name for name in variants() if any(line["without"] == name for line in lines)]
    text = ["| kind | without | " + " | ".join(GROUPS) + " |", "|---" * (2 + len(GROUPS)) + "|"]
    for kind, by in sums.items():
        subjects = sorted({subject for _, subject in by})
        drawn = person_resamples(len(subjects), resamples, 0)
        weights = np.concatenate([np.ones((1, len(subjects))), drawn])
        whole = weights @ np.array([by[WHOLE, subject] for subject in subjects])
        for name in shown[1:]:
            ours = weights @ np.array([by[name, subject] for subject in subjects])
            percent = 100 * (ours / np.maximum(whole, 1e-300) - 1)
            low, high = np.quantile(percent[1:], (0.025, 0.975), axis=0)
            cells = [
                "–"
                if not whole[0, g]
                else f"{percent[0, g]:+.1f} ({low[g]:+.1f} to {high[g]:+.1f})"
                for g in range(len(GROUPS))
            ]
            text.append(f"| {kind} | {name} | " + " | ".join(cells) + " |")
    return "\n".join(text)


def main() -> None:
    """Score what is not yet in the file, and print the table."""
    parser = argparse.ArgumentParser(description="Error of residual prediction without each part.")
    parser.add_argument("--dataset", type=Path, default=Path("face_dataset"))
    parser.add_argument("--checkpoints", type=Path, nargs="+", required=True, help="one a fold")
    parser.add_argument("--most_frames", type=int, default=400, help="of each track, the first")
    parser.add_argument("--out", type=Path, default=Path("forecast_ablation.jsonl"))
    parser.add_argument("--resamples", type=int, default=1000)
    options = parser.parse_args()
    lines = []
    if options.out.exists():
        lines = [json.loads(line) for line in options.out.read_text().splitlines()]
    done = {(line["without"], line["fold"], line["most_frames"]) for line in lines}
    with FaceDataset(options.dataset) as dataset:
        settings, stretches = dataset.manifest.settings, dataset_stretches(dataset)
    with options.out.open("a") as out:
        for name in variants():
            for folder in options.checkpoints:
                predictor, record = load_predictor(folder)
                fold = record.folds["test"][0]
                if (name, fold, options.most_frames) in done:
                    continue
                assert isinstance(predictor, ResidualPredictor)
                own = [
                    replace(stretch, landmarks=stretch.landmarks[: options.most_frames])
                    for stretch in stretches
                    if stretch.fold == fold
                ]
                with without(name, predictor.fit) as fit:
                    tracks = score(ResidualPredictor(fit), own, settings)
                head = {"without": name, "fold": fold, "most_frames": options.most_frames}
                lines.append({**head, "tracks": tracks})
                print(json.dumps(lines[-1]), file=out, flush=True)
    print(table([x for x in lines if x["most_frames"] == options.most_frames], options.resamples))


if __name__ == "__main__":
    main()
