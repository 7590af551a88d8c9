"""Coverage of a benchmark's 95 % intervals, and false positives of its tests, by simulation.

In the simulated benchmarks all conditions are equally good, episodes are hard or easy for all of
them, and training runs are better or worse by luck.

    python benchmarks/interval_coverage.py
"""

from __future__ import annotations

import argparse

import numpy as np
from tqdm import tqdm

from robo_manip_baselines.benchmark.statistics.inference import paired_success, rate_estimate
from robo_manip_baselines.rollout.results import Proportion

DIFFICULTY = 1.2
"""Standard deviation of the episodes' log-odds: from 1 in 7 to 6 in 7 at one of them."""

MIDDLE = 0.6
"""Log-odds of an average run in an average episode."""


def draw(
    rng: np.random.Generator, conditions: int, runs: int, episodes: int, luck: float
) -> np.ndarray:
    """Draw outcomes (conditions, runs, episodes) of conditions that are equally good."""
    odds = (
        MIDDLE
        + luck * rng.normal(size=(conditions, runs, 1))
        + DIFFICULTY * rng.normal(size=(1, 1, episodes))
    )
    return (rng.random(odds.shape) < 1.0 / (1.0 + np.exp(-odds))).astype(float)


def main() -> None:
    """Print a table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--benchmarks", type=int, default=500, help="simulated for each row")
    parser.add_argument("--episodes", type=int, default=100)
    parser.add_argument("--resamples", type=int, default=300)
    options = parser.parse_args()
    rng = np.random.default_rng(0)
    print(
        "| luck of a run | training seeds | its interval holds the true rate | Wilson over all "
        "episodes | interval holds the true difference, 0 | McNemar below 0.05 |"
    )
    print("|--:|--:|--:|--:|--:|--:|")
    for luck in (0.0, 0.3, 0.6):
        truth = draw(rng, 1, 3000, 1000, luck).mean()
        for runs in (1, 2, 3, 5):
            hits = np.zeros(4)
            for _ in tqdm(range(options.benchmarks), leave=False):
                ours, theirs = draw(rng, 2, runs, options.episodes, luck)
                rate = rate_estimate(ours, rng, options.resamples)
                pooled = Proportion.of(int(ours.sum()), ours.size)
                pairs = paired_success(ours, theirs, rng, options.resamples)
                hits += (
                    (rate.low or 0.0) <= truth <= (rate.high or 1.0),
                    (pooled.low or 0.0) <= truth <= (pooled.high or 1.0),
                    (pairs.difference.low or 0.0) <= 0.0 <= (pairs.difference.high or 0.0),
                    (pairs.p or 1.0) < 0.05,
                )
            rates = " | ".join(f"{100 * hit / options.benchmarks:.0f} %" for hit in hits)
            print(f"| {luck:g} | {runs} | {rates} |", flush=True)


if __name__ == "__main__":
    main()
