"""Failures of the conditions of a benchmark: shared episodes, distance from success, mouth motion.

python benchmarks/feeding_failures.py docs/results/feeding-cpu/one-training/results.jsonl
"""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from robo_manip_baselines.envs.mujoco.face.motion import MotionLibrary
from robo_manip_baselines.envs.mujoco.tasks.feeding.success import MOUTH_TOLERANCE
from robo_manip_baselines.rollout.results import EpisodeResult, read_rows
from robo_manip_baselines.runs.command import run_command

BLIND = "baseline"
"""Condition that does not observe the mouth where there are no images."""

SHORT = 0.006
"""m beyond the tolerance along x at which a gripper that aims well has nearly arrived."""

HARD = 0.5
"""Share of the policies from which on an episode that they fail is called hard."""


def is_short(result: EpisodeResult) -> bool:
    """Return whether the gripper let go in front of the mouth, just beyond the tolerance."""
    offset = result.columns["closest_offset"]
    if result.failure != "dropped" or offset is None:
        return False
    out, *beside = np.abs(offset)
    limit, *tolerance = MOUTH_TOLERANCE
    return bool(limit <= out < limit + SHORT and np.less(beside, tolerance).all())


def failures(results: Sequence[EpisodeResult]) -> None:
    """Print the episodes in which conditions fail, and the drops just in front of the mouth."""
    seeing = [r for r in results if r.condition != BLIND]
    failed = Counter(r.seed for r in seeing if not r.is_success)
    policies = len({(r.condition, r.train_seed) for r in seeing})
    hard = [count for count in failed.values() if count >= HARD * policies]
    text = f"{failed.total()} failures of {policies} policies"
    if failed:
        text += (
            f", {sum(hard) / failed.total():.0%} of them in {len(hard)} episodes "
            f"in which {HARD:.0%} of them or more fail"
        )
    print(text)
    dropped = [r for r in seeing if r.failure == "dropped"]
    print(
        f"{len(dropped)} dropped, {sum(map(is_short, dropped))} of them let go within "
        f"{1000 * SHORT:.0f} mm of the tolerance along x, beside the mouth by less than it"
    )
    print(f"{'condition':32} success  with those")
    for condition in dict.fromkeys(r.condition for r in results):
        own = [r for r in results if r.condition == condition]
        rates = [np.mean([r.is_success for r in own])]
        rates.append(np.mean([r.is_success or is_short(r) for r in own]))
        print(f"{condition:32} {rates[0]:7.0%}  {rates[1]:10.0%}")


def motion(library: MotionLibrary) -> None:
    """Print the distance that recorded mouths move within a horizon."""
    print("frames  median  90th percentile of the distance that the mouth moves, mm")
    for frames in (1, 2, 3, 4, 5, 8):
        moves = []
        for start, length in zip(library.run_start, library.run_length, strict=True):
            mouth = library.mouth[start : start + length]
            moves.append(1000.0 * np.linalg.norm(mouth[frames:] - mouth[:-frames], axis=1))
        median, far = np.percentile(np.concatenate(moves), [50, 90])
        print(f"{frames:6}  {median:6.1f}  {far:6.1f}")


def main() -> None:
    """Print all of it."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("results", type=Path, help="a results.jsonl of bin/Benchmark.py")
    parser.add_argument("--motion_library", type=Path, help="the shipped one if not given")
    options = parser.parse_args()
    failures(read_rows(options.results))
    motion(MotionLibrary.load(options.motion_library))


if __name__ == "__main__":
    run_command(main)
