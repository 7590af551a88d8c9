"""Actions as a policy predicts them: relative to the mouth, or to the robot's posture.

Environments, demonstrations and action buffers have targets of the joints. A policy can predict
them relative to what it observes when it predicts a chunk: then what is the same wherever the mouth
is, is the same to the network. `ActionEncoding` changes one into the other, there and back.

Legend: ... any leading shape, K actions of a chunk, A elements of an action (7 for each arm: six
joints and the gripper), S elements of the packed observation, F frames of the mouth.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from robo_manip_baselines.observation import FRAME_RATE, ObservationSpec
from robo_manip_baselines.observation.arm import ARM_JOINTS, gripper_position, joints_at
from robo_manip_baselines.runs.errors import RequestError

Floats = NDArray[np.float64]

ARM_LAG: Final = 3.0
"""Frames of 1/30 s by which the arm follows its targets, as measured with the servo
(``docs/results/foresight-cpu``)."""

_SIZE = len(ARM_JOINTS) + 1
_PLACE, _WRIST = slice(0, 3), slice(3, 6)
"""Elements of an arm's action: waist, shoulder and elbow, or the gripper's x, y, z; the wrist."""

ROUND_TRIP: Final = 1e-6
"""rad by which an action may come back otherwise: float32, near the arm's longest reach."""


@dataclass(frozen=True)
class ActionEncoding:
    """Actions less a reference that depends on the observation.

    With ``spec.moves_gripper`` waist, shoulder and elbow are first replaced by the position of the
    gripper that they lead to with the wrist's joints as they are (m, world), and the reference of
    these is the mouth; wrist and gripper stay. With ``is_relative`` the reference of the joints is
    the observed posture; the gripper's target stays.

    Attributes:
        spec: of the observations.
        step: s between two actions of a chunk.
        is_relative: whether actions are relative to the posture.

    Raises:
        RequestError: actions would be relative to both.
    """

    spec: ObservationSpec
    step: float
    is_relative: bool = False

    def __post_init__(self) -> None:
        if self.is_relative and self.spec.moves_gripper:
            raise RequestError(
                f"relative_actions and mouth_frame '{self.spec.mouth_frame}': actions can be "
                "relative to one thing; choose the mouth_frame gripper, or leave one of them out"
            )

    def __bool__(self) -> bool:
        """Return whether actions are encoded at all."""
        return self.is_relative or self.spec.moves_gripper

    def columns(self, action: ArrayLike) -> Floats:
        """Return actions (..., A) before the reference is taken off."""
        columns = np.array(action, np.float64)
        if self.spec.moves_gripper:
            for arm, own in self._arms(columns):
                own[..., _PLACE] = gripper_position(arm, own[..., :-1])
        return columns

    def reference(self, vector: NDArray[np.float32], count: int) -> Floats:
        """Return what is taken off the ``count`` actions of chunks, (..., K, A).

        ``vector`` (..., S) are the packed observations that the chunks are made from.
        """
        lead = vector.shape[:-1]
        reference = np.zeros((*lead, count, _SIZE * len(self.spec.arm_names)))
        if self.is_relative:
            reference[:] = vector[..., None, self.spec.posture_places]
            for _, own in self._arms(reference):
                own[..., -1] = 0.0
        elif self.spec.moves_gripper:
            mouth = self._mouth(self.spec.target_positions(vector), count)
            for _, own in self._arms(reference):
                own[..., _PLACE] = mouth
        return reference

    def encode(self, action: ArrayLike, vector: NDArray[np.float32]) -> Floats:
        """Return chunks (..., K, A) as the policy predicts them from observations (..., S)."""
        columns = self.columns(action)
        return columns - self.reference(vector, columns.shape[-2])

    def decode(self, encoded: ArrayLike, vector: NDArray[np.float32]) -> Floats:
        """Undo `encode`; a gripper out of reach becomes the nearest one in its direction."""
        encoded = np.asarray(encoded, np.float64)
        action = encoded + self.reference(vector, encoded.shape[-2])
        if self.spec.moves_gripper:
            for arm, own in self._arms(action):
                own[..., :-1] = joints_at(arm, own[..., _PLACE], own[..., _WRIST])
        return action

    def require_round_trip(self, action: ArrayLike) -> None:
        """Make sure that actions (..., A) come back from their columns.

        Raises:
            RequestError: an arm is past its longest reach, or reaches behind its waist.
        """
        if not self.spec.moves_gripper:
            return
        action = np.asarray(action, np.float64)
        for arm, own in self._arms(action):
            joints = own[..., :-1]
            again = joints_at(arm, gripper_position(arm, joints), joints[..., _WRIST])
            if np.abs(again - joints).max(initial=0.0) > ROUND_TRIP:
                raise RequestError(
                    f"mouth_frame '{self.spec.mouth_frame}': in these demonstrations the {arm} arm "
                    "is stretched past its longest reach or bent back behind its waist, where the "
                    "gripper's position does not say where the joints are; choose the mouth_frame "
                    "gripper or none"
                )

    def _mouth(self, track: Floats, count: int) -> Floats:
        """Return the mouth (..., K, 3) of each action, from that of frames 0 ... F - 1.

        That of a forecast is the one for when the arm has followed the action, interpolated between
        frames; after the last frame it stays where it is.
        """
        if self.spec.mouth_time == "now":
            return np.broadcast_to(track[..., :1, :], (*track.shape[:-2], count, 3))
        late = self.spec.corruption.delay + ARM_LAG
        frame = np.minimum(np.arange(count) * self.step * FRAME_RATE + late, track.shape[-2] - 1.0)
        before = np.minimum(frame.astype(int), track.shape[-2] - 2)
        share = (frame - before)[:, None]
        return (1.0 - share) * track[..., before, :] + share * track[..., before + 1, :]

    def _arms(self, values: Floats) -> list[tuple[str, Floats]]:
        """Return each arm with a view of its elements."""
        names = self.spec.arm_names
        return [(arm, values[..., i * _SIZE : (i + 1) * _SIZE]) for i, arm in enumerate(names)]
