"""Experimental arms: what a policy was trained with, what it is shown, and what that is called."""

from __future__ import annotations

import platform
from contextlib import closing
from dataclasses import dataclass, fields, replace
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

from robo_manip_baselines.commands.rollout import PolicyOptions, RolloutOptions
from robo_manip_baselines.envs.mujoco.cell.opengl import opengl_problem
from robo_manip_baselines.envs.mujoco.tasks.face_env import CONTROL_PERIOD, world_of
from robo_manip_baselines.envs.mujoco.tasks.registry import env_id
from robo_manip_baselines.observation import Corruption, ObservationSpec
from robo_manip_baselines.observation.spec import CorruptionOptions, parse_cameras, parse_image_size
from robo_manip_baselines.policy.checkpoint import Checkpoint, read_checkpoint
from robo_manip_baselines.policy.presets import ActionExecution
from robo_manip_baselines.policy.registry import policy_entry
from robo_manip_baselines.rollout.results import EpisodeResult
from robo_manip_baselines.rollout.workers import Task
from robo_manip_baselines.runs.checkpoints import CHECKPOINTS
from robo_manip_baselines.runs.errors import RequestError, require_choice

if TYPE_CHECKING:
    import torch


def arm_name(spec: ObservationSpec) -> str:
    """Name an experimental arm: what a policy is shown, such as ``current_pred_h2_uniform``."""
    horizon = f"_h{spec.horizon}" if spec.obs == "current_pred" else ""
    corruption = f"_{spec.corruption.label}" if spec.corruption else ""
    return f"{spec.obs}{horizon}{corruption}"


def changed_name(trained: ObservationSpec, shown: ObservationSpec) -> str:
    """Name what a policy is shown otherwise than in training: ``_under_delay3``; or nothing."""
    if _without_path(trained.corruption) == _without_path(shown.corruption):
        return ""
    return f"_under_{shown.corruption.label if shown.corruption else 'truth'}"


def describe(corruption: Corruption | None) -> str:
    """Say what stands between truth and policy, as options are spelt."""
    if corruption is None:
        return "no corruption"
    changed = {
        item.name: getattr(corruption, item.name)
        for item in fields(Corruption)
        if getattr(corruption, item.name) != item.default
    }
    return ", ".join(
        f"{name} {value[:12] if name == 'stats_sha256' else value}"
        for name, value in changed.items()
    )


def choose_corruption(
    checkpoint: Checkpoint, given: CorruptionOptions, is_change: bool
) -> Corruption | None:
    """Return what stands between truth and policy: as in training, or as was typed.

    Args:
        checkpoint: says what it was in training.
        given: what was typed; ``--no_corruption`` always holds.
        is_change: whether what was typed may differ from training.

    Raises:
        RequestError: it differs and may not, or cannot be used.
    """
    trained = checkpoint.spec.corruption
    chosen = given.apply(trained)
    chosen = chosen and chosen.pinned()
    # Statistics are the same wherever their file lies: their digest is compared.
    is_same = _without_path(chosen) == _without_path(trained)
    if is_same or not given.corruption or is_change:
        return chosen
    raise RequestError(
        f"checkpoint '{checkpoint.folder}' was trained with {describe(trained)}, not with "
        f"{describe(chosen)}; leave the options as trained, or say --change_corruption to "
        "evaluate it so all the same"
    )


def _without_path(corruption: Corruption | None) -> Corruption | None:
    return corruption and replace(corruption, error_stats=None)


FIRST_SEED = 1000
"""of an evaluation, if none is given: far from the seeds of demonstrations, which start at 0."""


@dataclass(frozen=True)
class Evaluation:
    """What to evaluate, and how.

    Attributes:
        checkpoint: of the policy.
        task: where it acts.
        execution: execution of its action chunks.
        seeds: of the episodes.
        out: folder of the results.
        num_envs, workers: see ``open_environments``.
        device: where the network runs.
        precision: of the network, see ``PolicyRunner``.
    """

    checkpoint: Checkpoint
    task: Task
    execution: ActionExecution
    seeds: range
    out: Path
    num_envs: int
    workers: int
    device: torch.device
    precision: str

    def __str__(self) -> str:
        execution, checkpoint = self.execution, self.checkpoint
        how = (
            f"temporal ensemble (decay {execution.ensemble_decay:g})"
            if execution.temporal_ensemble
            else f"{execution.n_action_steps} actions of each chunk"
        )
        return (
            f"{checkpoint.policy}, {self.arm}, step {checkpoint.step}, on "
            f"{self.device} in {self.precision}: {how}; seeds {self.seeds[0]} to {self.seeds[-1]}"
        )

    @property
    def arm(self) -> str:
        """What the policy was trained with, and what it is shown here where that is another."""
        trained = self.checkpoint.spec
        return arm_name(trained) + changed_name(trained, self.task.spec)

    def seen_seeds(self) -> list[int]:
        """Return the seeds that the demonstrations were recorded with, training or validation."""
        split = self.checkpoint.split
        return sorted(set(self.seeds) & {*split.train, *split.validation})

    def settings(self) -> dict[str, Any]:
        """Return what results of one folder must have in common."""
        return {
            "env": env_id(self.task.env),
            "env_kwargs": self.task.env_kwargs,
            "observation": self.task.spec.to_json(),
            "xml_hash": self.checkpoint.xml_hash,
            "policy": self.checkpoint.policy,
            "checkpoint": self.checkpoint.content_hash,
            "acting": _effective(self.execution),
            "device": self.device.type,
            "precision": self.precision,
        }

    def facts(self) -> dict[str, Any]:
        """Return what else to note beside results."""
        checkpoint = self.checkpoint
        return {
            "arm": self.arm,
            "checkpoint_folder": str(checkpoint.folder),
            "checkpoint_step": checkpoint.step,
            "train_seed": checkpoint.train_seed,
            "first_seed": self.seeds[0],
        }


def plan(options: RolloutOptions) -> Evaluation:
    """Turn what was typed into what to evaluate.

    Raises:
        RequestError: something does not exist, or checkpoint, environment and options do not fit.
    """
    given = options.evaluation
    policy_entry(options.policy or "")
    env_id(options.env)
    for name, value, least in (
        ("num_envs", given.num_envs, 1),
        ("workers", options.workers, 0),
        ("video", given.video, 0),
    ):
        if value < least:
            raise RequestError(f"{name} {value}: must be {least} or more")
    if given.checkpoint is None:
        raise RequestError(
            "which checkpoint? say --checkpoint runs/..., as bin/Train.py printed it"
        )
    # Imported here: what was wrong above is said without waiting for PyTorch.
    from robo_manip_baselines.policy.execution import INFERENCE_PRECISIONS
    from robo_manip_baselines.training.device import choose_device

    require_choice("precision", given.precision, INFERENCE_PRECISIONS)
    checkpoint = read_checkpoint(given.checkpoint)
    _refuse_contradictions(options, checkpoint)
    recorded = checkpoint.dataset.get("env_kwargs", {})
    corruption = choose_corruption(checkpoint, options.detection, given.change_corruption)
    spec = replace(checkpoint.spec, corruption=corruption)
    task = Task(checkpoint.env, spec, {**recorded, **options.motion_arguments()})
    check_fit(checkpoint, task)
    if (checkpoint.spec.cameras or given.video) and (problem := opengl_problem()):
        why = "the policy sees images" if checkpoint.spec.cameras else "--video 0 needs no OpenGL"
        raise RequestError(f"{problem} ({why})")
    return Evaluation(
        checkpoint=checkpoint,
        task=task,
        execution=choose_execution(checkpoint.execution, given),
        seeds=options.seeds(FIRST_SEED),
        out=options.out
        or Path("results")
        / f"{options.env}_{run_name(given.checkpoint)}{changed_name(checkpoint.spec, spec)}",
        num_envs=given.num_envs,
        workers=options.workers,
        device=choose_device(given.device),
        precision=given.precision,
    )


def choose_execution(trained: ActionExecution, given: PolicyOptions) -> ActionExecution:
    """Return the checkpoint's action execution with the options that were given.

    Raises:
        RequestError: both ways were typed.
    """
    if given.temporal_ensemble and given.execute is not None:
        raise RequestError("--temporal_ensemble and --execute: say one of them")
    if given.execute is not None:
        return replace(trained, temporal_ensemble=False, n_action_steps=given.execute)
    return replace(trained, temporal_ensemble=True) if given.temporal_ensemble else trained


def check_fit(checkpoint: Checkpoint, task: Task) -> None:
    """Make sure that the environment is the one that the policy was trained for.

    Raises:
        RequestError: naming what the checkpoint has and what the environment has.
    """
    with closing(task.make()) as env:
        world = world_of(env)
        pairs = {
            "actions": (", ".join(checkpoint.action_names), ", ".join(world.action_names)),
            "control period": (checkpoint.control_period, CONTROL_PERIOD),
            "size of the state": (checkpoint.dims.state, task.vector_size),
            "model hash": (checkpoint.xml_hash[:12], world.xml_hash[:12]),
        }
    for name, (trained, here) in pairs.items():
        if trained != here:
            raise RequestError(
                f"checkpoint '{checkpoint.folder}' was trained with {name} {trained}; {task.env} "
                f"has {here} here; install the release that trained it, "
                f"{checkpoint.versions.get('robo_manip_baselines', 'unknown')}, or train again"
            )


def _refuse_contradictions(options: RolloutOptions, checkpoint: Checkpoint) -> None:
    """Refuse options that say otherwise than the checkpoint.

    Raises:
        RequestError: naming both.
    """
    given, spec = options.evaluation, checkpoint.spec
    cameras = None if options.cameras is None else parse_cameras(options.cameras)
    pairs = {
        "policy": (options.policy, checkpoint.policy),
        "environment": (options.env, checkpoint.env),
        "obs": (given.obs, spec.obs),
        "horizon": (given.horizon, spec.horizon),
        "object_pose": (given.object_pose or None, spec.object_pose),
        "cameras": (cameras, spec.cameras),
        "image_size": (
            options.image_size and parse_image_size(options.image_size),
            spec.image_size,
        ),
    }
    for name, (typed, trained) in pairs.items():
        if typed is not None and typed != trained:
            raise RequestError(
                f"checkpoint '{checkpoint.folder}' was trained with {name} {_spelt(trained)}, not "
                f"{_spelt(typed)}; leave the option as trained, or train another policy"
            )


def run_name(checkpoint: Path) -> str:
    """Name results after the run folder, with the step where one checkpoint of it was named."""
    path = checkpoint.resolve()
    if path.parent.name == CHECKPOINTS:
        return f"{path.parent.parent.name}_{path.name}"
    return path.name


def stamp(result: EpisodeResult, evaluation: Evaluation) -> EpisodeResult:
    """Note in a result which policy acted."""
    checkpoint = evaluation.checkpoint
    return replace(
        result,
        policy=checkpoint.policy,
        arm=evaluation.arm,
        train_seed=checkpoint.train_seed,
        checkpoint=checkpoint.content_hash,
        versions=software(),
    )


def software() -> dict[str, str]:
    """Return the versions of what an outcome depends on."""
    packages = ("mujoco", "numpy", "robo_manip_baselines", "torch")
    return {"python": platform.python_version(), **{name: version(name) for name in packages}}


def _effective(execution: ActionExecution) -> dict[str, Any]:
    """Return the settings that make a difference."""
    used = "decay" if execution.temporal_ensemble else "execute"
    return {name: execution.to_json()[name] for name in ("temporal_ensemble", used)}


def _spelt(value: object) -> str:
    if isinstance(value, tuple):
        parts = [str(part) for part in value]
        is_size = bool(value) and isinstance(value[0], int)
        return ("x" if is_size else ",").join(parts) or "none"
    return str(value)
