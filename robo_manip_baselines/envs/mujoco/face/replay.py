"""Replay of a recorded motion: the mouth at every instant of an episode, now and ahead.

Legend: P physics steps, T control steps, K frames from now to the longest horizon, H frames of a
forecast.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from robo_manip_baselines.envs.mujoco.face import REST_OPENING, FaceModel
from robo_manip_baselines.envs.mujoco.face.motion import SEGMENT_DURATION, MotionSegment
from robo_manip_baselines.observation import FRAME_PERIOD, MAX_HORIZON

FACE_MOTIONS = ("episode", "after_lift")
"""Start of the recorded motion: with the episode (paper, section IV.C), or when the cube has
been lifted (paper, Algorithm 1, line 12)."""

FRAMES_AHEAD = np.arange(MAX_HORIZON + 1) * FRAME_PERIOD
"""s ahead at which the true mouth is known, (K,): now and at 1 ... 24 frames of 1/30 s."""


@dataclass(frozen=True)
class FaceReplay:
    """A segment of recorded motion laid out on the clocks of the simulation, from its start.

    Attributes:
        bodies: for each mocap body, positions (P, 3) m and orientations (P, 4) wxyz, world.
        mouth: (T, K, 3) m, world: the mouth now and at ``FRAMES_AHEAD``.
        predicted: (T, H, 3) m, world: the mouth 1 ... H frames ahead, as a trained predictor
            forecast it; None if the recorded motion came without. Exact at video frames;
            between them the predictor's last error is held.
        jaw: (T,) m between the inner lips.
        jaw_angle: (P,) rad, of the jaw about its hinge.
        opening: (T, 2) m, half width and half height of the mouth's opening.
    """

    bodies: dict[str, tuple[NDArray[np.float64], NDArray[np.float64]]]
    mouth: NDArray[np.float64]
    jaw: NDArray[np.float64]
    jaw_angle: NDArray[np.float64]
    opening: NDArray[np.float64]
    predicted: NDArray[np.float64] | None = None

    @classmethod
    def lay_out(
        cls,
        segment: MotionSegment,
        start_position: NDArray[np.float64],
        face: FaceModel,
        *,
        timestep: float,
        substeps: int,
    ) -> FaceReplay:
        """Interpolate `SEGMENT_DURATION` onto the physics clock; the face stands still afterwards.

        Args:
            segment: recorded motion, relative to its start.
            start_position: (3,) m, world: the mouth at the start of the segment.
            face: places the bodies of the face around the mouth.
            timestep: s of physics.
            substeps: physics steps in a control step.
        """
        physics = np.arange(round(SEGMENT_DURATION / timestep) + 1) * timestep
        displacement, orientation, recorded_jaw = segment.at(physics)
        ahead = segment.displacement_at(physics[::substeps, None] + FRAMES_AHEAD)
        error = segment.prediction_error(physics[::substeps])
        predicted = None
        if error is not None:
            predicted = start_position + ahead[:, 1 : error.shape[1] + 1] + error
        jaw = recorded_jaw + REST_OPENING
        return cls(
            bodies=face.body_poses(start_position + displacement, orientation, jaw),
            mouth=start_position + ahead,
            jaw=jaw[::substeps],
            jaw_angle=face.jaw_angle(jaw),
            opening=np.stack(face.opening(jaw[::substeps]), axis=-1),
            predicted=predicted,
        )
