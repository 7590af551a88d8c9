"""From arms and size to units of work."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from robo_manip_baselines.benchmark.conditions import ArmLine
from robo_manip_baselines.benchmark.presets import Preset
from robo_manip_baselines.benchmark.work_item import InputFile, Unit
from robo_manip_baselines.benchmark.worker import FORECAST, LIBRARY, STATS
from robo_manip_baselines.envs.mujoco.face.motion import MotionLibrary
from robo_manip_baselines.observation.corruption import MEASURED_ERRORS
from robo_manip_baselines.observation.error_stats import load_error_stats
from robo_manip_baselines.rollout.evaluation import FIRST_SEED
from robo_manip_baselines.rollout.results import EpisodeResult
from robo_manip_baselines.runs.errors import RequestError

_WORK = "robo_manip_baselines.benchmark.worker"


@dataclass(frozen=True, eq=False)
class Run:
    """A training of an arm, and its evaluation.

    Attributes:
        arm: which one.
        train_seed: of the training.
        training: unit.
        evaluations: units, in the order of their seeds.
    """

    arm: ArmLine
    train_seed: int
    training: Unit
    evaluations: tuple[Unit, ...]


@dataclass(frozen=True, eq=False)
class Plan:
    """All units of a benchmark but the videos, which depend on its results.

    Attributes:
        env: name of the environment.
        preset: the size.
        arms: in the order of the file.
        runs: in the order of the arms, then of the training seeds.
        library: of recorded motion, None for the one that ships with the package.
    """

    env: str
    preset: Preset
    arms: tuple[ArmLine, ...]
    runs: tuple[Run, ...]
    library: InputFile | None

    def units(self, shard: tuple[int, int] | None = None) -> tuple[Unit, ...]:
        """Return the units in an order in which they can be done.

        Trainings come first: the short units fill up what room is left in the end.

        Args:
            shard: (i, n) for the i-th of n parts, i from 1: every n-th training with its evaluation
                and all demonstrations that these need. All units if None.
        """
        runs = self.runs if shard is None else self.runs[shard[0] - 1 :: shard[1]]
        demonstrations = [unit for run in runs for unit in run.training.needs]
        evaluations = [unit for run in runs for unit in run.evaluations]
        units = [*demonstrations, *(run.training for run in runs), *evaluations]
        return tuple({unit.key: unit for unit in units}.values())

    @property
    def video_seconds(self) -> float:
        """Seconds that a video is expected to take."""
        return self.preset.seconds.get("video", 30.0)

    def video(self, run: Run, result: EpisodeResult) -> Unit:
        """Return the unit that acts an episode out once more and draws it."""
        args = [*_evaluation_args(self, run.arm, result.seed, 1), "--video", "1"]
        return Unit(
            "video",
            f"{run.arm.name}_seed{run.train_seed}_{result.seed}",
            f"{_WORK}:evaluate",
            {"args": args, "prediction": run.arm.prediction},
            needs=(run.training,),
            files=run.training.files,
            threads=self.preset.threads,
            gpus=self.preset.gpu_share,
            seconds=self.video_seconds,
        )


def make_plan(
    env: str,
    arms: Sequence[ArmLine],
    preset: Preset,
    *,
    library: Path | None = None,
    error_stats: Path | None = None,
) -> Plan:
    """Plan a benchmark.

    Args:
        env: name of the environment.
        arms: to train and evaluate.
        preset: the size.
        library: of recorded motion; the one that ships with the package if None.
        error_stats: for the errors that are drawn; those that ship with the package if None.

    Raises:
        RequestError: a file cannot be used, or an arm needs predictions that the library lacks.
    """
    motion = MotionLibrary.load(library)
    for arm in arms:
        if problem := missing_predictions(arm, motion):
            raise RequestError(problem)
    load_error_stats(error_stats)
    files = _Files(
        library and InputFile.of(LIBRARY, library),
        error_stats and InputFile.of(STATS, error_stats),
    )
    plan = Plan(env, preset, tuple(arms), (), files.library)
    demonstrations: dict[tuple[str, str], tuple[Unit, ...]] = {}
    runs: list[Run] = []
    for arm in arms:
        variant = arm.expert, arm.prediction
        if variant not in demonstrations:
            demonstrations[variant] = _demonstrations(plan, arm)
        for train_seed in range(preset.train_seeds):
            training = _training(plan, arm, train_seed, demonstrations[variant], files)
            runs.append(Run(arm, train_seed, training, _evaluations(plan, arm, training)))
    return Plan(env, preset, tuple(arms), tuple(runs), files.library)


def missing_predictions(arm: ArmLine, library: MotionLibrary) -> str:
    """Say so if an arm shows a predictor's output and the library has none; else nothing."""
    if arm.error != "model" or library.predicted is not None:
        return ""
    return (
        f"arm '{arm.name}' shows a trained predictor's output, and '{library.source}' has no "
        "predicted mouth; give a library with --motion_library that 'python -m face_prediction "
        "predict' wrote, or do without the arm"
    )


@dataclass(frozen=True)
class _Files:
    """What comes from outside the package."""

    library: InputFile | None
    error_stats: InputFile | None

    def of(self, arm: ArmLine) -> tuple[InputFile, ...]:
        """Return what training and evaluating an arm read."""
        stats = self.error_stats if arm.error in MEASURED_ERRORS else None
        return tuple(file for file in (self.library, stats) if file)


def _demonstrations(plan: Plan, arm: ArmLine) -> tuple[Unit, ...]:
    preset = plan.preset
    variant = f"{arm.expert}_{arm.prediction}" if arm.prediction != "truth" else arm.expert
    given = ["--motion_library", library] if (library := _library(plan, arm)) else []
    units = []
    for block in _blocks(0, preset.demonstrations, preset.demonstration_block):
        args = [plan.env, "--scripted", "--expert", arm.expert, *_seeds(block), *given]
        args += ["--cameras", *(preset.cameras or ("none",)), "--preview", "0", "--workers", "1"]
        units.append(
            Unit(
                "demonstrations",
                f"{variant}_{block.start:06d}",
                f"{_WORK}:demonstrate",
                {"args": [*args, "--out", "out"], "prediction": arm.prediction},
                files=(plan.library,) if plan.library else (),
                seconds=len(block) * preset.seconds.get("demonstration", 5.0),
            )
        )
    return tuple(units)


def _training(
    plan: Plan, arm: ArmLine, train_seed: int, demonstrations: tuple[Unit, ...], files: _Files
) -> Unit:
    # Imported here: a plan is read without what training needs.
    from robo_manip_baselines.commands.train import parse_config

    preset = plan.preset
    args = [arm.policy, "--preset", preset.train_preset, "--env", plan.env, *arm.train_args]
    if files.error_stats and arm.error in MEASURED_ERRORS:
        args += ["--error_stats", STATS]
    args += ["--seed", str(train_seed), *preset.train_args, "--device", preset.device]
    args += ["--logger", "none", "--dataset", "demonstrations", "--out", "out"]
    return Unit(
        "training",
        f"{arm.name}_seed{train_seed}",
        f"{_WORK}:train",
        # What the options come to: another default in the preset makes another training.
        {"args": args, "options": parse_config(args, has_gpu=False).to_json()},
        needs=demonstrations,
        files=files.of(arm),
        threads=preset.threads,
        gpus=preset.gpu_share,
        seconds=preset.seconds.get("training", 600.0),
    )


def _evaluations(plan: Plan, arm: ArmLine, training: Unit) -> tuple[Unit, ...]:
    preset = plan.preset
    return tuple(
        Unit(
            "evaluation",
            f"{training.name}_{block.start:06d}",
            f"{_WORK}:evaluate",
            {
                "args": _evaluation_args(plan, arm, block.start, len(block)),
                "prediction": arm.prediction,
            },
            needs=(training,),
            files=training.files,
            threads=preset.threads,
            gpus=preset.gpu_share,
            seconds=len(block) * preset.seconds.get("episode", 5.0),
        )
        for block in _blocks(FIRST_SEED, preset.num_episodes, preset.episode_block)
    )


def _evaluation_args(plan: Plan, arm: ArmLine, first: int, count: int) -> list[str]:
    args = [plan.env, "--policy", arm.policy, "--checkpoint", "run"]
    args += [*_seeds(range(first, first + count)), "--num_envs", str(plan.preset.num_envs)]
    return [*args, "--workers", "0", "--device", plan.preset.device, "--out", "out"]


def _library(plan: Plan, arm: ArmLine) -> str | None:
    if arm.prediction != "truth":
        return FORECAST
    return LIBRARY if plan.library else None


def _seeds(block: range) -> list[str]:
    return ["--num_episodes", str(len(block)), "--seed", str(block.start)]


def _blocks(first: int, count: int, size: int) -> list[range]:
    return [
        range(start, min(start + size, first + count))
        for start in range(first, first + count, size)
    ]
