"""Success of scripted experts, task by task, for each named motion of the face: a table.

A call that was stopped is continued by the same command: finished cells stay in ``cells.jsonl``.

    python benchmarks/expert_motions.py --out docs/results/experts
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from expert_safety import run_expert
from tqdm import tqdm

from robo_manip_baselines.benchmark.tables.table import Cell, Column, Row, Table, write_tables
from robo_manip_baselines.envs.mujoco.face.motions import MOTIONS, parse_motion
from robo_manip_baselines.envs.mujoco.tasks.registry import task_entry, task_names
from robo_manip_baselines.runs.command import parse, run_command
from robo_manip_baselines.runs.documents import parse_json, read_json_lines
from robo_manip_baselines.runs.errors import require_choice
from robo_manip_baselines.runs.files import locked, write_text
from robo_manip_baselines.runs.ranges import Episodes, Seed
from robo_manip_baselines.runs.versions import software_versions

CELLS = "cells.jsonl"
EXPERT = "servo"


@dataclass(frozen=True)
class Options:
    """Let scripted experts act under each motion, and write the table of their success."""

    out: Path
    """Folder of the table and of the finished cells."""
    envs: tuple[str, ...] = ()
    """Tasks; all if not given."""
    expert: str = EXPERT
    """Name in the tasks' entries."""
    motions: tuple[str, ...] = tuple(MOTIONS)
    """Motions of the face by name."""
    face: str = "visual"
    """Kind of face."""
    num_episodes: Episodes = 20
    """Episodes of each cell, one a seed."""
    seed: Seed = 0
    """Seed of the first."""


@dataclass(frozen=True)
class MotionCell:
    """Episodes of one expert under one motion.

    Attributes:
        env: name of the task.
        expert: name in its entry.
        motion: as `parse_motion` writes it.
        face: kind of face.
        seed, episodes: first seed, and number of episodes.
        successes, strict, safe: how many of them succeeded, strictly, and safely.
        completion_time, completion_time_sd: s, of the successes; None without any.
        versions: of the software.
    """

    env: str
    expert: str
    motion: str
    face: str
    seed: int
    episodes: int
    successes: int
    strict: int
    safe: int
    completion_time: float | None
    completion_time_sd: float | None
    versions: dict[str, str]

    @property
    def key(self) -> tuple[str, str, str, str, int, int]:
        """Identity of the cell."""
        return self.env, self.expert, self.motion, self.face, self.seed, self.episodes


def measure(env: str, motion: str, options: Options) -> MotionCell:
    """Let the expert act through the episodes of a cell."""
    seeds = range(options.seed, options.seed + options.num_episodes)
    run = run_expert(env, options.expert, options.face, motion, seeds)
    episodes = list(tqdm(run, f"{env}, {motion}", len(seeds)))
    times = [e.completion_time for e in episodes if e.completion_time is not None]
    return MotionCell(
        env=env,
        expert=options.expert,
        motion=motion,
        face=options.face,
        seed=options.seed,
        episodes=len(episodes),
        successes=sum(episode.is_success for episode in episodes),
        strict=sum(episode.is_success_strict for episode in episodes),
        safe=sum(episode.safety.success_safe for episode in episodes),
        completion_time=float(np.mean(times)) if times else None,
        completion_time_sd=float(np.std(times, ddof=1)) if len(times) > 1 else None,
        versions=software_versions("mujoco", "numpy"),
    )


def read_cells(path: Path) -> dict[tuple[object, ...], MotionCell]:
    """Return the finished cells of a file by their keys; none if there is no file."""
    if not path.exists():
        return {}
    found = [
        MotionCell(**parse_json(text, f"'{path}', line {number}"))
        for number, text in read_json_lines(path)
    ]
    return {cell.key: cell for cell in found}


def make_table(cells: Sequence[MotionCell]) -> Table:
    """Return the table: a row for each motion, a column for each task."""
    by_place = {(cell.env, cell.motion): cell for cell in cells}
    envs = list(dict.fromkeys(cell.env for cell in cells))
    motions = list(dict.fromkeys(cell.motion for cell in cells))
    counts = ("successes", "strict", "safe", "episodes")
    columns = [Column("motion", ("motion",), is_text=True)]
    columns += [Column(env, tuple(f"{env}_{count}" for count in counts)) for env in envs]
    rows = []
    for motion in motions:
        row = [Cell(motion, (motion,))]
        for env in envs:
            cell = by_place.get((env, motion))
            values = tuple(getattr(cell, count) if cell else None for count in counts)
            text = " / ".join(map(str, values[:3])) if cell else "–"
            row.append(Cell(text, values))
        rows.append(Row("", tuple(row)))
    first = cells[0]
    last = first.seed + first.episodes - 1
    return Table(
        name="motions",
        title=f"Scripted expert {first.expert}, {first.face} face: success by motion and task",
        columns=tuple(columns),
        rows=tuple(rows),
        notes=(
            f"Episodes with success / strict success / safe success, of {first.episodes} in each "
            f"cell (seeds {first.seed} to {last}).",
        ),
    )


def main() -> None:
    """Measure what is missing, and write the table."""
    options = parse(Options, "python benchmarks/expert_motions.py --out docs/results/experts")
    envs = options.envs or task_names()
    for env in envs:
        require_choice("expert", options.expert, task_entry(env).experts)
    motions = [str(parse_motion(motion)) for motion in options.motions]
    options.out.mkdir(parents=True, exist_ok=True)
    path = options.out / CELLS
    with locked(options.out, is_kept=False):
        for motion in motions:  # row by row: a table that was stopped has whole ones
            for env in envs:
                wanted = (env, options.expert, motion, options.face, options.seed)
                if (*wanted, options.num_episodes) not in read_cells(path):
                    cell = measure(env, motion, options)
                    cells = [*read_cells(path).values(), cell]
                    write_text(path, "".join(json.dumps(asdict(c)) + "\n" for c in cells))
        finished = [cell for cell in read_cells(path).values() if cell.key[1] == options.expert]
        same = [cell for cell in finished if cell.key[3:] == _setting(options)]
        write_tables(options.out, [make_table(sorted(same, key=_order))])
    print((options.out / "motions.md").read_text())


def _setting(options: Options) -> tuple[str, int, int]:
    return options.face, options.seed, options.num_episodes


def _order(cell: MotionCell) -> tuple[int, int]:
    tasks, motions = task_names(), list(MOTIONS)
    return tasks.index(cell.env), motions.index(cell.motion) if cell.motion in motions else 99


if __name__ == "__main__":
    run_command(main)
