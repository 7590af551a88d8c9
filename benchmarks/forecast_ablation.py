"""Worth of each part of residual prediction: the error without it, on people never fitted to.

Every person is forecast by the fit of their fold, whole and with one part taken out: an expert, or
what weights experts and rows. Fits are not repeated: the rest makes up for a part only as far as
the mixture does. Without an expert, or with other weights, the forecasts of the whole are mixed
again. Errors are means of abs dU and dV after the first 69 frames of a track, as in
``face-prediction evaluate``; intervals are over people. Every line of ``--out`` is one part on one
fold, with the digest of the weights: a run that was interrupted goes on where it stopped, and a
fold that was fitted again is forecast again::

    face-prediction fit --dataset face_dataset --test_fold 0 --out checkpoints/residual_fold0
    python benchmarks/forecast_ablation.py --dataset face_dataset \
        --checkpoints checkpoints/residual_fold* --out ablation.jsonl

prints a Markdown table of these checkpoints.
"""

from __future__ import annotations

import argparse
import json
import os
from collections import defaultdict
from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from face_prediction.dataset.reader import FaceDataset
from face_prediction.dataset.sequences import SequenceSettings
from face_prediction.dataset.tracks import FaceStretch, dataset_stretches
from face_prediction.evaluation.tracks import TRACK_GROUPS, person_resamples
from face_prediction.models.loading import load_predictor
from face_prediction.models.residual import adaptive
from face_prediction.models.residual.adaptive import HORIZONS
from face_prediction.models.residual.experts import EXPERTS
from face_prediction.models.residual.fit import missed, mix_again, trial
from face_prediction.models.residual.predictor import (
    ResidualFit,
    ResidualPredictor,
    face_series,
    face_side,
)
from robo_manip_baselines.runs.command import run_command
from robo_manip_baselines.runs.documents import convert, parse_json, read_json_lines
from robo_manip_baselines.runs.errors import RequestError
from robo_manip_baselines.runs.files import AppendFile, file_digest, locked_file

WEIGHTS = "model.safetensors"
WHOLE = "nothing"
MIXING: dict[str, dict[str, float]] = {
    "weights by errors (all experts alike)": {"SHARPNESS": 0.0},
    "caution at rest": {"CAUTION": 0.0},
}
"""Parts of the mixture that a constant of `adaptive` switches off, and its value then."""
ROWS: dict[str, dict[str, float]] = {
    "overlapping errors count less": {"OVERLAP": 0.0},
}
"""The same, of what a face teaches as well."""
LEARNING = "learning from the face"
SHRINKAGE = "covariance between people (plain ridge)"
_NEVER = 60.0  # logarithm of an expert's error that leaves it without weight


def mixing_variants() -> dict[str, int | None]:
    """Parts that need no other forecasts of the experts; for an expert its number."""
    experts = {f"`{expert!r}`": number for number, expert in enumerate(EXPERTS)}
    return dict.fromkeys(MIXING) | experts


def variants() -> list[str]:
    """All parts, in the order of the table."""
    return [WHOLE, LEARNING, SHRINKAGE, *ROWS, *mixing_variants()]


@contextmanager
def without(name: str, fit: ResidualFit) -> Iterator[ResidualFit]:
    """Yield the fit without a part of `variants`."""
    people, number = fit.people, mixing_variants().get(name)
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
    constants = {**MIXING, **ROWS}.get(name, {})
    before = {key: getattr(adaptive, key) for key in constants}
    for key, value in constants.items():
        setattr(adaptive, key, value)
    try:
        yield replace(fit, people=replace(people, linear=tuple(changed)))
    finally:
        for key, value in before.items():
            setattr(adaptive, key, value)


def sums(stretch: FaceStretch, errors: np.ndarray, settings: SequenceSettings) -> dict[str, object]:
    """Sums and counts by group of frames ahead of errors (T, H, 2) in face sides, in crops."""
    crops = stretch.crop_sides(settings) / face_side(stretch.landmarks[0])
    size = (np.abs(errors).mean(axis=-1) / crops[:, None])[settings.history - 1 :]
    knots = np.array(HORIZONS)
    parts = [size[:, (knots >= first) & (knots <= last)] for first, last in TRACK_GROUPS.values()]
    return {
        "subject": stretch.subject,
        "kind": stretch.kind,
        "sums": [float(np.nansum(part)) for part in parts],
        "counts": [int(np.isfinite(part).sum()) for part in parts],
    }


def score(
    fit: ResidualFit, stretches: list[FaceStretch], settings: SequenceSettings, names: list[str]
) -> Iterator[tuple[str, list[dict[str, object]]]]:
    """Yield each part's name, and the sums of every track without it."""
    shown = [stretch.landmarks / face_side(stretch.landmarks[0]) for stretch in stretches]
    series = [face_series(track, fit.basis) for track in shown]
    cuts = np.cumsum([len(track) for track in series])[:-1]
    mixing = [name for name in names if name in mixing_variants()]
    for name in [name for name in variants() if name in names or (name == WHOLE and mixing)]:
        if name in mixing:
            continue
        with without(name, fit) as changed:
            tried = trial(changed, series)
        errors = [missed(made, track) for (_, made), track in zip(tried, series, strict=True)]
        if name in names:
            yield name, [sums(*pair, settings) for pair in zip(stretches, errors, strict=True)]
        if name != WHOLE:
            continue
        for other in mixing:
            with without(other, fit) as changed:
                again = mix_again(changed.people, [made for made, _ in tried], series)[1]
            pairs = zip(stretches, np.split(again, cuts), strict=True)
            yield other, [sums(*pair, settings) for pair in pairs]


def read_lines(path: Path) -> list[dict[str, Any]]:
    """Read the lines of ``--out``, if it exists, and remove a last one that was cut off.

    Raises:
        RequestError: the file cannot be read, or a line is damaged.
    """
    if not path.exists():
        return []
    lines: list[dict[str, Any]] = []
    for number, text in read_json_lines(path):
        source = f"'{path}', line {number}"
        lines.append(convert(parse_json(text, source), dict, source))
    os.truncate(path, path.read_bytes().rfind(b"\n") + 1)
    return lines


def load_fit(folder: Path) -> tuple[ResidualFit, dict[str, Any]]:
    """Load the fit of a fold; return it with what its lines hold: ``fold`` and ``sha256``.

    Raises:
        RequestError: it is no residual prediction, or no people were left for the report.
    """
    predictor, record = load_predictor(folder)
    if not isinstance(predictor, ResidualPredictor):
        raise RequestError(f"'{folder}': holds {record.model}; give folders of face-prediction fit")
    if record.split != "person" or not record.folds["test"]:
        raise RequestError(f"'{folder}': leaves no fold of people out; fit it with --test_fold")
    digest = file_digest(folder / WEIGHTS)
    return predictor.fit, {"fold": record.folds["test"][0], "sha256": digest}


def table(lines: list[dict[str, Any]], resamples: int) -> str:
    """Markdown: percent by which the error grows without each part, with 95 % over people."""
    found: dict = defaultdict(lambda: defaultdict(lambda: np.zeros(len(TRACK_GROUPS))))
    for line in lines:
        for track in line["tracks"]:
            found[track["kind"]][line["without"], track["subject"]] += np.array(track["sums"])
    shown = [name for name in variants() if any(line["without"] == name for line in lines)]
    text = [
        "| kind | without | " + " | ".join(TRACK_GROUPS) + " |",
        "|---" * (2 + len(TRACK_GROUPS)) + "|",
    ]
    for kind, by in found.items():
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
                for g in range(len(TRACK_GROUPS))
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
    fits = [load_fit(folder) for folder in options.checkpoints]
    if len({origin["fold"] for _, origin in fits}) < len(fits):
        raise RequestError("--checkpoints: two leave out the same fold; give one of each fold")
    with FaceDataset(options.dataset) as dataset:
        settings, stretches = dataset.manifest.settings, dataset_stretches(dataset)
    chosen: list[dict[str, Any]] = []
    with locked_file(options.out):
        lines = read_lines(options.out)
        with closing(AppendFile(options.out, is_flushed=True)) as out:
            for fit, origin in fits:
                head = {**origin, "most_frames": options.most_frames}
                there = [line for line in lines if head.items() <= line.items()]
                done = {line["without"] for line in there}
                own = [
                    replace(stretch, landmarks=stretch.landmarks[: options.most_frames])
                    for stretch in stretches
                    if stretch.fold == origin["fold"]
                ]
                names = [name for name in variants() if name not in done]
                for name, tracks in score(fit, own, settings, names):
                    there.append({"without": name, **head, "tracks": tracks})
                    out.append(f"{json.dumps(there[-1])}\n".encode())
                chosen += there
    print(table(chosen, options.resamples))


if __name__ == "__main__":
    run_command(main)
