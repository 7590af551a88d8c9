"""The spoon that may feed in place of the gripper: its model, and the food on it.

The right gripper holds the spoon from the start, and its handle is fixed to it, as handles of
adapted cutlery are strapped to a hand. The food, a small cube, lies free on the bowl and can be
spilled. A mouth that has had it between the lips for a while closes on it: the lips of recorded
people do not close, so that a spoon that is drawn out would take the food along.
"""

from __future__ import annotations

from typing import Any, Final

import mink
import mujoco
import numpy as np
from numpy.typing import NDArray

from robo_manip_baselines.envs.mujoco.cell.scene import CONTROL_PERIOD, FACE, MOUTH, SOLID

Floats = NDArray[np.float64]

SPOON: Final = "spoon"
"""Body of the spoon, what touches a face with it, and the site in its bowl."""

REACH: Final = 0.10
"""m from the gripper's site to the middle of the bowl, along the fingers: they stay 7 cm from the
lips, and the arm can draw the bowl back by 0.13 m from every mouth."""

TOOL: Final = mink.SE3.from_translation(np.array([REACH, 0.0, 0.0]))
"""Site of the spoon in the frame of the gripper's."""

SPOON_HOME_QPOS: Final = (0.0, -1.45, 1.20, 0.0, 0.25, 0.0)
"""rad, joints of the right arm at the start: the spoon level, 0.1 m or more from every mouth."""

SPOON_FINGER: Final = 0.025
"""m, position of a finger on the handle, 8 mm thick."""

FOOD_SIZE: Final = 0.014
"""m, edge of the food: 2.7 cm³, half a teaspoon of 5 ml."""

FOOD_MASS: Final = 0.0016
"""kg, at the density of the cube that a gripper brings (0.6 g/cm³)."""

BOWL: Final = np.array([0.013, 0.010])
"""m, half length and half width of the bowl's inside. The food lies with 3 mm to spare, and the
bowl passes between the corners of the lips, 45 mm apart and less where it is low."""

RIM: Final = 0.004
"""m, height of the bowl's rim above its floor; food that is knocked against it stays."""

_FOOD_HEIGHT: Final = FOOD_SIZE / 2 - RIM
"""m from the site of the spoon, at the height of the rim, up to the middle of the food."""

_WALL: Final = 0.001
"""m, thickness of floor and rim."""

SPREAD: Final = 0.002
"""m, largest distance of the food from the middle of the bowl at the start, along and across."""

TAKING_TIME: Final = 0.3
"""s for which the food is in the mouth before lips close on it: a choice, somewhat more than the
quarter of a second in which people react to what they see."""

TAKING_STEPS: Final = round(TAKING_TIME / CONTROL_PERIOD)
"""The same in control steps."""

FOOD_BITS: Final = (SOLID, SOLID | MOUTH)
"""Contact bits of the food: like the cube it passes lips, and touches the inside of a mouth."""

_SOLID: Final[dict[str, Any]] = {
    "contype": SOLID,
    "conaffinity": SOLID | FACE | MOUTH,
    "group": 2,
    "friction": (0.6, 0.005, 0.0001),
    "rgba": (0.80, 0.82, 0.85, 1.0),
}


def add_spoon(scene: mujoco.MjSpec) -> None:
    """Add the spoon to the right gripper: body and site `SPOON`, the middle of the bowl's rim."""
    link = scene.body("right/gripper_link")
    grip = float(scene.site("right/gripper").pos[0])
    body = link.add_body(name=SPOON, pos=(grip + REACH, 0, 0), gravcomp=1)
    body.add_site(name=SPOON, size=(0.002,) * 3, group=4)
    box, capsule = mujoco.mjtGeom.mjGEOM_BOX, mujoco.mjtGeom.mjGEOM_CAPSULE
    floor = -RIM - _WALL
    (length, width), half = BOWL + 2 * _WALL, (RIM + 2 * _WALL) / 2
    parts = {
        "floor": ((length, width, _WALL), (0.0, 0.0, floor)),
        "front": ((_WALL, width, half), (-(length - _WALL), 0.0, floor - _WALL + half)),
        "back": ((_WALL, width, half), (length - _WALL, 0.0, floor - _WALL + half)),
        "left": ((length, _WALL, half), (0.0, width - _WALL, floor - _WALL + half)),
        "right": ((length, _WALL, half), (0.0, -(width - _WALL), floor - _WALL + half)),
    }
    for name, (size, pos) in parts.items():
        mass = 0.01 if name == "floor" else 0.0025
        body.add_geom(name=f"spoon/{name}", type=box, size=size, pos=pos, mass=mass, **_SOLID)
    # Before the finger tips it can be touched; between the fingers it is only to be seen.
    neck = [-length, 0.0, floor, -REACH + 0.032, 0.0, 0.0]
    body.add_geom(
        name="spoon/neck", type=capsule, size=(0.003, 0, 0), fromto=neck, mass=0.005, **_SOLID
    )
    body.add_geom(
        name="spoon/handle",
        type=box,
        size=(0.032, SPOON_FINGER - 0.021, 0.007),
        pos=(-REACH, 0, 0),
        mass=0,
        **{**_SOLID, "contype": 0, "conaffinity": 0, "rgba": (0.16, 0.42, 0.70, 1.0)},
    )


def add_food(scene: mujoco.MjSpec) -> None:
    """Add the food: body, free joint and geom ``cube``, the names of what a gripper brings."""
    body = scene.worldbody.add_body(name="cube", pos=(0.1, 0.5, FOOD_SIZE / 2))
    body.add_freejoint(name="cube")
    contype, conaffinity = FOOD_BITS
    body.add_geom(
        name="cube",
        type=mujoco.mjtGeom.mjGEOM_BOX,
        size=(FOOD_SIZE / 2,) * 3,
        mass=FOOD_MASS,
        rgba=(0.85, 0.10, 0.08, 1),
        contype=contype,
        conaffinity=conaffinity,
        condim=4,
        friction=(0.6, 0.005, 0.0001),
    )


def is_on_spoon(offset: Floats) -> bool:
    """Return whether food is on the bowl: above its floor, within its rim, not thrown up.

    Args:
        offset: (3,) m, centre of the food from the site of the spoon, in its frame.
    """
    along, across, up = offset
    (length, width), height = BOWL, up - _FOOD_HEIGHT
    return bool(abs(along) < length and abs(across) < width and abs(height) < FOOD_SIZE / 2)


class Meal:
    """The food of a spoon, until a mouth has taken it.

    Args:
        model: with spoon and food.

    Attributes:
        is_taken: the mouth has closed on the food, which goes with it from then on.
    """

    def __init__(self, model: mujoco.MjModel) -> None:
        self._spoon, self._mouth = model.site(SPOON).id, model.site("mouth").id
        self._qpos = int(model.joint("cube").qposadr[0])
        self._qvel = int(model.joint("cube").dofadr[0])
        self._geom, self._body = model.geom("cube").id, model.body("cube").id

    def place(self, model: mujoco.MjModel, data: mujoco.MjData, offset: Floats) -> None:
        """Put food on the spoon, ``offset`` (2,) m from the middle of the bowl, along and across.

        The joints of the arm have been set.
        """
        self.is_taken, self._steps = False, 0
        model.geom_contype[self._geom], model.geom_conaffinity[self._geom] = FOOD_BITS
        mujoco.mj_kinematics(model, data)
        axes = data.site_xmat[self._spoon].reshape(3, 3)
        place = data.site_xpos[self._spoon] + axes @ (*offset, _FOOD_HEIGHT)
        turn = np.empty(4)
        mujoco.mju_mat2Quat(turn, axes.ravel())
        data.qpos[self._qpos : self._qpos + 7] = (*place, *turn)

    def is_on_spoon(self, data: mujoco.MjData) -> bool:
        """Return whether the food is on the spoon now."""
        axes = data.site_xmat[self._spoon].reshape(3, 3)
        offset = (data.xpos[self._body] - data.site_xpos[self._spoon]) @ axes
        return not self.is_taken and is_on_spoon(offset)

    def advance(self, model: mujoco.MjModel, data: mujoco.MjData, *, is_inside: bool) -> None:
        """Take in a control step, after which the food is inside the mouth or not."""
        self._steps = self._steps + 1 if is_inside and self.is_on_spoon(data) else 0
        if self._steps >= TAKING_STEPS:
            self.is_taken = True
            model.geom_contype[self._geom] = model.geom_conaffinity[self._geom] = 0
            axes = data.site_xmat[self._mouth].reshape(3, 3)
            self._held = (data.xpos[self._body] - data.site_xpos[self._mouth]) @ axes

    def hold(self, data: mujoco.MjData) -> None:
        """Keep food that was taken where it is in the mouth, after a physics step."""
        if self.is_taken:
            axes = data.site_xmat[self._mouth].reshape(3, 3)
            place = data.site_xpos[self._mouth] + axes @ self._held
            data.qpos[self._qpos : self._qpos + 3] = place
            data.qvel[self._qvel : self._qvel + 6] = 0.0
