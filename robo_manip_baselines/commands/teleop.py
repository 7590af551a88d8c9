"""``bin/Teleop.py``: a person steers the arms, and demonstrations are recorded."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro
from annotated_types import Interval

from robo_manip_baselines.commands.rollout import changed_options, env_arguments
from robo_manip_baselines.envs.mujoco.cell.scene import CONTROL_PERIOD
from robo_manip_baselines.envs.mujoco.tasks.registry import task_entry
from robo_manip_baselines.observation import CAMERAS, ObservationSpec
from robo_manip_baselines.observation.spec import ImageSize
from robo_manip_baselines.runs.browser import PageOptions
from robo_manip_baselines.runs.command import parse
from robo_manip_baselines.runs.errors import RequestError, require_printable
from robo_manip_baselines.runs.progress import closing_table
from robo_manip_baselines.runs.ranges import Episodes, Quality, Seed
from robo_manip_baselines.teleop.options import SteeringOptions

if TYPE_CHECKING:
    from robo_manip_baselines.teleop.teleoperate import TeleopConfig

EXAMPLE = """python bin/Teleop.py FeedingEnv --num_episodes 10 --out dataset/teleop

Example: python bin/Teleop.py FeedingEnv --device replay --episodes dataset/FeedingEnv"""

DESCRIPTION = "Steer the arms by hand, and record demonstrations."


@dataclass(frozen=True)
class ImageOptions:
    """Images of the episodes.

    Attributes:
        cameras: Cameras to record, or none.
        image_size: Height and width of the images.
        image_codec: jpeg, png or raw.
        image_quality: Quality of jpeg, 1 to 100.
    """

    cameras: tuple[str, ...] = CAMERAS
    image_size: ImageSize = (480, 640)
    image_codec: str = "jpeg"
    image_quality: Quality = 90


@dataclass(frozen=True)
class ReplayOptions:
    """Only with --device replay.

    Attributes:
        episodes: Episode files, or folders of them, whose end-effector motion is played back.
    """

    episodes: tuple[Path, ...] = ()


@dataclass(frozen=True)
class SharedOptions:
    """A policy that acts until the person takes over.

    Attributes:
        policy: Policy that acts, for example Act.
        checkpoint: Folder of a training run, or of one of its checkpoints; or shipped:baseline,
            shipped:current, shipped:forecast, which come with the package.
        policy_device: Device of the network: auto, cpu, cuda or cuda:1.
    """

    policy: str | None = None
    checkpoint: Path | None = None
    policy_device: str = "cpu"


@dataclass(frozen=True)
class TeleopOptions:
    """Options of the command.

    Attributes:
        env: Task, for example FeedingEnv.
        device: Device of the person: keyboard, in a window of MuJoCo; web, a page in the browser;
            spacemouse, one or two of them beside either; or replay, which plays recorded episodes
            back as if a person did it. If not given, keyboard where there is a display, else web.
        arm: Arms that the person steers: right, left or both; if not given, those of the task.
        out: Folder of the episodes; if not given, dataset/teleop/<env>.
        num_episodes: Episodes, one for each seed from --seed on that has none yet.
        seed: Seed of the first episode.
        operator: Name in the episodes of the person who steers.
        time_limit: s after which an episode ends; if not given, that of the task.
        face: Kind of face: visual, or physical, soft tissue on a head that yields.
        face_motion: Start of the face's motion: with the episode, or after_lift.
        motion: Motion of the face: recorded, sway, ..., with parameters sway:amplitude=0.03, or a
            sum recorded+tremor.
        people: People who move: all, train or test.
        clips: Recorded clips to draw from; all if not given.
        utensil: What brings the food in FeedingEnv: gripper (if not given) or spoon.
        motion_library: File of recorded face motion, or extended, which ships, too.
        images: Images of the episodes.
        replay: Only with --device replay.
        page: Only with --device web, or spacemouse where there is no display.
        steering: Speed of the hand; only with --device keyboard or spacemouse.
        shared: A policy that acts until the person takes over.
    """

    env: tyro.conf.Positional[str]
    device: str | None = None
    arm: str | None = None
    out: Path | None = None
    num_episodes: Episodes = 50
    seed: Seed = 0
    operator: str = "operator"
    time_limit: Annotated[float | None, Interval(ge=0.02, le=3600.0)] = None
    face: str | None = None
    face_motion: str | None = None
    motion: str | None = None
    people: str | None = None
    clips: tuple[str, ...] = ()
    utensil: str | None = None
    motion_library: Path | None = None
    images: tyro.conf.OmitArgPrefixes[ImageOptions] = field(default_factory=ImageOptions)
    replay: tyro.conf.OmitArgPrefixes[ReplayOptions] = field(default_factory=ReplayOptions)
    page: tyro.conf.OmitArgPrefixes[PageOptions] = field(default_factory=PageOptions)
    steering: tyro.conf.OmitArgPrefixes[SteeringOptions] = field(default_factory=SteeringOptions)
    shared: tyro.conf.OmitArgPrefixes[SharedOptions] = field(default_factory=SharedOptions)

    def __post_init__(self) -> None:
        require_printable("--operator", self.operator)


def to_config(options: TeleopOptions) -> TeleopConfig:
    """Return the configuration that the options ask for.

    Raises:
        RequestError: a value is not valid.
    """
    from robo_manip_baselines.teleop.teleoperate import TeleopConfig, default_device

    task, images = task_entry(options.env), options.images
    if options.replay.episodes and options.device != "replay":
        raise RequestError("--episodes goes with --device replay; leave it out")
    device = options.device or default_device()
    for given, usual, devices in (
        (options.page, PageOptions(), ("web", "spacemouse")),  # the page may be a mouse's screen
        (options.steering, SteeringOptions(), ("keyboard", "spacemouse")),
    ):
        if device not in devices and (changed := changed_options(given, usual)):
            raise RequestError(
                f"--{changed[0]} goes with --device {' or '.join(devices)}, not with {device}; "
                "leave it out"
            )
    limit = options.time_limit
    spec = ObservationSpec(cameras=images.cameras, image_size=images.image_size)
    return TeleopConfig(
        env=options.env,
        out=options.out or Path("dataset") / "teleop" / options.env,
        device=device,
        arm=options.arm or task.arms[0],
        first_seed=options.seed,
        num_episodes=options.num_episodes,
        operator=options.operator,
        step_limit=None if limit is None else round(limit / CONTROL_PERIOD),
        cameras=spec.cameras,
        image_size=spec.image_size,
        codec=images.image_codec,
        quality=images.image_quality,
        env_kwargs=env_arguments(options),
        episodes=options.replay.episodes,
        page=options.page,
        steering=options.steering,
        policy=options.shared.policy,
        checkpoint=options.shared.checkpoint,
        policy_device=options.shared.policy_device,
    )


def main(args: Sequence[str]) -> None:
    """Run ``bin/Teleop.py``."""
    default = TeleopOptions(tyro.MISSING)
    options = parse(TeleopOptions, EXAMPLE, description=DESCRIPTION, args=args, default=default)
    config = to_config(options)
    from robo_manip_baselines.teleop.teleoperate import teleoperate

    summary = teleoperate(config)
    late = f"{summary.missed} of {summary.steps} steps"
    rows = {
        "saved": f"{summary.saved}, {summary.successes} of them successes",
        "discarded": str(summary.discarded),
        "loop rate": "-" if math.isnan(summary.rate) else f"{summary.rate:.1f} Hz, late {late}",
        "written to": str(config.out),
    }
    print(closing_table(rows))  # noqa: T201
