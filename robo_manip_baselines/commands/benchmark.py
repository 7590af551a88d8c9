"""``bin/Benchmark.py``: its options, what it prints, exit codes."""

from __future__ import annotations

import logging
import re
import shlex
import sys
from collections import Counter
from collections.abc import Iterable, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import tyro
from annotated_types import Interval

from robo_manip_baselines.benchmark.aggregation import (
    BENCHMARK,
    aggregate_results,
    closing_summary,
    videos_to_make,
    write_aggregation,
)
from robo_manip_baselines.benchmark.conditions import (
    AS_IN_THE_PRESET,
    CONDITIONS,
    SizeChanges,
    read_conditions,
)
from robo_manip_baselines.benchmark.plan import (
    PRESETS,
    BenchmarkPreset,
    Plan,
    in_place_of,
    make_plan,
    missing_predictions,
)
from robo_manip_baselines.benchmark.scheduler import (
    Executor,
    GridProgress,
    ItemsFailedError,
    LocalExecutor,
    run_items,
)
from robo_manip_baselines.benchmark.work_item import ITEMS, ArtifactStore, WorkItem
from robo_manip_baselines.commands import foresight
from robo_manip_baselines.envs.mujoco.cell.opengl import opengl_problem
from robo_manip_baselines.envs.mujoco.face import FACES
from robo_manip_baselines.envs.mujoco.face.motion import MotionLibrary
from robo_manip_baselines.runs.command import EXIT_FAILED, parse
from robo_manip_baselines.runs.documents import parse_settings
from robo_manip_baselines.runs.errors import RequestError, require_choice
from robo_manip_baselines.runs.files import prepare_folder, require_out_folder
from robo_manip_baselines.runs.progress import closing_table, duration
from robo_manip_baselines.runs.ranges import Episodes, require_ranges
from robo_manip_baselines.runs.threads import processors
from robo_manip_baselines.runs.versions import source_digest
from robo_manip_baselines.training.config import TrainConfig
from robo_manip_baselines.training.requirements import prepare_pytorch

DESCRIPTION = """Train every condition of a benchmark, evaluate all of them on common seeds, and
write tables and a report. The same command continues where an earlier one was stopped."""

EXAMPLE = "python bin/Benchmark.py feeding --preset smoke"

EXECUTORS = ("local", "ray")

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class BenchmarkOptions:
    """Options of a benchmark.

    Attributes:
        benchmark: Name of the benchmark: feeding, delay, foresight_policies, foresight_horizons;
            drinking, wiping, bimanual_feeding; demo, of the checkpoints that come with the package,
            without training; or foresight, a study without policies that has options of its own
            (foresight --help).
        preset: Size: cpu (without images), cpu_images (three cameras), paper (three cameras, a GPU)
            or smoke (three minutes).
        conditions: Names of conditions, with spaces or commas between them; those of the preset if
            not given.
        conditions_file: YAML file of conditions; the one that ships with the package if not given.
        train_seeds: Trainings of each condition, seeds from 0; as in the preset if not given.
        num_episodes: Evaluation episodes of each training, seeds from 1000; as in the preset if not
            given.
        demonstrations: Demonstrations of each expert, seeds from 0; as in the preset if not given.
        train_settings: Settings of trainings that differ from the preset's, as NAME=VALUE
            (steps=200); docs/training.md lists them.
        device: Device of the networks: cpu or cuda; as in the preset if not given.
        face: Kind of face: visual or physical; as in the file of conditions if not given.
        motion_library: File of recorded face motion, or extended; the one that ships if not
            given.
        error_stats: File of error statistics; the one that ships with the package if not given.
        reference: Condition that tables compare the others with; if not given, current (in studies
            of several motions or delays, that of the same), or the first one.
        executor: Place of the work: local (processes of this machine) or ray (a Ray cluster).
        address: Only with --executor ray: address of the cluster, or auto; if not given, one is
            started here.
        num_workers: Only with --executor local: work items that run at once; as many as the cores
            carry if not given.
        out: Folder to write to; results/<benchmark>_<preset> if not given.
        shard: i/n: do only the i-th of n parts, and write no tables; a call without it does that.
        videos: --no_videos leaves a success and a failure of each condition out of the report.
        dry_run: Only print what there is to do.

    Raises:
        RequestError: a value is not valid.
    """

    benchmark: tyro.conf.Positional[str]
    preset: str = "cpu"
    conditions: tuple[str, ...] = ()
    conditions_file: Path | None = None
    train_seeds: Annotated[int, Interval(ge=1, le=1000)] | None = None
    num_episodes: Episodes | None = None
    demonstrations: Episodes | None = None
    train_settings: tuple[str, ...] = ()
    device: str | None = None
    face: str | None = None
    motion_library: Path | None = None
    error_stats: Path | None = None
    reference: str | None = None
    executor: str = "local"
    address: str | None = None
    num_workers: Annotated[int, Interval(ge=1, le=1024)] | None = None
    out: Path | None = None
    shard: str | None = None
    videos: bool = True
    dry_run: bool = False

    def __post_init__(self) -> None:
        if self.benchmark == foresight.NAME:
            raise RequestError(f"benchmark '{foresight.NAME}': its name comes first, then options")
        if self.conditions_file is None:
            shipped = [path.stem for path in CONDITIONS.glob("*.yaml")]
            require_choice("benchmark", self.benchmark, shipped)
        require_choice("preset", self.preset, PRESETS)
        require_choice("executor", self.executor, EXECUTORS)
        if self.device is not None:
            require_choice("device", self.device, ("cpu", "cuda"))
        if self.face is not None:
            require_choice("face", self.face, FACES)
        require_ranges(self)
        if self.executor == "ray" and self.num_workers is not None:
            raise RequestError("--num_workers goes with --executor local; Ray counts its own cores")
        if self.executor != "ray" and self.address is not None:
            raise RequestError("--address goes with --executor ray; leave it out")
        self.part  # noqa: B018 — refuses what is no part
        self.size  # noqa: B018

    @property
    def size(self) -> BenchmarkPreset:
        """Preset with the given numbers in place of its own."""
        return self.size_of(AS_IN_THE_PRESET)

    def size_of(self, changes: SizeChanges) -> BenchmarkPreset:
        """Return the preset with the numbers of a benchmark, then those given, in place of its."""
        names = "train_seeds", "num_episodes", "demonstrations", "device"
        given = {name: getattr(self, name) for name in names if getattr(self, name) is not None}
        preset = PRESETS[self.preset]
        settings = in_place_of(preset.train_settings, changes.train_settings)
        own = parse_settings(self.train_settings, "--train_settings")
        size = replace(
            preset,
            train_settings=in_place_of(settings, own),
            **{**changes.given(), **given},
        )
        share = 0.0 if size.device == "cpu" else preset.gpu_share or 1.0
        return replace(size, gpu_share=share)

    @property
    def folder(self) -> Path:
        """Folder to write to."""
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

    @property
    def workers(self) -> int:
        """Number of work items that run at once on this machine."""
        return self.num_workers or max(processors() // self.size.threads, 1)


def parse_options(args: Sequence[str]) -> BenchmarkOptions:
    """Read a command line, with options under their present or earlier names.

    Raises:
        RequestError: one line that names what is wrong and what is valid.
        SystemExit: with code 0 after ``--help``.
    """
    given = [re.sub(r"^--arms(?=$|=|[-_]file)", "--conditions", arg) for arg in args]
    if given != list(args):
        logger.info("--arms and --arms_file are called --conditions and --conditions_file now")
    return parse(BenchmarkOptions, EXAMPLE, description=DESCRIPTION, args=given)


def benchmark(options: BenchmarkOptions) -> int:
    """Run a benchmark.

    Returns:
        The exit code: 0, or 1 where work items failed.

    Raises:
        RequestError: the request cannot be met.
    """
    inputs = [options.conditions_file, options.motion_library, options.error_stats]
    require_out_folder(options.folder, BENCHMARK, inputs)
    plan = plan_of(options)
    if options.reference:
        names = [condition.name for condition in plan.conditions]
        require_choice("reference condition", options.reference, names)
    store = ArtifactStore(options.folder / ITEMS)
    items = plan.items(options.part)
    manifests = [manifest for manifest in map(store.manifest, items) if manifest]
    if others := sum(manifest.get("source") != source_digest() for manifest in manifests):
        logger.warning(
            "%d of %d work items were done by other code of the package, and are used as they are; "
            "remove '%s' to do them again",
            *(others, len(items), store.root),
        )
    if options.dry_run:
        workers = options.workers if options.executor == "local" else None
        print(overview(plan, items, store, workers))  # noqa: T201
        return 0
    if options.executor == "local":
        _require_device(plan)
    prepare_folder(options.folder)
    logger.info("%s, preset %s, in %s", options.benchmark, options.preset, options.folder)
    try:
        with closing(_executor(options, store)) as executor:
            carry_out(plan, items, store, executor, options)
    except ItemsFailedError as error:
        logger.error("%s", error)
        return EXIT_FAILED
    return 0


def plan_of(options: BenchmarkOptions) -> Plan:
    """Plan the benchmark that the options ask for.

    Conditions that nobody has named and that lack their files are left out, with a warning.

    Raises:
        RequestError: it cannot be done.
    """
    path = options.conditions_file or CONDITIONS / f"{options.benchmark}.yaml"
    file = read_conditions(path)
    if options.benchmark in [condition.name for condition in file.conditions]:
        # The last of several --conditions, where no name came before them.
        raise RequestError(
            f"benchmark '{options.benchmark}': is a condition; the benchmark's name comes first: "
            "python bin/Benchmark.py NAME --conditions ..."
        )
    for preset in (*file.presets, *file.sizes):
        require_choice(f"preset in '{path}'", preset, PRESETS)
    changes = file.sizes.get(options.preset, AS_IN_THE_PRESET)
    size = options.size_of(changes)
    named = tuple(name for part in options.conditions for name in part.split(",") if name)
    conditions = file.conditions
    if chosen := named or file.presets.get(options.preset):
        conditions = file.choose(chosen)
    elif not options.conditions_file:
        library = MotionLibrary.load(options.motion_library)
        problems = {c.name: missing_predictions(c, library) for c in conditions}
        for problem in filter(None, problems.values()):
            logger.warning("left out: %s", problem)
        conditions = tuple(c for c in conditions if not problems[c.name])
    given = parse_settings(options.train_settings, "--train_settings")
    if given := {**changes.train_settings, **given}:
        # A policy takes those that it has: at least one must have each.
        preset = size.train_preset
        known = [TrainConfig.from_preset(c.policy, preset, file.env) for c in conditions]
        names = set().union(*(config.to_json() for config in known))
        for name in given:
            require_choice("training setting", name, sorted(names))
    return make_plan(
        file.env,
        conditions,
        size,
        library=options.motion_library,
        error_stats=options.error_stats,
        headline=file.headline,
        people=file.people,
        face=options.face or file.face,
        compare_within=file.compare_within,
    )


def carry_out(
    plan: Plan,
    items: Sequence[WorkItem],
    store: ArtifactStore,
    executor: Executor,
    options: BenchmarkOptions,
) -> None:
    """Do the work items, then the videos, then write the aggregation.

    Raises:
        RequestError: a work item reports a wrong request.
        ItemsFailedError: work items failed.
    """
    is_whole = options.part is None
    has_videos = is_whole and options.videos and plan.preset.has_videos
    if has_videos and (problem := opengl_problem()):
        logger.warning("no videos: %s", problem)
        has_videos = False
    workers = executor.workers(plan.preset.threads, plan.preset.gpu_share)
    later = 2 * len(plan.conditions) * plan.preset.seconds.get("video", 30.0) if has_videos else 0.0
    with closing(GridProgress(items, workers, later=later)) as progress:
        _count_done(progress, items, store)
        run_items(items, store, executor, progress)
        if not is_whole:
            return
        statistics = aggregate_results(plan, store, options.folder, options.reference)
        videos = videos_to_make(plan, statistics) if has_videos else {}
        progress.add(videos)
        _count_done(progress, videos, store)
        run_items(tuple(videos), store, executor, progress)
    logger.info("writing tables, figures and the report to %s", options.folder)
    command = shlex.join(["python", f"bin/{Path(sys.argv[0]).name}", *sys.argv[1:]])
    write_aggregation(plan, store, statistics, options.folder, videos, command)
    print(closing_summary(statistics, options.folder))  # noqa: T201


def overview(
    plan: Plan, items: Sequence[WorkItem], store: ArtifactStore, workers: int | None
) -> str:
    """Lay out what there is to do, and the time that so many workers take, None if unknown."""
    total = Counter(item.kind for item in items)
    left = Counter(item.kind for item in items if not store.is_done(item))
    progress = GridProgress(items, workers or 1, bar=False)
    seconds = _count_done(progress, items, store)
    rows = {
        "conditions": ", ".join(condition.name for condition in plan.conditions),
        "end point": plan.headline,
        "people": str(plan.people),
        "face": plan.face,
        **{kind: f"{left[kind]} of {count} items to do" for kind, count in total.items()},
        "done": f"{duration(seconds)} of work, videos apart",
    }
    if workers:
        rows["workers"] = str(workers)
        rows["time"] = f"about {duration(progress.seconds_left)}, videos apart"
    return closing_table(rows)


def _count_done(progress: GridProgress, items: Iterable[WorkItem], store: ArtifactStore) -> float:
    """Count the items that are done as ended; return the s that they took."""
    total = 0.0
    for item in items:
        if manifest := store.manifest(item):
            progress.end(item, float(manifest["seconds"]))
            total += float(manifest["seconds"])
    return total


def _require_device(plan: Plan) -> None:
    """Refuse a size whose trainings cannot run here, before an hour of demonstrations."""
    if plan.preset.device == "cpu":
        return
    import torch  # slow to import

    if not torch.cuda.is_available():
        raise RequestError(
            f"a CUDA device is needed, and PyTorch {torch.__version__} finds none; take --preset "
            "cpu without --device, or --executor ray with a cluster that has GPUs"
        )


def _executor(options: BenchmarkOptions, store: ArtifactStore) -> Executor:
    if options.executor == "local":
        return LocalExecutor(store, options.workers)
    from robo_manip_baselines.benchmark.ray_cluster import RayExecutor  # an optional dependency

    return RayExecutor(store, options.address)


def main(args: Sequence[str]) -> int:
    """Run ``bin/Benchmark.py``."""
    if args and args[0] == foresight.NAME:
        return foresight.main(args[1:])
    prepare_pytorch()
    return benchmark(parse_options(args))
