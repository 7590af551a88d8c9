"""The mouth as the camera ``front_close`` sees it: images, a tracker, reports that come late.

Camera frame: x right in the image, y up, the camera looks along -z; metres.
"""

from __future__ import annotations

import time as clock
from dataclasses import dataclass
from typing import NoReturn

import mujoco
import numpy as np
from numpy.typing import NDArray

from robo_manip_baselines.envs.mujoco.cell.rendering import CameraRenderer
from robo_manip_baselines.envs.mujoco.cell.scene import MOUTH_BASE, TIMESTEP
from robo_manip_baselines.envs.mujoco.face.perception import OpenTracker, find_tracker
from robo_manip_baselines.observation import (
    FRAME_PERIOD,
    FRAME_RATE,
    MAX_HORIZON,
    TargetObservation,
)
from robo_manip_baselines.observation.spec import CameraLatency
from robo_manip_baselines.runs.errors import RequestError

Floats = NDArray[np.float64]

CAMERA = "front_close"
"""Camera that looks at the face, as in the paper (section IV.C)."""

IMAGE_SIZE = (480, 640)
"""Height and width of its images in pixels (paper, section IV.C)."""

_TIME_ROUNDING = 1e-7
"""s by which times that are meant to be the same may differ."""


@dataclass(frozen=True)
class Report:
    """Result of one image.

    Attributes:
        arrival: s since the start of the episode from which on it is known.
        time: s, of the image.
        position: (K, 3) m, world: the mouth then and 1 ... K - 1 frames after it.
    """

    arrival: float
    time: float
    position: Floats


class CameraMouth:
    """Takes images 30 times a second, and reports where the mouth is seen and forecast.

    Images are taken at the physics step nearest to each thirtieth of a second, whatever the control
    period. A report arrives the latency after its image, but the first one is waited for. While the
    face is not found, the last report stays; before it was ever found, the mouth is reported where
    a head is placed, `MOUTH_BASE`.

    Args:
        model: of the cell with a face.
        latency: frames of 1/30 s from an image to its report, or ``"measured"``: the time that the
            tracker took on this machine, which differs from run to run.
        has_depth: whether the camera measures depth, too.
        open_tracker: see `find_tracker`.

    Attributes:
        frames: images of this episode so far.
        frames_without_face: those in which no face was found.
        seconds: that the tracker took for the last image.

    Raises:
        RequestError: the tracker cannot be opened.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        latency: CameraLatency,
        *,
        has_depth: bool = False,
        open_tracker: OpenTracker | None = None,
    ) -> None:
        opened = open_tracker or find_tracker()
        self._camera = model.camera(CAMERA).id
        self._tracker = opened(float(model.cam_fovy[self._camera]), MAX_HORIZON)
        self._renderer = CameraRenderer(model, *IMAGE_SIZE)
        self._latency, self._has_depth = latency, has_depth
        self._reports: list[Report] = []
        self.frames = self.frames_without_face = 0
        self.seconds = 0.0

    def reset(self, data: mujoco.MjData) -> None:
        """Start an episode with an image of its first state, and wait for the report."""
        self._tracker.reset()
        self.frames = self.frames_without_face = 0
        nowhere = np.tile(np.array(MOUTH_BASE), (MAX_HORIZON + 1, 1))
        self._reports = [Report(0.0, 0.0, nowhere)]
        self._take(data, 0.0, is_first=True)

    def watch(self, data: mujoco.MjData, physics_step: int) -> None:
        """Take an image if it is time for one.

        Args:
            data: after so many physics steps of the episode; its poses are computed again.
            physics_step: counted from 1.
        """
        time = physics_step * TIMESTEP
        if abs(time - self.frames * FRAME_PERIOD) > TIMESTEP / 2:
            return
        # After a step, bodies and cameras are still where they were before its integration.
        mujoco.mj_kinematics(self._renderer.model, data)
        mujoco.mj_camlight(self._renderer.model, data)
        self._take(data, time)

    def observe(self, time: float) -> TargetObservation:
        """Return the newest report that is known at ``time`` s."""
        report = self._known_at(time)
        return TargetObservation(np.asarray(report.time), report.position)

    def past(self, time: float, frames: int) -> Floats:
        """Return the mouth as it was reported 1 ... ``frames`` frames before ``time`` s, (P, 3)."""
        moments = time - np.arange(1, frames + 1) * FRAME_PERIOD
        reports = [self._known_at(moment).position[0] for moment in moments.tolist()]
        return np.array(reports).reshape(frames, 3)

    def close(self) -> None:
        """Free the detector and the OpenGL context."""
        self._tracker.close()
        self._renderer.close()

    def __getstate__(self) -> NoReturn:
        raise RequestError(
            "an environment whose mouth comes from a camera cannot be copied: its tracker's state "
            "is in native memory; make another one"
        )

    def _known_at(self, time: float) -> Report:
        """Return the newest report that has arrived; before the first, that one."""
        late = time + _TIME_ROUNDING
        known = (report for report in reversed(self._reports) if report.arrival <= late)
        return next(known, self._reports[0])

    def _take(self, data: mujoco.MjData, time: float, *, is_first: bool = False) -> None:
        """Take an image, and let the tracker have it."""
        image = self._renderer.render(data, [CAMERA])[CAMERA]
        depth = self._renderer.render_depth(data, CAMERA) if self._has_depth else None
        begun = clock.perf_counter()
        found = self._tracker.update(image, time, depth)
        self.seconds = clock.perf_counter() - begun
        self.frames += 1
        if found is None:
            self.frames_without_face += 1
            return
        turn = data.cam_xmat[self._camera].reshape(3, 3)
        position = found @ turn.T + data.cam_xpos[self._camera]
        taken = self.seconds if isinstance(self._latency, str) else self._latency / FRAME_RATE
        if is_first:
            self._reports.clear()
            taken = 0.0
        self._reports.append(Report(time + taken, time, position))
