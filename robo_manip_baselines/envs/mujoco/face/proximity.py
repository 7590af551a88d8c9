"""Distances of the robot, and of what it carries, from the face and from its eyes.

Cheap where nothing is near: spheres around the geoms are compared with one around the whole face,
then with those of its geoms, and only what may be nearest is measured.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, NamedTuple

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

_ONES: Final = np.ones(3)


class Proximity(NamedTuple):
    """Nearness of the robot at the end of a control step.

    Attributes:
        hand: m between the face and a gripper; None beyond `RANGE`; 0 where they touch or overlap.
        load: m between the face and what a gripper carries, likewise; None without a load.
        eye: m between an eyeball and any part of the robot or what it carries, likewise.
        grippers: (2, 3) m, world: the sites ``left/gripper`` and ``right/gripper``.
        mouth: (3,) m, world.
    """

    hand: float | None
    load: float | None
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
        is_arm = np.array([kind in (ARM, GRIPPER) for kind in kinds])
        is_object = np.array([kind in objects for kind in kinds])
        moves = model.body_weldid[model.geom_bodyid] != 0
        self._parts = np.flatnonzero(touchable & ~is_face & moves & (is_arm | is_object))
        # A tool that hangs on an arm is carried always; what lies free, while a gripper touches it.
        arms = {int(model.body(f"{arm}/base_link").id) for arm in ARM_BASES}
        root = model.body_rootid[model.geom_bodyid[self._parts]].tolist()
        self._free = [
            kinds[geom] if is_object[geom] and body not in arms else ""
            for geom, body in zip(self._parts.tolist(), root, strict=True)
        ]
        places = {ARM: None, GRIPPER: 0}
        self._place = [places.get(kinds[geom], 1) for geom in self._parts.tolist()]
        self._kinds = [*kinds, OTHER]
        surface = [
            geom
            for geom, name in enumerate(names)
            if is_face[geom] and touchable[geom] and region_of(name) in _OUTSIDE
        ]
        eyes = [model.geom(f"face/eye_{side}").id for side in ("left", "right")]
        self._face = np.array([*surface, *eyes])
        self._surface = len(surface)
        self._reach = model.geom_rbound[self._parts][:, None] + model.geom_rbound[self._face]
        self._limit = (self._reach + RANGE) ** 2
        is_link = np.array([place is None for place in self._place])
        self._limit[is_link, : self._surface] = 0.0  # links of an arm count for the eyes alone
        self._head = model.body("face/head").id
        around_face = _radius(model, self._head, self._face)
        self._around = (model.geom_rbound[self._parts] + around_face + RANGE) ** 2
        sites = [f"{arm}/gripper" for arm in ("left", "right")] + ["mouth"]
        self._sites = np.array([model.site(site).id for site in sites])

    def measure(
        self, model: mujoco.MjModel, data: mujoco.MjData, pairs: Sequence[Sequence[int]]
    ) -> Proximity:
        """Return the present distances, given the pairs of geoms that touch."""
        places = data.geom_xpos.take(self._parts, axis=0)
        nearest = [RANGE] * 3  # in the order of `Proximity`
        way = places - data.xpos[self._head]
        if ((way * way) @ _ONES < self._around).any():
            self._find_nearest(model, data, places, pairs, nearest)
        hand, load, eye = (distance if distance < RANGE else None for distance in nearest)
        sites = data.site_xpos.take(self._sites, axis=0)
        return Proximity(hand, load, eye, sites[:2], sites[2])

    def _find_nearest(
        self,
        model: mujoco.MjModel,
        data: mujoco.MjData,
        places: NDArray[np.float64],
        pairs: Sequence[Sequence[int]],
        nearest: list[float],
    ) -> None:
        """Lower ``nearest``, hand, load and eye, to the distances of parts at ``places``."""
        offset = places[:, None] - data.geom_xpos.take(self._face, axis=0)
        square = np.einsum("ijk,ijk->ij", offset, offset)
        near = np.flatnonzero(square < self._limit)
        if len(near):
            # The nearest centres first; then spheres around the geoms rule most others out.
            centres = np.sqrt(square.take(near))
            order = np.argsort(centres)
            bound = centres - self._reach.take(near)
            carried = self._carried(pairs)
            for pair, least in zip(near[order].tolist(), bound[order].tolist(), strict=True):
                part, other = divmod(pair, len(self._face))
                place = 2 if other >= self._surface else self._place[part]
                free = self._free[part]
                if place is None or (free and free not in carried):
                    continue
                if least < (best := nearest[place]):
                    geoms = int(self._parts[part]), int(self._face[other])
                    distance = mujoco.mj_geomDistance(model, data, *geoms, best, None)
                    nearest[place] = min(best, max(distance, 0.0))

    def _carried(self, pairs: Sequence[Sequence[int]]) -> set[str]:
        """Return the kinds of things that touch a gripper."""
        kinds = ((self._kinds[first], self._kinds[second]) for first, second in pairs)
        return {kind for pair in kinds if GRIPPER in pair for kind in pair}


def _radius(model: mujoco.MjModel, head: int, geoms: NDArray[np.intp]) -> float:
    """Return m, of a sphere about a head that holds its geoms, however its jaw turns.

    The origins of bodies, the jaw's hinge among them, keep their distance from that of the head.
    """
    bodies = model.geom_bodyid[geoms]
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    hinge = np.linalg.norm(data.xpos[bodies] - data.xpos[head], axis=1)
    radius = hinge + np.linalg.norm(model.geom_pos[geoms], axis=1) + model.geom_rbound[geoms]
    return float(radius.max()) + 1e-6  # for rounding, and welds that give way by less
