"""Episodes of a visual servo that feeds, in many cells: motion, delay, lead, execution, forecast.

All cells have the same seeds. The cube is fetched alike in all cells of a seed and motion, and
brought before the mouth alike in all cells that also have the delay in common: each is simulated
once, and the cells go on from there. The results are those of whole episodes.
"""

from __future__ import annotations

import copy
import json
from collections.abc import Iterable, Iterator
from dataclasses import asdict, dataclass
from itertools import groupby
from pathlib import Path
from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from robo_manip_baselines.benchmark.foresight.forecasters import FORECASTERS, Forecasters
from robo_manip_baselines.envs.mujoco.cell.scene import CONTROL_PERIOD
from robo_manip_baselines.envs.mujoco.expert.servo import Execution, ServoConfig, first_of
from robo_manip_baselines.envs.mujoco.tasks.feeding.env import FeedingEnv
from robo_manip_baselines.envs.mujoco.tasks.feeding.expert import (
    BROUGHT,
    INSERTED,
    LIFTED,
    WITHDRAWN,
    FeedingServo,
)
from robo_manip_baselines.envs.mujoco.tasks.feeding.success import FeedingProgress
from robo_manip_baselines.envs.mujoco.tasks.registry import make_env, task_entry
from robo_manip_baselines.observation import FRAME_PERIOD
from robo_manip_baselines.runs.documents import convert, parse_json
from robo_manip_baselines.runs.errors import RequestError, require_choice
from robo_manip_baselines.runs.ranges import Amount, NonNegativeInt, Seed

TASK = "FeedingEnv"

ROW_VERSION = 1

CHUNK_SIZE = 30
"""Control steps of a plan with execution ``ensemble``: 0.6 s, ACT's preset ``cpu``."""

ENSEMBLE_DECAY = 0.01
"""of the temporal ensemble (public ACT)."""

SETTLING = 0.5
"""s after the start of the insertion that the tracking error leaves out: until then the gripper
goes from where the mouth was seen to where it is forecast."""

EXECUTIONS = ("direct", "ensemble")
"""Execution of plans: the first step of each, or the average of all plans of a control step."""


class Cell(NamedTuple):
    """Cell of the grid.

    Attributes:
        motion: of the face, see `parse_motion`.
        delay: frames of 1/30 s, age of the newest frame that the servo sees.
        execution: one of ``EXECUTIONS``.
        forecaster: one of ``FORECASTERS``.
        lead: frames, from the newest one seen, ahead of which it aims.
    """

    motion: str
    delay: int
    execution: str
    forecaster: str
    lead: int


@dataclass(frozen=True)
class ForesightRow:
    """Result of an episode. SI units.

    Attributes:
        motion, delay, execution, forecaster, lead: see `Cell`.
        seed: of the episode.
        is_success: the task's condition was met.
        is_success_strict: and its strict condition.
        completion_time: s from the lift to success; null without.
        face_force: N, largest normal force between the robot and the face.
        tracking_error: m, root mean square of the distance across the approach between gripper
            and mouth, from ``SETTLING`` after the start of the insertion to its end; null if it
            ended before.
        steps: control steps until the servo turns home.
    """

    motion: str
    delay: NonNegativeInt
    execution: str
    forecaster: str
    lead: NonNegativeInt
    seed: Seed
    is_success: bool
    is_success_strict: bool
    completion_time: Amount | None
    face_force: Amount
    tracking_error: Amount | None
    steps: NonNegativeInt

    @property
    def cell(self) -> Cell:
        """Cell of the grid."""
        return Cell(*(getattr(self, name) for name in Cell._fields))

    @property
    def key(self) -> tuple[Cell, int]:
        """Cell and seed, of which there is one row."""
        return self.cell, self.seed

    def to_line(self) -> str:
        """Return the row as one line of JSON, without the line's end."""
        return json.dumps({"version": ROW_VERSION, **asdict(self)}, allow_nan=False)

    @classmethod
    def from_line(cls, line: str, source: str = "row") -> ForesightRow:
        """Read a row; ``source`` begins messages.

        Raises:
            RequestError: it is no such row.
        """
        values = convert(parse_json(line, source), dict, source)
        if (version := values.pop("version", None)) != ROW_VERSION:
            raise RequestError(f"{source}: version {version}; this release reads {ROW_VERSION}")
        row = convert(values, cls, source)
        require_choice(f"execution in {source}", row.execution, EXECUTIONS)
        require_choice(f"forecaster in {source}", row.forecaster, FORECASTERS)
        return row


class Request(NamedTuple):
    """Episodes of one seed and motion.

    Attributes:
        motion: of the face.
        seed: of the episodes.
        cells: of that motion.
    """

    motion: str
    seed: int
    cells: tuple[Cell, ...]


class EpisodePlayer:
    """Plays the episodes of requests, in environments that it keeps.

    Args:
        motion_library: file of recorded motion; the one that ships with the package if None.
    """

    def __init__(self, motion_library: Path | None = None) -> None:
        self._library = motion_library
        self._worlds: dict[str, tuple[FeedingEnv, Forecasters]] = {}

    def __call__(self, request: Request) -> list[ForesightRow]:
        """Return a row for each cell, in the order of the cells."""
        world, forecasters = self._open(request.motion)
        rows = {row.cell: row for row in play(world, forecasters, request.seed, request.cells)}
        return [rows[cell] for cell in request.cells]

    def _open(self, motion: str) -> tuple[FeedingEnv, Forecasters]:
        if motion not in self._worlds:
            world = open_world(motion, self._library)
            self._worlds[motion] = world, Forecasters(world)
        return self._worlds[motion]


def open_world(motion: str, motion_library: Path | None = None) -> FeedingEnv:
    """Make the environment of a motion.

    Raises:
        RequestError: the motion or the library cannot be used.
    """
    env = make_env(TASK, cameras=(), motion=motion, motion_library=motion_library)
    assert isinstance(env.unwrapped, FeedingEnv)
    return env.unwrapped


def play(
    world: FeedingEnv, forecasters: Forecasters, seed: int, cells: Iterable[Cell]
) -> Iterator[ForesightRow]:
    """Play the episodes of a seed, those of the same delay after one another."""
    truth = forecasters.start("truth", seed)
    world.reset(seed=seed)
    fetching = FeedingServo(world, ServoConfig(), truth)
    fetching.reset()
    lifted = _Run(world)
    lifted.advance(fetching, LIFTED)
    after_lift = lifted.saved()
    for delay, group in groupby(sorted(cells, key=lambda cell: cell.delay), lambda c: c.delay):
        brought = after_lift.restored()
        bringing = fetching.branch(LIFTED, ServoConfig(delay=delay), truth)
        brought.advance(bringing, BROUGHT)
        before_mouth = brought.saved()
        for cell in group:
            run = before_mouth.restored()
            config = ServoConfig(
                lead=cell.lead,
                delay=delay,
                plan_steps=1 if cell.execution == "direct" else CHUNK_SIZE,
            )
            forecast = forecasters.start(cell.forecaster, seed)
            servo = bringing.branch(BROUGHT, config, forecast, make_execution(cell.execution))
            yield run.finish(servo, cell, seed)


def make_execution(name: str) -> Execution:
    """Make the execution of an episode's plans.

    ``ensemble`` is the temporal ensemble of policies. Only positions go through it: phases and
    fingers of the servo act at once, so that what it costs is its latency in following.
    """
    if name == "direct":
        return first_of
    from robo_manip_baselines.policy.execution import TemporalEnsemble  # loads PyTorch

    buffer, env_ids = TemporalEnsemble(1, CHUNK_SIZE, 3, decay=ENSEMBLE_DECAY), np.zeros(1, np.intp)

    def ensemble(plan: NDArray[np.float64]) -> NDArray[np.float64]:
        # The buffer returns float32, which keeps 30 nm of a metre.
        return buffer.act(env_ids, plan[None])[0].astype(np.float64)  # type: ignore[arg-type]

    return ensemble


def plan_age() -> float:
    """Return the mean age, in frames of 1/30 s, of the plans in a full temporal ensemble."""
    age = np.arange(CHUNK_SIZE)[::-1]  # the oldest first
    weight = np.exp(-ENSEMBLE_DECAY * np.arange(CHUNK_SIZE))
    return float(age @ weight / weight.sum()) * CONTROL_PERIOD / FRAME_PERIOD


class _Run:
    """Stretch of an episode from the present state of an environment on."""

    def __init__(self, world: FeedingEnv, force: float = 0.0, is_over: bool = False) -> None:
        self._world, self.force, self.is_over = world, force, is_over

    def advance(self, actor: FeedingServo, phases: int) -> list[float]:
        """Act until ``phases`` are done, or the episode is over.

        Returns:
            m, across the approach: the distance between gripper and mouth after each step.
        """
        world, limit, distances = self._world, task_entry(TASK).max_episode_steps, []
        while not self.is_over and actor.phases_done < phases:
            world.simulate(actor.act())
            _, is_ended = world.advance()
            self.is_over = is_ended or world.step_count >= limit
            self.force = max(self.force, world.face_force)
            distances.append(float(np.hypot(*(world.gripper_position - world.mouth_track[0])[1:])))
        return distances

    def finish(self, actor: FeedingServo, cell: Cell, seed: int) -> ForesightRow:
        """Act until the servo turns home; return the result."""
        apart = np.array(self.advance(actor, INSERTED)[round(SETTLING / CONTROL_PERIOD) :])
        self.advance(actor, WITHDRAWN)
        progress = self._world.progress
        return ForesightRow(
            **cell._asdict(),
            seed=seed,
            is_success=progress.is_success,
            is_success_strict=progress.is_success_strict,
            completion_time=progress.completion_time,
            face_force=self.force,
            tracking_error=float(np.sqrt((apart**2).mean())) if len(apart) else None,
            steps=self._world.step_count,
        )

    def saved(self) -> _SavedRun:
        """Return the present state, to go on from any number of times."""
        world = self._world
        return _SavedRun(
            world=world,
            data=copy.copy(world.data),
            progress=world.progress,
            step_count=world.step_count,
            motion_start=world.motion_start,
            force=self.force,
            is_over=self.is_over,
        )


class _SavedRun(NamedTuple):
    world: FeedingEnv
    data: mujoco.MjData
    progress: FeedingProgress
    step_count: int
    motion_start: int | None
    force: float
    is_over: bool

    def restored(self) -> _Run:
        """Put the environment back into this state."""
        mujoco.mj_copyData(self.world.data, self.world.model, self.data)
        self.world.progress, self.world.step_count = self.progress, self.step_count
        self.world.motion_start = self.motion_start
        return _Run(self.world, self.force, self.is_over)
