"""``bin/Rollout.py``: its options, and what it does and says."""

from __future__ import annotations

import logging
from pathlib import Path

from robo_manip_baselines.data import list_episodes
from robo_manip_baselines.errors import RequestError
from robo_manip_baselines.evaluation.preview import write_preview
from robo_manip_baselines.expert.collect import Collection, Summary, collect
from robo_manip_baselines.expert.rollout_options import EXAMPLE, RolloutOptions
from robo_manip_baselines.observation import CAMERAS
from robo_manip_baselines.observation.options import parse_cameras, parse_image_size
from robo_manip_baselines.opengl_check import opengl_problem

__all__ = ["EXAMPLE", "RolloutOptions", "rollout", "to_collection"]

logger = logging.getLogger(__name__)

PREVIEW = "preview.mp4"

FIRST_SEED = 0
"""of demonstrations, if none is given."""


def rollout(options: RolloutOptions) -> None:
    """Let the scripted expert or the trained policy act, whichever the options name.

    Raises:
        RequestError: the request cannot be met.
    """
    if options.policy is None:
        demonstrate_all(options)
        return
    # Imported here: demonstrations need no PyTorch.
    from robo_manip_baselines.training.requirements import prepare_pytorch

    prepare_pytorch()
    from robo_manip_baselines.evaluation.evaluate_command import evaluate

    evaluate(options)


def demonstrate_all(options: RolloutOptions) -> None:
    """Collect what the options ask for, then print a table and write the preview.

    Raises:
        RequestError: the request cannot be met.
    """
    shown = options.demonstration.preview
    if shown < 0:
        raise RequestError(f"preview {shown}: must be 0 or more episodes")
    collection = to_collection(options)
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
        expert=options.demonstration.expert,
        seeds=options.seeds(FIRST_SEED),
        env_kwargs={
            "cameras": CAMERAS if options.cameras is None else parse_cameras(options.cameras),
            "image_size": parse_image_size(options.image_size or "480x640"),
            "face_motion": "episode",
            **options.motion_arguments(),
        },
        codec=options.demonstration.image_codec,
        quality=options.demonstration.image_quality,
        workers=options.workers,
    )


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
