"""FaceWipingEnv: wipe residue off the cheek of a person who moves."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from robo_manip_baselines.envs.mujoco.cell.vx300s import HOME_QPOS
from robo_manip_baselines.envs.mujoco.tasks.face_env import FaceEnv
from robo_manip_baselines.envs.mujoco.tasks.wiping import ENTRY
from robo_manip_baselines.envs.mujoco.tasks.wiping.model import (
    HANDLE_FINGER,
    SPOTS,
    Cheek,
    ResidueSites,
    add_cheek,
    add_pad,
)
from robo_manip_baselines.envs.mujoco.tasks.wiping.success import (
    Phase,
    StepMeasurements,
    WipingProgress,
    is_on_eye,
    reached_spots,
)

Floats = NDArray[np.float64]


class FaceWipingEnv(FaceEnv):
    """Wipe residue off the right cheek of a head that moves as a person moved.

    Units are SI; the world frame is x right, y forward, z up with the table's top at z = 0;
    quaternions are wxyz. Control is at 50 Hz.

    The right gripper holds a soft pad on a handle from the start; the handle is fixed to it, and
    the fingers have no part in the task.

    ## Action space

    That of `FeedingEnv`: ``Box(7,)`` float32, or ``Box(14,)`` with ``arms="both"``: targets of the
    position servos.

    ## Observation space

    That of `FeedingEnv`, without ``object_position``: ``state``, and ``mouth``, ``history`` or
    ``prediction`` of the mouth, whatever ``obs`` asks for, and ``images/<camera>``, which show the
    residue. Forces are not observed, nor which spots are left.

    ## Residue

    36 spots on a square inch of the right cheek, its middle 0.036 m beside and 0.036 m above the
    mouth: one in each cell of a grid of 6 by 6. A spot is wiped off by a control step in which the
    pad touches the face less than 0.010 m from it with a normal force of 1 to 3 N, the mean of the
    physics steps. It then disappears from images. Spots have no part in the physics.

    ## Reward

    The share of the residue that the step has wiped off; 1 in all.

    ## Starting state

    The right arm at home, the fingers on the handle, the left arm folded. Drawn from
    ``reset(seed=...)``:

    - the place of each spot in its cell;
    - the mouth, (0, 0.5, 0.35) plus a uniform offset of +-0.05 along each axis, and the motion, as
      `FeedingEnv` draws them. With ``face_motion="after_lift"`` the motion starts with the first
      contact of the pad.

    ## Info

    | key | type | content |
    |---|---|---|
    | ``is_success`` | bool | at least 80 % of the spots are wiped off |
    | ``is_success_strict`` | bool | ``is_success``, and so far the force was 1 to 3 N in at least
    70 % of the time in contact and never more than 10 N, and the robot has not touched an eye
    (0.020 m around the middle of the lids) |
    | ``completion_time`` | float or None | s from the start to ``is_success``; None before |
    | ``phase`` | str | approach, wipe (from the first contact) or finish (after ``is_success``) |
    | ``wiped_share`` | float | share of the spots that are wiped off |
    | ``pad_force`` | float | N, the normal force between pad and face, mean of the step |
    | ``face_force`` | float | N, the largest normal force between the robot and the face in the
    step |

    ## Episode end

    Terminates when the pad has withdrawn by 0.08 m from the middle of the residue after
    ``is_success``. Truncated after 600 steps (12 s).

    ## Arguments

    Those of `FeedingEnv`, without ``object_pose`` and ``utensil``.

    ## Version history

    - v0: first release.
    """

    task = ENTRY
    phase_names = tuple(phase.name.lower() for phase in Phase)

    def __init__(self, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        model = self.model
        self.cheek = Cheek.load()
        self._middle = self.cheek.at((0.0, 0.0))[0]
        self._sites = ResidueSites(model)
        self._head = model.body("face/head").id
        self._pad_geom = model.geom("wiping/pad").id
        self._wrench = np.zeros(6)

    def add_objects(self, scene: mujoco.MjSpec) -> None:
        """Add the cheek that can be touched, the residue and the pad."""
        add_cheek(scene)
        add_pad(scene)

    def reset_task(self, rng: np.random.Generator) -> None:
        """Put residue on the cheek, and the fingers on the handle."""
        self.progress = WipingProgress(spots=SPOTS)
        self._clear_contacts()
        self._set_arm("right", HOME_QPOS, HANDLE_FINGER)
        self.spots, normals = self.cheek.draw_spots(rng)
        self._sites.place(self.model, self.spots, normals)

    # -- geometry -------------------------------------------------------------------------------

    @property
    def pad_position(self) -> Floats:
        """(3,) m, world: centre of the pad."""
        return self.data.geom_xpos[self._pad_geom].copy()

    def head_pose(self, ahead: float = 0.0) -> tuple[Floats, Floats]:
        """Position (3,) m and orientation (4,) wxyz of ``face/head`` in the world, ``ahead`` s on.

        After the end of the recording the head stands still.
        """
        position, orientation = self.replay.bodies["face/head"]
        step = self._row() * self.substeps + round(ahead / self.model.opt.timestep)
        row = min(step, len(position) - 1)
        return position[row], orientation[row]

    def _from_head(self, point: Floats) -> Floats:
        """Return a point (3,) m of the world in the frame of ``face/head``."""
        data = self.data
        return (point - data.xpos[self._head]) @ data.xmat[self._head].reshape(3, 3)

    # -- contact --------------------------------------------------------------------------------

    @property
    def pad_force(self) -> float:
        """N, normal force between pad and face, the mean of the last step."""
        return self._pad_force / self.substeps

    def simulate(self, action: NDArray[np.float32]) -> None:
        """Apply an action for one control period, measuring contacts afresh."""
        self._clear_contacts()
        super().simulate(action)

    def watch_contacts(self) -> None:
        """Add up force and place of the contacts of the pad, and see to the eyes."""
        for number, pair in enumerate(self.touch.pairs):
            if self._face_geoms.isdisjoint(pair):
                continue
            mujoco.mj_contactForce(self.model, self.data, number, self._wrench)
            force, place = float(self._wrench[0]), self._from_head(self.data.contact.pos[number])
            self._face_force = max(self._face_force, force)
            self._on_eye = self._on_eye or is_on_eye(place, self.cheek.eyes)
            if self._pad_geom in pair:
                self._pad_force += force
                self._moment += force * place

    def _clear_contacts(self) -> None:
        self._pad_force = self._face_force = 0.0
        self._on_eye = False
        self._moment = np.zeros(3)

    # -- task -----------------------------------------------------------------------------------

    def advance(self) -> tuple[float, bool]:
        """Evaluate the task after a control step; return reward and whether it has ended."""
        before = self.progress
        self.progress = now = before.advance(self._measure())
        if now.contact_steps:
            self.start_motion()
        if new := now.wiped - before.wiped:
            self._sites.hide(self.model, new)
        return len(new) / SPOTS, now.is_clear

    def _measure(self) -> StepMeasurements:
        contact = self._moment / self._pad_force if self._pad_force > 0.0 else None
        return StepMeasurements(
            time=self.time,
            pad_force=self.pad_force,
            face_force=self._face_force,
            reached=reached_spots(self.spots, contact, self.pad_force),
            touches_eye=self._on_eye,
            pad_distance=float(np.linalg.norm(self._from_head(self.pad_position) - self._middle)),
        )

    def info(self) -> dict[str, Any]:
        """Return what the class docstring lists under Info."""
        progress = self.progress
        return {
            "is_success": progress.is_success,
            "is_success_strict": progress.is_success_strict,
            "completion_time": progress.success_time,
            "phase": progress.phase.name.lower(),
            "wiped_share": progress.wiped_share,
            "pad_force": self.pad_force,
            "face_force": self._face_force,
        }

    def task_row(self) -> dict[str, Any]:
        """Return the present values of the fields that the task adds to episode files."""
        residue = np.ones(SPOTS, np.int8)
        residue[list(self.progress.wiped)] = 0
        return {"pad_force": self.pad_force, "residue": residue}

    def show_row(self, row: Mapping[str, NDArray[Any]]) -> None:
        """Show the spots that were left."""
        self._sites.show(self.model, row["residue"])
