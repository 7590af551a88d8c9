"""The cup as a MuJoCo body, and the liquid that is seen in it.

A feeding cup with a lid and a spout: body, lid and spout of capsules and cylinders to be seen, a
box and two capsules to be touched. Liquid is drawn as upright slices of the cavity, each filled to
where the level surface cuts it, and drops along the jet; both are geoms without mass or contacts.
"""

from __future__ import annotations

from typing import Any, Final

import mujoco
import numpy as np
from numpy.typing import NDArray

from robo_manip_baselines.envs.mujoco.cell.scene import BASE_Y, FACE, MOUTH, SOLID
from robo_manip_baselines.envs.mujoco.tasks.drinking.liquid import (
    CAVITY_HEIGHT,
    CAVITY_RADIUS,
    SPOUT_AXIS,
    SPOUT_ROOT,
    SPOUT_TIP,
)

Floats = NDArray[np.float64]

BODY_RADIUS: Final = 0.025
BODY_HEIGHT: Final = 0.055
"""m, outside of the body, a cylinder about the origin of the cup's frame. Open fingers are 72 mm
apart, which leaves 11 mm on either side."""

SPOUT_RADIUS: Final = 0.005
"""m, outside of the spout at its tip: a wall of 1 mm about the opening."""

CUP_MASS: Final = 0.10
"""kg: 60 g of plastic, and a serving of water, whose weight stays when it has been drunk."""

SLICES: Final = 10
"""Slices of the liquid, across the axis towards the spout."""

DROPS: Final = 7
"""Drops that are seen of a jet."""

SLICE, DROP = "cup/slice_", "cup/drop_"
"""Starts of the names of their geoms."""

DROP_RADIUS: Final = 0.0022
"""m, of a drop of 45 µl."""

_HIDDEN: Final = 1e-4
"""m, size of a geom that is not to be seen."""

_VISUAL: Final[dict[str, Any]] = {"contype": 0, "conaffinity": 0, "mass": 0, "group": 2}
_SOLID: Final[dict[str, Any]] = {
    "contype": SOLID,
    "conaffinity": SOLID | FACE | MOUTH,
    "group": 3,
    "condim": 4,
    "friction": (0.8, 0.01, 0.0001),
    "rgba": (0.2, 0.6, 0.9, 0.4),
}
_CLEAR: Final = (0.86, 0.93, 0.97, 0.20)
_LID: Final = (0.16, 0.42, 0.70, 1.0)
_JUICE: Final = (0.88, 0.42, 0.05, 1.0)


def add_cup(spec: mujoco.MjSpec) -> None:
    """Add the cup, standing free on the table: body, free joint and geom ``cup``, site ``spout``.

    The site is at the middle of the spout's opening, its x axis along the spout. Unlike a cube,
    which lips give way to, the cup touches lips and face.
    """
    body = spec.worldbody.add_body(name="cup", pos=(0.12, BASE_Y, BODY_HEIGHT / 2))
    body.add_freejoint(name="cup")
    _add_solids(body)
    _add_visuals(body)
    for number in range(SLICES):
        _add_liquid(body, f"{SLICE}{number}", mujoco.mjtGeom.mjGEOM_BOX)
    for number in range(DROPS):
        _add_liquid(body, f"{DROP}{number}", mujoco.mjtGeom.mjGEOM_SPHERE)
    up = -np.arctan2(SPOUT_AXIS[2], SPOUT_AXIS[0]) / 2
    quat = (np.cos(up), 0.0, np.sin(up), 0.0)
    body.add_site(name="spout", pos=SPOUT_TIP.tolist(), quat=quat, size=(0.002,) * 3, group=4)


def _add_solids(body: mujoco.MjsBody) -> None:
    # Flat where the pads hold it, so that they touch it in four points and it does not turn.
    half = (0.021, BODY_RADIUS, BODY_HEIGHT / 2)
    box = mujoco.mjtGeom.mjGEOM_BOX
    body.add_geom(name="cup", type=box, size=half, mass=CUP_MASS, **_SOLID)
    end = SPOUT_TIP - SPOUT_RADIUS * SPOUT_AXIS
    body.add_geom(
        name="cup/spout_solid",
        type=mujoco.mjtGeom.mjGEOM_CAPSULE,
        fromto=[*SPOUT_ROOT.tolist(), *end.tolist()],
        size=(SPOUT_RADIUS, 0, 0),
        mass=0,
        **_SOLID,
    )


def _add_visuals(body: mujoco.MjsBody) -> None:
    cylinder = mujoco.mjtGeom.mjGEOM_CYLINDER
    half, lid, foot = BODY_HEIGHT / 2, 0.004, 0.0015
    for name, radius, thickness, height, rgba in (
        ("wall", BODY_RADIUS, half, 0.0, _CLEAR),
        ("lid", BODY_RADIUS + 0.0005, lid, half, _LID),
        ("foot", BODY_RADIUS + 0.0005, foot, foot - half - 0.0002, _LID),
    ):
        size, pos = (radius, thickness, 0), (0, 0, height)
        body.add_geom(name=f"cup/{name}", type=cylinder, size=size, pos=pos, rgba=rgba, **_VISUAL)
    middle = (SPOUT_ROOT + SPOUT_TIP) / 2
    for name, start, end, radius in (
        ("spout_root", SPOUT_ROOT, middle, 1.5 * SPOUT_RADIUS),
        ("spout_tip", SPOUT_ROOT, SPOUT_TIP, SPOUT_RADIUS),
    ):
        body.add_geom(
            name=f"cup/{name}",
            type=cylinder,
            fromto=[*start.tolist(), *end.tolist()],
            size=(radius, 0, 0),
            rgba=_LID,
            **_VISUAL,
        )


def _add_liquid(body: mujoco.MjsBody, name: str, kind: mujoco.mjtGeom) -> None:
    # Not at the origin: MuJoCo would take the geom to be there for good.
    pos, size = (0, 0, BODY_HEIGHT / 4), (_HIDDEN,) * 3
    body.add_geom(name=name, type=kind, pos=pos, size=size, rgba=_JUICE, **_VISUAL)


def slice_heights(surface: float, up: Floats, places: Floats) -> tuple[Floats, Floats]:
    """Return lower and upper ends (N,) m along z of the liquid at places (N,) m along x.

    Args:
        surface: m, of the liquid along ``up``, see `surface_height`.
        up: (3,) unit vector against gravity, in the frame of the cup.
        places: in the frame of the cup, in the middle across.
    """
    half = CAVITY_HEIGHT / 2
    steep = up[2] if abs(up[2]) > 1e-3 else np.copysign(1e-3, up[2])
    cut = np.clip((surface - up[0] * places) / steep, -half, half)
    end = np.full(len(places), -half if steep > 0.0 else half)
    return np.minimum(cut, end), np.maximum(cut, end)


class LiquidView:
    """Geoms of a model that show the liquid.

    Args:
        model: with the cup.
    """

    def __init__(self, model: mujoco.MjModel) -> None:
        names = [f"{SLICE}{n}" for n in range(SLICES)] + [f"{DROP}{n}" for n in range(DROPS)]
        self._geoms = np.array([model.geom(name).id for name in names])
        edges = np.linspace(-CAVITY_RADIUS, CAVITY_RADIUS, SLICES + 1)
        self._places = (edges[1:] + edges[:-1]) / 2
        chords = np.sqrt(CAVITY_RADIUS**2 - self._places**2)
        width = float(edges[1] - edges[0]) / 2
        self._shape = np.column_stack([np.full(SLICES, width), chords, np.zeros(SLICES)])
        self._positions, self._sizes = np.zeros((2, len(names), 3))
        self._positions[:SLICES, 0] = self._places

    def show(self, model: mujoco.MjModel, surface: float, up: Floats, drops: Floats) -> None:
        """Show liquid up to a surface in a cup that is turned, and drops on their way.

        MuJoCo places the geoms with the next kinematics.

        Args:
            model: to change.
            surface: m, of the liquid along ``up``, see `surface_height`.
            up: (3,) unit vector against gravity, in the frame of the cup.
            drops: (N, 3) m, in the frame of the cup, at most `DROPS`.
        """
        low, high = slice_heights(surface, up, self._places)
        half = (high - low) / 2
        self._positions[:SLICES, 2] = (high + low) / 2
        # Where there is no liquid a slice would still be seen as a film.
        shown = half > _HIDDEN
        self._sizes[:SLICES] = np.where(shown[:, None], self._shape, _HIDDEN)
        self._sizes[:SLICES, 2] = np.where(shown, half, _HIDDEN)
        end = SLICES + len(drops)
        self._positions[SLICES:end] = drops
        self._positions[end:] = 0.0
        self._sizes[SLICES:end] = DROP_RADIUS
        self._sizes[end:] = _HIDDEN
        model.geom_pos[self._geoms] = self._positions
        model.geom_size[self._geoms] = self._sizes
