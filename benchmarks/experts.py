"""Scripted experts of feeding: success, forces and slip, expert by expert, clip by clip.

Example: python benchmarks/experts.py --num_episodes 50
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import mink
import numpy as np

from robo_manip_baselines.envs.mujoco.tasks.feeding import ENTRY
from robo_manip_baselines.envs.mujoco.tasks.feeding.env import FeedingEnv
from robo_manip_baselines.envs.mujoco.tasks.feeding.success import Phase
from robo_manip_baselines.envs.mujoco.tasks.registry import make_env
from robo_manip_baselines.runs.command import parse, run_command
from robo_manip_baselines.runs.errors import RequestError


@dataclass(frozen=True)
class Options:
    """Run episodes of every scripted expert and print their results."""

    num_episodes: int = 50
    """Episodes of each expert, one for each seed from --seed on."""
    seed: int = 0
    """Seed of the first episode."""
    face_motion: str = "episode"
    """episode or after_lift."""
    motion: str = "recorded"
    """Of the face, as the option --motion of Rollout.py takes it."""
    utensil: str = "gripper"
    """gripper or spoon."""


@dataclass(frozen=True)
class ExpertEpisode:
    """One episode.

    Attributes:
        clip: recorded clip whose motion the face replayed.
        is_success, is_success_strict: as in ``info``.
        touched_face: the gripper touched lips or face after the lift.
        released_inside: the cube was let go in the mouth.
        completion_time: s; NaN without success.
        slip: m, how far the cube moved in the gripper while it was carried.
        force: N, largest between robot and face.
    """

    seed: int
    clip: str
    is_success: bool
    is_success_strict: bool
    touched_face: bool
    released_inside: bool
    completion_time: float
    slip: float
    force: float


def play(world: FeedingEnv, expert: str, seed: int) -> ExpertEpisode:
    """Run one episode."""
    actor = ENTRY.make_expert(expert, world)
    world.reset(seed=seed)
    actor.reset()
    force, carried = 0.0, []
    for _ in range(600):
        _, _, terminated, _, info = world.step(actor.act())
        force = max(force, info["face_force"])
        if world.progress.phase is Phase.CARRY:
            gripper = mink.SO3(world.gripper_orientation)
            carried.append(gripper.inverse().apply(world.cube_position - world.gripper_position))
        if terminated:
            break
    time = world.progress.completion_time
    return ExpertEpisode(
        seed=seed,
        clip=world.segment.clip,
        is_success=world.progress.is_success,
        is_success_strict=world.progress.is_success_strict,
        touched_face=world.progress.touched_face,
        released_inside=world.progress.released_inside,
        completion_time=np.nan if time is None else time,
        slip=float(np.ptp(carried, axis=0).max()) if carried else np.nan,
        force=force,
    )


def table(name: str, outcomes: dict[str, list[ExpertEpisode]]) -> Iterator[str]:
    """Lay outcomes out as Markdown, a row for each group."""
    heads = [
        name,
        "success",
        "strict",
        "touched face",
        "let go outside",
        "completion time (s, mean ± sd)",
    ]
    heads += ["slip (mm)", "force (N)", "failed"]
    yield f"| {' | '.join(heads)} |"
    yield "|---" * len(heads) + "|"
    for group, played in outcomes.items():
        n = len(played)
        times = [outcome.completion_time for outcome in played if outcome.is_success]
        slips = [1e3 * outcome.slip for outcome in played]
        forces = [outcome.force for outcome in played]
        failed = ", ".join(str(outcome.seed) for outcome in played if not outcome.is_success)
        yield (
            f"| {group} | {sum(o.is_success for o in played)}/{n} "
            f"| {sum(o.is_success_strict for o in played)}/{n} "
            f"| {sum(o.touched_face for o in played)} "
            f"| {sum(not o.released_inside for o in played)} "
            f"| {np.mean(times):.2f} ± {np.std(times, ddof=min(1, len(times) - 1)):.2f} "
            f"| {np.median(slips):.1f}, at most {np.max(slips):.1f} "
            f"| {np.median(forces):.1f}, at most {np.max(forces):.1f} | {failed or '–'} |"
        )


def main() -> None:
    """Run and print."""
    options: Options = parse(Options, "python benchmarks/experts.py --num_episodes 50")
    if options.num_episodes < 1:
        raise RequestError(f"num_episodes {options.num_episodes}: must be 1 or more")
    env = make_env(
        "FeedingEnv",
        cameras=(),
        face_motion=options.face_motion,
        motion=options.motion,
        utensil=options.utensil,
    )
    assert isinstance(env.unwrapped, FeedingEnv)
    seeds = range(options.seed, options.seed + options.num_episodes)
    by_expert = {
        expert: [play(env.unwrapped, expert, seed) for seed in seeds] for expert in ENTRY.experts
    }
    env.close()
    print("\n".join(table("expert", by_expert)), end="\n\n")
    for expert, outcomes in by_expert.items():
        clips = sorted({outcome.clip for outcome in outcomes})
        by_clip = {clip: [o for o in outcomes if o.clip == clip] for clip in clips}
        print("\n".join(table(f"{expert}, by clip", by_clip)), end="\n\n")


if __name__ == "__main__":
    run_command(main)
