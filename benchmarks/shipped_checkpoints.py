"""Make the checkpoints that come with the package: demonstrations, trainings, shipped folders.

A call that was stopped is continued by the same command. ``--from NAME=RUN`` ships a run that was
trained elsewhere in place of training ``NAME`` here:

    python benchmarks/shipped_checkpoints.py --names forecast --from forecast=runs/act_forecast
"""

from __future__ import annotations

import dataclasses
import os
import shlex
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime, timezone
from pathlib import Path
from typing import Annotated, Any

import tyro

from robo_manip_baselines import __version__
from robo_manip_baselines.commands.rollout import main as rollout
from robo_manip_baselines.commands.train import parse_config
from robo_manip_baselines.policy.checkpoint import (
    ACTING_FILES,
    MODEL,
    ORIGIN,
    ORIGIN_SCHEMA,
    SHIPPED,
    Checkpoint,
    CheckpointOrigin,
    read_checkpoint,
)
from robo_manip_baselines.policy.checkpoint import (
    CONFIG as CONFIG_FILE,
)
from robo_manip_baselines.rollout.demonstrate import SUMMARY
from robo_manip_baselines.runs.checkpoints import checkpoint_folder
from robo_manip_baselines.runs.command import parse, run_command
from robo_manip_baselines.runs.documents import read_json
from robo_manip_baselines.runs.errors import RequestError, require_choice
from robo_manip_baselines.runs.files import remove_folder, write_json
from robo_manip_baselines.runs.ranges import Count, Episodes, Processes
from robo_manip_baselines.training.config import CONFIG, TrainConfig, read_config
from robo_manip_baselines.training.requirements import prepare_pytorch

DEMONSTRATIONS = {"expert": "servo", "motion": "dyskinetic", "people": "train", "cameras": "none"}
"""Options of ``bin/Rollout.py FeedingEnv --scripted``."""

NETWORK = {
    **{"preset": "cpu", "cvae_layers": 1, "actions_per_query": 1},
    **{"seed": 0, "logger": "none"},
}
"""Options of ``bin/Train.py Act`` for every policy: about 460 000 weights."""

POLICIES: dict[str, dict[str, Any]] = {
    "baseline": {"obs": "baseline"},
    "current": {"obs": "current", "delay": 4},
    "forecast": {"obs": "current_pred", "horizon": 16, "relative": True, "delay": 4},
}
"""Name of a shipped checkpoint -> its options of ``bin/Train.py Act`` beside ``NETWORK``."""

MAX_BYTES = 3_000_000
"""Largest file of weights that the package takes."""

EXAMPLE = "python benchmarks/shipped_checkpoints.py --work shipped_runs"

NOT_RECORDED = frozenset({"policy", "env", "dataset", "num_episodes", "preset", "device", "out"})
"""Options of a run that its recorded command lacks: named first, or without effect on weights."""


@dataclass(frozen=True)
class Options:
    """Make the checkpoints that come with the package.

    Attributes:
        work: Folder of demonstrations and runs.
        names: Checkpoints to make; all if not given.
        given: NAME=RUN, a run to ship in place of training that name.
        num_episodes: Demonstrations.
        steps: Optimiser steps of each training; those of the preset if not given.
        workers: Processes that record demonstrations.
        out: Folder of the shipped checkpoints.
    """

    work: Path = Path("shipped_runs")
    names: tuple[str, ...] = tuple(POLICIES)
    given: Annotated[tuple[str, ...], tyro.conf.arg(name="from")] = ()
    num_episodes: Episodes = 400
    steps: Count | None = None
    workers: Processes = 2
    out: Path = SHIPPED

    @property
    def runs(self) -> dict[str, Path]:
        """Name of a checkpoint -> its run folder.

        Raises:
            RequestError: there is no such checkpoint, or a value of ``given`` is no NAME=RUN.
        """
        found = {n: self.work / require_choice("checkpoint", n, POLICIES) for n in self.names}
        for text in self.given:
            name, sign, folder = text.partition("=")
            if not sign or not folder:
                raise RequestError(
                    f"--from '{text}': must be NAME=RUN, as current=runs/act_current"
                )
            found[require_choice("checkpoint of --names", name, found)] = Path(folder)
        return found


def to_options(values: Mapping[str, Any]) -> list[str]:
    """Write settings as options of a command line."""
    words: list[str] = []
    for name, value in values.items():
        if isinstance(value, bool):
            words.append(f"--{name}" if value else f"--no_{name}")
        elif isinstance(value, Sequence) and not isinstance(value, str):
            words += [f"--{name}", *(map(str, value) if value else ["none"])]
        elif value is not None:
            words += [f"--{name}", str(value)]
    return words


def record(folder: Path, options: Options) -> None:
    """Record the demonstrations that a folder lacks."""
    size = {"num_episodes": options.num_episodes, "workers": options.workers, "preview": 0}
    settings = {**DEMONSTRATIONS, **size, "out": folder}
    rollout(["FeedingEnv", "--scripted", *to_options(settings)])


def train_policy(name: str, run: Path, dataset: Path, steps: int | None) -> None:
    """Train a policy, or continue; a finished run is left as it is."""
    from robo_manip_baselines.training.trainer import train

    given = {**NETWORK, **POLICIES[name], "steps": steps, "dataset": dataset, "out": run}
    if train(parse_config(["Act", *to_options(given)]), resume=True):
        raise RequestError(f"the training of '{name}' was interrupted; call again to continue")


def recording_command(dataset: Path) -> str:
    """Return the command that recorded demonstrations, from their summary."""
    summary = read_json(dataset / SUMMARY, dict[str, Any])
    kwargs = {k: v for k, v in summary["env_kwargs"].items() if k in ("motion", "people")}
    words = {"expert": summary["expert"], **kwargs, "cameras": summary["env_kwargs"]["cameras"]}
    words |= {"seed": summary["first_seed"], "num_episodes": summary["episodes"]}
    return shlex.join(["python", "bin/Rollout.py", "FeedingEnv", "--scripted", *to_options(words)])


def training_command(run: Path) -> str:
    """Return the command that trained a run, from its settings: those that no preset gives."""
    config = TrainConfig.from_json(read_config(run / CONFIG))
    preset = TrainConfig.from_preset(config.policy, config.preset, config.env).to_json()
    changed = {
        name: value
        for name, value in config.to_json().items()
        if name not in NOT_RECORDED and value != preset[name]
    }
    words = ["python", "bin/Train.py", config.policy, "--preset", config.preset]
    return shlex.join([*words, *to_options(changed)])


def ship(run: Path, folder: Path) -> Checkpoint:
    """Copy what acting needs of a run's newest checkpoint into a folder, with its origin.

    Raises:
        RequestError: the run or its demonstrations are not there, or the weights are too large.
    """
    checkpoint = read_checkpoint(run)
    weights = checkpoint.folder / MODEL
    if (size := weights.stat().st_size) > MAX_BYTES:
        raise RequestError(
            f"'{weights}' has {size} bytes, more than {MAX_BYTES}; train a smaller network"
        )
    dataset = read_config(run / CONFIG).get("dataset") or checkpoint.dataset.get("folder", "")
    origin = CheckpointOrigin(
        commands=(recording_command(Path(dataset)), training_command(run)),
        demonstrations=checkpoint.dataset.get("content_hash", ""),
        date=datetime.fromtimestamp(weights.stat().st_mtime, timezone.utc).date().isoformat(),
        package_version=checkpoint.versions.get("robo_manip_baselines", __version__),
    )
    if folder.exists():
        remove_folder(folder)
    with checkpoint_folder(folder) as temporary:
        for name in ACTING_FILES:
            shutil.copyfile(checkpoint.folder / name, temporary / name)
        # The place of the demonstrations on this machine means nothing elsewhere.
        content = read_json(temporary / CONFIG_FILE, dict[str, Any])
        content["dataset"]["folder"] = Path(content["dataset"].get("folder", "")).name
        write_json(temporary / CONFIG_FILE, content)
        write_json(temporary / ORIGIN, {**ORIGIN_SCHEMA.to_json(), **dataclasses.asdict(origin)})
    return read_checkpoint(folder)


def main() -> None:
    """Run the command."""
    options = parse(Options, EXAMPLE)
    prepare_pytorch()
    own = {name: run for name, run in options.runs.items() if run == options.work / name}
    dataset = options.work / "demonstrations"
    if own:
        record(dataset, options)
    for name, run in own.items():
        train_policy(name, run, dataset, options.steps)
    for name, run in options.runs.items():
        made = ship(run, options.out / name)
        size = sum(entry.stat().st_size for entry in os.scandir(made.folder))
        print(f"{name}: {size / 1e6:.2f} MB, step {made.step}, {made.content_hash[:12]}")


if __name__ == "__main__":
    run_command(main)
