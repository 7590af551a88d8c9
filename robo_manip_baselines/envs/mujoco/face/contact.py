"""Contacts of the face: region by region, how hard it was touched, and by what.

A *region* is a part of the face, whatever geoms it has; a *toucher* is a part of the robot or an
object of the task. Normal forces count, of all contact points of a region with one toucher
together.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final, NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from robo_manip_baselines.envs.mujoco.cell.scene import ARM_BASES, FACE

REGIONS: Final = (
    "forehead",
    "eyes",
    "nose",
    "cheeks",
    "lips",
    "chin",
    "tongue",
    "teeth",
    "mouth",
    "head",
    "neck",
)
"""``mouth``: its other walls inside; ``head``: the sides and the back; ``neck``: with the bust."""

_EATING: Final = ("lips", "tongue", "teeth", "mouth")
"""Regions that food touches when it is eaten."""

GRIPPER, ARM, OTHER = "gripper", "arm", "other"
ROBOT_PARTS: Final = (GRIPPER, ARM, OTHER)
"""Touchers of every task, before the objects of its own; ``other``: anything else."""

_REGION_OF: Final = {
    "skull": "head",
    "cheek_skin": "cheeks",
    "cheeks": "cheeks",
    "eye": "eyes",
    "lip": "lips",
    "shoulders": "neck",
    "chest": "neck",
    "tongue_floor": "tongue",
    "teeth_upper": "teeth",
    "teeth_lower": "teeth",
    "cheek_left": "mouth",
    "cheek_right": "mouth",
    "throat": "mouth",
    "palate": "mouth",
}
"""Name of a geom, or its beginning, without ``face/`` -> region, where it is another word."""

EYE_REACH: Final = 0.016
"""m from an eye's centre within which skull, cheeks and nose count as the eye: the eyeball's 12 mm
and the lids."""

_BROWS: Final = 0.046
"""m, body frame: height of the eyebrows, above which the front of the skull is the forehead."""


_BRIDGE: Final = 0.012
"""m from the middle of the face to the sides of the nose's bridge."""

_WALL: Final = 0.040
"""m from the middle of the face: the walls of the mouth, inside and outside."""


_AROUND_EYES: Final = ("head", "cheeks", "nose", "forehead")
"""Regions of geoms that reach to the eyes."""

_BY_POINT: Final = (*_AROUND_EYES, "mouth")
"""Regions of geoms for which the point decides where they are touched, see `_region_at`."""


class FaceContact(NamedTuple):
    """Contact of one region with one toucher during a control step.

    Attributes:
        region: one of `REGIONS`.
        toucher: one of `ROBOT_PARTS` or an object of the task.
        is_food: the toucher is something that the outside of a visual face does not stop, at the
            lips or in the mouth: a mouth takes it in.
        force: N, the largest of the physics steps, all contact points together.
        impulse: N s.
        point: (x, y, z) m, frame of ``face/head`` (out of the face, the person's left, up): the
            hardest contact point at that moment.
    """

    region: str
    toucher: str
    is_food: bool
    force: float
    impulse: float
    point: tuple[float, float, float]


class _Touching(NamedTuple):
    """Contact with the face, as far as its two geoms decide.

    Attributes:
        number: of the contact.
        face: geom of the face.
        region: None where the point decides.
        toucher: as in `FaceContact`.
        is_stopped: the outside of a face stops the other geom.
        is_robot: and this is the outside.
    """

    number: int
    face: int
    region: str | None
    toucher: str
    is_stopped: bool
    is_robot: bool


class _InHead:
    """Contact points of a physics step in the frame of the head, each made when it is asked for."""

    def __init__(self, data: mujoco.MjData, head: int) -> None:
        self._data, self._head = data, head
        self._points: NDArray[np.float64] | None = None  # of all contacts, world

    def point(self, number: int) -> tuple[float, float, float]:
        """Return x, y, z in m of a contact."""
        data, head = self._data, self._head
        if self._points is None:
            self._points = data.contact.pos
            self._origin, self._axes = data.xpos[head], data.xmat[head].reshape(3, 3)
        x, y, z = ((self._points[number] - self._origin) @ self._axes).tolist()
        return x, y, z


class FaceTouch:
    """Contacts of the face during a control step.

    Args:
        model: compiled.
        objects: names of the task's objects, with which the names of their bodies begin.

    Attributes:
        touchers: `ROBOT_PARTS` and the objects.
        pairs: the two geoms of every contact of the last physics step; -1 for a flexible one. The
            same list as of the step before where the same geoms touch.
        robot_force: N, the largest of one contact point between the face and the robot, or a tool
            that the outside of a face stops, in the last physics step.
    """

    def __init__(self, model: mujoco.MjModel, objects: Sequence[str]) -> None:
        self.touchers = (*ROBOT_PARTS, *objects)
        self._head = model.body("face/head").id
        self._dt = float(model.opt.timestep)
        names = [model.geom(geom).name for geom in range(model.ngeom)]
        touchable = (model.geom_contype | model.geom_conaffinity) != 0
        # One more than there are geoms: number -1 is no face.
        self._is_face = [
            bool(touchable[geom]) and name.startswith("face/") for geom, name in enumerate(names)
        ] + [False]
        self._regions = [
            region_of(name) if is_face else ""
            for name, is_face in zip(names, self._is_face, strict=False)
        ]
        self._toucher = [toucher_of(model, geom, objects) for geom in range(model.ngeom)] + [OTHER]
        outside = (model.geom_contype & FACE) != 0
        self._is_stopped = [*((model.geom_conaffinity & FACE) != 0).tolist(), False]
        self._is_outside = [*(outside & np.array(self._is_face[:-1])).tolist(), False]
        self._eyes = np.array([model.geom(f"face/eye_{side}").pos for side in ("left", "right")])
        self.clear()

    def clear(self) -> None:
        """Begin a control step."""
        self.pairs: list[list[int]] = []
        self._packed_pairs, self._touching = b"", list[_Touching]()
        self.robot_force = 0.0
        self._found: dict[tuple[str, str, bool], FaceContact] = {}

    def read(self, model: mujoco.MjModel, data: mujoco.MjData) -> None:
        """Take in the contacts of a physics step."""
        geoms = data.contact.geom
        # Which geoms touch changes seldom, and bytes are compared faster than they are unpacked.
        if (packed := geoms.tobytes()) != self._packed_pairs:
            self._packed_pairs, self.pairs, is_face = packed, geoms.tolist(), self._is_face
            pairs = enumerate(self.pairs)
            self._touching = [
                self._touch(n, a, b) for n, (a, b) in pairs if is_face[a] or is_face[b]
            ]
        self.robot_force = 0.0
        if self._touching:
            self._measure(model, data, self._touching)

    def _touch(self, number: int, first: int, second: int) -> _Touching:
        face, other = (first, second) if self._is_face[first] else (second, first)
        is_stopped, region = self._is_stopped[other], self._regions[face]
        return _Touching(
            number,
            face,
            None if region in _BY_POINT else region,
            self._toucher[other],
            is_stopped,
            self._is_outside[face] and is_stopped,
        )

    def _measure(
        self, model: mujoco.MjModel, data: mujoco.MjData, touching: list[_Touching]
    ) -> None:
        # Most contacts go on, softer than they have been, in a region that their geom is all of:
        # then nobody asks for their points.
        wrench, in_head = np.zeros(6), _InHead(data, self._head)
        total: dict[tuple[str, str, bool], float] = {}
        hardest: dict[tuple[str, str, bool], tuple[float, int]] = {}
        for number, face, region, toucher, is_stopped, is_robot in touching:
            mujoco.mj_contactForce(model, data, number, wrench)
            if (force := wrench.item(0)) <= 0.0:
                continue
            if is_robot:
                self.robot_force = max(self.robot_force, force)
            if region is None:
                region = self._region_at(face, *in_head.point(number))
            is_food = not is_stopped and region in _EATING
            key = region, toucher, is_food
            total[key] = total.get(key, 0.0) + force
            if key not in hardest or force > hardest[key][0]:
                hardest[key] = force, number
        for key, force in total.items():
            before, impulse = self._found.get(key), force * self._dt
            if before is not None:
                impulse += before.impulse
            if before is None or force > before.force:
                point = in_head.point(hardest[key][1])
                self._found[key] = FaceContact(*key, force, impulse, point)
            else:
                self._found[key] = FaceContact(*key, before.force, impulse, before.point)

    @property
    def contacts(self) -> tuple[FaceContact, ...]:
        """Contacts since `clear`."""
        return tuple(self._found.values())

    def row(self) -> dict[str, np.ndarray[Any, Any]]:
        """Return the row of an episode file, (R, B) float32 each, regions by touchers.

        ``region_force`` is in N, ``region_impulse`` in N s.
        """
        force, impulse = np.zeros((2, len(REGIONS), len(self.touchers)), dtype=np.float32)
        for contact in self._found.values():
            place = REGIONS.index(contact.region), self.touchers.index(contact.toucher)
            force[place] = max(force[place], contact.force)
            impulse[place] += contact.impulse
        return {"region_force": force, "region_impulse": impulse}

    def _region_at(self, geom: int, x: float, y: float, z: float) -> str:
        """Return the region of a point of a geom, in the frame of the head.

        The geoms of the visual face are larger than its regions.
        """
        region = self._regions[geom]
        if region in _AROUND_EYES:
            if np.linalg.norm(self._eyes - (x, y, z), axis=1).min() < EYE_REACH:
                return "eyes"
            if region == "head" and x > 0.0:
                beside = "cheeks" if abs(y) > _BRIDGE else "nose"
                return "forehead" if z > _BROWS else beside
        if region == "mouth" and abs(y) > _WALL:
            return "cheeks"
        return region


def region_of(geom: str) -> str:
    """Return the region of a geom of the face by its name."""
    name = geom.removeprefix("face/")
    stem = name.rstrip("0123456789").rstrip("_")
    if name not in _REGION_OF:
        stem = stem.removesuffix("_left").removesuffix("_right")
    region = _REGION_OF.get(name) or _REGION_OF.get(stem, stem)
    if region not in REGIONS:
        raise ValueError(f"geom '{geom}' belongs to no region of the face")
    return region


def toucher_of(model: mujoco.MjModel, geom: int, objects: Sequence[str]) -> str:
    """Return what a geom is: an object of the task, wherever it hangs, or a part of an arm."""
    body = int(model.geom_bodyid[geom])
    while body:
        name = model.body(body).name
        for found in sorted(objects, key=len, reverse=True):
            if name.startswith(found):
                return found
        arm, _, link = name.partition("/")
        if arm in ARM_BASES:
            return GRIPPER if link.startswith("gripper") or "finger" in link else ARM
        body = int(model.body_parentid[body])
    return OTHER
