"""``bin/Benchmark.py foresight``: its options, what it prints, exit codes."""

from __future__ import annotations

import logging
import shlex
from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from annotated_types import Interval

from robo_manip_baselines.benchmark.foresight.analysis import ForesightStatistics
from robo_manip_baselines.benchmark.foresight.episodes import Cell
from robo_manip_baselines.benchmark.foresight.grid import PRESETS
from robo_manip_baselines.benchmark.foresight.report import PAGE, write_report
from robo_manip_baselines.benchmark.foresight.study import (
    FOLDER,
    possible_cells,
    prepare_study,
    read_study,
    requests,
    require_settings,
    run_study,
    study_settings,
)
from robo_manip_baselines.runs.command import parse
from robo_manip_baselines.runs.errors import require_choice
from robo_manip_baselines.runs.files import locked, require_out_folder
from robo_manip_baselines.runs.progress import ProgressBar, closing_table, duration
from robo_manip_baselines.runs.ranges import Episodes, require_ranges
from robo_manip_baselines.runs.threads import processors

DESCRIPTION = """Let a scripted visual servo feed people who move, over delays, leads, ways to
execute its plans and forecasters, and write tables, figures and a page. The same command continues
where an earlier one was stopped."""

EXAMPLE = "python bin/Benchmark.py foresight --preset smoke"

NAME = "foresight"

FIRST_SEED = 0
"""of the episodes."""

EPISODE_SECONDS = 0.3
"""of one core for an episode of a cell, measured where the presets were made, on a busy machine."""

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class ForesightOptions:
    """Options of the study.

    Attributes:
        preset: Size: cpu (half an hour on two cores), full (an hour and a half, more motions,
            delays and forecasters) or smoke (half a minute).
        num_episodes: Episodes of each cell, seeds from 0; as in the preset if not given.
        motion_library: File of recorded face motion, or extended; the one that ships if not
            given.
        num_workers: Processes; as many as there are cores if not given. Results do not depend on
            it.
        out: Folder to write to; results/foresight_<preset> if not given.
        dry_run: Only print what there is to do.

    Raises:
        RequestError: a value is not valid.
    """

    preset: str = "cpu"
    num_episodes: Episodes | None = None
    motion_library: Path | None = None
    num_workers: Annotated[int, Interval(ge=1, le=1024)] | None = None
    out: Path | None = None
    dry_run: bool = False

    def __post_init__(self) -> None:
        require_choice("preset", self.preset, PRESETS)
        require_ranges(self)

    @property
    def folder(self) -> Path:
        """Folder to write to."""
        return self.out or Path("results") / f"{NAME}_{self.preset}"

    @property
    def seeds(self) -> range:
        """Seeds of every cell."""
        number = self.num_episodes or PRESETS[self.preset].num_episodes
        return range(FIRST_SEED, FIRST_SEED + number)

    @property
    def workers(self) -> int:
        """Number of processes."""
        return self.num_workers if self.num_workers is not None else processors()


def foresight(options: ForesightOptions, command: str) -> int:
    """Run the study.

    Args:
        options: of it.
        command: command line, for the page.

    Returns:
        The exit code, 0.

    Raises:
        RequestError: the request cannot be met.
    """
    folder, library = options.folder, options.motion_library
    require_out_folder(folder, FOLDER, [library])
    settings = study_settings(library)
    require_settings(folder, settings)
    cells = possible_cells(PRESETS[options.preset].cells, library)
    for cell in PRESETS[options.preset].cells:
        if cell not in cells:
            logger.info("left out: the library has no forecast for %s", " ".join(map(str, cell)))
    with nullcontext() if options.dry_run else locked(folder):
        done = read_study(folder)
        todo = requests(cells, options.seeds, done)
        left = sum(len(request.cells) for request in todo)
        if options.dry_run:
            print(overview(options, cells, left))  # noqa: T201
            return 0
        if not prepare_study(folder, settings):
            logger.warning(
                "'%s' was begun by other code of the package; its episodes are used as they are, "
                "remove it to do them again",
                folder,
            )
        logger.info("%s, preset %s, in %s", NAME, options.preset, folder)
        total = len(cells) * len(options.seeds)
        with ProgressBar(total, "episode", done=total - left) as progress:
            run_study(
                folder,
                todo,
                motion_library=library,
                num_workers=options.workers,
                on_rows=lambda rows: progress.advance(len(rows)),
            )
        rows = read_study(folder)
        wanted = [rows[cell, seed] for cell in sorted(cells) for seed in options.seeds]
        statistics = ForesightStatistics(wanted)
        facts = {
            "Command": f"`{command}`",
            "Episodes": f"{len(options.seeds)} of each of {len(cells)} cells, seeds "
            f"{options.seeds[0]} to {options.seeds[-1]}",
            "Software": ", ".join(f"{k} {v}" for k, v in settings.items() if "." in str(v)),
        }
        write_report(folder, statistics, facts)
    print(summary(statistics, folder))  # noqa: T201
    return 0


def overview(options: ForesightOptions, cells: Sequence[Cell], left: int) -> str:
    """Lay out what there is to do."""
    total = len(cells) * len(options.seeds)
    return closing_table(
        {
            "cells": f"{len(cells)}, motions {', '.join(dict.fromkeys(c.motion for c in cells))}",
            "episodes": f"{left} of {total} to do",
            "workers": str(options.workers),
            "time": f"about {duration(left * EPISODE_SECONDS / options.workers)}",
        }
    )


def summary(statistics: ForesightStatistics, folder: Path) -> str:
    """Lay out the table that the command prints at its end."""
    rows = {}
    for best in statistics.best_leads:
        motion, delay, execution = best.setting
        found, gain = best.lead, best.gain
        text = "none" if found.mean is None else f"{found.mean:4.1f}"
        text = f"best lead {text}, expected {best.expected}"
        if gain and gain.difference.mean is not None:
            text += f", strict success {100.0 * gain.difference.mean:+.0f} points"
        rows[f"{motion}, delay {delay}, {execution}"] = text
    return closing_table(rows | {"page": str(folder / PAGE)})


def main(args: Sequence[str]) -> int:
    """Run ``bin/Benchmark.py foresight``, given the options after its name."""
    options = parse(ForesightOptions, EXAMPLE, description=DESCRIPTION, args=args)
    return foresight(options, shlex.join(["python", "bin/Benchmark.py", NAME, *args]))
