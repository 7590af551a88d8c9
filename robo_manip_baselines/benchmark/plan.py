"""Plan of a benchmark: conditions times the size of a preset become work items."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

from robo_manip_baselines.benchmark.conditions import (
    EVERYBODY,
    ConditionConfig,
    DrawnPeople,
    find_references,
)
from robo_manip_baselines.benchmark.work_item import MOUNTS, OUT, WorkItem
from robo_manip_baselines.benchmark.worker import LIBRARY, STATS
from robo_manip_baselines.envs.mujoco.face import FACES
from robo_manip_baselines.envs.mujoco.face.motion import MotionLibrary, library_file
from robo_manip_baselines.envs.mujoco.face.motions import parse_motion
from robo_manip_baselines.envs.mujoco.tasks.registry import task_entry
from robo_manip_baselines.observation import CAMERAS, ObservationSpec
from robo_manip_baselines.observation.corruption import MEASURED_ERRORS
from robo_manip_baselines.observation.error_stats import load_error_stats
from robo_manip_baselines.observation.spec import ImageSize
from robo_manip_baselines.policy.checkpoint import ACTING_FILES, read_checkpoint
from robo_manip_baselines.policy.presets import TrainSettings
from robo_manip_baselines.rollout.demonstrate import Collection
from robo_manip_baselines.rollout.evaluation import (
    FIRST_SEED,
    EvaluationConfig,
    evaluated_people,
)
from robo_manip_baselines.rollout.results import EpisodeResult
from robo_manip_baselines.runs.checkpoints import MANIFEST
from robo_manip_baselines.runs.errors import RequestError
from robo_manip_baselines.runs.ranges import Amount, Count, Episodes, require_ranges
from robo_manip_baselines.training.config import BUDGET_OPTIONS, TrainConfig

_FUNCTIONS = "robo_manip_baselines.benchmark.worker"
"""Module of the functions that do work items."""


@dataclass(frozen=True)
class BenchmarkPreset:
    """Size of a benchmark: everything that is the same for all of its conditions.

    Attributes:
        train_preset: preset of the policies.
        cameras: of the demonstrations; none shows the positions of the objects instead.
        image_size: of the demonstrations, from which the policies' images are made.
        demonstrations: episodes of each expert, seeds from 0.
        demonstration_block: of them in a work item.
        num_episodes: evaluation episodes of each trained policy, seeds from 1000.
        episode_block: of them in a work item.
        train_seeds: trainings of each condition, seeds from 0.
        train_settings: settings of the training that differ from the policy's preset; those that a
            policy does not have are left out.
        num_envs: evaluation episodes that run at once in a work item.
        device: of networks, ``cpu`` or ``cuda``.
        precision: of networks that act, ``fp32`` or ``bf16``.
        threads: CPU threads of each work item, whatever the number of workers: another number would
            round differently.
        gpu_share: of a GPU for each training and evaluation.
        caution: for readers of the report; empty where none is needed.
        has_videos: whether the report shows a success and a failure of each condition.
        seconds: kind of work item -> expected s for each of its episodes, or for the training, as
            measured; for the time left before any item has been done.

    Raises:
        RequestError: a value is not valid.
    """

    train_preset: str
    cameras: tuple[str, ...]
    demonstrations: Episodes
    demonstration_block: Episodes
    num_episodes: Episodes
    episode_block: Episodes
    image_size: ImageSize = ObservationSpec().image_size
    train_seeds: Count = 1
    train_settings: Mapping[str, Any] = field(default_factory=dict)
    num_envs: Count = 8
    device: str = "cpu"
    precision: str = "fp32"
    threads: Count = 1
    gpu_share: Amount = 0.0
    caution: str = ""
    has_videos: bool = True
    seconds: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        require_ranges(self)


PRESETS: dict[str, BenchmarkPreset] = {
    # Two CPU cores, without images.
    "cpu": BenchmarkPreset(
        train_preset="cpu",
        cameras=(),
        demonstrations=50,
        demonstration_block=25,
        num_episodes=100,
        episode_block=50,
        seconds={"demonstrations": 2.0, "training": 90.0, "evaluation": 1.2, "video": 40.0},
    ),
    # Two CPU cores and three cameras, drawn at twice the size that policies are shown or more.
    "cpu_images": BenchmarkPreset(
        train_preset="cpu_images",
        cameras=CAMERAS,
        image_size=(240, 320),
        demonstrations=150,
        demonstration_block=10,
        num_episodes=100,
        episode_block=25,
        seconds={"demonstrations": 5.0, "training": 1500.0, "evaluation": 4.0, "video": 40.0},
    ),
    # The paper's setting (Table III, section IV.C): three cameras, 50 demonstrations, 50 episodes.
    "paper": BenchmarkPreset(
        train_preset="paper",
        cameras=CAMERAS,
        demonstrations=50,
        demonstration_block=4,
        num_episodes=50,
        episode_block=4,
        # A checkpoint, with the optimiser a gigabyte, takes as long as a hundred steps.
        train_settings={"checkpoint_every": 4000},
        num_envs=4,
        device="cuda",
        precision="bf16",
        gpu_share=0.125,
        seconds={"demonstrations": 10.0, "training": 600.0, "evaluation": 8.0, "video": 40.0},
    ),
    # A check of the whole chain in three minutes, too small for any conclusion.
    "smoke": BenchmarkPreset(
        train_preset="cpu",
        cameras=(),
        demonstrations=5,
        demonstration_block=3,
        num_episodes=4,
        episode_block=4,
        train_settings={"steps": 200, "hidden_size": 64, "feedforward_size": 128},
        caution="This size only shows that everything works: its policies have hardly learnt "
        "anything. --preset cpu compares conditions.",
        seconds={"demonstrations": 3.0, "training": 20.0, "evaluation": 3.0, "video": 20.0},
    ),
}


@dataclass(frozen=True, eq=False)
class PlannedRun:
    """Training of a condition, and its evaluation.

    Attributes:
        condition: of the run.
        train_seed: of the training.
        training: work item; None where the condition's policy is trained already.
        evaluations: work items, in the order of their seeds.
    """

    condition: ConditionConfig
    train_seed: int
    training: WorkItem | None
    evaluations: tuple[WorkItem, ...]

    @property
    def name(self) -> str:
        """Name of its work items."""
        return f"{self.condition.name}_seed{self.train_seed}"


@dataclass(frozen=True, eq=False)
class Plan:
    """All work items of a benchmark but the videos, which depend on its results.

    Attributes:
        env: name of the task.
        preset: the size.
        conditions: in the order of the file.
        library, error_stats: files of the user; None for those that ship with the package.
        headline: end point that was declared for it, see `ConditionFile`.
        people: in demonstrations and evaluation.
        face: kind of face, likewise.
        compare_within: keys of conditions, likewise.
    """

    env: str
    preset: BenchmarkPreset
    conditions: tuple[ConditionConfig, ...]
    library: Path | None = None
    error_stats: Path | None = None
    headline: str = "success"
    people: DrawnPeople = EVERYBODY
    face: str = FACES[0]
    compare_within: tuple[str, ...] = ()

    @property
    def references(self) -> dict[str, str] | None:
        """Name of a condition -> name of its reference; None where the file declares none."""
        within = self.compare_within
        return find_references(self.conditions, within) if within else None

    @cached_property
    def runs(self) -> tuple[PlannedRun, ...]:
        """Trainings with their evaluations, in the order of the conditions, then of the seeds."""
        demonstrations: dict[tuple[str, str], tuple[WorkItem, ...]] = {}
        runs: list[PlannedRun] = []
        for condition in self.conditions:
            if condition.checkpoint:
                runs.append(self._run_of_checkpoint(condition))
                continue
            variant = condition.expert, condition.motion
            if variant not in demonstrations:
                demonstrations[variant] = self._demonstrations(condition)
            for train_seed in range(self.preset.train_seeds):
                runs.append(self._run(condition, train_seed, demonstrations[variant]))
        return tuple(runs)

    def items(self, shard: tuple[int, int] | None = None) -> tuple[WorkItem, ...]:
        """Return the work items in order of priority, none before its needs.

        Trainings precede evaluations: short items fill up the room that is left in the end.

        Args:
            shard: (i, n) for the i-th of n parts, i from 1: every n-th training with its evaluation
                and all demonstrations that these need. All items if None.
        """
        runs = self.runs if shard is None else self.runs[shard[0] - 1 :: shard[1]]
        trainings = [run.training for run in runs if run.training]
        demonstrations = [item for training in trainings for item in training.needs]
        evaluations = [item for run in runs for item in run.evaluations]
        items = [*demonstrations, *trainings, *evaluations]
        return tuple({item.key: item for item in items}.values())

    def video(self, result: EpisodeResult) -> WorkItem:
        """Return the work item that runs the episode of a result once more, for a video."""
        key = result.condition, result.train_seed or 0
        run = next(run for run in self.runs if (run.condition.name, run.train_seed) == key)
        name = f"{run.name}_{result.seed}"
        seeds = range(result.seed, result.seed + 1)
        needs, files = run.evaluations[0].needs, run.evaluations[0].files
        return self._evaluation("video", name, seeds, run.condition, needs, files)

    def _demonstrations(self, condition: ConditionConfig) -> tuple[WorkItem, ...]:
        variant = condition.expert
        env_kwargs: dict[str, Any] = {
            "cameras": self.preset.cameras,
            "image_size": self.preset.image_size,
            "face_motion": "episode",
        }
        if self.library:
            env_kwargs["motion_library"] = LIBRARY
        if condition.motion != "recorded":
            variant += f"_{re.sub(r'[^a-z0-9._]+', '-', condition.motion)}"
            env_kwargs["motion"] = condition.motion
        if (people := self.people.demonstrations) != "all":
            variant += f"_{people}"
            env_kwargs["people"] = people
        if self.face != FACES[0]:
            variant += f"_{self.face}"
            env_kwargs["face"] = self.face
        items = []
        for seeds in _blocks(0, self.preset.demonstrations, self.preset.demonstration_block):
            config = Collection(self.env, Path(OUT), condition.expert, seeds, env_kwargs)
            name = f"{variant}_{seeds.start:06d}"
            settings = {"config": config.to_json()}
            item = self._item("demonstrations", name, "run_demonstrations", settings, self._files())
            items.append(replace(item, threads=1, gpus=0.0, seconds=item.seconds * len(seeds)))
        return tuple(items)

    def _run(
        self, condition: ConditionConfig, train_seed: int, demonstrations: tuple[WorkItem, ...]
    ) -> PlannedRun:
        preset = self.preset
        default = TrainConfig.from_preset(condition.policy, preset.train_preset, env=self.env)
        known = default.to_json()
        settings = {name: v for name, v in preset.train_settings.items() if name in known}
        settings = {**dict.fromkeys(BUDGET_OPTIONS), **in_place_of(known, settings)} | {
            "seed": train_seed,
            "device": preset.device,
            "logger": "none",
            "dataset": MOUNTS["demonstrations"],
            "out": OUT,
        }
        config = TrainConfig.from_json(settings)
        spec = condition.observation(config.spec)
        files = self._files()
        if self.error_stats and spec.corruption.error in MEASURED_ERRORS:
            spec = replace(spec, corruption=replace(spec.corruption, error_stats=STATS))
            files[STATS] = self.error_stats
        config = replace(config, spec=spec)
        if preset.cameras and preset.device == "cpu":
            config = replace(config, training=_with_one_precision(config.training))
        run = PlannedRun(condition, train_seed, None, ())
        settings = {"config": config.to_document()}
        training = self._item("training", run.name, "run_training", settings, files)
        training = replace(training, needs=demonstrations)
        run = replace(run, training=training)
        return replace(run, evaluations=self._evaluations(run, (training,), training.files))

    def _run_of_checkpoint(self, condition: ConditionConfig) -> PlannedRun:
        """Plan the evaluation of a policy that is trained already, from copies of its files."""
        checkpoint = read_checkpoint(condition.checkpoint)
        mount, names = MOUNTS["training"], (MANIFEST, *ACTING_FILES)
        files = self._files() | {f"{mount}/{name}": checkpoint.folder / name for name in names}
        run = PlannedRun(condition, checkpoint.train_seed, None, ())
        return replace(run, evaluations=self._evaluations(run, (), files))

    def _evaluations(
        self, run: PlannedRun, needs: tuple[WorkItem, ...], files: Mapping[str, Path]
    ) -> tuple[WorkItem, ...]:
        blocks = _blocks(FIRST_SEED, self.preset.num_episodes, self.preset.episode_block)
        return tuple(
            self._evaluation(
                *("evaluation", f"{run.name}_{seeds.start:06d}", seeds, run.condition, needs, files)
            )
            for seeds in blocks
        )

    def _evaluation(
        self,
        kind: str,
        name: str,
        seeds: range,
        condition: ConditionConfig,
        needs: tuple[WorkItem, ...],
        files: Mapping[str, Path],
    ) -> WorkItem:
        env_kwargs = {"people": self.people.evaluation} if self.people else {}
        if self.face != FACES[0]:
            env_kwargs["face"] = self.face
        if condition.checkpoint:  # whose demonstrations are not the benchmark's
            env_kwargs["motion"] = condition.motion
            if self.library:
                env_kwargs["motion_library"] = LIBRARY
        config = EvaluationConfig(
            checkpoint=Path(MOUNTS["training"]),
            seeds=seeds,
            out=Path(OUT),
            env_kwargs=env_kwargs,
            num_envs=self.preset.num_envs,
            workers=0,
            device=self.preset.device,
            precision=self.preset.precision,
            videos=int(kind == "video"),
        )
        settings = {"config": config.to_json()}
        item = self._item(kind, name, "run_evaluation", settings, files)
        return replace(item, needs=needs, seconds=item.seconds * len(seeds))

    def _item(
        self,
        kind: str,
        name: str,
        function: str,
        settings: Mapping[str, Any],
        files: Mapping[str, Path],
    ) -> WorkItem:
        return WorkItem(
            kind,
            name,
            f"{_FUNCTIONS}:{function}",
            settings,
            files=files,
            threads=self.preset.threads,
            gpus=self.preset.gpu_share,
            seconds=self.preset.seconds.get(kind, 60.0),
        )

    def _files(self) -> dict[str, Path]:
        return {LIBRARY: self.library} if self.library else {}


def make_plan(
    env: str,
    conditions: Sequence[ConditionConfig],
    preset: BenchmarkPreset,
    *,
    library: Path | None = None,
    error_stats: Path | None = None,
    headline: str = "success",
    people: DrawnPeople = EVERYBODY,
    face: str = FACES[0],
    compare_within: tuple[str, ...] = (),
) -> Plan:
    """Plan a benchmark.

    Args:
        env: name of the task.
        conditions: to train and evaluate.
        preset: the size.
        library: of recorded motion, or the name of one that ships; the default one if None.
        error_stats: of drawn errors; those that ship with the package if None.
        headline: end point of the benchmark.
        people: in demonstrations and evaluation.
        face: kind of face, likewise.
        compare_within: keys of conditions, see `find_references`.

    Raises:
        RequestError: a file cannot be used, a condition needs predictions that the library lacks or
            errors further ahead than the statistics go, its people cannot be split, or a trained
            policy is evaluated on other people or another face than were declared.
    """
    motion, file = MotionLibrary.load(library), library_file(library)
    for condition in conditions:
        if parse_motion(condition.motion).recorded:
            for part in (people.demonstrations, people.evaluation):
                motion.part(part)
        if problem := missing_predictions(condition, motion):
            raise RequestError(problem)
    stats = load_error_stats(error_stats)
    for condition in conditions:
        if condition.checkpoint:  # has statistics of its own
            _require_declared(condition, people, face)
            continue
        if condition.spec.corruption.error in MEASURED_ERRORS:
            try:
                stats.require_horizon(condition.spec.horizon)
            except RequestError as error:
                raise RequestError(f"condition '{condition.name}': {error}") from None
    return Plan(
        env,
        preset,
        tuple(condition.for_task(task_entry(env)) for condition in conditions),
        file and file.resolve(),
        error_stats and error_stats.resolve(),
        headline,
        people,
        face,
        compare_within,
    )


def _require_declared(condition: ConditionConfig, people: DrawnPeople, face: str) -> None:
    """Refuse a trained policy that brings along people or a face that were not declared."""
    recorded = read_checkpoint(condition.checkpoint).dataset.get("env_kwargs", {})
    drawn = evaluated_people(recorded)
    if not people and drawn != people.evaluation:
        raise RequestError(
            f"condition '{condition.name}': its policy is evaluated on the people '{drawn}', of "
            "whom it has no demonstrations; say people: {demonstrations: train, evaluation: "
            f"{drawn}}}"
        )
    if face == FACES[0] != (own := recorded.get("face", FACES[0])):
        raise RequestError(
            f"condition '{condition.name}': its policy learnt from a {own} face, this benchmark "
            f"has the {face} one; say face: {own}"
        )


def missing_predictions(condition: ConditionConfig, library: MotionLibrary) -> str:
    """Return why a condition lacks a predictor's output in the library; empty if it does not."""
    spec, frames = condition.spec, library.predicted_frames
    if spec.corruption.error != "model" or spec.horizon <= frames:
        return ""
    lacking = (
        f"predicts the mouth {frames} frames ahead, not {spec.horizon}"
        if frames
        else "has no predicted mouth"
    )
    return (
        f"condition '{condition.name}' observes a trained predictor's output, and "
        f"'{library.source}' {lacking}; give a library with --motion_library that "
        "'python -m face_prediction predict' wrote, or leave the condition out"
    )


def in_place_of(settings: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    """Return settings of a training with changes; a budget takes the place of the other one."""
    gone = BUDGET_OPTIONS if changes.keys() & BUDGET_OPTIONS else ()
    return {name: value for name, value in settings.items() if name not in gone} | {**changes}


def _with_one_precision(training: TrainSettings) -> TrainSettings:
    """Return settings without ``auto``, which is another precision on another node."""
    import torch  # slow to import

    from robo_manip_baselines.training.device import autocast_type

    found = autocast_type(training.precision, torch.device("cpu"), has_images=True)
    return replace(training, precision="fp32" if found is None else "bf16")


def _blocks(first: int, count: int, size: int) -> list[range]:
    return [
        range(start, min(start + size, first + count))
        for start in range(first, first + count, size)
    ]
