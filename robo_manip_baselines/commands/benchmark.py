"""The options of ``bin/Benchmark.py``."""

from __future__ import annotations

import logging
import os
import re
import shlex
import sys
from collections import Counter
from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path

import tyro

from robo_manip_baselines.benchmark.aggregation import (
    summary,
    videos_to_make,
    write_outcome,
    write_results,
)
from robo_manip_baselines.benchmark.conditions import ARMS, ArmLine, choose_arms, read_arms
from robo_manip_baselines.benchmark.local import LocalExecutor
from robo_manip_baselines.benchmark.plan import Plan, make_plan, missing_predictions
from robo_manip_baselines.benchmark.presets import PRESETS, Preset
from robo_manip_baselines.benchmark.scheduler import (
    Executor,
    Progress,
    UnitsFailedError,
    run_units,
    spelt,
)
from robo_manip_baselines.benchmark.work_item import Store, Unit, is_of_other_source
from robo_manip_baselines.envs.mujoco.cell.opengl import opengl_problem
from robo_manip_baselines.envs.mujoco.face.motion import MotionLibrary
from robo_manip_baselines.runs.command import EXIT_FAILED, parse
from robo_manip_baselines.runs.errors import RequestError, require_choice
from robo_manip_baselines.runs.files import prepare_folder
from robo_manip_baselines.training.requirements import prepare_pytorch

EXAMPLE = "python bin/Benchmark.py feeding --preset smoke"

EXECUTORS = ("local", "ray")


@dataclass(frozen=True)
class BenchmarkOptions:
    """Train every arm of a benchmark, evaluate all of them on common seeds, and write tables and a
    report. The same command goes on where an earlier one was stopped.
    """

    benchmark: tyro.conf.Positional[str]
    """Which benchmark: feeding, delay."""
    preset: str = "cpu"
    """How large: cpu (without images), paper (three cameras, a GPU) or smoke (three minutes)."""
    arms: tuple[str, ...] = ()
    """Names of arms, with spaces or commas between them; those of the preset if not given."""
    arms_file: Path | None = None
    """YAML file of arms; the one that ships with the package if not given."""
    train_seeds: int | None = None
    """Trainings of each arm, seeds from 0; as the preset says if not given."""
    num_episodes: int | None = None
    """Evaluation episodes of each training, seeds from 1000; as the preset says if not given."""
    motion_library: Path | None = None
    """File of recorded face motion; the one that ships with the package if not given."""
    error_stats: Path | None = None
    """File of error statistics; the one that ships with the package if not given."""
    reference: str | None = None
    """Arm that tables compare the others with; current if not given, or the first one."""
    executor: str = "local"
    """Where the work is done: local (processes of this machine) or ray (a Ray cluster)."""
    address: str | None = None
    """Only with --executor ray: of the cluster, or auto; if not given, one is started here."""
    num_workers: int | None = None
    """Only with --executor local: units that run at once; as many as the cores carry if not
    given."""
    out: Path | None = None
    """Folder to write to; results/<benchmark>_<preset> if not given."""
    shard: str | None = None
    """i/n: do only the i-th of n parts, and write no tables; a call without it does that."""
    videos: bool = True
    """--no_videos leaves a success and a failure of each arm out of the report."""
    dry_run: bool = False
    """Only say what there is to do."""

    def __post_init__(self) -> None:
        if self.arms_file is None:
            require_choice("benchmark", self.benchmark, [path.stem for path in ARMS.glob("*.yaml")])
        require_choice("preset", self.preset, PRESETS)
        require_choice("executor", self.executor, EXECUTORS)
        if self.num_workers is not None and self.num_workers < 1:
            raise RequestError(f"num_workers {self.num_workers}: must be 1 or more")
        if self.executor == "ray" and self.num_workers is not None:
            raise RequestError("--num_workers goes with --executor local; Ray counts its own cores")
        if self.executor != "ray" and self.address is not None:
            raise RequestError("--address goes with --executor ray; leave it out")
        self.part  # noqa: B018 — what is no part is refused here
        self.size  # noqa: B018

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the arms; empty for all of the file.

        Those of a preset are arms of ``feeding``.
        """
        given = tuple(name for part in self.arms for name in part.split(",") if name)
        is_feeding = self.benchmark == "feeding" and self.arms_file is None
        return given or (PRESETS[self.preset].arms if is_feeding else ())

    @property
    def size(self) -> Preset:
        """The preset with what was given in place of its own."""
        given = {"train_seeds": self.train_seeds, "num_episodes": self.num_episodes}
        return replace(
            PRESETS[self.preset], **{name: v for name, v in given.items() if v is not None}
        )

    @property
    def folder(self) -> Path:
        """The folder to write to."""
        return self.out or Path("results") / f"{self.benchmark}_{self.preset}"

    @property
    def part(self) -> tuple[int, int] | None:
        """(i, n) of ``shard``.

        Raises:
            RequestError: it is not of that form.
        """
        if self.shard is None:
            return None
        match = re.fullmatch(r"(\d+)/(\d+)", self.shard)
        if not match or not 1 <= int(match[1]) <= int(match[2]):
            raise RequestError(f"shard '{self.shard}': must be i/n with i from 1 to n, such as 2/8")
        return int(match[1]), int(match[2])


UNITS = "units"

logger = logging.getLogger(__name__)


def benchmark(options: BenchmarkOptions) -> int:
    """Do what the options ask for.

    Returns:
        The exit code: 0, or 1 where units failed.

    Raises:
        RequestError: the request cannot be met.
    """
    plan = plan_of(options)
    if options.reference:
        require_choice("reference arm", options.reference, [arm.name for arm in plan.arms])
    store = Store(options.folder / UNITS)
    units = plan.units(options.part)
    if others := sum(is_of_other_source(note) for note in map(store.note, units) if note):
        logger.warning(
            "%d of %d units were done by other code of the package, and are used as they are; "
            "remove '%s' to do them again",
            *(others, len(units), store.root),
        )
    if options.dry_run:
        print(overview(plan, units, store, _workers(options, plan)))  # noqa: T201
        return 0
    if options.executor == "local":
        _require_device(options.preset, plan)
    prepare_folder(options.folder)
    try:
        with closing(_executor(options, plan, store)) as executor:
            carry_out(plan, units, store, executor, options)
    except UnitsFailedError as error:
        logger.error("%s", error)
        return EXIT_FAILED
    return 0


def plan_of(options: BenchmarkOptions) -> Plan:
    """Plan what the options ask for.

    Raises:
        RequestError: it cannot be done.
    """
    env, arms = read_arms(options.arms_file or ARMS / f"{options.benchmark}.yaml")
    if options.names:
        arms = choose_arms(arms, options.names)
    elif not options.arms_file:
        arms = tuple(arm for arm in arms if not _is_left_out(arm, options))
    return make_plan(
        env, arms, options.size, library=options.motion_library, error_stats=options.error_stats
    )


def _is_left_out(arm: ArmLine, options: BenchmarkOptions) -> bool:
    """Whether nobody has asked for an arm by name and it cannot be had; says so."""
    if problem := missing_predictions(arm, MotionLibrary.load(options.motion_library)):
        logger.warning("left out: %s", problem)
    return bool(problem)


def carry_out(
    plan: Plan,
    units: Sequence[Unit],
    store: Store,
    executor: Executor,
    options: BenchmarkOptions,
) -> None:
    """Do the units, then the videos, then write what it all came to.

    Raises:
        RequestError: a unit says that the request was wrong.
        UnitsFailedError: units failed.
    """
    is_whole = options.part is None
    has_videos = is_whole and options.videos and plan.preset.has_videos
    if has_videos and (problem := opengl_problem()):
        logger.warning("no videos: %s", problem)
        has_videos = False
    workers = executor.workers(plan.preset.threads, plan.preset.gpu_share)
    later = 2 * len(plan.arms) * plan.video_seconds if has_videos else 0.0
    with closing(Progress(units, workers, later=later)) as progress:
        _note_done(progress, units, store)
        run_units(units, store, executor, progress)
        if not is_whole:
            return
        study = write_results(plan, store, options.folder, options.reference)
        videos = videos_to_make(plan, study) if has_videos else {}
        progress.add(videos)
        _note_done(progress, tuple(videos), store)
        run_units(tuple(videos), store, executor, progress)
    logger.info("writing tables, plots and the report to %s", options.folder)
    write_outcome(plan, store, study, options.folder, videos, command_line(sys.argv))
    print(summary(study, options.folder))  # noqa: T201


def overview(plan: Plan, units: Sequence[Unit], store: Store, workers: int) -> str:
    """Say what there is to do."""
    todo = [unit for unit in units if not store.is_done(unit)]
    total, left = Counter(unit.kind for unit in units), Counter(unit.kind for unit in todo)
    progress = Progress(units, workers, bar=False)
    _note_done(progress, units, store)
    spent = sum(float(note["seconds"]) for note in map(store.note, units) if note)
    rows = {
        "arms": ", ".join(arm.name for arm in plan.arms),
        **{kind: f"{left[kind]} of {count} units to do" for kind, count in total.items()},
        "done": f"{spelt(spent)} of work, videos apart",
        "workers": str(workers),
        "time": f"about {spelt(progress.seconds_left)}, videos apart",
    }
    width = max(map(len, rows))
    return "\n".join(f"{name:<{width}}  {value}" for name, value in rows.items())


def command_line(argv: Sequence[str]) -> str:
    """Return the command as it can be typed again."""
    return shlex.join(["python", f"bin/{Path(argv[0]).name}", *argv[1:]])


def _note_done(progress: Progress, units: Sequence[Unit], store: Store) -> None:
    for unit in units:
        if note := store.note(unit):
            progress.ended(unit, float(note["seconds"]))


def _require_device(preset: str, plan: Plan) -> None:
    """Refuse what no training could be done with, before an hour of demonstrations."""
    if plan.preset.device == "cpu":
        return
    # Imported here: it takes seconds.
    import torch

    if not torch.cuda.is_available():
        raise RequestError(
            f"preset '{preset}' needs a CUDA device, and PyTorch {torch.__version__} finds none; "
            "take --preset cpu, or --executor ray with a cluster that has GPUs"
        )


def _executor(options: BenchmarkOptions, plan: Plan, store: Store) -> Executor:
    if options.executor == "local":
        return LocalExecutor(store, _workers(options, plan))
    # Imported here: Ray is needed by nobody else.
    from robo_manip_baselines.benchmark.ray_cluster import RayExecutor

    return RayExecutor(store, options.address)


def _workers(options: BenchmarkOptions, plan: Plan) -> int:
    """How many units run at once."""
    cores = (
        len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    )
    return options.num_workers or max(cores // plan.preset.threads, 1)


def main(args: Sequence[str]) -> int:
    """Run ``bin/Benchmark.py``."""
    prepare_pytorch()
    return benchmark(parse(BenchmarkOptions, EXAMPLE, args=args))
