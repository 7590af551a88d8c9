"""Safety of a scripted expert, for each face and motion: the table of ``docs/safety.md``.

python benchmarks/expert_safety.py --motions recorded sway turn_away --num_episodes 50
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from robo_manip_baselines.benchmark.report.figures import draw_faces, styled_figure
from robo_manip_baselines.envs.mujoco.cell.scene import CONTROL_PERIOD
from robo_manip_baselines.envs.mujoco.face import FACES
from robo_manip_baselines.envs.mujoco.tasks.face_env import world_of
from robo_manip_baselines.envs.mujoco.tasks.registry import make_env
from robo_manip_baselines.envs.mujoco.tasks.safety import (
    FORCE_TIERS,
    EpisodeSafety,
    SafetyMetrics,
    SafetySummary,
    summarize_safety,
)
from robo_manip_baselines.runs.command import parse, run_command
from robo_manip_baselines.runs.files import atomic_file


@dataclass(frozen=True)
class Options:
    """Let a scripted expert act, and print its safety for each motion and face."""

    env: str = "FeedingEnv"
    """Task."""
    expert: str = "reactive"
    """Name in the task's entry."""
    faces: tuple[str, ...] = FACES
    """Kinds of face."""
    motions: tuple[str, ...] = ("recorded",)
    """Motions of the face by name."""
    num_episodes: int = 50
    """Episodes of each, one a seed."""
    seed: int = 0
    """Seed of the first."""
    figure: Path | None = None
    """PNG of the faces with their contact points."""


class ExpertEpisode(NamedTuple):
    """Episode of a scripted expert.

    Attributes:
        is_success, is_success_strict, completion_time: as in the last ``info``.
        safety: of the episode.
    """

    is_success: bool
    is_success_strict: bool
    completion_time: float | None
    safety: EpisodeSafety


def run_expert(
    env: str, expert: str, face: str, motion: str, seeds: range
) -> Iterator[ExpertEpisode]:
    """Let an expert act through episodes, one a seed."""
    with contextlib.closing(make_env(env, cameras=(), face=face, motion=motion)) as made:
        world = world_of(made)
        world.measures_proximity = True
        actor = world.task.make_expert(expert, world)
        for seed in seeds:
            _, info = made.reset(seed=seed)
            actor.reset()
            metrics, ended = SafetyMetrics(CONTROL_PERIOD), False
            while not ended:
                _, _, terminated, truncated, info = made.step(actor.act())
                metrics.update(info)
                ended = terminated or truncated
            yield ExpertEpisode(
                bool(info["is_success"]),
                bool(info["is_success_strict"]),
                info["completion_time"],
                metrics.result(info),
            )


def row_of(face: str, motion: str, successes: int, safety: SafetySummary) -> str:
    """Return a row of the table."""
    above = " / ".join(str(safety.above[str(tier)]) for tier in FORCE_TIERS)
    speed = "–"
    if safety.approach_speed is not None:
        speed = f"{safety.approach_speed_p90:.3f} ({safety.approach_speed:.3f})"
    refusals = "–"
    if safety.refusals is not None:
        refusals = f"{safety.refusals_respected} of {safety.refusals}"
    cells = (
        face,
        motion,
        f"{successes} of {safety.episodes}",
        f"{safety.safe} of {safety.episodes}",
        f"{safety.force:.1f} ({safety.force_max:.1f})",
        above,
        f"{safety.food_force:.1f}",
        str(safety.eye_contacts),
        str(safety.eye_near_misses),
        speed,
        refusals,
    )
    return f"| {' | '.join(cells)} |"


def main() -> None:
    """Print the table, and draw the figure if one is asked for."""
    options = parse(Options, "python benchmarks/expert_safety.py --motions recorded sway")
    tiers = " / ".join(map(str, FORCE_TIERS))
    head = (
        "face | motion | success | safe success | largest force, N: mean (largest) | "
        f"episodes above {tiers} N | food on lips, N | eyes touched | near an eye | "
        "approach, m/s: p90 (largest) | refusals respected"
    )
    print(f"| {head} |\n|{'---|' * (head.count('|') + 1)}")
    seeds = range(options.seed, options.seed + options.num_episodes)
    panels: dict[str, list[EpisodeSafety]] = {}
    for motion in options.motions:
        for face in options.faces:
            episodes = list(run_expert(options.env, options.expert, face, motion, seeds))
            found = [episode.safety for episode in episodes]
            panels[f"{face}, {motion}"] = found
            if summary := summarize_safety(found):
                successes = sum(episode.is_success for episode in episodes)
                print(row_of(face, motion, successes, summary), flush=True)
    if options.figure:
        with styled_figure("agg", "white") as figure:
            draw_faces(figure, panels)
            with atomic_file(options.figure) as temporary:
                figure.savefig(temporary, format="png", dpi=150)


if __name__ == "__main__":
    run_command(main)
