"""The options of ``bin/Benchmark.py``."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from pathlib import Path

import tyro

from robo_manip_baselines.benchmark.arm_file import ARMS
from robo_manip_baselines.benchmark.presets import PRESETS, Preset
from robo_manip_baselines.errors import RequestError, require_choice

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
