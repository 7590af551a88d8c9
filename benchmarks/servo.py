"""Value of foresight to a visual servo: motion, delay, lead and forecast, on common seeds.

The scripted servo feeds a face that moves; it sees the mouth some frames late, and aims a lead
ahead of the newest one seen. Episodes are appended to a file as they end. The same command
continues from there, and prints the table of all episodes in it.

Example: python benchmarks/servo.py --num_episodes 50 --workers 2 --out servo.jsonl
"""

from __future__ import annotations

import json
import os
from collections import defaultdict
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from functools import cache
from multiprocessing import get_context
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from robo_manip_baselines.envs.mujoco.expert.servo import ARM_LAG, Forecast, ServoConfig
from robo_manip_baselines.envs.mujoco.face.motions import parse_motion
from robo_manip_baselines.envs.mujoco.tasks.feeding.env import FeedingEnv
from robo_manip_baselines.envs.mujoco.tasks.feeding.expert import FeedingServo
from robo_manip_baselines.envs.mujoco.tasks.registry import make_env
from robo_manip_baselines.observation import FRAME_PERIOD
from robo_manip_baselines.rollout.results import Proportion
from robo_manip_baselines.runs.command import parse, run_command
from robo_manip_baselines.runs.errors import RequestError, require_choice
from robo_manip_baselines.runs.files import prepare_folder

MAX_STEPS = 600

SETTINGS = (
    *("recorded/0", "recorded/8", "recorded:speed=3/8", "sway/4"),
    *("dyskinetic/0", "dyskinetic/4", "dyskinetic/8"),
)


class Cell(NamedTuple):
    """Motion, delay and lead in frames, and forecast."""

    motion: str
    delay: int
    lead: int
    forecast: str = "truth"


class Episode(NamedTuple):
    """Result of an episode; force is the largest on the face, N."""

    success: bool
    strict: bool
    force: float


def truth(world: FeedingEnv) -> Forecast:
    """Forecast without error."""
    return lambda seen, ahead: world.mouth_at(seen + ahead)


def persistence(world: FeedingEnv) -> Forecast:
    """Forecast that the mouth stays where it was seen."""
    return lambda seen, ahead: world.mouth_at(seen)


def constant_velocity(world: FeedingEnv) -> Forecast:
    """Forecast that the mouth goes on as it did from the last video frame to the newest."""

    def forecast(seen: float, ahead: float) -> NDArray[np.float64]:
        before, now = world.mouth_at([seen - FRAME_PERIOD, seen])
        return now + (now - before) * (ahead / FRAME_PERIOD)

    return forecast


FORECASTS = {maker.__name__: maker for maker in (truth, persistence, constant_velocity)}


@dataclass(frozen=True)
class Options:
    """Let a visual servo feed under delays and leads, and print how often it succeeded.

    Attributes:
        settings: Motions with a delay in frames: sway/4.
        num_episodes: Episodes of each cell, one for each seed from --seed on.
        seed: Seed of the first episode.
        forecasts: Forecasts of the mouth: truth, persistence, constant_velocity; all but the truth
            with a lead of delay + 3 frames only.
        out: File of the episodes, a line each; lines that are there are kept.
        workers: Processes.
    """

    settings: tuple[str, ...] = SETTINGS
    num_episodes: int = 50
    seed: int = 0
    forecasts: tuple[str, ...] = ("truth", "constant_velocity")
    out: Path = Path("servo.jsonl")
    workers: int = 2

    def __post_init__(self) -> None:
        for name in ("num_episodes", "workers"):
            if getattr(self, name) < 1:
                raise RequestError(f"{name} {getattr(self, name)}: must be 1 or more")
        for forecast in self.forecasts:
            require_choice("forecast", forecast, FORECASTS)
        self.cells()

    def cells(self) -> list[Cell]:
        """Return the cells of the table.

        Raises:
            RequestError: a motion or a delay is not valid.
        """
        cells: list[Cell] = []
        for text in self.settings:
            motion, _, frames = text.rpartition("/")
            if not frames.isdigit():
                raise RequestError(f"settings '{text}': must be a motion and a delay, as in sway/4")
            motion, delay = str(parse_motion(motion)), int(frames)
            for name in self.forecasts:
                leads = {0, 5, delay + ARM_LAG} if name == "truth" else {delay + ARM_LAG}
                cells += [Cell(motion, delay, lead, name) for lead in sorted(leads)]
        return cells


@cache
def open_world(motion: str) -> FeedingEnv:
    """Make the environment of a motion once in this process."""
    world = make_env("FeedingEnv", cameras=(), motion=motion).unwrapped
    assert isinstance(world, FeedingEnv)
    return world


def play(cell: Cell, seed: int) -> Episode:
    """Run one episode."""
    world = open_world(cell.motion)
    config = ServoConfig(lead=cell.lead, delay=cell.delay)
    actor = FeedingServo(world, config, FORECASTS[cell.forecast](world))
    world.reset(seed=seed)
    actor.reset()
    force = 0.0
    for _ in range(MAX_STEPS):
        _, _, terminated, _, info = world.step(actor.act())
        force = max(force, info["face_force"])
        if terminated:
            break
    return Episode(world.progress.is_success, world.progress.is_success_strict, force)


def read_episodes(path: Path) -> dict[tuple[Cell, int], Episode]:
    """Read the episodes of a file; a torn last line is left out.

    Raises:
        RequestError: a line is damaged.
    """
    text = path.read_text(encoding="utf-8") if path.exists() else ""
    episodes = {}
    for number, line in enumerate(text[: text.rfind("\n") + 1].splitlines(), start=1):
        try:
            cell, seed, episode = json.loads(line)
            episodes[Cell(*cell), int(seed)] = Episode(*episode)
        except (ValueError, TypeError) as error:
            problem = f"'{path}', line {number} is damaged; remove it, or give another --out"
            raise RequestError(problem) from error
    return episodes


def run(options: Options) -> dict[tuple[Cell, int], Episode]:
    """Play the episodes that the file lacks, seed by seed; return all episodes."""
    episodes = read_episodes(options.out)
    seeds = range(options.seed, options.seed + options.num_episodes)
    todo = [(cell, seed) for seed in seeds for cell in options.cells()]
    todo = [key for key in todo if key not in episodes]
    prepare_folder(options.out.parent)
    if options.out.exists():  # drop a torn line
        os.truncate(options.out, options.out.read_bytes().rfind(b"\n") + 1)
    pool = ProcessPoolExecutor(options.workers, get_context("spawn"))
    try:
        with options.out.open("a", encoding="utf-8") as file:
            futures = {pool.submit(play, *key): key for key in todo}
            for future in tqdm(as_completed(futures), total=len(todo), unit="episode"):
                key = futures[future]
                episodes[key] = future.result()
                file.write(json.dumps([*key, episodes[key]]) + "\n")
                file.flush()
    finally:
        pool.shutdown(cancel_futures=True)
    return episodes


def table(cells: Sequence[Cell], episodes: dict[tuple[Cell, int], Episode]) -> Iterator[str]:
    """Lay the episodes out as Markdown, a row for each cell."""
    of_cell = defaultdict(list)
    for (cell, _), episode in episodes.items():
        of_cell[cell].append(episode)
    yield "| motion | delay | lead | forecast | success | strict success | force, 90 % (N) |"
    yield "|---|---|---|---|---|---|---|"
    for cell in cells:
        played, n = of_cell[cell], len(of_cell[cell])
        rates = [Proportion.of(sum(getattr(e, kind) for e in played), n) for kind in RATES]
        shown = " | ".join(f"{100 * (r.rate or 0):.0f} % ({r.count}/{n})" for r in rates)
        force = np.percentile([e.force for e in played], 90)
        yield f"| {' | '.join(map(str, cell))} | {shown} | {force:.1f} |"


RATES = ("success", "strict")


def main() -> None:
    """Run and print."""
    options: Options = parse(Options, "python benchmarks/servo.py --num_episodes 50 --workers 2")
    print("\n".join(table(options.cells(), run(options))))


if __name__ == "__main__":
    run_command(main)
