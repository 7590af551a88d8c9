"""``bin/Replay.py``: replay recorded episodes, compare every state, and draw a video."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import tyro

from robo_manip_baselines.runs.command import parse
from robo_manip_baselines.runs.errors import RequestError
from robo_manip_baselines.runs.files import locked_file, require_out_file
from robo_manip_baselines.runs.videos import VIDEO

EXAMPLE = "python bin/Replay.py dataset/FeedingEnv/episode_000000.hdf5 --video replay.mp4"


@dataclass(frozen=True)
class ReplayOptions:
    """Replay recorded episodes, compare every state, and draw a video if asked."""

    episodes: tyro.conf.Positional[tuple[Path, ...]]
    """Episode files, or folders of them."""
    video: Path | None = None
    """Write an H.264 video of the replayed episodes here."""
    view: bool = False
    """Show the episodes in MuJoCo's viewer, in real time."""


def replay_episodes(options: ReplayOptions) -> int:
    """Replay the episodes of the options; return 1 if any state strays from the recorded one.

    Raises:
        RequestError: no episode is named, or a file is damaged or of another model.
    """
    # Imported here: --help needs no simulator.
    from robo_manip_baselines.data import list_episodes
    from robo_manip_baselines.envs.mujoco.cell.opengl import opengl_problem, require_viewer
    from robo_manip_baselines.rollout.demonstrate import deviation
    from robo_manip_baselines.rollout.videos import write_preview

    paths: list[Path] = []
    for given in options.episodes:
        paths += list_episodes(given) if given.is_dir() else [given]
    if not paths:
        raise RequestError("no episode to replay; name files, or a folder that holds some")
    if options.video:
        require_out_file(options.video, VIDEO, paths, option="--video")
        if problem := opengl_problem():
            raise RequestError(f"--video {options.video}: {problem}")
    if options.view:
        require_viewer()
    strays = 0
    for path in paths:
        found = deviation(path, is_watched=options.view)
        strays += found.qpos > 0.0 or found.qvel > 0.0
        within = f"qpos within {found.qpos:g}, qvel within {found.qvel:g}"
        print(f"{path}: {found.steps} steps, {within}")  # noqa: T201
    print(f"{len(paths) - strays} of {len(paths)} episodes replay bit for bit")  # noqa: T201
    if options.video:
        with locked_file(options.video):
            write_preview(options.video, paths)
        print(f"video: {options.video}")  # noqa: T201
    return int(strays > 0)


def main(args: Sequence[str]) -> int:
    """Run ``bin/Replay.py``."""
    return replay_episodes(parse(ReplayOptions, EXAMPLE, args=args))
