"""What one evaluation episode came to: a line of ``results.jsonl``."""

from __future__ import annotations

import json
import types
import typing
from dataclasses import asdict, dataclass, field, fields
from typing import Any

from robo_manip_baselines.evaluation.failure import FAILURES

Offset = tuple[float, float, float]


@dataclass(frozen=True)
class EpisodeResult:
    """One episode, SI units, world frame.

    Attributes:
        env: name of the environment
        seed: of the episode
        is_success: the gripper brought the cube within 0.03, 0.01 and 0.01 m of the mouth
        is_success_strict: and let go of it inside the mouth, without touching the face
        completion_time: s from the lift to success; null without success
        time_since_lift: s from the lift to the end of the episode; null without a lift
        steps: control steps of 0.02 s
        failure: kind of failure; empty for a success
        closest_distance: m, smallest distance gripper-mouth while the lifted cube was held; null
            without a lift
        closest_offset: m, x, y, z of gripper minus mouth at the closest approach with the cube,
            nearest in units of the tolerances; null without a lift
        cube_offset: m, cube minus mouth in the face's axes (out, across to the person's left, up)
            where the lifted cube was held and its centre nearest to the mouth; null without a lift
        face_force: N, largest normal force between robot and face
        motion_clip: recorded clip whose motion the face replayed
        motion_subject: person in that clip
        policy: name of the policy
        arm: experimental arm: what the policy was shown, for example current_pred_h2
        train_seed: seed of the training run; null for a policy that was not trained
        checkpoint: hash of the checkpoint's contents
        versions: of the software
    """

    env: str
    seed: int
    is_success: bool
    is_success_strict: bool
    completion_time: float | None
    time_since_lift: float | None
    steps: int
    failure: str
    closest_distance: float | None
    closest_offset: Offset | None
    cube_offset: Offset | None
    face_force: float
    motion_clip: str
    motion_subject: str
    policy: str = ""
    arm: str = ""
    train_seed: int | None = None
    checkpoint: str = ""
    versions: dict[str, str] = field(default_factory=dict)

    def to_line(self) -> str:
        """Return it as one line of JSON, without the line's end."""
        return json.dumps(asdict(self), allow_nan=False)

    @classmethod
    def from_line(cls, line: str) -> EpisodeResult:
        """Read what ``to_line`` wrote.

        Raises:
            ValueError: it is no such line; the message says what is wrong with it.
        """
        values = json.loads(line)
        if not isinstance(values, dict):
            raise ValueError("it is no JSON object")
        hints = typing.get_type_hints(cls)
        names = [item.name for item in fields(cls)]
        for name in names:
            if name not in values:
                raise ValueError(f"'{name}' is missing")
            if not _fits(values[name], hints[name]):
                raise ValueError(f"'{name}' is {json.dumps(values[name])}")
        if unknown := sorted(set(values) - set(names)):
            raise ValueError(f"'{unknown[0]}' is unknown")
        if values["failure"] and values["failure"] not in FAILURES:
            raise ValueError(f"'failure' is {json.dumps(values['failure'])}")
        for name in ("closest_offset", "cube_offset"):
            if values[name] is not None:
                values[name] = tuple(values[name])
        return cls(**values)


def _fits(value: Any, hint: Any) -> bool:
    """Whether a JSON value is of the declared type."""
    if isinstance(hint, types.UnionType) or typing.get_origin(hint) is typing.Union:
        return any(_fits(value, part) for part in typing.get_args(hint))
    if hint is float:
        return isinstance(value, float | int) and not isinstance(value, bool)
    if hint is int:
        return isinstance(value, int) and not isinstance(value, bool)
    if hint == Offset:
        return isinstance(value, list) and len(value) == 3 and all(_fits(v, float) for v in value)
    if typing.get_origin(hint) is dict:
        return isinstance(value, dict) and all(isinstance(v, str) for v in value.values())
    return isinstance(value, hint)
