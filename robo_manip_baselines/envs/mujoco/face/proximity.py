"""Distances of the robot, and of what it carries, from the face and from its eyes.

Cheap where nothing is near: a sphere around each geom is compared with one around the head, and
only what may be nearest is measured.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final, NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from robo_manip_baselines.envs.mujoco.cell.scene import ARM_BASES
from robo_manip_baselines.envs.mujoco.face.contact import (
    ARM,
    GRIPPER,
    OTHER,
    region_of,
    toucher_of,
)

RANGE: Final = 0.06
"""m from the face, or from an eye, up to which distances are measured."""

_OUTSIDE: Final = ("forehead", "eyes", "nose", "cheeks", "lips", "chin", "head")
"""Regions whose geoms are the surface of the face."""

_HEAD_RADIUS: Final = 0.17
"""m from the origin of ``face/head`` within which all of them lie."""


class Proximity(NamedTuple):
    """Nearness of the robot at the end of a control step.

    Attributes:
        face: m between the face and a gripper or what it carries; None beyond `RANGE`; 0 where they
            touch or overlap.
        eye: m between an eyeball and any part of the robot or what it carries, likewise.
        grippers: (2, 3) m, world: the sites ``left/gripper`` and ``right/gripper``.
        mouth: (3,) m, world.
    """

    face: float | None
    eye: float | None
    grippers: NDArray[np.float64]
    mouth: NDArray[np.float64]


class FaceProximity:
    """Measures `Proximity`.

    Args:
        model: compiled.
        objects: names of the task's objects, as `FaceTouch` takes them.
    """

    def __init__(self, model: mujoco.MjModel, objects: Sequence[str]) -> None:
        names = [model.geom(geom).name for geom in range(model.ngeom)]
        touchable = (model.geom_contype | model.geom_conaffinity) != 0
        is_face = np.array([name.startswith("face/") for name in names])
        kinds = [toucher_of(model, geom, objects) for geom in range(model.ngeom)]
        on_world = model.body_weldid[model.geom_bodyid] == 0
        is_arm = np.array([kind in (ARM, GRIPPER) for kind in kinds])
        is_object = np.array([kind in objects for kind in kinds])
        parts = touchable & ~is_face & ((is_arm & ~on_world) | is_object)
        self._parts = np.flatnonzero(parts)
        self._kind = [kinds[geom] for geom in self._parts]
        # A tool that hangs on an arm is carried always; what lies free, while a gripper touches it.
        arms = {int(model.body(f"{arm}/base_link").id) for arm in ARM_BASES}
        root = model.body_rootid[model.geom_bodyid[self._parts]]
        self._is_free = [
            kind in objects and int(r) not in arms for kind, r in zip(self._kind, root, strict=True)
        ]
        self._reach = model.geom_rbound[self._parts]
        self._kinds = [*kinds, OTHER]
        surface = [
            geom
            for geom, name in enumerate(names)
            if is_face[geom] and touchable[geom] and region_of(name) in _OUTSIDE
        ]
        self._face = np.array(surface)
        self._eyes = np.array([model.geom(f"face/eye_{side}").id for side in ("left", "right")])
        self._head = model.body("face/head").id
        self._sites = [model.site(f"{arm}/gripper").id for arm in ("left", "right")]
        self._mouth = model.site("mouth").id

    def measure(
        self, model: mujoco.MjModel, data: mujoco.MjData, pairs: Sequence[Sequence[int]]
    ) -> Proximity:
        """Return the present distances, given the pairs of geoms that touch."""
        offset = data.geom_xpos[self._parts] - data.xpos[self._head]
        gap = np.sqrt(np.einsum("ij,ij->i", offset, offset)) - self._reach
        near = np.flatnonzero(gap < _HEAD_RADIUS + RANGE).tolist()
        face = eye = None
        if near:
            carried = self._carried(pairs)
            near = [n for n in near if not self._is_free[n] or self._kind[n] in carried]
            hands = [int(self._parts[n]) for n in near if self._kind[n] != ARM]
            face = _nearest(model, data, hands, self._face)
            eye = _nearest(model, data, [int(self._parts[n]) for n in near], self._eyes)
        grippers, mouth = data.site_xpos[self._sites], data.site_xpos[self._mouth].copy()
        return Proximity(face, eye, grippers, mouth)

    def _carried(self, pairs: Sequence[Sequence[int]]) -> set[str]:
        """Return the kinds of things that touch a gripper."""
        kinds = ((self._kinds[first], self._kinds[second]) for first, second in pairs)
        return {kind for pair in kinds if GRIPPER in pair for kind in pair}


def _nearest(
    model: mujoco.MjModel, data: mujoco.MjData, ours: Sequence[int], theirs: NDArray[Any]
) -> float | None:
    """Return the distance between two sets of geoms, m; None beyond `RANGE`, 0 for an overlap."""
    if not ours:
        return None
    offset = data.geom_xpos[ours][:, None] - data.geom_xpos[theirs]
    bound = np.sqrt(np.einsum("ijk,ijk->ij", offset, offset))
    bound -= model.geom_rbound[ours][:, None] + model.geom_rbound[theirs]
    best = RANGE
    for pair in np.argsort(bound, axis=None).tolist():
        one, other = divmod(pair, len(theirs))
        if bound[one, other] >= best:
            break
        distance = mujoco.mj_geomDistance(model, data, ours[one], int(theirs[other]), best, None)
        best = min(best, distance)
        if best <= 0.0:
            return 0.0
    return best if best < RANGE else None
