"""Demonstrations: a scripted expert acts, every step is recorded, and can be replayed."""

from __future__ import annotations

import contextlib
import logging
import multiprocessing
import time
from collections import defaultdict
from collections.abc import Callable, Generator, Iterator, Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import gymnasium
import numpy as np
from annotated_types import Interval
from numpy.typing import NDArray

from robo_manip_baselines.data import (
    EpisodeReader,
    episode_path,
    finished_seeds,
    list_episodes,
    read_metadata,
    remove_partial_episodes,
    write_episode,
)
from robo_manip_baselines.data.files import (
    FAILED_FOLDER,
    UNRENDERED_FOLDER,
    list_failures,
    seed_of,
)
from robo_manip_baselines.envs.mujoco.face.motion import pin_library
from robo_manip_baselines.envs.mujoco.tasks.face_env import world_of
from robo_manip_baselines.envs.mujoco.tasks.face_rows import episode_row
from robo_manip_baselines.envs.mujoco.tasks.registry import (
    entry_of_id,
    make_env,
    task_entry,
    without_library_path,
)
from robo_manip_baselines.rollout.agreement import VERSIONS
from robo_manip_baselines.rollout.results import (
    completion_time,
    require_own_summary,
    require_seeds,
)
from robo_manip_baselines.runs.documents import as_json
from robo_manip_baselines.runs.errors import RequestError, require_choice
from robo_manip_baselines.runs.files import FolderKind, locked, require_out_folder, write_json
from robo_manip_baselines.runs.images import CODECS, DEFAULT_QUALITY, encode_image
from robo_manip_baselines.runs.processes import answers
from robo_manip_baselines.runs.progress import EpisodeProgress
from robo_manip_baselines.runs.ranges import Quality, require_ranges
from robo_manip_baselines.runs.versions import software_versions

SUMMARY = "summary.json"

EXPERT_VERSION = 4
"""Schema version of the episodes of experts."""

SCRIPTED = "scripted"
"""Source of an episode without the attribute ``source``."""

RECORDING_SOFTWARE = ("mujoco", "numpy", "robo_manip_baselines")
"""Software whose versions episode files hold."""

logger = logging.getLogger(__name__)


class Demonstration(NamedTuple):
    """Content of one episode file, as `write_episode` takes it.

    Attributes:
        arrays: field -> (T, ...) array.
        images: camera -> T encoded frames.
        attributes: attribute -> value.
    """

    arrays: dict[str, NDArray[Any]]
    images: dict[str, list[NDArray[np.uint8]]]
    attributes: dict[str, Any]


class EpisodeRecorder:
    """Rows, images and attributes of a running episode, whoever acts in it.

    Args:
        env: made by `make_env`, just reset with ``seed``.
        seed: of the episode.
        codec, quality: of `encode_image`, for the cameras of ``env``.

    Raises:
        ValueError: the environment was not made by its id.
    """

    def __init__(
        self, env: gymnasium.Env[Any, Any], seed: int, *, codec: str, quality: int
    ) -> None:
        if env.spec is None:
            raise ValueError("the environment must be made by its id, so that it can be made again")
        world = world_of(env)
        self._env, self._world, self._codec, self._quality = env, world, codec, quality
        self._cameras = world.observation_spec.image_keys()
        self._rows: dict[str, list[Any]] = defaultdict(list)
        self._images: dict[str, list[NDArray[np.uint8]]] = {
            camera: [] for camera in self._cameras.values()
        }
        self._start = {**world.start_attributes(), "seed": seed}
        self._info: dict[str, Any] = {}

    @property
    def steps(self) -> int:
        """T, steps so far."""
        return len(self._rows["action"])

    def before(
        self, observation: Mapping[str, NDArray[Any]], action: NDArray[Any], **columns: Any
    ) -> None:
        """Take in the state before a step, the action, and values of further columns.

        Cameras that the observation does not show are left out.
        """
        for name, value in (*episode_row(self._world).items(), *columns.items()):
            self._rows[name].append(value)
        self._rows["action"].append(action)
        shown = {key: camera for key, camera in self._cameras.items() if key in observation}
        for key, camera in shown.items():
            self._images[camera].append(encode_image(observation[key], self._codec, self._quality))

    def after(self, info: dict[str, Any]) -> None:
        """Take in what is known after the step."""
        for name, value in self._world.touch.row().items():
            self._rows[name].append(value)
        self._rows["is_success"].append(info["is_success"])
        self._rows["is_success_strict"].append(info["is_success_strict"])
        self._info = info

    def finish(self, expert: str, **attributes: Any) -> Demonstration:
        """Return the episode, of one step or more.

        Args:
            expert: name of the expert or operator that acted.
            **attributes: optional ones of the schema.
        """
        env, world, info = self._env, self._world, self._info
        time, spec = info["completion_time"], env.spec
        assert spec is not None
        env_kwargs = dict(spec.kwargs)
        if env_kwargs.get("render_mode") == "human":  # how it was watched
            del env_kwargs["render_mode"]
        if env_kwargs.get("motion_library"):
            env_kwargs["motion_sha256"] = world.library.sha256
        if "motion" in env_kwargs:
            env_kwargs["motion"] = str(world.motion)
        known = {
            "env_id": spec.id,
            "env_kwargs": env_kwargs,
            **self._start,
            "is_success": info["is_success"],
            "is_success_strict": info["is_success_strict"],
            "completion_time": np.nan if time is None else time,
            "versions": software_versions(*RECORDING_SOFTWARE),
            "expert": expert,
            "image_codec": self._codec,
            "image_quality": self._quality,
            **attributes,
        }
        arrays = {name: np.asarray(values) for name, values in self._rows.items()}
        return Demonstration(arrays, self._images, known)


def demonstrate(
    env: gymnasium.Env[Any, Any],
    expert: str,
    seed: int,
    *,
    codec: str,
    quality: int,
    on_steps: Callable[[int], None] | None = None,
) -> Demonstration:
    """Let an expert, a name in the task's entry, act through one episode.

    The cameras of ``env``, made by `make_env`, are recorded; ``codec`` and ``quality`` are those of
    `encode_image`. ``on_steps`` is called with 1 after every control step.
    """
    world = world_of(env)
    actor = world.task.make_expert(expert, world)
    observation, _ = env.reset(seed=seed)
    recorder = EpisodeRecorder(env, seed, codec=codec, quality=quality)
    actor.reset()
    ended = False
    while not ended:
        action = actor.act()
        recorder.before(observation, action)
        observation, _, terminated, truncated, info = env.step(action)
        recorder.after(info)
        ended = terminated or truncated
        if on_steps:
            on_steps(1)
    return recorder.finish(expert)


@dataclass(frozen=True)
class Collection:
    """Demonstrations to collect.

    Attributes:
        env: name of the task.
        out: folder of the demonstrations; failed episodes go to its ``failed/``.
        expert: name in the task's entry.
        seeds: of the episodes, one each.
        env_kwargs: arguments of the environment; held as JSON holds them.
        codec, quality: of the images.
        workers: processes.
        is_watched: show the episodes in MuJoCo's viewer; they are recorded in this process.

    Raises:
        RequestError: a value is not valid.
    """

    env: str
    out: Path
    expert: str
    seeds: range
    env_kwargs: dict[str, Any]
    codec: str = "jpeg"
    quality: Quality = DEFAULT_QUALITY
    workers: Annotated[int, Interval(ge=1, le=1024)] = 1
    is_watched: bool = False

    def __post_init__(self) -> None:
        object.__setattr__(self, "env_kwargs", as_json(self.env_kwargs))
        require_choice("expert", self.expert, task_entry(self.env).experts)
        require_choice("image codec", self.codec, CODECS)
        require_seeds(self.seeds)
        require_ranges(self)

    def to_json(self) -> dict[str, Any]:
        """Return what JSON can hold, without ``is_watched``, on which no episode depends."""
        values = asdict(self)
        del values["is_watched"]
        return {**values, "out": str(self.out), "seeds": [self.seeds.start, self.seeds.stop]}

    @classmethod
    def from_json(cls, values: Mapping[str, Any]) -> Collection:
        """Return the collection that ``to_json`` was called on."""
        return cls(**{**values, "out": Path(values["out"]), "seeds": range(*values["seeds"])})


@dataclass(frozen=True)
class CollectionSummary:
    """Summary of all episodes of a folder, those of earlier calls included.

    Attributes:
        first_seed: smallest seed.
        episodes: how many there are.
        successes, strict_successes: how many of them succeeded.
        failed_seeds: seeds that did not.
        completion_time_mean, completion_time_sd: s, over successes; None without any.
        steps: control steps of the episodes that this run recorded.
        steps_per_second: of this run, all workers together; None if nothing was left to do.
    """

    first_seed: int
    episodes: int
    successes: int
    strict_successes: int
    failed_seeds: list[int]
    completion_time_mean: float | None
    completion_time_sd: float | None
    steps: int
    steps_per_second: float | None


def collect(collection: Collection) -> CollectionSummary:
    """Record every seed that has not been recorded yet, and write ``summary.json``.

    Killed at any moment, it leaves whole episodes only; the same call carries on from there.

    Raises:
        RequestError: the request cannot be met; nothing has been written then.
    """
    # Everything about the request that can be wrong is found out here, before any file exists.
    collection = replace(collection, env_kwargs=pin_library(collection.env_kwargs))
    require_demonstrations_folder(collection.out)
    watched = {"render_mode": "human"} if collection.is_watched else {}
    with contextlib.closing(make_env(collection.env, **collection.env_kwargs, **watched)) as env:
        _require_fitting_expert(collection, env)
        _refuse_other_settings(collection, world_of(env).xml_hash)
        with locked(collection.out, is_kept=False):
            return _collect(collection, env)


def _collect(collection: Collection, env: gymnasium.Env[Any, Any]) -> CollectionSummary:
    """Record what is missing in the folder of a collection, which is held."""
    remove_partial_episodes(collection.out)
    done = finished_seeds(collection.out)
    todo = [seed for seed in collection.seeds if seed not in done]
    if len(todo) < len(collection.seeds):
        total = len(collection.seeds)
        logger.info("%d of %d episodes are there already", total - len(todo), total)
    steps, begin = 0, time.perf_counter()
    longest = task_entry(collection.env).max_episode_steps
    with (
        EpisodeProgress(len(todo), longest, collection.expert) as progress,
        contextlib.closing(_record_all(collection, env, todo, progress.step)) as counts,
    ):
        for count in counts:
            steps += count
            progress.end(count)
    elapsed = time.perf_counter() - begin
    summary = _summarize(collection.out, steps, steps / elapsed if todo else None)
    content = {
        "env": task_entry(collection.env).env_id,
        "env_kwargs": collection.env_kwargs,
        "expert": collection.expert,
        "workers": collection.workers,
        **asdict(summary),
    }
    write_json(collection.out / SUMMARY, content)
    return summary


def _summarize(folder: Path, steps: int, steps_per_second: float | None) -> CollectionSummary:
    """Summarize all episodes of a folder."""
    paths = {seed_of(path): path for path in list_episodes(folder) + list_failures(folder)}
    seeds = sorted(seed for seed in paths if seed is not None)
    outcomes = {seed: read_metadata(paths[seed]) for seed in seeds}
    times = [o["completion_time"] for o in outcomes.values() if o["is_success"]]
    mean, sd = completion_time(times)
    strict = sum(bool(o["is_success_strict"]) for o in outcomes.values())
    failed = [seed for seed, o in outcomes.items() if not o["is_success"]]
    return CollectionSummary(
        min(outcomes), len(outcomes), len(times), strict, failed, mean, sd, steps, steps_per_second
    )


def _record_all(
    collection: Collection,
    env: gymnasium.Env[Any, Any],
    seeds: list[int],
    on_steps: Callable[[int], None],
) -> Generator[int, None, None]:
    """Record seeds, here or in worker processes; yield the steps of each as it is finished.

    ``on_steps`` is called with the number of steps taken since its last call.
    """
    workers = min(collection.workers, len(seeds))
    if workers <= 1 or collection.is_watched:
        for seed in seeds:
            yield _record(collection, env, seed, on_steps)
        return
    logger.info("starting %d worker processes", workers)
    counter, seen = multiprocessing.get_context("spawn").Value("q", 0), 0

    def report_steps() -> None:
        nonlocal seen
        taken = counter.value
        on_steps(taken - seen)
        seen = taken

    try:
        yield from answers(_Recorder, (collection, counter), seeds, workers, report_steps)
    finally:
        remove_partial_episodes(collection.out)


def _record(
    collection: Collection,
    env: gymnasium.Env[Any, Any],
    seed: int,
    on_steps: Callable[[int], None],
) -> int:
    """Record one episode into its file; return its number of steps."""
    images: Any = {"codec": collection.codec, "quality": collection.quality}
    demonstration = demonstrate(env, collection.expert, seed, **images, on_steps=on_steps)
    path = episode_path(collection.out, seed, demonstration.attributes["is_success"])
    write_episode(path, *demonstration)
    return len(demonstration.arrays["time"])


class _Recorder:
    """Environment of a worker process: seeds in, numbers of recorded steps out."""

    def __init__(self, collection: Collection, counter: Any) -> None:
        self._collection, self._counter = collection, counter
        self._env = make_env(collection.env, **collection.env_kwargs)
        self.close = self._env.close

    def __call__(self, seed: int) -> int:
        return _record(self._collection, self._env, seed, self._count_steps)

    def _count_steps(self, count: int) -> None:
        with self._counter.get_lock():
            self._counter.value += count


def _holds_an_episode(folder: Path) -> bool:
    for path in [*list_episodes(folder), *list_failures(folder)]:
        with contextlib.suppress(RequestError):  # damaged, or made by something else
            read_metadata(path)
            return True
    return False


_DEMONSTRATIONS = FolderKind(
    "demonstrations",
    _holds_an_episode,
    begun=lambda path: path.name in (FAILED_FOLDER, UNRENDERED_FOLDER) and path.is_dir(),
)


def require_demonstrations_folder(out: Path) -> None:
    """Make sure that demonstrations can be written to a folder and that nothing is lost by it.

    Raises:
        RequestError: the folder holds something else, or cannot be written to.
    """
    require_out_folder(out, _DEMONSTRATIONS)
    require_own_summary(out / SUMMARY, "expert", "first_seed")


def _require_fitting_expert(collection: Collection, env: gymnasium.Env[Any, Any]) -> None:
    """Refuse an expert that does not move the arms of the environment.

    Raises:
        RequestError: its actions have another size.
    """
    world = world_of(env)
    env.reset(seed=collection.seeds.start)
    actor = world.task.make_expert(collection.expert, world)
    if world.camera_mouth and not getattr(actor, "goes_by_observation", False):
        raise RequestError(
            f"mouth_source {world.observation_spec.mouth_source}: the expert "
            f"'{collection.expert}' of {collection.env} knows the true mouth; leave it out, or "
            "choose an expert that goes by what is observed: servo of FeedingEnv or DrinkingEnv"
        )
    actor.reset()
    action = actor.act()
    if action.shape != env.action_space.shape:
        raise RequestError(
            f"arms {world.observation_spec.arms}: the expert '{collection.expert}' gives actions "
            f"of shape {action.shape}, {collection.env} takes {env.action_space.shape}; choose "
            "other arms"
        )


def _refuse_other_settings(collection: Collection, xml_hash: str) -> None:
    """Refuse to mix episodes of other settings with those that the folder holds.

    Raises:
        RequestError: naming the first setting that differs.
    """
    wanted = {
        "env_id": task_entry(collection.env).env_id,
        "env_kwargs": collection.env_kwargs,
        "source": SCRIPTED,
        "expert": collection.expert,
        "image_codec": collection.codec,
        "image_quality": collection.quality,
        "xml_hash": xml_hash,
        "schema_version": EXPERT_VERSION,
    }
    refuse_other_settings(collection.out, wanted)


def refuse_other_settings(folder: Path, wanted: Mapping[str, Any]) -> None:
    """Refuse to mix episodes with those of other settings, or other software, in a folder.

    Args:
        folder: of episodes; may be absent.
        wanted: attribute -> value that the episodes must have.

    Raises:
        RequestError: naming the first setting that differs.
    """
    wanted = {
        **wanted,
        "env_kwargs": without_library_path(wanted["env_kwargs"]),
        "versions": _deciding_versions(software_versions(*RECORDING_SOFTWARE)),
    }
    for path in [*(list_episodes(folder) if folder.is_dir() else []), *list_failures(folder)]:
        recorded = read_metadata(path)
        there = {
            "source": SCRIPTED,
            **recorded,
            "env_kwargs": without_library_path(recorded["env_kwargs"]),
            "versions": _deciding_versions(recorded["versions"]),
        }
        for name, value in wanted.items():
            if there[name] != value:
                raise RequestError(
                    f"'{folder}' holds episodes with {name} {there[name]}, not {value} "
                    f"({path.name}); give another --out or remove that folder"
                )


def _deciding_versions(versions: Mapping[str, str]) -> dict[str, str]:
    """Return the versions of the software that decides how an episode goes."""
    return {name: versions[name] for name in VERSIONS if name in versions}


@dataclass(frozen=True)
class Deviation:
    """Largest deviation of the simulator's state from the recorded one.

    Attributes:
        qpos: m, rad.
        qvel: m/s, rad/s.
        steps: how many were compared.
    """

    qpos: float
    qvel: float
    steps: int


def remake_env(episode: EpisodeReader, **changes: Any) -> gymnasium.Env[Any, Any]:
    """Make the environment that an episode was recorded in.

    Args:
        episode: open file.
        **changes: arguments that shall differ, such as the cameras.

    Raises:
        RequestError: this release's environment is not the recorded one.
    """
    recorded = episode.attributes
    task = entry_of_id(recorded["env_id"])
    kwargs = {**recorded["env_kwargs"], **changes}
    for name in ("error", "mouth_source", "camera_latency"):  # ``error`` is of older releases
        kwargs.pop(name, None)  # they say what was shown to whom the recorded actions are
    env = make_env(task.name, **kwargs)
    xml_hash = world_of(env).xml_hash
    if xml_hash != recorded["xml_hash"]:
        env.close()
        raise RequestError(
            f"'{episode.path}' was recorded with another model (hash {recorded['xml_hash'][:12]}, "
            f"here {xml_hash[:12]}); install the release that recorded it, "
            f"{recorded['versions'].get('robo_manip_baselines', 'unknown')}"
        )
    return env


def replay(env: gymnasium.Env[Any, Any], episode: EpisodeReader) -> Iterator[int]:
    """Replay an episode in an environment from `remake_env`, as before each step yielded."""
    env.reset(seed=int(episode.attributes["seed"]))
    for step, action in enumerate(episode.array("action")):
        yield step
        env.step(action)


def deviation(path: Path, *, is_watched: bool = False) -> Deviation:
    """Replay an episode and compare every state with the recorded one.

    Args:
        path: of the episode.
        is_watched: show it in MuJoCo's viewer, in real time.

    Raises:
        RequestError: the file is damaged, or of another model.
    """
    mode = "human" if is_watched else None
    with (
        EpisodeReader(path) as episode,
        contextlib.closing(remake_env(episode, cameras=(), render_mode=mode)) as env,
    ):
        qpos, qvel = episode.array("qpos"), episode.array("qvel")
        data = world_of(env).data
        worst = np.zeros(2)
        for step in replay(env, episode):
            strays = np.abs(data.qpos - qpos[step]).max(), np.abs(data.qvel - qvel[step]).max()
            worst = np.maximum(worst, strays)
        return Deviation(float(worst[0]), float(worst[1]), len(episode))
