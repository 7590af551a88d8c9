"""Demonstrations: a folder of episodes as a policy sees it, split into training and validation.

Legend: E episodes, T control steps of an episode, A arms (left before right) or elements of an
action, S elements of the packed observation.
"""

from __future__ import annotations

import hashlib
import json
import shlex
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from itertools import pairwise
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from robo_manip_baselines.data.episode import EpisodeReader, read_metadata
from robo_manip_baselines.data.files import FAILED_FOLDER, finished_seeds, list_episodes, seed_of
from robo_manip_baselines.data.schema import POLICY_ATTRIBUTES
from robo_manip_baselines.envs.mujoco.tasks.registry import without_library_path
from robo_manip_baselines.observation import ObservationSpec, ObservedNames, State
from robo_manip_baselines.observation.corruption import prediction_problem
from robo_manip_baselines.observation.spec import size_text
from robo_manip_baselines.runs.documents import convert
from robo_manip_baselines.runs.errors import RequestError
from robo_manip_baselines.runs.ranges import Seed

READ_TOGETHER = 64
"""Episodes whose target is forecast side by side, which is faster than one after another."""


def recorded_state(episode: EpisodeReader) -> State:
    """Read the (T, ...) state of an episode of one arm or of both.

    Where the episode has no target, its position is NaN.

    Raises:
        EpisodeFileError: a field is missing or damaged.
    """
    task, array = episode.task, episode.array
    has_prediction = task.predicted_field in episode.fields
    by_arm = array("gripper_position").shape  # (T, A)
    objects = [array(name)[:, None, :3] for name in task.object_fields]
    nowhere = np.full((len(episode), 1, 3), np.nan)
    return State(
        time=array("time"),
        joint_position=array("joint_position").reshape(*by_arm, -1),
        joint_velocity=array("joint_velocity").reshape(*by_arm, -1),
        gripper_position=array("gripper_position"),
        gripper_velocity=array("gripper_velocity"),
        end_effector_position=array("end_effector_position"),
        target_position=array(task.target_field) if task.target_field else nowhere,
        object_position=np.concatenate([np.empty((len(episode), 0, 3)), *objects], axis=1),
        predicted_target=array(task.predicted_field) if has_prediction else None,
    )


@dataclass(frozen=True)
class Split:
    """Episodes by the seed that each was recorded with, so that it names them in any folder.

    Attributes:
        train: seeds of the training episodes, ascending.
        validation: seeds of the episodes held out, ascending; perhaps none.
    """

    train: tuple[Seed, ...]
    validation: tuple[Seed, ...]

    def __post_init__(self) -> None:
        if not self.train or set(self.train) & set(self.validation):
            raise RequestError("a split needs at least one training seed, and none in both parts")

    def to_json(self) -> dict[str, list[int]]:
        """Return what `from_json` takes, made of plain lists."""
        return {"train": list(self.train), "validation": list(self.validation)}

    @classmethod
    def from_json(cls, data: Any) -> Split:
        """Undo `to_json`.

        Raises:
            RequestError: ``data`` is no split.
        """
        return convert(data, cls, "split")


def split_episodes(seeds: Iterable[int], fraction: float, seed: int) -> Split:
    """Hold out a random share of the episodes.

    The result depends on which seeds there are, not on their order.

    Args:
        seeds: of the episodes, all different.
        fraction: share to hold out, 0 or more and less than 1, rounded to whole episodes. More
            than 0 holds out at least one episode wherever one is left to train on.
        seed: of the draw.

    Raises:
        RequestError: there is no episode, a seed is there twice, or a number is out of range.
    """
    ordered = sorted(seeds)
    if not ordered:
        raise RequestError("no episode to train on; record some first")
    if len(set(ordered)) < len(ordered):
        twice = next(a for a, b in pairwise(ordered) if a == b)
        raise RequestError(f"episode seed {twice} is there twice; each may be there once")
    if not 0.0 <= fraction < 1.0:
        raise RequestError(f"validation fraction {fraction}: must be 0 or more, less than 1")
    if seed < 0:
        raise RequestError(f"seed {seed}: must be 0 or more")
    held_out = round(fraction * len(ordered))
    if fraction > 0.0:
        held_out = min(max(held_out, 1), len(ordered) - 1)
    shuffled = np.random.default_rng([seed, *b"split"]).permutation(ordered).tolist()
    return Split(tuple(sorted(shuffled[held_out:])), tuple(sorted(shuffled[:held_out])))


SHOWN = {field.name for field in fields(ObservationSpec)} | {"error"}
"""Arguments of an environment that say what it shows (``error``: in older files); files hold truth,
whatever was shown."""


CARRIED: Final = 0.01
"""m from where it lay at the start beyond which an object is carried."""


@dataclass(frozen=True)
class Demonstrations:
    """Episodes one after another, in the order of their seeds.

    Attributes:
        paths: E files.
        seeds: E seeds that the episodes were recorded with, ascending.
        lengths: (E,) int64, steps of each episode.
        offsets: (E + 1,) int64, row at which each episode begins, and the number of rows.
        state: (sum T, S) float32, all observed vectors joined, in their own units.
        action: (sum T, A) float32, in its own units (rad, m).
        spec: what is observed.
        env_id: registered id of the environment.
        action_names: A names.
        control_period: s between rows.
        xml_hash: of the simulator's model.
        env_kwargs: what the environment was made with, but for what ``spec`` says.
        content_hash: SHA-256 over the content hashes of the files, in order, each of which was
            compared with what the file holds.
        intervention: (sum T,) bool, whether a person chose the action instead of the policy, False
            in episodes without a policy; None where there is no other.
    """

    paths: tuple[Path, ...]
    seeds: tuple[int, ...]
    lengths: NDArray[np.int64]
    offsets: NDArray[np.int64]
    state: NDArray[np.float32]
    action: NDArray[np.float32]
    spec: ObservationSpec
    env_id: str
    action_names: tuple[str, ...]
    control_period: float
    xml_hash: str
    env_kwargs: Mapping[str, Any]
    content_hash: str
    intervention: NDArray[np.bool_] | None = None

    def rows(self, episodes: Sequence[int]) -> NDArray[np.int64]:
        """Return the rows of the episodes of these indices, in their order."""
        ranges = [np.arange(self.offsets[i], self.offsets[i + 1]) for i in episodes]
        return np.concatenate([np.zeros(0, np.int64), *ranges])

    def carried(self, names: ObservedNames) -> NDArray[np.bool_]:
        """Return which objects have left the place where they lay, at every row (sum T, O).

        None has where they are not observed. ``names`` are the task's.
        """
        count = len(names.objects) if self.spec.object_pose else 0
        part = self.spec.slices(names).get("object_position", slice(0, 0))
        place = self.state[:, part].reshape(len(self.state), count, 3)
        start = np.repeat(place[self.offsets[:-1]], self.lengths, axis=0)
        return np.linalg.norm(place - start, axis=-1) > CARRIED

    def indices(self, seeds: Sequence[int]) -> tuple[int, ...]:
        """Return the indices of the episodes of these seeds, in their order.

        Raises:
            RequestError: there is no episode of such a seed.
        """
        place = {seed: index for index, seed in enumerate(self.seeds)}
        missing = [seed for seed in seeds if seed not in place]
        if missing:
            raise RequestError(
                f"'{self.paths[0].parent}' has no episode of seed {missing[0]}; it holds "
                f"{len(self.seeds)}, seeds {self.seeds[0]} to {self.seeds[-1]}"
            )
        return tuple(place[seed] for seed in seeds)


def load_demonstrations(
    folder: Path, spec: ObservationSpec, *, limit: int | None = None, env: str | None = None
) -> Demonstrations:
    """Read the vectors and actions of a folder's episodes; images stay in the files.

    Args:
        folder: as ``bin/Rollout.py`` writes it; ``failed/`` is left out.
        spec: what to observe. Its corruption is applied to what is read, drawn from the seed of
            each episode. An ``image_size`` smaller than the recorded one is met by `fit_image` as
            images are read, and the size at which they were drawn becomes ``render_size``, so that
            the policy is shown the same in rollouts; a larger one is refused, for it would add
            nothing.
        limit: read only so many episodes, those of the lowest seeds; all of them if None.
        env: name of the task, for error messages; the folder's name if None.

    Raises:
        RequestError: no such folder, no or not enough episodes in it, episodes that do not belong
            together, something in ``spec`` that they do not hold, or error statistics that cannot
            be used. Says what to do.
        EpisodeFileError: a file is damaged, was changed after it was recorded, or is in use.
    """
    folder = Path(folder)
    if spec.sees_by_camera:
        raise RequestError(
            f"mouth_source {spec.mouth_source}: demonstrations hold the true mouth; train with "
            "truth, with an error if wanted, and evaluate by camera: bin/Rollout.py --policy ... "
            f"--mouth_source {spec.mouth_source}"
        )
    # With the digest of the statistics, so that a policy is evaluated with those it learnt from.
    spec = replace(spec, corruption=spec.corruption.pinned())
    pipeline = spec.make_pipeline()
    paths = _episode_paths(env or folder.name, folder, spec, limit)
    spec = _drawn_as_recorded(spec, read_metadata(paths[0]))
    forecast = _forecaster(paths[0], spec)
    packed: list[NDArray[np.float32]] = []
    actions: list[NDArray[np.float32]] = []
    attributes: list[dict[str, Any]] = []
    interventions: list[NDArray[np.bool_]] = []
    has_interventions = False
    for first in range(0, len(paths), READ_TOGETHER):
        states: list[State] = []
        for path in paths[first : first + READ_TOGETHER]:
            with EpisodeReader(path) as episode:
                attributes.append(episode.attributes)
                _require_same(paths[0], attributes[0], path, attributes[-1])
                _require_spec(episode, spec)
                states.append(recorded_state(episode))
                actions.append(episode.array("action").astype(np.float32))
                is_shared = "intervention" in episode.fields
                has_interventions = has_interventions or is_shared
                nobody = np.zeros(len(episode), bool)
                interventions.append(episode.array("intervention") if is_shared else nobody)
        seeds = [item["seed"] for item in attributes[first:]]
        if forecast:
            made = forecast([state.target_position for state in states], seeds)
            states = [replace(s, predicted_target=m) for s, m in zip(states, made, strict=True)]
        for state, seed in zip(states, seeds, strict=True):
            target = pipeline.observe_episode(state, seed) if pipeline else None
            packed.append(spec.pack(state, target))
    lengths = np.array([len(action) for action in actions], dtype=np.int64)
    hashes = "\n".join(item["content_sha256"] for item in attributes)
    shared = attributes[0]
    return Demonstrations(
        paths=tuple(paths),
        seeds=tuple(item["seed"] for item in attributes),
        lengths=lengths,
        offsets=np.concatenate([np.zeros(1, np.int64), np.cumsum(lengths)]),
        state=np.concatenate(packed),
        action=np.concatenate(actions),
        spec=spec,
        env_id=shared["env_id"],
        action_names=tuple(shared["action_names"]),
        control_period=shared["control_period"],
        xml_hash=shared["xml_hash"],
        env_kwargs=_world(shared),
        content_hash=hashlib.sha256(hashes.encode()).hexdigest(),
        intervention=np.concatenate(interventions) if has_interventions else None,
    )


def recording_command(env: str, folder: Path, spec: ObservationSpec, num_episodes: int = 50) -> str:
    """Return the command that records demonstrations of a task for ``spec``."""
    out = shlex.quote(str(folder))
    line = f"python bin/Rollout.py {env} --scripted --num_episodes {num_episodes} --out {out}"
    if not spec.cameras:
        return f"{line} --cameras none"
    height, width = spec.image_size
    return line if (height, width) == (480, 640) else f"{line} --image_size {height}x{width}"


def _episode_paths(env: str, folder: Path, spec: ObservationSpec, limit: int | None) -> list[Path]:
    if limit is not None and limit < 1:
        raise RequestError(f"{limit} episodes: must be 1 or more")
    paths = list_episodes(folder) if folder.is_dir() else []
    if not paths:
        what = "holds no episode_*.hdf5 file" if folder.is_dir() else "is no folder"
        raise RequestError(f"'{folder}' {what}; record it: {recording_command(env, folder, spec)}")
    if limit is not None and limit > len(paths):
        recorded = read_metadata(paths[0])
        same = replace(
            spec,
            cameras=tuple(recorded["cameras"]),
            image_size=tuple(recorded["image_size"]) if recorded["cameras"] else spec.image_size,
        )
        # Failures count among the seeds that are done, so that more of them are needed.
        seeds = max(finished_seeds(folder)) + 1 + limit - len(paths)
        line = recording_command(env, folder, same, seeds)
        raise RequestError(
            f"'{folder}' holds {len(paths)} episodes, not {limit}; ask for fewer, or record: {line}"
        )
    return paths[:limit]


def _require_same(
    first: Path, expected: Mapping[str, Any], path: Path, given: Mapping[str, Any]
) -> None:
    """Raise RequestError if two files are not of one kind."""
    ours, theirs = (
        {**item, "env_kwargs": without_library_path(_world(item))} for item in (expected, given)
    )
    for name in (*POLICY_ATTRIBUTES, "env_kwargs"):
        if theirs[name] != ours[name]:
            raise RequestError(
                f"'{path}' has {name} {json.dumps(theirs[name])} where '{first}' has "
                f"{json.dumps(ours[name])}; keep episodes of one kind in one folder"
            )


def _frames_ahead(episode: EpisodeReader) -> tuple[int, int]:
    """Return how many frames ahead the target is known, and predicted (0 without predictions)."""
    task = episode.task
    if not task.target_field:
        return 0, 0
    has_prediction = task.predicted_field in episode.fields
    predicted = episode.array(task.predicted_field).shape[1] if has_prediction else 0
    return episode.array(task.target_field).shape[1] - 1, predicted


def _forecaster(
    path: Path, spec: ObservationSpec
) -> Callable[[list[NDArray[np.float64]], list[int]], list[NDArray[np.float64]]] | None:
    """Return what makes a forecaster's output of tracks and seeds; None where none is observed.

    Raises:
        RequestError: the episodes have no such forecasts.
    """
    if (name := spec.corruption.prediction) == "truth":
        return None
    # Imports the simulator.
    from robo_manip_baselines.envs.mujoco.face.forecasters import MotionForecasters

    with EpisodeReader(path) as episode:
        episode.task.require_forecasts(spec)
        made = MotionForecasters.of_kwargs(episode.attributes["env_kwargs"])
        made.require(name)
    return lambda tracks, seeds: made.forecast_tracks(name, tracks, seeds)


def _require_spec(episode: EpisodeReader, spec: ObservationSpec) -> None:
    """Raise RequestError if an episode is no demonstration of what is to be observed."""
    path, attributes = episode.path, episode.attributes
    if attributes["seed"] != seed_of(path):
        raise RequestError(f"'{path}' holds seed {attributes['seed']}: give it its name back")
    if not attributes["is_success"]:
        raise RequestError(f"'{path}' is a failure: move it to '{path.parent / FAILED_FOLDER}'")
    arms = tuple(dict.fromkeys(name.partition("/")[0] for name in attributes["joint_names"]))
    if arms != spec.arm_names:
        raise RequestError(
            f"'{path}' was recorded with the arms {', '.join(arms)}; arms '{spec.arms}' needs "
            f"{', '.join(spec.arm_names)}"
        )
    if spec.object_pose and not episode.task.names.objects:
        raise RequestError(f"object_pose: {episode.task.name} has no objects; leave it out")
    if spec.frames and not episode.task.target_field:
        raise RequestError(
            f"'{path}' was imported and holds no face: it shows nothing for {spec.obs}; choose "
            "--obs baseline"
        )
    known, predicted = _frames_ahead(episode)
    if spec.frames - 1 > known:
        again = path.parent.with_name(f"{path.parent.name}_longer")
        raise RequestError(
            f"'{path}' holds the {episode.task.names.target} {known} frames ahead, not "
            f"{spec.horizon}; choose a horizon up to {known}, or record again: "
            f"{recording_command(episode.task.name, again, spec)}"
        )
    if spec.corruption.error == "model" and (
        problem := prediction_problem(predicted, spec.horizon)
    ):
        raise RequestError(f"'{path}' holds {problem}")
    recorded = attributes["cameras"]
    there = ", ".join(recorded) or "none"
    # Beside, for episodes with other images do not belong into the same folder.
    beside = path.parent.with_name(f"{path.parent.name}_images")
    line = recording_command(episode.task.name, beside, spec)
    missing = [camera for camera in spec.cameras if camera not in recorded]
    if missing:
        raise RequestError(
            f"'{path}' has no images of {', '.join(missing)}; its cameras: {there}; choose "
            f"--cameras {' '.join(recorded) or 'none'}, or record others: {line}"
        )
    if not spec.cameras:
        return
    shown, recorded = spec.image_size, tuple(attributes["image_size"])
    if shown[0] > recorded[0] or shown[1] > recorded[1]:
        size = size_text(recorded)
        raise RequestError(
            f"image size {size_text(shown)}: '{path}' holds {size}; choose --image_size {size} or "
            f"less, or record: {line}"
        )
    drawn = _drawn_size(attributes)
    if drawn != spec.drawn_size:
        raise RequestError(
            f"'{path}' holds images of {size_text(recorded)} drawn at {size_text(drawn)}, not "
            f"{size_text(spec.drawn_size)}; keep episodes of one kind in one folder"
        )
    if drawn != recorded != shown:  # twice shrunk, which no environment does
        raise RequestError(
            f"image size {size_text(shown)}: the images in '{path}' were drawn at "
            f"{size_text(drawn)} and shrunk to {size_text(recorded)}; choose --image_size "
            f"{size_text(recorded)}, or record: {line}"
        )


def _drawn_as_recorded(spec: ObservationSpec, attributes: Mapping[str, Any]) -> ObservationSpec:
    """Return a spec whose cameras are drawn as those of an episode were.

    Unchanged where the episode cannot show what it asks for; `_require_spec` says why.
    """
    drawn = _drawn_size(attributes)
    is_larger = spec.image_size[0] > drawn[0] or spec.image_size[1] > drawn[1]
    if not spec.cameras or spec.render_size or is_larger:
        return spec
    return replace(spec, render_size=drawn)


def _drawn_size(attributes: Mapping[str, Any]) -> tuple[int, int]:
    """Return height and width at which the images of an episode were drawn."""
    height, width = attributes["env_kwargs"].get("render_size") or attributes["image_size"]
    return height, width


def _world(attributes: Mapping[str, Any]) -> dict[str, Any]:
    """Return the arguments of the environment that say more than what it shows."""
    kwargs = attributes["env_kwargs"]
    return {name: kwargs[name] for name in sorted(kwargs) if name not in SHOWN}
