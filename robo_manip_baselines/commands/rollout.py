"""The options of ``bin/Rollout.py``, for both of its uses."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path

import tyro

from robo_manip_baselines.data import list_episodes
from robo_manip_baselines.data.episode import DEFAULT_QUALITY
from robo_manip_baselines.envs.mujoco.cell.opengl import opengl_problem
from robo_manip_baselines.observation import CAMERAS
from robo_manip_baselines.observation.spec import CorruptionOptions, parse_cameras, parse_image_size
from robo_manip_baselines.rollout.demonstrate import Collection, Summary, collect
from robo_manip_baselines.rollout.videos import write_preview
from robo_manip_baselines.runs.command import parse
from robo_manip_baselines.runs.errors import RequestError

EXAMPLE = """python bin/Rollout.py FeedingEnv --scripted --num_episodes 50 --workers 2

Example: python bin/Rollout.py FeedingEnv --policy Act --checkpoint runs/act --video 4"""


@dataclass(frozen=True)
class ScriptedOptions:
    """Only with --scripted."""

    expert: str = "reactive"
    """reactive: Algorithm 1 of the paper. anticipatory: aims where the mouth will be."""
    image_codec: str = "jpeg"
    """jpeg, png or raw."""
    image_quality: int = DEFAULT_QUALITY
    """Quality of jpeg, 1 to 100."""
    preview: int = 2
    """How many of the first episodes the preview video shows; 0 for no video."""


@dataclass(frozen=True)
class PolicyOptions:
    """Only with --policy."""

    checkpoint: Path | None = None
    """Folder of a training run, or of one of its checkpoints."""
    num_envs: int = 8
    """Episodes that run at once; what they come to does not depend on it."""
    temporal_ensemble: bool = False
    """Average the predictions of all chunks, whatever the checkpoint says."""
    execute: int | None = None
    """Carry out so many actions of a chunk before the next, whatever the checkpoint says."""
    device: str = "auto"
    """Where the network runs: auto, cpu, cuda or cuda:1."""
    precision: str = "fp32"
    """fp32, or bf16 for the products inside the network."""
    video: int = 0
    """Videos to write: of the first successes and the first failures, half of each."""
    obs: str | None = None
    """What the policy is shown: the checkpoint says it, this is only checked against it."""
    horizon: int | None = None
    """Frames that it looks ahead; only checked."""
    object_pose: bool = False
    """Whether it is shown where the cube is; only checked."""
    change_corruption: bool = False
    """Let --error, --delay, --face_dropout, --detector_rate and what belongs to them replace what
    the policy was trained with; otherwise they are only checked."""


@dataclass(frozen=True)
class RolloutOptions:
    """Let a scripted expert record demonstrations (--scripted), or evaluate a trained policy
    (--policy, --checkpoint).
    """

    env: tyro.conf.Positional[str]
    """Environment, for example FeedingEnv."""
    scripted: bool = False
    """Let the scripted expert act, and write its episodes down."""
    policy: str | None = None
    """Let a trained policy act, for example Act, and write down how well it does."""
    num_episodes: int = 50
    """Episodes, one for each seed from --seed on."""
    seed: int | None = None
    """Seed of the first episode; if not given, 0 with --scripted and 1000 with --policy."""
    out: Path | None = None
    """Folder to write to; if not given, dataset/<env> or results/<env>_<run>."""
    cameras: tuple[str, ...] | None = None
    """Cameras to record, or none; all if not given. With --policy, only checked."""
    image_size: str | None = None
    """Height x width of images in pixels; 480x640 if not given. With --policy, only checked."""
    face_motion: str | None = None
    """When the face starts to move: with the episode, or after_lift. If not given, episode, or as
    in the demonstrations of the policy."""
    clips: tuple[str, ...] = ()
    """Recorded clips to draw from; if not given, all, or those of the demonstrations."""
    motion_library: Path | None = None
    """File of recorded face motion; if not given, the one that ships with the package, or that of
    the demonstrations."""
    workers: int = 2
    """Processes in which environments step; with --policy, 0 steps them in the main one."""
    demonstration: tyro.conf.OmitArgPrefixes[ScriptedOptions] = field(
        default_factory=ScriptedOptions
    )
    evaluation: tyro.conf.OmitArgPrefixes[PolicyOptions] = field(default_factory=PolicyOptions)
    detection: tyro.conf.OmitArgPrefixes[CorruptionOptions] = field(
        default_factory=CorruptionOptions
    )
    """Only with --policy: what stands between the true and the shown mouth."""

    def __post_init__(self) -> None:
        if self.scripted and self.policy is not None:
            raise RequestError("--scripted and --policy: one of them acts; leave the other out")
        if not self.scripted and self.policy is None:
            raise RequestError(
                "nothing acts; say --scripted to let the scripted expert act, or "
                "--policy Act --checkpoint runs/... to let a trained policy act"
            )
        unused = (self.evaluation, self.detection) if self.scripted else (self.demonstration,)
        for options in unused:
            if name := _first_difference(options):
                wanted = "--policy" if self.scripted else "--scripted"
                raise RequestError(f"--{name} goes with {wanted}; leave it out")
        if self.num_episodes < 1:
            raise RequestError(f"num_episodes {self.num_episodes}: must be 1 or more")
        if self.seed is not None and self.seed < 0:
            raise RequestError(f"seed {self.seed}: must be 0 or more")

    def seeds(self, first: int) -> range:
        """Return the seeds of the episodes; ``first`` where none was given."""
        start = first if self.seed is None else self.seed
        return range(start, start + self.num_episodes)

    def motion_arguments(self) -> dict[str, object]:
        """Return the arguments of the environment about the recorded motion that were given."""
        given = {
            "face_motion": self.face_motion,
            "clips": self.clips,
            "motion_library": self.motion_library and str(self.motion_library),
        }
        return {name: value for name, value in given.items() if value}


def _first_difference(options: ScriptedOptions | PolicyOptions | CorruptionOptions) -> str | None:
    """Name the first option that is not at its default, as it is spelt."""
    defaults = type(options)()
    for name in (item.name for item in fields(options)):
        value = getattr(options, name)
        if value != getattr(defaults, name):
            return f"no_{name}" if value is False else name
    return None


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
    from robo_manip_baselines.commands.evaluate import evaluate

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


def main(args: Sequence[str]) -> None:
    """Run ``bin/Rollout.py``."""
    rollout(parse(RolloutOptions, EXAMPLE, args=args))
