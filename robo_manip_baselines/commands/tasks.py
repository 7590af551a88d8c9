"""``bin/Tasks.py``: all registered tasks, those of other packages included, and a picture."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from robo_manip_baselines.envs.mujoco.tasks.registry import task_entry, task_names
from robo_manip_baselines.runs.command import parse
from robo_manip_baselines.runs.errors import RequestError
from robo_manip_baselines.runs.files import FileKind, require_out_file
from robo_manip_baselines.runs.ranges import Seed

PICTURE = "--picture"
EXAMPLE = "python bin/Tasks.py --picture tasks.png"


@dataclass(frozen=True)
class TasksOptions:
    """List the registered tasks; draw a picture with frames of an episode of each if asked."""

    picture: Path | None = None
    """Write a PNG here: for each task, its scripted expert at work, and at the first success."""
    seed: Seed = 0
    """Seed of the episodes."""


def show_tasks(options: TasksOptions) -> None:
    """Print the tasks, and draw them.

    Raises:
        RequestError: the picture cannot be written, or there is no OpenGL.
    """
    # Imported here: --help needs no simulator.
    from robo_manip_baselines.envs.mujoco.cell.opengl import opengl_problem
    from robo_manip_baselines.rollout.task_pictures import tile_tasks, write_png

    if options.picture:
        if options.picture.exists():
            raise RequestError(f"'{options.picture}': is there already; name another file")
        require_out_file(
            options.picture, FileKind("PNG", lambda path: None, ".png"), option=PICTURE
        )
        if problem := opengl_problem():
            raise RequestError(f"--picture {options.picture}: {problem}")
    for name in task_names():
        entry = task_entry(name)
        print(f"{name}\n  success  {entry.success}\n  strict   {entry.strict_success}")  # noqa: T201
        print(f"  arms     {', '.join(entry.arms)}\n  experts  {', '.join(entry.experts)}")  # noqa: T201
        for argument, values in entry.choices.items():
            print(f"  {argument:<8} {', '.join(values)}")  # noqa: T201
    if options.picture:
        write_png(options.picture, tile_tasks(task_names(), options.seed))
        print(f"picture: {options.picture}")  # noqa: T201


def main(args: Sequence[str]) -> None:
    """Run ``bin/Tasks.py``."""
    show_tasks(parse(TasksOptions, EXAMPLE, args=args))
