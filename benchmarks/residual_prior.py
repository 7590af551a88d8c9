"""Gain from adapting to the watched face: the prior of residual prediction, in parts.

Every fold of a dataset is forecast by what was fitted to the others, from landmarks alone::

    python benchmarks/residual_prior.py face_dataset [--people 4 8 16]

prints Markdown: the mouth's error of the best baseline, and how much lower (or higher, +) that of
each variant is, by kind of footage, over frames 1-2 and 3-5. ``--people`` adds the whole prior
fitted to the first so many people of the folds, in an order drawn from a seed: a learning curve.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from face_prediction.dataset.reader import FaceDataset
from face_prediction.forecast import (
    FORECASTERS,
    LandmarkSequences,
    fit_forecaster,
    mouth_centre,
)
from face_prediction.models.residual.prior import EXPERTS, AdaptivePrior, LinearExpert

HISTORY, HORIZON = 70, 5
SHAPES = 8
SEED = 0
#: Orders of people that a point of the learning curve is the mean of.
DRAWS = 3
BATCH = 64

VARIANTS: dict[str, tuple[LinearExpert, ...]] = {
    "the whole prior": EXPERTS,
    "no expert learns from periods": tuple(e for e in EXPERTS if not e.periodic),
    "no expert adapts": tuple(e for e in EXPERTS if e.shrink is None),
    "all adapt, none to periods": tuple(
        e for e in EXPERTS if e.shrink is not None and not e.periodic
    ),
    "one expert (8 shapes, 3 lags), adapted": (replace(EXPERTS[1]),),
    "one expert (8 shapes, 3 lags), fixed": (EXPERTS[0],),
}


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("dataset", type=Path)
    parser.add_argument("--people", type=int, nargs="*", default=[])
    options = parser.parse_args()
    with FaceDataset(options.dataset) as dataset:
        entries = [dataset.entry(i) for i in range(len(dataset))]
        landmarks = np.stack([dataset.landmarks(i)[..., :2] for i in range(len(dataset))])
    subjects = np.array([entry.subject for entry in entries])
    folds = np.array([-1 if entry.fold is None else entry.fold for entry in entries])
    kinds = np.array([entry.kind for entry in entries])
    truth = mouth_centre(landmarks[:, HISTORY:])

    def baseline(name: str, train: np.ndarray, test: np.ndarray) -> np.ndarray:
        sequences = LandmarkSequences(landmarks[train], tuple(subjects[train]))
        forecaster = fit_forecaster(name, sequences)
        return mouth_centre(forecaster.predict(landmarks[test, :HISTORY], HORIZON))

    def prior(experts: tuple[LinearExpert, ...], train: np.ndarray, test: np.ndarray) -> np.ndarray:
        model = AdaptivePrior(HORIZON, SHAPES, experts)
        model.fit(LandmarkSequences(landmarks[train], tuple(subjects[train])))
        parts: list[np.ndarray] = []
        with torch.inference_mode():
            for part in np.array_split(test, max(1, len(test) // BATCH)):
                mouth, shapes = model.series(torch.tensor(landmarks[part, :HISTORY]))
                ahead = model(mouth, shapes, torch.tensor([HISTORY - 1])).mouth[:, 0]
                parts.append((mouth[:, -1:] + ahead).numpy())
        return np.concatenate(parts)

    def errors(forecast, people: int | None = None, draw: int = 0) -> np.ndarray:
        """(N, H) mean of abs dU and dV, every fold forecast by the others' people."""
        result = np.full((len(landmarks), HORIZON), np.nan)
        for fold in sorted(set(folds[folds >= 0])):
            train, test = np.flatnonzero(folds != fold), np.flatnonzero(folds == fold)
            if people is not None:
                names = np.unique(subjects[train])
                rng = np.random.default_rng([SEED, draw, int(fold)])
                chosen = rng.permutation(names)[:people]
                train = train[np.isin(subjects[train], chosen)]
            result[test] = np.abs(forecast(train, test) - truth[test]).mean(axis=-1)
        return result

    baselines = {
        name: errors(lambda train, test, n=name: baseline(n, train, test)) for name in FORECASTERS
    }
    rows = {
        name: errors(lambda train, test, e=experts: prior(e, train, test))
        for name, experts in VARIANTS.items()
    }
    for people in options.people:
        drawn = [
            errors(lambda train, test: prior(EXPERTS, train, test), people, draw)
            for draw in range(DRAWS)
        ]
        rows[f"the whole prior, fitted to {people} people"] = np.mean(drawn, axis=0)
    shown = [kind for kind in ("natural", "head_motion", "grid") if (kinds == kind).any()]
    print("| | " + " | ".join(f"{k}, 1-2 | {k}, 3-5" for k in shown) + " |")
    print("|---" * (1 + 2 * len(shown)) + "|")
    best = {k: min(baselines, key=lambda n, k=k: baselines[n][kinds == k][:, 2:].mean())
            for k in shown}  # fmt: skip
    cells = [
        f"{baselines[best[k]][kinds == k][:, part].mean():.5f} ({best[k]})"
        for k in shown
        for part in (slice(0, 2), slice(2, 5))
    ]
    print("| best baseline, crops | " + " | ".join(cells) + " |")
    for name, values in rows.items():
        cells = []
        for k in shown:
            for part in (slice(0, 2), slice(2, 5)):
                ours = values[kinds == k][:, part].mean()
                theirs = baselines[best[k]][kinds == k][:, part].mean()
                cells.append(f"{100 * (ours / theirs - 1):+.1f} %")
        print(f"| {name} | " + " | ".join(cells) + " |")


if __name__ == "__main__":
    main()
