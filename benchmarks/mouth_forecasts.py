"""Errors of the forecasters of the mouth: motions x frames ahead, as a table."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from robo_manip_baselines.envs.mujoco.cell.scene import CONTROL_PERIOD
from robo_manip_baselines.envs.mujoco.face.forecasters import MotionForecasters
from robo_manip_baselines.envs.mujoco.face.motion import MotionLibrary
from robo_manip_baselines.envs.mujoco.face.motions import parse_motion
from robo_manip_baselines.envs.mujoco.face.replay import FRAMES_AHEAD
from robo_manip_baselines.observation import FORECASTERS, MAX_HORIZON
from robo_manip_baselines.rollout.evaluation import FIRST_SEED
from robo_manip_baselines.runs.command import parse, run_command
from robo_manip_baselines.runs.errors import RequestError, require_choice
from robo_manip_baselines.runs.markdown import markdown_table

EXAMPLE = "python benchmarks/mouth_forecasts.py --motions dyskinetic sway --frames 4 8 16"

FIRST, LAST = 1.0, 11.0
"""s since the start of an episode between which forecasts are made."""


@dataclass(frozen=True)
class Options:
    """Forecast the mouth of people who were not fitted to, and print the error of each forecaster.

    Attributes:
        motions: As the option --motion of Rollout.py takes them.
        frames: Video frames ahead.
        forecasters: Names, as the option --prediction of Train.py takes them.
        num_episodes: Episodes of each motion, on the seeds of evaluations.
    """

    motions: tuple[str, ...] = ("dyskinetic", "sway", "recorded")
    frames: tuple[int, ...] = (4, 8, 16)
    forecasters: tuple[str, ...] = tuple(name for name in FORECASTERS if name != "shuffled")
    num_episodes: int = 40

    def __post_init__(self) -> None:
        if self.num_episodes < 1:
            raise RequestError(f"num_episodes {self.num_episodes}: must be 1 or more")
        if not all(1 <= frames <= MAX_HORIZON for frames in self.frames):
            raise RequestError(f"frames {self.frames}: must be 1 to {MAX_HORIZON}")
        for name in self.forecasters:
            require_choice("forecaster", name, FORECASTERS)
        for motion in self.motions:
            parse_motion(motion)


def errors(motion: str, name: str, num_episodes: int) -> list[float]:
    """Return root mean squares, mm, of the error 1, 2, ... frames ahead."""
    made = MotionForecasters.of(parse_motion(motion), MotionLibrary.load(), "test")
    steps = slice(round(FIRST / CONTROL_PERIOD), round(LAST / CONTROL_PERIOD))
    squares = []
    for seed in range(FIRST_SEED, FIRST_SEED + num_episodes):
        rng = np.random.default_rng(seed)
        path = made.motion.draw(rng, made.library, seed=seed, people="test")
        times = np.arange(steps.stop)[:, None] * CONTROL_PERIOD + FRAMES_AHEAD
        track = path.displacement_at(times)
        error = made.forecast_track(name, track, seed)[steps] - track[steps, 1:]
        squares.append((error**2).sum(axis=-1).mean(axis=0))
    return list(1e3 * np.sqrt(np.mean(squares, axis=0)))


def main() -> int:
    """Print the table."""
    options = parse(Options, EXAMPLE)
    rows = []
    for motion in options.motions:
        found = [errors(motion, name, options.num_episodes) for name in options.forecasters]
        for frames in options.frames:
            values = (f"{error[frames - 1]:#.2g}".removesuffix(".") for error in found)
            rows.append([f"`{motion}`", frames, *values])
    head = ["motion", "frames ahead", *(f"`{name}`" for name in options.forecasters)]
    print(markdown_table(head, rows))
    return 0


if __name__ == "__main__":
    run_command(main)
