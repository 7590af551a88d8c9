"""State of the simulator before corruption, and the observed target.

Legend: ... any leading shape (none in an environment, (T,) for an episode, (B, T) for a batch),
A arms, O objects of the task, K frames from now to the longest known horizon, H frames of a
forecast. Environments and new episode files have K = `MAX_HORIZON` + 1, older files K = 6.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

FRAME_RATE = 30.0
"""Hz of the video in which the detector looks for the face (paper, section IV.A)."""

FRAME_PERIOD = 1.0 / FRAME_RATE
"""s between two frames of the recorded motion and of the prediction (paper, section IV.A)."""

MAX_HORIZON = 24
"""Frames of the longest horizon, 0.8 s: room for a delay, the arm's lag and the age of a plan. The
predictor of the paper looks 5 frames ahead (section IV.A)."""


@dataclass(frozen=True)
class State:
    """State of the simulator before corruption. SI units, world frame.

    The target is the tracked point on the face that a task is about, such as the mouth.

    Attributes:
        time: (...) s since the start of the episode.
        joint_position: (..., A, 6) rad.
        joint_velocity: (..., A, 6) rad/s.
        gripper_position: (..., A) m, position of a finger.
        gripper_velocity: (..., A) m/s.
        end_effector_position: (..., 3) m, gripper site of the right arm.
        target_position: (..., K, 3) m, now and 1 ... K - 1 frames ahead.
        object_position: (..., O, 3) m, centres of the task's objects.
        predicted_target: (..., H, 3) m, target 1 ... H frames ahead as forecast by the forecaster
            whose output is observed, or else by a trained predictor; None where the recorded motion
            holds none.
    """

    time: Floats
    joint_position: Floats
    joint_velocity: Floats
    gripper_position: Floats
    gripper_velocity: Floats
    end_effector_position: Floats
    target_position: Floats
    object_position: Floats
    predicted_target: Floats | None = None


@dataclass(frozen=True)
class TargetObservation:
    """Target as the detector reports it. SI units, world frame.

    Attributes:
        time: (...) s since the start of the episode at which it was seen.
        position: (..., K, 3) m, at that time and 1 ... K - 1 frames after it.
        past: (..., P, 3) m, as it was reported 1 ... P frames ago; None where nobody asks for it.
    """

    time: Floats
    position: Floats
    past: Floats | None = None

    def at(self, time: float) -> Floats:
        """Return the target, (3,) m, as it is expected at ``time`` s, of one observation.

        Between two frames on the straight line; after the last one, there.
        """
        last = len(self.position) - 1
        frame = min(max((time - float(self.time)) * FRAME_RATE, 0.0), float(last))
        before = min(int(frame), max(last - 1, 0))
        part = frame - before
        after = min(before + 1, last)
        return (1.0 - part) * self.position[before] + part * self.position[after]
