"""A session from its configuration: environment, device, folder, loop."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any

from annotated_types import Interval

from robo_manip_baselines.data import EpisodeReader, list_episodes
from robo_manip_baselines.data.demonstrations import SHOWN
from robo_manip_baselines.data.files import UNRENDERED_FOLDER
from robo_manip_baselines.data.schema import TELEOP
from robo_manip_baselines.envs.mujoco.cell.opengl import opengl_problem, viewer_problem
from robo_manip_baselines.envs.mujoco.face.motion import pin_library
from robo_manip_baselines.envs.mujoco.tasks.face_env import FaceEnv, world_of
from robo_manip_baselines.envs.mujoco.tasks.registry import (
    TaskEntry,
    make_env,
    task_entry,
    without_library_path,
)
from robo_manip_baselines.observation import CAMERAS
from robo_manip_baselines.observation.spec import ARMS
from robo_manip_baselines.rollout.demonstrate import (
    refuse_other_settings,
    require_demonstrations_folder,
)
from robo_manip_baselines.runs.browser import PageOptions
from robo_manip_baselines.runs.documents import as_json
from robo_manip_baselines.runs.errors import RequestError, require_choice
from robo_manip_baselines.runs.files import locked
from robo_manip_baselines.runs.images import CODECS, DEFAULT_QUALITY
from robo_manip_baselines.runs.ranges import Episodes, Quality, Seed, require_ranges
from robo_manip_baselines.teleop.device import DEVICES, TeleopDevice, make_device
from robo_manip_baselines.teleop.options import SteeringOptions
from robo_manip_baselines.teleop.recording import EpisodeStore
from robo_manip_baselines.teleop.replay import ReplayDevice
from robo_manip_baselines.teleop.session import SessionSummary, TeleopSession
from robo_manip_baselines.teleop.shared import CheckpointPolicy, read_shared

STEERED: Mapping[str, tuple[str, ...]] = {
    "right": ("right",),
    "left": ("left",),
    "both": ("left", "right"),
}
"""Value of ``arm`` -> arms that the person steers."""


@dataclass(frozen=True)
class TeleopConfig:
    """Configuration of a session.

    Attributes:
        env: name of the task.
        out: folder of the episodes; failed ones go to its ``failed/``.
        device: name of the device.
        arm: key of `STEERED`.
        first_seed: of the episodes, and ``num_episodes``: one for each seed from it on.
        operator: name of the person in the files.
        step_limit: control steps after which an episode ends; that of the task if None.
        cameras, image_size, codec, quality: of the recorded images.
        env_kwargs: further arguments of the environment.
        episodes: files, or folders of them, for the device ``replay``.
        page: address of the page of the device ``web``.
        steering: speed of the hand with the devices ``keyboard`` and ``spacemouse``.
        policy, checkpoint: policy that acts until the person takes over; None for none.
        policy_device: of its network.

    Raises:
        RequestError: a value is not valid.
    """

    env: str
    out: Path
    device: str
    arm: str
    first_seed: Seed = 0
    num_episodes: Episodes = 50
    operator: str = "operator"
    step_limit: Annotated[int | None, Interval(ge=1, le=180_000)] = None
    cameras: tuple[str, ...] = CAMERAS
    image_size: tuple[int, int] = (480, 640)
    codec: str = "jpeg"
    quality: Quality = DEFAULT_QUALITY
    env_kwargs: Mapping[str, Any] = field(default_factory=dict)
    episodes: tuple[Path, ...] = ()
    page: PageOptions = field(default_factory=PageOptions)
    steering: SteeringOptions = field(default_factory=SteeringOptions)
    policy: str | None = None
    checkpoint: Path | None = None
    policy_device: str = "cpu"

    def __post_init__(self) -> None:
        require_choice("device", self.device, DEVICES)
        require_choice("arm", self.arm, STEERED)
        require_choice("image codec", self.codec, CODECS)
        if (self.policy is None) != (self.checkpoint is None):
            raise RequestError(
                "--policy and --checkpoint: a policy that shares control needs both, for example "
                "--policy Act --checkpoint shipped:forecast"
            )
        require_ranges(self)

    @property
    def task(self) -> TaskEntry:
        """Entry of the task."""
        return task_entry(self.env)

    @property
    def steered(self) -> tuple[str, ...]:
        """Arms that the person steers."""
        return STEERED[self.arm]

    def recorded_kwargs(self) -> dict[str, Any]:
        """Return the arguments of the environment as files have them, cameras included."""
        kwargs: dict[str, Any] = {"cameras": self.cameras, "image_size": self.image_size}
        arms = self.task.arms[0]
        if not set(self.steered) <= set(ARMS[arms]):
            arms = "both"
            kwargs["arms"] = arms
        self.task.require_arms(arms)
        return pin_library(as_json({**kwargs, "face_motion": "episode", **self.env_kwargs}))


def teleoperate(config: TeleopConfig) -> SessionSummary:
    """Run a session until the person ends it, or all episodes are there.

    Killed at any moment, it loses the running episode; the same call carries on from there.

    Raises:
        RequestError: the request cannot be met; nothing has been written then.
    """
    kwargs = config.recorded_kwargs()
    if config.cameras and (problem := opengl_problem()):
        raise RequestError(f"--cameras {' '.join(config.cameras)}: {problem}; or --cameras none")
    require_demonstrations_folder(config.out)
    checkpoint = None
    live: dict[str, Any] = {**kwargs, "cameras": ()}
    if config.policy and config.checkpoint:
        checkpoint = read_shared(config.policy, config.checkpoint, config.env)
        if checkpoint.spec.cameras and (problem := opengl_problem()):
            raise RequestError(f"{problem} (the policy sees images)")
        live |= checkpoint.spec.env_kwargs()
    live["disable_env_checker"] = True  # it would miss the images that are not drawn
    with contextlib.closing(make_env(config.env, **live)) as env:
        world = world_of(env)
        world.renders_images = False
        policy = checkpoint and CheckpointPolicy(checkpoint, world, config.policy_device)
        wanted = {
            "env_id": config.task.env_id,
            "env_kwargs": kwargs,
            "source": TELEOP,
            "image_codec": config.codec,
            "image_quality": config.quality,
            "xml_hash": world.xml_hash,
        }
        refuse_other_settings(config.out, wanted)
        refuse_other_settings(config.out / UNRENDERED_FOLDER, wanted)
        device = open_device(config, kwargs, world)
        with (
            contextlib.closing(device),
            locked(config.out, is_kept=False),
            contextlib.closing(EpisodeStore(config.out)) as store,
        ):
            session = TeleopSession(
                env,
                device,
                store,
                _seeds(config, device, store),
                config.steered,
                env_kwargs=kwargs,
                operator=config.operator,
                device_name=config.device,
                step_limit=config.step_limit or config.task.max_episode_steps,
                codec=config.codec,
                quality=config.quality,
                policy=policy or None,
            )
            summary = session.run()
            store.finish()
    return summary


def default_device() -> str:
    """Return ``keyboard`` where a window can be opened, else ``web``."""
    return "web" if viewer_problem() else "keyboard"


def open_device(config: TeleopConfig, kwargs: Mapping[str, Any], world: FaceEnv) -> TeleopDevice:
    """Open the device of a session.

    Args:
        config: of the session.
        kwargs: arguments of the environment, as files have them.
        world: the environment, unwrapped.

    Raises:
        RequestError: it cannot be opened, or does not go with the rest; says what to do.
    """
    if config.device == "replay":
        paths = _episode_paths(config)
        for path in paths:
            _require_same_world(path, config, kwargs)
        return make_device("replay", episodes=paths, arms=config.steered)
    given: dict[str, Any] = {"arms": config.steered}
    if config.device == "spacemouse":
        shown_by = replace(config, device=default_device())
        given |= {"screen": lambda: open_device(shown_by, kwargs, world)}
    if config.device in ("keyboard", "web"):
        given |= {"world": world, "has_policy": config.policy is not None}
    if config.device in ("keyboard", "spacemouse"):
        given["steering"] = config.steering
    if config.device == "web":
        given["cameras"] = config.cameras or (() if opengl_problem() else CAMERAS)
        given["page"] = config.page
    return make_device(config.device, **given)


def _episode_paths(config: TeleopConfig) -> list[Path]:
    paths: list[Path] = []
    for given in config.episodes:
        paths += list_episodes(given) if given.is_dir() else [given]
    if any(path.parent.resolve() == config.out.resolve() for path in paths):
        raise RequestError(f"--out {config.out}: is played back; name another folder")
    return paths[: config.num_episodes]


_LOOKS = SHOWN | {"shadows", "multisamples", "render_mode"}
"""Arguments of the environment that say nothing of how the world goes on."""


def _require_same_world(path: Path, config: TeleopConfig, kwargs: Mapping[str, Any]) -> None:
    """Require that an episode was recorded in the world of the session.

    Raises:
        RequestError: it was not.
    """
    with EpisodeReader(path) as episode:
        known = episode.attributes
    worlds = [
        {k: v for k, v in without_library_path(item).items() if k not in _LOOKS}
        for item in ({"face_motion": "episode", **known["env_kwargs"]}, kwargs)
    ]
    if known["env_id"] != config.task.env_id:
        raise RequestError(f"'{path}' is of {known['env_id']}, not of {config.env}")
    for name in sorted({*worlds[0], *worlds[1]}):
        recorded, ours = (json.dumps(world.get(name)) for world in worlds)
        if recorded != ours:
            raise RequestError(
                f"'{path}' was recorded with {name} {recorded}, not {ours}; give the options that "
                "it was recorded with"
            )


def _seeds(config: TeleopConfig, device: TeleopDevice, store: EpisodeStore) -> list[int]:
    """Return the seeds that are still to be recorded; none where only images are left to draw.

    Raises:
        RequestError: there is nothing left to do.
    """
    wanted: Sequence[int] = range(config.first_seed, config.first_seed + config.num_episodes)
    problem = (
        f"holds all episodes of the seeds {wanted[0]} to {wanted[-1]}; give another --seed or more "
        "--num_episodes"
    )
    if isinstance(device, ReplayDevice):
        wanted, problem = device.seeds, "holds an episode of every seed played back"
    taken = store.seeds
    seeds = [seed for seed in wanted if seed not in taken]
    if not seeds and not store.waiting:
        raise RequestError(f"'{config.out}' {problem}")
    return seeds
