"""Response of a policy's actions to the mouth, to the robot's own posture and to what it holds.

A policy that imitates, and that is shown too little of the mouth, can read its next action off
where its arm is, which in demonstrations is where the demonstrator was going: the copycat problem
(Wen et al., "Fighting Copycat Agents in Behavioral Cloning from Observation Histories", NeurIPS
2020). Its error on demonstrations is small, and it does not follow the mouth. This displaces the
observed mouth, then the arm, then the object that the gripper holds, by 5 mm in frames of
demonstrations near the mouth, and measures the proportion of each displacement by which the actions
move.

    python benchmarks/action_response.py --dataset dyskinetic --checkpoints runs/*/checkpoints/*
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from robo_manip_baselines.data.demonstrations import recorded_state
from robo_manip_baselines.data.episode import EpisodeReader
from robo_manip_baselines.data.files import list_episodes
from robo_manip_baselines.observation import State, TargetObservation
from robo_manip_baselines.observation.arm import gripper_position, joints_at
from robo_manip_baselines.policy.checkpoint import Checkpoint, load_model, read_checkpoint
from robo_manip_baselines.runs.command import parse, run_command
from robo_manip_baselines.runs.errors import RequestError
from robo_manip_baselines.runs.markdown import markdown_table
from robo_manip_baselines.runs.ranges import Episodes

EXAMPLE = (
    "python benchmarks/action_response.py --dataset dyskinetic --checkpoints runs/*/checkpoints/*"
)

DISPLACEMENT = 0.005
"""m: as far as a mouth moves within some frames, and small beside the distance from it."""

NEAR, LET_GO = 0.12, 0.03
"""m from the mouth between which frames are taken: the servo follows it there, and lets go at less
than 0.03."""

EVERY = 3
"""Control steps from one frame that is taken to the next."""

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Options:
    """Measure how far the actions of policies follow the mouth, the arm and the held object."""

    dataset: Path
    """Folder of demonstrations."""
    checkpoints: tuple[Path, ...]
    """Checkpoints of policies without images; training seeds of a condition are one row."""
    num_episodes: Episodes = 25
    """Episodes of the dataset, those of the lowest seeds."""
    num_actions: int = 10
    """First actions of each chunk that count."""


class Recorded(NamedTuple):
    """A recorded episode.

    Attributes:
        state: (T, ...) of the simulator.
        action: (T, 7) targets of the right arm.
        seed: of the episode.
        rows: steps that are taken.
    """

    state: State
    action: Floats
    seed: int
    rows: NDArray[np.int64]


class Response(NamedTuple):
    """Response of a policy's actions, where each is the position of the gripper that it leads to.

    Attributes:
        mouth: movement of the actions as a proportion of the mouth's displacement: 1 follows it.
        arm: movement as a proportion of the arm's displacement: 1 copies it.
        held: movement as a proportion of the held object's displacement.
        error: m from the demonstrated actions.
    """

    mouth: float
    arm: float
    held: float
    error: float


def read_episodes(folder: Path, count: int) -> Iterator[Recorded]:
    """Read the steps near the mouth of the first ``count`` episodes of a folder."""
    for path in list_episodes(folder)[:count]:
        with EpisodeReader(path) as episode:
            state, action = recorded_state(episode), episode.array("action")
            seed = episode.attributes["seed"]
        gap = state.end_effector_position - state.target_position[:, 0]
        distance = np.linalg.norm(gap, axis=-1)
        rows = np.flatnonzero((distance < NEAR) & (distance > LET_GO))[::EVERY]
        yield Recorded(state, action, seed, rows)


def displaced_mouth(observed: TargetObservation, by: Floats) -> TargetObservation:
    """Move the mouth in every frame that is observed."""
    past = None if observed.past is None else observed.past + by
    return replace(observed, position=observed.position + by, past=past)


def displaced_arm(state: State, by: Floats) -> State:
    """Move the right arm's gripper; the wrist's joints stay, and so does what it holds."""
    place = state.end_effector_position + by
    joints = state.joint_position.copy()
    joints[:, -1] = joints_at("right", place, joints[:, -1, 3:])
    return replace(state, joint_position=joints, end_effector_position=place)


def respond(checkpoint: Checkpoint, episodes: list[Recorded], count: int) -> Response:
    """Displace mouth, arm and object along each axis, and compare the first ``count`` actions.

    Raises:
        RequestError: the policy's actions are not a function of one observed state alone.
    """
    spec, normalization = checkpoint.spec, checkpoint.normalization
    model = load_model(checkpoint)
    problems = {
        "sees images": spec.cameras,
        "acts with both arms": spec.arms != "right",
        "does not observe the mouth": not spec.frames,
        "observes a forecast with errors": spec.corruption.has_forecast_error,
        "encodes its actions": checkpoint.encoding,
        "sees several steps or draws noise": model.n_obs_steps > 1 or model.sample_noise_size,
    }
    if problem := next((text for text, is_there in problems.items() if is_there), None):
        raise RequestError(f"'{checkpoint.folder}' {problem}; choose another checkpoint")
    pipeline = spec.make_pipeline()
    moves: dict[str, list[Floats]] = {"mouth": [], "arm": [], "held": []}
    errors: list[Floats] = []

    def predict(state: State, observed: TargetObservation, rows: NDArray[np.int64]) -> Floats:
        vector = spec.pack(state, observed if pipeline else None)[rows]
        normalized = torch.from_numpy(normalization.normalize_state(vector))
        with torch.inference_mode():
            chunk = model.predict(normalized[:, None], None, None)[:, :count].numpy()
        return gripper_position("right", normalization.unnormalize_action(chunk)[..., :6])

    for state, action, seed, rows in episodes:
        if not len(rows):
            continue
        observed = TargetObservation(state.time, state.target_position)
        if pipeline:
            observed = pipeline.observe_episode(state, seed)

        usual = predict(state, observed, rows)
        steps = np.minimum(rows[:, None] + np.arange(usual.shape[1]), len(action) - 1)
        gap = usual - gripper_position("right", action[steps][..., :6])
        errors.append(np.linalg.norm(gap, axis=-1).ravel())
        for axis, by in enumerate(DISPLACEMENT * np.eye(3)):
            moved = replace(state, target_position=state.target_position + by)
            holding = replace(state, object_position=state.object_position + by)
            changed = {
                "mouth": (moved, displaced_mouth(observed, by)),
                "arm": (displaced_arm(state, by), observed),
                "held": (holding, observed),
            }
            for name, seen in changed.items():
                change = predict(*seen, rows) - usual
                moves[name].append(change[..., axis].ravel() / DISPLACEMENT)
    if not errors:
        raise RequestError("no frame near the mouth: the dataset has to be one of feeding")
    parts = {**moves, "error": errors}
    return Response(**{name: float(np.concatenate(part).mean()) for name, part in parts.items()})


def condition(checkpoint: Checkpoint) -> tuple[str, str, int]:
    """Return what a row is about: policy, observation and optimiser steps."""
    return checkpoint.policy, checkpoint.spec.name, checkpoint.step


def table(responses: dict[tuple[str, str, int], list[Response]]) -> str:
    """Return the means over the training seeds, and their range."""

    def text(values: list[float], digits: int) -> str:
        mean, low, high = (f"{f(values):.{digits}f}" for f in (np.mean, min, max))
        return mean if low == high else f"{mean} ({low} to {high})"

    rows = [
        (
            *name,
            len(own),
            text([r.mouth for r in own], 2),
            text([r.arm for r in own], 2),
            text([r.held for r in own], 2),
            text([1e3 * r.error for r in own], 1),
        )
        for name, own in responses.items()
    ]
    head = ("policy", "observation", "steps", "trainings", "follows the mouth", "the arm")
    return markdown_table((*head, "the held object", "error, mm"), rows)


def main() -> None:
    """Measure each checkpoint, and print a row for each condition."""
    options = parse(Options, EXAMPLE)
    torch.set_num_threads(1)
    episodes = list(read_episodes(options.dataset, options.num_episodes))
    responses: dict[tuple[str, str, int], list[Response]] = defaultdict(list)
    for path in options.checkpoints:
        checkpoint = read_checkpoint(path)
        measured = respond(checkpoint, episodes, options.num_actions)
        responses[condition(checkpoint)].append(measured)
    print(table(responses))


if __name__ == "__main__":
    run_command(main)
