"""Options of ``bin/Train.py``: preset, then YAML file, then command line."""

from __future__ import annotations

import dataclasses
import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Generic, TypeVar

import tyro

from robo_manip_baselines.envs.mujoco.tasks.registry import task_entry
from robo_manip_baselines.observation import Corruption, ObservationSpec
from robo_manip_baselines.policy.presets import PolicyPreset, TrainSettings
from robo_manip_baselines.policy.registry import POLICIES, load_part, policy_entry
from robo_manip_baselines.runs.command import parse
from robo_manip_baselines.runs.errors import RequestError, require_choice
from robo_manip_baselines.training.run_folder import CONFIG, read_config

Network = TypeVar("Network")

logger = logging.getLogger(__name__)

EXAMPLE = "python bin/Train.py Act --obs current_pred --horizon 2 --seed 0"

FREE = frozenset({"device", "logger", "dataset", "log_every", "validate_every", "checkpoint_every"})
"""Options that may change when a run is resumed: they do not decide the weights."""

_NOT_SAVED = ("out", "resume", "config")


@dataclass(frozen=True)
class TrainOptions(Generic[Network]):
    """Train a policy on demonstrations."""

    policy: tyro.conf.Positional[str]
    """Policy, for example Act."""
    network: tyro.conf.OmitArgPrefixes[Network]
    """Settings of the network."""
    training: tyro.conf.OmitArgPrefixes[TrainSettings]
    """Settings of the training."""
    spec: tyro.conf.OmitArgPrefixes[ObservationSpec] = field(
        default_factory=lambda: ObservationSpec("current_pred")
    )
    """What the policy is shown."""
    corruption: bool = True
    """--no_corruption shows the truth, whatever else is said."""
    env: str = "FeedingEnv"
    """Environment of the demonstrations."""
    dataset: Path | None = None
    """Folder of demonstrations; dataset/<env> if not given."""
    num_episodes: int | None = None
    """Use only so many demonstrations, the first ones; all if not given."""
    preset: str = "auto"
    """Where the defaults come from: paper, cpu, or auto: paper where there is a GPU, else cpu."""
    seed: int = 0
    """Seed of the weights, of the order of the examples and of the split."""
    device: str = "auto"
    """auto, cpu, cuda or cuda:NUMBER."""
    out: Path | None = None
    """Run folder; runs/<policy>_<obs>[_h<horizon>][_<corruption>]_<preset>_seed<seed> if not
    given."""
    resume: bool = False
    """Go on with the run in the run folder."""
    config: Path | None = None
    """YAML file of options, such as the config.yaml of a run; the command line goes before it."""
    logger: str = "tensorboard"
    """Where curves are shown beside metrics.jsonl: tensorboard, wandb or none."""
    log_every: int = 50
    """Steps between lines of metrics.jsonl."""
    validate_every: int = 500
    """Steps between losses on the episodes held out."""
    checkpoint_every: int = 1000
    """Steps between checkpoints."""

    def __post_init__(self) -> None:
        require_choice("policy", self.policy, POLICIES)
        task_entry(self.env)
        for name in ("log_every", "validate_every", "checkpoint_every"):
            if getattr(self, name) < 1:
                raise RequestError(f"{name} {getattr(self, name)}: must be 1 or more steps")
        if self.seed < 0:
            raise RequestError(f"seed {self.seed}: must be 0 or more")
        if not self.corruption:
            object.__setattr__(self, "spec", replace(self.spec, corruption=Corruption()))

    @property
    def folder(self) -> Path:
        """The run folder."""
        if self.out is not None:
            return self.out
        name = f"{self.policy.lower()}_{self.spec.name}_{self.preset}_seed{self.seed}"
        return Path("runs") / name

    @property
    def demonstrations(self) -> Path:
        """The folder of demonstrations."""
        return self.dataset or Path("dataset") / self.env

    def to_config(self) -> dict[str, Any]:
        """Return all options but those that say where and how to run, flat, for YAML."""
        values: dict[str, Any] = {}
        for item in dataclasses.fields(self):
            value = getattr(self, item.name)
            if item.name in ("network", "training"):
                values |= dataclasses.asdict(value)
            elif item.name == "spec":
                values |= spec_options(value)
            elif item.name not in (*_NOT_SAVED, "corruption"):
                values[item.name] = value
        return {name: _to_yaml(value) for name, value in values.items()}


def spec_options(spec: ObservationSpec) -> dict[str, Any]:
    """Return a spec as options, flat, in the names and forms of the command line."""
    values = {item.name: getattr(spec, item.name) for item in dataclasses.fields(spec)}
    corruption = values.pop("corruption")
    height, width = spec.image_size
    values |= {"cameras": spec.cameras or ("none",), "image_size": f"{height}x{width}"}
    # Options of the corruption that are at their defaults are left out, as in older runs.
    for item in dataclasses.fields(corruption):
        value = getattr(corruption, item.name)
        name = "corruption_seed" if item.name == "seed" else item.name
        if item.name != "stats_sha256":
            values[name] = value if value != item.default or name == "error" else None
    return values


def parse_options(args: Sequence[str], has_gpu: bool) -> TrainOptions[Any]:
    """Read a command line; its preset and its YAML file give the defaults.

    Args:
        args: without the name of the program.
        has_gpu: what the preset ``auto`` goes by.

    Raises:
        RequestError: one line that says what is wrong and what is valid.
        SystemExit: with code 0 after ``--help``.
    """
    is_help = bool(args) and args[0] in ("-h", "--help")
    if not args or (args[0].startswith("-") and not is_help):
        raise RequestError(f"say first which policy to train: {', '.join(POLICIES)}")
    policy = next(iter(POLICIES)) if is_help else args[0]
    presets: dict[str, PolicyPreset] = load_part(policy_entry(policy).presets)
    file = _yaml_file(args)
    values = read_config(file) if file else {}
    if values.setdefault("policy", policy) != policy:
        raise RequestError(f"'{file}' is of policy {values['policy']}, not {policy}")
    name = _last_value(args, "preset") or str(values.get("preset", "auto"))
    name = _choose_preset(name, presets, has_gpu)
    defaults = _with_budget(_defaults(policy, name, presets[name]), values)
    if file:
        defaults = _apply_yaml(file, {**values, "preset": name}, defaults)
    given = {budget: _last_value(args, budget) for budget in ("epochs", "steps")}
    defaults = _with_budget(defaults, {k: v for k, v in given.items() if v is not None})
    description = (
        f"Train a policy on demonstrations. Policies: {', '.join(POLICIES)}; the options and "
        f"defaults below are those of {policy} with --preset {name}. Presets of {policy}: "
        f"{', '.join(presets)}."
    )
    options = _parse(defaults, list(args), description)
    return dataclasses.replace(options, preset=name)


def _defaults(policy: str, name: str, preset: PolicyPreset) -> TrainOptions[Any]:
    return TrainOptions(
        policy=policy,
        preset=name,
        network=preset.config,
        training=preset.training,
        spec=ObservationSpec(
            "current_pred",
            cameras=preset.cameras,
            image_size=preset.image_size,
            object_pose=preset.object_pose,
        ),
    )


def _choose_preset(name: str, presets: Mapping[str, PolicyPreset], has_gpu: bool) -> str:
    if name == "auto":
        name = "paper" if has_gpu and "paper" in presets else "cpu"
        logger.info(
            "--preset auto: %s, so %s%s",
            "PyTorch finds a GPU" if has_gpu else "PyTorch finds no GPU",
            name,
            "" if "paper" in presets else f" (of {', '.join(presets)})",
        )
    return require_choice("preset", name, presets)


def _parse(defaults: TrainOptions[Any], args: list[str], description: str) -> TrainOptions[Any]:
    kind: Any = TrainOptions[type(defaults.network)]
    return parse(kind, EXAMPLE, description=description, args=args, default=defaults)


def _with_budget(defaults: TrainOptions[Any], given: Mapping[str, Any]) -> TrainOptions[Any]:
    """Let the one budget that is given, epochs or steps, replace the other's default."""
    named = [name for name in ("epochs", "steps") if given.get(name) not in (None, "None")]
    if len(named) != 1:
        return defaults
    budget = {"epochs": None, "steps": None, named[0]: 1}  # the value itself is parsed later
    training = dataclasses.replace(defaults.training, **budget)
    return dataclasses.replace(defaults, training=training)


def _apply_yaml(
    file: Path, values: Mapping[str, Any], defaults: TrainOptions[Any]
) -> TrainOptions[Any]:
    """Parse a file's values as if they had been typed, so that they are checked the same way."""
    known = [*defaults.to_config(), "corruption"]
    args = [defaults.policy]
    for name, value in values.items():
        if name not in known:
            try:
                require_choice("option", name, known)
            except RequestError as error:
                raise RequestError(f"'{file}': {error}") from None
        if name == "policy" or value is None:
            continue
        if isinstance(value, bool):
            args.append(f"--{name}" if value else f"--no_{name}")
        elif isinstance(value, list):
            args += [f"--{name}", *([str(part) for part in value] or ["none"])]
        elif isinstance(value, dict):
            raise RequestError(f"'{file}': {name} must be one value or a list, not a mapping")
        else:
            args.append(f"--{name}={value}")
    try:
        return _parse(defaults, args, "")
    except RequestError as error:
        raise RequestError(f"'{file}': {error}") from None


def _yaml_file(args: Sequence[str]) -> Path | None:
    """The file of defaults: ``--config``, else with ``--resume`` the one in the run folder."""
    if given := _last_value(args, "config"):
        return Path(given)
    out = _last_value(args, "out")
    saved = Path(out) / CONFIG if out else None
    return saved if saved and "--resume" in args and saved.is_file() else None


def _last_value(args: Sequence[str], name: str) -> str | None:
    """The value that follows ``--name`` or ``--name=``; None where it is not given."""
    found: str | None = None
    for place, arg in enumerate(args):
        option, sign, value = arg.partition("=")
        if option != f"--{name}":
            continue
        if sign:
            found = value
        elif place + 1 < len(args):
            found = args[place + 1]
    return found


def _to_yaml(value: Any) -> Any:
    if isinstance(value, Path):
        return str(value)
    return list(value) if isinstance(value, tuple) else value
