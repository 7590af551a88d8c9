"""Configuration of a training run: one frozen dataclass, without PyTorch.

In JSON and in ``config.yaml`` all settings stand side by side under the names of their options,
as in every release.
"""

from __future__ import annotations

import dataclasses
import typing
from collections.abc import Mapping, Set
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, Generic, TypeVar

import tyro

from robo_manip_baselines.data.actions import ActionEncoding
from robo_manip_baselines.data.normalization import METHODS
from robo_manip_baselines.envs.mujoco.tasks.registry import task_entry
from robo_manip_baselines.observation import Corruption, ObservationSpec
from robo_manip_baselines.observation.spec import parse_image_size, size_text
from robo_manip_baselines.policy.presets import (
    ActionExecution,
    TrainSettings,
)
from robo_manip_baselines.policy.registry import policy_entry, policy_presets
from robo_manip_baselines.runs.checkpoints import list_checkpoints
from robo_manip_baselines.runs.documents import as_json, convert, read_yaml
from robo_manip_baselines.runs.errors import RequestError, require_choice
from robo_manip_baselines.runs.files import FolderKind, write_text
from robo_manip_baselines.runs.ranges import Count, Episodes, Seed, require_ranges

Network = TypeVar("Network")

CONFIG = "config.yaml"
METRICS = "metrics.jsonl"
CURVES = "curves.png"

RUNTIME_OPTIONS = frozenset(
    {"device", "logger", "dataset", "out", "log_every", "validate_every", "checkpoint_every"}
)
"""Options that may change when a run is resumed: they do not decide the weights."""

BUDGET_OPTIONS = frozenset({"steps", "epochs"})
"""Options that may also change when a run is resumed, to extend it."""

EXTENDING_OPTIONS = BUDGET_OPTIONS | {"early_stopping"}
"""The same, with what ends a run before its budget is spent."""

_PARTS = ("network", "training", "spec")
"""Attributes of the configuration whose fields are options."""

_NEWER = {"object_noise": 0.0}
"""Options that earlier releases had not; the value, that of presets, does what these did."""

_CORRUPTION = {
    "corruption_seed" if item.name == "seed" else item.name: item.name
    for item in fields(Corruption)
    if item.name != "stats_sha256"
}
"""Option -> attribute of `Corruption`."""


@dataclass(frozen=True)
class TrainConfig(Generic[Network]):
    """Everything that decides a training run.

    Attributes:
        policy: Policy, for example Act.
        network: Settings of the network.
        training: Optimiser, sampling and budget.
        spec: Observations of the policy.
        env: Environment of the demonstrations.
        dataset: Folder of demonstrations; dataset/<env> if not given.
        num_episodes: Use only so many demonstrations, the first ones; all if not given.
        preset: Origin of the defaults: paper, cpu, ..., or auto: paper where there is a GPU, else
            cpu.
        init_from: Run, checkpoint or shipped:NAME whose weights and normalisation the training
            begins with, with a schedule of its own; random weights if not given.
        seed: Seed of the weights, of the order of the examples and of the split.
        device: auto, cpu, cuda or cuda:NUMBER.
        out: Run folder; runs/<policy>_<obs>[_h<horizon>][_<corruption>]_<preset>_seed<seed> if
            not given.
        logger: Display of the curves beside metrics.jsonl: tensorboard, wandb or none.
        log_every: Steps between lines of metrics.jsonl.
        validate_every: Steps between losses on the episodes held out.
        checkpoint_every: Steps between checkpoints.

    Raises:
        RequestError: a value that is not valid.
    """

    policy: tyro.conf.Positional[str]
    network: tyro.conf.OmitArgPrefixes[Network]
    training: tyro.conf.OmitArgPrefixes[TrainSettings]
    spec: tyro.conf.OmitArgPrefixes[ObservationSpec]
    env: str = "FeedingEnv"
    dataset: Path | None = None
    num_episodes: Episodes | None = None
    preset: str = "cpu"
    init_from: Path | None = None
    seed: Seed = 0
    device: str = "auto"
    out: Path | None = None
    logger: str = "tensorboard"
    log_every: Count = 50
    validate_every: Count = 500
    checkpoint_every: Count = 1000

    def __post_init__(self) -> None:
        require_choice("preset", self.preset, ["auto", *policy_presets(self.policy)])
        task_entry(self.env).require_arms(self.spec.arms)
        require_ranges(self)
        if self.training.relative_actions and self.spec.moves_gripper:
            ActionEncoding(self.spec, 1.0, is_relative=True)  # refuses
        if self.training.norm is not None:
            own = policy_entry(self.policy).normalization
            require_choice("norm", self.training.norm, dict.fromkeys([*METHODS, own]))

    @property
    def norm(self) -> str:
        """Normalisation of states and actions, the policy's own where none is given."""
        return self.training.norm or policy_entry(self.policy).normalization

    @classmethod
    def from_preset(
        cls, policy: str, preset: str, env: str = "FeedingEnv", **changes: Any
    ) -> TrainConfig[Any]:
        """Return the defaults of a preset, with changes to attributes of the configuration.

        A preset's ``object_pose`` applies only where the task has objects.

        Raises:
            RequestError: there is no such policy, preset or task, or a value is not valid.
        """
        presets = policy_presets(policy)
        chosen = presets[require_choice("preset", preset, presets)]
        task = task_entry(env)
        spec = ObservationSpec(
            obs="current_pred",
            cameras=chosen.cameras,
            image_size=chosen.image_size,
            object_pose=chosen.object_pose and bool(task.names.objects),
            arms=task.arms[0],
        )
        config = cls(policy, chosen.config, chosen.training, spec, env, preset=preset)
        return dataclasses.replace(config, **changes)

    @property
    def name(self) -> str:
        """Policy, condition, preset and seed, such as ``act_current_pred_h2_cpu_seed0``."""
        return f"{self.policy.lower()}_{self.spec.name}_{self.preset}_seed{self.seed}"

    @property
    def folder(self) -> Path:
        """Run folder."""
        return self.out or Path("runs") / self.name

    @property
    def demonstrations(self) -> Path:
        """Folder of demonstrations."""
        return self.dataset or Path("dataset") / self.env

    @property
    def execution(self) -> ActionExecution:
        """Default execution of the trained policy's action chunks."""
        return policy_presets(self.policy)[self.preset].execution

    def to_json(self) -> dict[str, Any]:
        """Return all settings by the names of their options, made of plain values."""
        values = {name: value for name, value in vars(self).items() if name not in _PARTS}
        for part in _PARTS:
            values |= vars(getattr(self, part))
        del values["render_size"]  # no option: demonstrations have it
        corruption = values.pop("corruption")
        values |= {name: getattr(corruption, of) for name, of in _CORRUPTION.items()}
        values["image_size"] = size_text(self.spec.image_size)
        return {name: _plain(value) for name, value in values.items()}

    def to_document(self) -> dict[str, Any]:
        """Return `to_json` for files: without options that earlier releases had not, where unused.

        So that runs and work items of these releases stay those of the same settings.
        """
        return {n: v for n, v in self.to_json().items() if n not in _NEWER or v != _NEWER[n]}

    @classmethod
    def from_json(cls, values: Mapping[str, Any]) -> TrainConfig[Any]:
        """Undo `to_json`; settings that are missing have the defaults of the preset.

        Raises:
            RequestError: a name or a value that is not valid.
        """
        env, policy, preset = (
            convert(values.get(name, default), str, name)
            for name, default in (("env", cls.env), ("policy", ""), ("preset", "cpu"))
        )
        default = cls.from_preset(policy, preset, env)
        known = [*default.to_json(), "corruption"]
        for name in values:
            require_choice("option", name, known)
        given = dict(values)
        if "image_size" in given:
            given["image_size"] = parse_image_size(convert(given["image_size"], str, "image_size"))
        is_on = given.pop("corruption", True) is not False  # --no_corruption of older releases
        names = _CORRUPTION.items() if is_on else ()
        given["corruption"] = {of: given[n] for n, of in names if given.get(n) is not None}
        parts: dict[str, Any] = {}
        for name in _PARTS:
            part = getattr(default, name)
            own = {item.name for item in fields(part)} & given.keys()
            changes = {item: given[item] for item in own}
            parts[name] = convert(
                as_json(dataclasses.asdict(part) | changes), type(part), "options"
            )
        kinds = typing.get_type_hints(cls, include_extras=True)
        own = (kinds.keys() - set(_PARTS)) & given.keys()
        parts |= {name: convert(given[name], kinds[name], name) for name in own}
        return dataclasses.replace(default, **parts)


def read_config(path: Path) -> dict[str, Any]:
    """Read a YAML file of options.

    Raises:
        RequestError: it cannot be read, or is no mapping.
    """
    values = read_yaml(path)
    if "latent_size" in values:
        # Runs of release 0.1.0, whose files have all options of ACT, lack this one.
        values.setdefault("actions_per_query", 1)
    return values


def write_config(run: Path, config: TrainConfig[Any]) -> None:
    """Write the options of a run, except its folder, so that ``--config`` reads them."""
    write_text(run / CONFIG, _to_yaml(config))


def _to_yaml(config: TrainConfig[Any]) -> str:
    import yaml  # slow to import

    values = {name: value for name, value in config.to_document().items() if name != "out"}
    return yaml.safe_dump(values, sort_keys=False, allow_unicode=True)


def _is_run(folder: Path) -> bool:
    """Return whether a folder has checkpoints, or options just as `write_config` writes them."""
    path = folder / CONFIG
    if list_checkpoints(folder) or not path.is_file():
        return bool(list_checkpoints(folder))
    try:
        return _to_yaml(TrainConfig.from_json(read_config(path))) == path.read_text("utf-8")
    except (RequestError, TypeError, AttributeError):
        return False


RUN = FolderKind("run of bin/Train.py", _is_run)


def require_same_config(
    run: Path, config: TrainConfig[Any], may_differ: Set[str] = RUNTIME_OPTIONS
) -> None:
    """Make sure that a run folder's options are those of ``config``, apart from ``may_differ``.

    Raises:
        RequestError: naming the first option that differs.
    """
    written = read_config(run / CONFIG)
    try:
        before = TrainConfig.from_json(written).to_json()
    except RequestError as error:
        raise RequestError(f"'{run / CONFIG}': {error}; choose another --out") from error
    for name, value in config.to_json().items():
        if name not in may_differ and value != before.get(name):
            pair = before[name], value
            old, new = (" ".join(map(str, v)) if isinstance(v, list) else v for v in pair)
            extends = "--resume extends it, " if name in EXTENDING_OPTIONS else ""
            raise RequestError(
                f"'{run}' holds a run with {name} {old}, not {new}; "
                f"{extends}choose another --out, or give the same options"
            )


def _plain(value: Any) -> Any:
    if isinstance(value, Path):
        return str(value)
    return list(value) if isinstance(value, tuple) else value
