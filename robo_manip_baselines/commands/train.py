"""``bin/Train.py``: preset, then YAML file, then command line; closing table and exit codes."""

from __future__ import annotations

import dataclasses
import difflib
import logging
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic

import tyro

from robo_manip_baselines.envs.mujoco.tasks.registry import task_entry
from robo_manip_baselines.observation import Corruption
from robo_manip_baselines.policy.registry import policy_names, policy_presets
from robo_manip_baselines.runs.checkpoints import BEST, list_checkpoints
from robo_manip_baselines.runs.command import last_value, parse
from robo_manip_baselines.runs.documents import shown
from robo_manip_baselines.runs.errors import RequestError, require_choice
from robo_manip_baselines.runs.files import require_out_folder
from robo_manip_baselines.runs.metrics import read_metrics
from robo_manip_baselines.runs.progress import closing_table
from robo_manip_baselines.training.config import (
    CONFIG,
    METRICS,
    RUN,
    Network,
    TrainConfig,
    read_config,
)
from robo_manip_baselines.training.requirements import prepare_pytorch

logger = logging.getLogger(__name__)

EXAMPLE = "python bin/Train.py Act --obs current_pred --horizon 2 --seed 0"


@dataclass(frozen=True)
class TrainCommandOptions(Generic[Network]):
    """Train a policy on demonstrations."""

    run: tyro.conf.OmitArgPrefixes[TrainConfig[Network]]
    corruption: bool = True
    """--no_corruption turns all corruption of the observations off."""
    resume: bool = False
    """Continue the run in the run folder; with a larger --steps or --epochs, extend it."""
    config: Path | None = None
    """YAML file of options, such as the config.yaml of a run; the command line overrides it."""


def parse_config(args: Sequence[str], has_gpu: bool | None = None) -> TrainConfig[Any]:
    """Read a command line; its preset and its YAML file give the defaults.

    ``has_gpu`` decides the preset ``auto``; if None, PyTorch is asked where that is needed.

    Raises:
        RequestError: one line that names what is wrong and what is valid.
        SystemExit: with code 0 after ``--help``.
    """
    is_help = any(arg in ("-h", "--help") for arg in args)
    if not args or (args[0].startswith("-") and not is_help):
        raise RequestError(f"name the policy to train first: {', '.join(policy_names())}")
    policy = args[0] if not args[0].startswith("-") else policy_names()[0]
    presets = policy_presets(policy)
    file = _yaml_file(args)
    values = read_config(file) if file else {}
    if values.setdefault("policy", policy) != policy:
        raise RequestError(f"'{file}' is of policy {shown(values['policy'])}, not '{policy}'")
    env = last_value(args, "env") or str(values.get("env", TrainConfig.env))
    preset = last_value(args, "preset") or str(values.get("preset", "auto"))
    if preset == "auto":
        preset = _auto_preset(list(presets), False if is_help else has_gpu, is_quiet=is_help)
    options = TrainCommandOptions(TrainConfig.from_preset(policy, preset, env))
    options = _with_budget(options, values)
    if file:
        options = _apply_yaml(file, {**values, "preset": preset}, options)
    options = _with_budget(options, {n: last_value(args, n) for n in ("epochs", "steps")})
    description = (
        f"Train a policy on demonstrations. Policies: {', '.join(policy_names())}; the options and "
        f"defaults below are those of {policy} with --preset {preset}. Presets of {policy}: "
        f"{', '.join(presets)}."
    )
    options = _parse(options, list(args), description)
    config = dataclasses.replace(options.run, preset=preset)
    if not options.corruption:
        spec = dataclasses.replace(config.spec, corruption=Corruption())
        config = dataclasses.replace(config, spec=spec)
    return config


def _parse(
    options: TrainCommandOptions[Any], args: list[str], description: str
) -> TrainCommandOptions[Any]:
    kind: Any = TrainCommandOptions[type(options.run.network)]
    return parse(kind, EXAMPLE, description=description, args=args, default=options)


def _auto_preset(presets: Sequence[str], has_gpu: bool | None, *, is_quiet: bool) -> str:
    """Return ``paper`` where there is a GPU, else ``cpu``; the first preset where there is none."""
    if has_gpu is None:
        import torch

        has_gpu = torch.cuda.is_available()
    wanted = "paper" if has_gpu and "paper" in presets else "cpu"
    name = wanted if wanted in presets else presets[0]
    if not is_quiet:
        found = "PyTorch finds a GPU" if has_gpu else "PyTorch finds no GPU"
        choice = "" if "paper" in presets else f" (of {', '.join(presets)})"
        logger.info("--preset auto: %s, so %s%s", found, name, choice)
    return name


def _with_budget(
    options: TrainCommandOptions[Any], given: Mapping[str, Any]
) -> TrainCommandOptions[Any]:
    """Let the one budget that is given, epochs or steps, replace the other's default."""
    named = [name for name in ("epochs", "steps") if given.get(name) not in (None, "None")]
    if len(named) != 1:
        return options
    budget = {"epochs": None, "steps": None, named[0]: 1}  # the value itself is parsed later
    training = dataclasses.replace(options.run.training, **budget)
    return dataclasses.replace(options, run=dataclasses.replace(options.run, training=training))


def _apply_yaml(
    file: Path, values: Mapping[str, Any], options: TrainCommandOptions[Any]
) -> TrainCommandOptions[Any]:
    """Parse a file's values as if they had been typed, so that they are checked the same way."""
    known = [*options.run.to_json(), "corruption"]
    args = [options.run.policy]
    try:
        for name, value in values.items():
            require_choice("option", name, known)
            if name == "policy" or value is None:
                continue
            if isinstance(value, bool):
                args.append(f"--{name}" if value else f"--no_{name}")
            elif isinstance(value, list):
                args += [f"--{name}", *([str(part) for part in value] or ["none"])]
            elif isinstance(value, dict):
                raise RequestError(f"{name} must be one value or a list, not a mapping")
            else:
                args.append(f"--{name}={value}")
        return _parse(options, args, "")
    except RequestError as error:
        raise RequestError(f"'{file}': {error}") from None


def _yaml_file(args: Sequence[str]) -> Path | None:
    """Return the file of defaults: ``--config``, else that of a run folder to resume."""
    if given := last_value(args, "config"):
        return Path(given)
    out = last_value(args, "out")
    saved = Path(out) / CONFIG if out else None
    return saved if saved and "--resume" in args and saved.is_file() else None


def summary(config: TrainConfig[Any], first_step: int) -> str:
    """Return the closing table of a run, from its metrics; ``first_step`` were done before."""
    losses = {"train": "-", "validation": "-"}
    step, seconds = 0, 0.0
    for line in read_metrics(config.folder / METRICS):
        step, seconds = line["step"], line.get("seconds", seconds)
        names = [n for n in line if n not in ("kind", "step", "epoch", "learning_rate")]
        parts = [f"{n} {line[n]:.4g}" for n in names if not n.startswith("seconds")]
        losses[line["kind"]] = ", ".join(parts)
    rows = {
        "steps": str(step) + (f" ({first_step} of them before)" if first_step else ""),
        "time": f"{seconds:.1f} s",
        "speed": f"{step / max(seconds, 1e-9):.1f} steps/s",
        "training": losses["train"],
        "held out": losses["validation"],
        "written to": str(config.folder),
    }
    if best := list_checkpoints(config.folder / BEST):
        rows["best held out"] = f"step {best[-1][0]}, in {config.folder / BEST}"
    return closing_table(rows)


def require_run(folder: Path) -> None:
    """Make sure that there is a run to resume, even one that has not saved a checkpoint yet.

    Raises:
        RequestError: naming the runs beside it whose names are most alike.
    """
    if list_checkpoints(folder) or (folder / CONFIG).is_file():
        return
    parent = folder.parent
    there = sorted(path.parent.name for path in parent.glob(f"*/{CONFIG}"))
    close = difflib.get_close_matches(folder.name, there, cutoff=0.0)
    near = ", ".join(f"'{parent / name}'" for name in close)
    hint = f"there are {near}" if near else f"no folder in '{parent}' does"
    raise RequestError(f"--resume: '{folder}' holds no run; {hint}")


def main(args: Sequence[str]) -> int:
    """Run ``bin/Train.py``; return 0, or 130 after an interruption whose state is saved.

    Raises:
        RequestError: the request cannot be met.
    """
    prepare_pytorch()
    config = parse_config(args)
    if is_resumed := "--resume" in args:
        require_run(config.folder)
    require_out_folder(config.folder, RUN, [config.demonstrations])
    from robo_manip_baselines.training.device import Processes
    from robo_manip_baselines.training.trainer import train

    before = list_checkpoints(config.folder)
    code = train(config, resume=is_resumed)
    if not Processes.from_environment().is_main:
        return code
    out = shlex.quote(str(config.folder))
    if code:
        step, _ = list_checkpoints(config.folder)[-1]
        resume = f"python bin/Train.py {config.policy} --out {out} --resume"
        logger.info("stopped at step %d; continue with: %s", step, resume)
        return code
    evaluate = f"python bin/Rollout.py {config.env} --policy {config.policy} --checkpoint {out}"
    table = summary(config, before[-1][0] if before else 0)
    has_env = bool(task_entry(config.env).env)
    print(f"{table}\nnext: {evaluate}" if has_env else table)  # noqa: T201
    return 0
