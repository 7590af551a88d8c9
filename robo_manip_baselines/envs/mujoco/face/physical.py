"""The physical head: a body that strives to follow the recorded motion, and yields.

Its neck is a spring and damper between where the head is and where the recording has it. Muscles
that move an undisturbed head exactly as recorded are added to that, so that nothing but contact
makes the two differ.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

import mujoco
import numpy as np
from numpy.typing import NDArray

from robo_manip_baselines.envs.mujoco.face.model import FaceModel, Floats, Poses, rotate

if TYPE_CHECKING:
    from robo_manip_baselines.envs.mujoco.face.replay import FaceReplay

HEAD_MASS: Final = 4.5
HEAD_INERTIA: Final = 0.02
"""kg, and kg m² about every axis: of an adult (Yoganandan et al. 2009, J Biomech 42:1177, reviews
3 to 6 kg; the round numbers, and that all axes have the same, are choices)."""

HEAD_CENTRE: Final = np.array([-0.03, 0.0, 0.02])
"""m, body frame of the head: centre of mass, a little before and above the ears."""

ROCKING_FREQUENCY: Final = 1.3
AXIAL_FREQUENCY: Final = 8.0
"""Hz, first two natural frequencies of head and neck in people: the head rocks on the neck, and
moves along it (Willinger, Bourdet, Fischer, Le Gall 2005, J Sound Vib 287:405: 1.3 ± 0.1 and
8 ± 0.7 Hz)."""

_LEVER: Final = 0.17
"""m, from the base of the neck to the head's centre of mass; an assumption."""

ROCKING_STIFFNESS: Final = HEAD_MASS * (2.0 * math.pi * ROCKING_FREQUENCY) ** 2
AXIAL_STIFFNESS: Final = HEAD_MASS * (2.0 * math.pi * AXIAL_FREQUENCY) ** 2
TURNING_STIFFNESS: Final = (HEAD_INERTIA + HEAD_MASS * _LEVER**2) * (
    2.0 * math.pi * ROCKING_FREQUENCY
) ** 2
"""N/m horizontally, N/m vertically, and N m/rad about every axis, of the neck: what the frequencies
make of the masses."""

JAW_INERTIA: Final = 1e-3
JAW_STIFFNESS: Final = 8.0
"""kg m² and N m/rad about its hinge: 1000 N/m at the front teeth, an assumption."""

DAMPING_RATIO: Final = 0.5
"""Of the critical damping of neck and jaw; an assumption between a passive neck, which swings,
and a tense one."""

_LIGHT: Final = 1e-4
"""kg of the jaw's own body: its inertia is in its hinge, so that opening it does not push the
head."""


def add_head(spec: mujoco.MjSpec, model: FaceModel, rest: Poses) -> dict[str, mujoco.MjsBody]:
    """Add a free head with a hinged jaw; return the bodies ``head`` and ``jaw``.

    ``face/head`` is the frame of the drawn head, on ``face/neck``, which moves and has the mass.
    """
    at, turn = rest["face/head"]
    neck = spec.worldbody.add_body(
        name="face/neck",
        pos=(at + rotate(turn, HEAD_CENTRE)).tolist(),
        quat=turn.tolist(),
        mass=HEAD_MASS,
        ipos=(0, 0, 0),
        inertia=(HEAD_INERTIA,) * 3,
        explicitinertial=True,
        gravcomp=1.0,  # people hold their heads up
    )
    neck.add_freejoint(name="face/neck")
    head = neck.add_body(name="face/head", pos=(-HEAD_CENTRE).tolist())
    jaw = head.add_body(
        name="face/jaw",
        pos=model.hinge.tolist(),
        mass=_LIGHT,
        ipos=(0, 0, 0),
        inertia=(_LIGHT * 1e-3,) * 3,
        explicitinertial=True,
        gravcomp=1.0,
    )
    jaw.add_joint(name="face/jaw", axis=(0, 1, 0), armature=JAW_INERTIA)
    return {"head": head, "jaw": jaw}


class CompliantHead:
    """Drives the physical head of a model towards a recorded motion.

    Args:
        model: with a physical face.
        face: its shape.
    """

    def __init__(self, model: mujoco.MjModel, face: FaceModel) -> None:
        neck, jaw = model.joint("face/neck"), model.joint("face/jaw")
        self._qpos, self._dof = int(neck.qposadr[0]), int(neck.dofadr[0])
        self._jaw_qpos, self._jaw_dof = int(jaw.qposadr[0]), int(jaw.dofadr[0])
        self._mouth = int(model.body("face/mouth").mocapid[0])
        self._lip_lever, self._dt = face.lip_lever, float(model.opt.timestep)
        self._stiffness = np.array(
            [ROCKING_STIFFNESS, ROCKING_STIFFNESS, AXIAL_STIFFNESS, *(TURNING_STIFFNESS,) * 3]
        )
        self._inertia = np.array([HEAD_MASS] * 3 + [HEAD_INERTIA] * 3)
        self._damping = 2.0 * DAMPING_RATIO * np.sqrt(self._stiffness * self._inertia)
        self._jaw_damping = 2.0 * DAMPING_RATIO * math.sqrt(JAW_STIFFNESS * JAW_INERTIA)

    def reset(self, data: mujoco.MjData, replay: FaceReplay) -> None:
        """Put the head where a recording starts, at rest."""
        position, orientation = replay.bodies["face/head"]
        self._position = position + rotate(orientation, HEAD_CENTRE)
        self._orientation = np.ascontiguousarray(orientation)
        self._angle = replay.jaw_angle
        self._row = 0
        self._velocity, self._jaw_velocity = np.zeros(6), 0.0
        start = self._qpos
        data.qpos[start : start + 3] = self._position[0]
        data.qpos[start + 3 : start + 7] = self._orientation[0]
        data.qpos[self._jaw_qpos] = self._angle[0]
        self.place_mouth(data)

    def drive(self, data: mujoco.MjData, row: int) -> None:
        """Apply forces for a physics step, at whose end the recording is at ``row``.

        With v the recorded velocity and e the distance from the recording: m dv/dt + k e + d de/dt.
        """
        start, dof, dt, before = self._qpos, self._dof, self._dt, self._row
        velocity = np.zeros(6)
        if row != before:
            velocity[:3] = (self._position[row] - self._position[before]) / dt
            turn = velocity[3:]
            mujoco.mju_subQuat(turn, self._orientation[row], self._orientation[before])
            turn /= dt
        error = np.empty(6)
        error[:3] = self._position[before] - data.qpos[start : start + 3]
        here = data.qpos[start + 3 : start + 7]
        mujoco.mju_subQuat(error[3:], self._orientation[before], here)
        data.qfrc_applied[dof : dof + 6] = (
            self._inertia * (velocity - self._velocity) / dt
            + self._stiffness * error
            + self._damping * (self._velocity - data.qvel[dof : dof + 6])
        )
        opening = (self._angle[row] - self._angle[before]) / dt
        data.qfrc_applied[self._jaw_dof] = (
            JAW_INERTIA * (opening - self._jaw_velocity) / dt
            + JAW_STIFFNESS * (self._angle[before] - data.qpos[self._jaw_qpos])
            + self._jaw_damping * (self._jaw_velocity - data.qvel[self._jaw_dof])
        )
        self._row, self._velocity, self._jaw_velocity = row, velocity, float(opening)

    def jaw_angle(self, data: mujoco.MjData) -> float:
        """Return the angle of the jaw, rad."""
        return float(data.qpos[self._jaw_qpos])

    def orientation(self, data: mujoco.MjData) -> Floats:
        """Return the orientation of the head, (4,) wxyz, world from body."""
        return data.qpos[self._qpos + 3 : self._qpos + 7].copy()

    def point(self, data: mujoco.MjData, point: NDArray[np.float64]) -> Floats:
        """Return a point (3,) m of the frame of ``face/head`` in the world."""
        found, start = np.empty(3), self._qpos
        mujoco.mju_rotVecQuat(found, point - HEAD_CENTRE, data.qpos[start + 3 : start + 7])
        return found + data.qpos[start : start + 3]

    def place_mouth(self, data: mujoco.MjData) -> None:
        """Put the body ``face/mouth``, which nothing touches, between the lips."""
        still, (x, y, z) = self._lip_lever
        angle = self.jaw_angle(data)
        cos, sin = math.cos(angle), math.sin(angle)
        lips = still + np.array([cos * x + sin * z, y, cos * z - sin * x])
        data.mocap_pos[self._mouth] = self.point(data, lips)
        data.mocap_quat[self._mouth] = data.qpos[self._qpos + 3 : self._qpos + 7]
