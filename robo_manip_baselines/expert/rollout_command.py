"""``bin/Rollout.py``: its options, and what it does and says."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from pathlib import Path

import tyro

from robo_manip_baselines.data import list_episodes
from robo_manip_baselines.data.images import DEFAULT_QUALITY
from robo_manip_baselines.errors import RequestError
from robo_manip_baselines.evaluation.preview import write_preview
from robo_manip_baselines.expert.collect import Collection, Summary, collect
from robo_manip_baselines.observation import CAMERAS
from robo_manip_baselines.opengl_check import opengl_problem

logger = logging.getLogger(__name__)

PREVIEW = "preview.mp4"

EXAMPLE = "python bin/Rollout.py FeedingEnv --scripted --num_episodes 50 --workers 2"


@dataclass(frozen=True)
class RolloutOptions:
    """Let a scripted expert act in an environment and write its episodes down."""

    env: tyro.conf.Positional[str]
    """Environment, for example FeedingEnv."""
    scripted: bool = False
    """Let the scripted expert act."""
    expert: str = "reactive"
    """reactive: Algorithm 1 of the paper. anticipatory: aims where the mouth will be."""
    num_episodes: int = 50
    """Episodes, one for each seed from --seed on."""
    seed: int = 0
    """Seed of the first episode."""
    out: Path | None = None
    """Folder to write to; dataset/<env> if not given."""
    cameras: tuple[str, ...] = CAMERAS
    """Cameras to record, or none."""
    image_size: str = "480x640"
    """Height x width of the images, in pixels."""
    image_codec: str = "jpeg"
    """jpeg, png or raw."""
    image_quality: int = DEFAULT_QUALITY
    """Quality of jpeg, 1 to 100."""
    face_motion: str = "episode"
    """When the face starts to move: with the episode, or after_lift."""
    clips: tuple[str, ...] = ()
    """Recorded clips to draw from; all if not given."""
    motion_library: Path | None = None
    """File of recorded face motion; the one that ships with the package if not given."""
    workers: int = 2
    """Processes."""
    preview: int = 2
    """How many of the first episodes the preview video shows; 0 for no video."""


def rollout(options: RolloutOptions) -> None:
    """Collect what the options ask for, then print a table and write the preview.

    Raises:
        RequestError: the request cannot be met.
    """
    if not options.scripted:
        raise RequestError("nothing acts; say --scripted to let the scripted expert act")
    if options.preview < 0:
        raise RequestError(f"preview {options.preview}: must be 0 or more episodes")
    collection = to_collection(options)
    shown = options.preview
    if shown and not collection.env_kwargs["cameras"] and (problem := opengl_problem()):
        logger.warning("no preview video: %s", problem)
        shown = 0
    summary = collect(collection)
    episodes = list_episodes(collection.out)[:shown]
    video = collection.out / PREVIEW if episodes else None
    if video:
        write_preview(video, episodes)
    print(table(collection, summary, video))  # noqa: T201


def to_collection(options: RolloutOptions) -> Collection:
    """Turn what was typed into what to collect."""
    return Collection(
        env=options.env,
        out=options.out or Path("dataset") / options.env,
        expert=options.expert,
        seeds=range(options.seed, options.seed + options.num_episodes),
        env_kwargs={
            "cameras": parse_cameras(options.cameras),
            "image_size": parse_image_size(options.image_size),
            "face_motion": options.face_motion,
            **({"clips": options.clips} if options.clips else {}),
            **({"motion_library": str(options.motion_library)} if options.motion_library else {}),
        },
        codec=options.image_codec,
        quality=options.image_quality,
        workers=options.workers,
    )


def parse_cameras(cameras: tuple[str, ...]) -> tuple[str, ...]:
    """Return camera names; ``none`` stands for no camera at all, and commas may separate them."""
    names = tuple(name for part in cameras for name in part.split(",") if name)
    return () if names == ("none",) else names


def parse_image_size(size: str) -> tuple[int, int]:
    """Return (height, width) from ``HEIGHTxWIDTH``.

    Raises:
        RequestError: it is not of that form.
    """
    height, cross, width = size.lower().partition("x")
    if not (cross and height.isdecimal() and width.isdecimal()):
        raise RequestError(f"image size '{size}': must be HEIGHTxWIDTH, for example 480x640")
    return int(height), int(width)


def table(collection: Collection, summary: Summary, video: Path | None) -> str:
    """Lay out the closing table."""
    mean, spread = summary.completion_time_mean, summary.completion_time_sd
    rate = summary.steps_per_second
    rows = {
        "episodes": str(summary.episodes),
        "success": f"{summary.successes}/{summary.episodes}",
        "strict success": f"{summary.strict_successes}/{summary.episodes}",
        "completion time": "-"
        if mean is None
        else f"{mean:.2f}" + (f" ± {spread:.2f} s" if spread is not None else " s"),
        "speed": "-" if rate is None else f"{rate:.0f} steps/s",
        "failed seeds": ", ".join(map(str, summary.failed_seeds)) or "-",
        "written to": str(collection.out),
        "preview": str(video or "-"),
    }
    width = max(map(len, rows))
    return "\n".join(f"{name:<{width}}  {value}" for name, value in rows.items())
