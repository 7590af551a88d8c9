"""A MuJoCo scene in the browser: viser draws a model's geoms and skins, and follows its state.

What MuJoCo's renderer draws by default is drawn: geoms and sites of the groups 0 to 2 that are not
transparent, and skins, which deform in the browser. viser has no textures on deforming meshes: a
textured skin is cut into patches of one colour each.

Importing this module needs no viser.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

if TYPE_CHECKING:
    import viser

Floats = NDArray[np.float64]

DRAWN_GROUPS: Final = 3
"""Groups of geoms and sites that MuJoCo draws by default: 0, 1 and 2."""

HIDDEN: Final = ("wall_",)
"""Starts of names of geoms that would hide the scene from a camera that moves around it."""

SIDES: Final = 24
"""Vertices around a round geom."""

ENDLESS: Final = 5.0
"""m, half of a side of a plane without end."""

PATCH_COLOURS: Final = 6
"""Colours of a textured skin."""

MOVED: Final = 1e-6
"""m, or quaternion component, below which a body has not moved and nothing is sent."""

_SQUARE: Final = np.array([[0, 1, 2], [0, 2, 3]])


class Mesh(NamedTuple):
    """Triangles: vertices (V, 3) in m, and faces (F, 3), indices of vertices."""

    vertices: Floats
    faces: NDArray[np.int64]


class Shape(NamedTuple):
    """Geom or site that is drawn for itself, since its pose on its body and its size change.

    Attributes:
        handle: of viser's mesh, of size 1.
        kind: geom or site, as the names of the model's arrays begin.
        number: of the geom or site in the model.
    """

    handle: Any
    kind: str
    number: int


class ViserScene:
    """Drawing of a model in a viser scene, below one node.

    Args:
        scene: of a viser server.
        model: to draw; read again with every update for what ``varying`` names, and for sites.
        root: name of the node.
        hidden: starts of names of geoms that are left out.
        varying: starts of names of boxes, spheres and ellipsoids whose pose on their body and size
            change in the model, see `FaceEnv.varying_geoms`.
    """

    def __init__(
        self,
        scene: viser.SceneApi,
        model: mujoco.MjModel,
        *,
        root: str = "/cell",
        hidden: tuple[str, ...] = HIDDEN,
        varying: tuple[str, ...] = (),
    ) -> None:
        self._scene, self._model, self._root = scene, model, root
        self._node = scene.add_frame(root, show_axes=False)
        self._bodies: dict[int, Any] = {}
        for (body, colour), parts in _parts(model, (*hidden, *varying)).items():
            self._add_mesh(body, "_".join(map(str, colour)), joined(parts), colour)
        self._shapes = [
            self._add_shape("geom", geom)
            for geom in range(model.ngeom)
            if varying and model.geom(geom).name.startswith(varying)
        ]
        self._shapes += [
            self._add_shape("site", site)
            for site in range(model.nsite)
            if model.site_group[site] < DRAWN_GROUPS
        ]
        self._update_shapes()
        self._bones: list[tuple[int, Any]] = []
        for skin in range(model.nskin):
            self._add_skin(skin)

    def update(self, data: mujoco.MjData) -> None:
        """Move everything to where it is in a state after ``mj_kinematics``.

        Only what has moved is sent. Within ``with server.atomic():`` browsers show it at once.
        """
        for body, handle in (*self._bodies.items(), *self._bones):
            _move(handle, data.xpos[body], data.xquat[body])
        self._update_shapes()

    def remove(self) -> None:
        """Remove the drawing from the scene."""
        self._node.remove()

    def _add_mesh(self, body: int, name: str, mesh: Mesh, colour: Sequence[int]) -> Any:
        """Add a mesh of a colour (RGBA, 0-255) below the frame of its body."""
        frame = f"{self._root}/body_{body}"
        if body not in self._bodies:
            self._bodies[body] = self._scene.add_frame(frame, show_axes=False)
        return self._scene.add_mesh_simple(
            f"{frame}/{name}",
            *mesh,
            color=(colour[0], colour[1], colour[2]),
            opacity=None if colour[3] == 255 else colour[3] / 255,
        )

    def _add_shape(self, kind: str, number: int) -> Shape:
        """Add a geom or a site, of size 1 and in its colour; `update` puts it where it is."""
        model = self._model
        form = mujoco.mjtGeom(getattr(model, f"{kind}_type")[number])
        colour = np.round(255 * getattr(model, f"{kind}_rgba")[number]).astype(int).tolist()
        body = int(getattr(model, f"{kind}_bodyid")[number])
        mesh = primitive_mesh(form, np.ones(3))
        return Shape(
            self._add_mesh(body, f"{kind}_{number}", mesh, [*colour[:3], 255]), kind, number
        )

    def _update_shapes(self) -> None:
        for handle, kind, number in self._shapes:
            position, orientation, size, colour, form = (
                getattr(self._model, f"{kind}_{name}")[number]
                for name in ("pos", "quat", "size", "rgba", "type")
            )
            if form == mujoco.mjtGeom.mjGEOM_SPHERE:  # has a radius alone
                size = np.full(3, size[0])
            _move(handle, position, orientation)
            if np.abs(np.asarray(handle.scale) - size).max() > MOVED:
                handle.scale = tuple(size.tolist())
            if handle.visible != (is_visible := bool(colour[3] > 0)):
                handle.visible = is_visible

    def _add_skin(self, skin: int) -> None:
        model = self._model
        vertices, faces = skin_mesh(model, skin)
        weights = _skin_weights(model, skin)
        first, number = model.skin_boneadr[skin], model.skin_bonenum[skin]
        bones = slice(first, first + number)
        for index, (colour, chosen) in enumerate(colour_patches(skin_colours(model, skin))):
            used, triangles = np.unique(faces[chosen], return_inverse=True)
            handle = self._scene.add_mesh_skinned(
                f"{self._root}/skin_{skin}_{index}",
                vertices[used],
                triangles.reshape(-1, 3),
                bone_wxyzs=model.skin_bonebindquat[bones],
                bone_positions=model.skin_bonebindpos[bones],
                skin_weights=weights[used],
                color=colour,
                side="double",
            )
            bodies = model.skin_bonebodyid[bones].tolist()
            self._bones += zip(bodies, handle.bones, strict=True)


def _move(handle: Any, position: Floats, orientation: Floats) -> None:
    """Put a node to a position (3,) m and an orientation (4,) wxyz, if it is not there."""
    if np.abs(handle.position - position).max() > MOVED:
        handle.position = position
    if np.abs(handle.wxyz - orientation).max() > MOVED:
        handle.wxyz = orientation


def _parts(
    model: mujoco.MjModel, hidden: tuple[str, ...]
) -> dict[tuple[int, tuple[int, ...]], list[Mesh]]:
    """Return the geoms that are drawn, in their body's frame, by body and colour (RGBA, 0-255)."""
    found: dict[tuple[int, tuple[int, ...]], list[Mesh]] = {}
    for geom in range(model.ngeom):
        colour = tuple(np.round(255 * geom_colour(model, geom)).astype(int).tolist())
        name = model.geom(geom).name
        is_drawn = model.geom_group[geom] < DRAWN_GROUPS and colour[3] > 0
        if not is_drawn or (hidden and name.startswith(hidden)):
            continue
        mesh = geom_mesh(model, geom)
        rotation = np.empty(9)
        mujoco.mju_quat2Mat(rotation, model.geom_quat[geom])
        placed = mesh.vertices @ rotation.reshape(3, 3).T + model.geom_pos[geom]
        key = int(model.geom_bodyid[geom]), colour
        found.setdefault(key, []).append(Mesh(placed, mesh.faces))
    return found


def geom_colour(model: mujoco.MjModel, geom: int) -> Floats:
    """(4,) RGBA of a geom, 0 to 1; of its material where its own is MuJoCo's default."""
    own, material = model.geom_rgba[geom], model.geom_matid[geom]
    is_default = np.allclose(own, (0.5, 0.5, 0.5, 1.0))
    return np.asarray(model.mat_rgba[material] if material >= 0 and is_default else own, np.float64)


def geom_mesh(model: mujoco.MjModel, geom: int) -> Mesh:
    """Return a geom's surface in its own frame; without triangles for height fields and SDFs."""
    kind = mujoco.mjtGeom(model.geom_type[geom])
    if kind == mujoco.mjtGeom.mjGEOM_MESH:
        mesh = model.geom_dataid[geom]
        first, number = model.mesh_vertadr[mesh], model.mesh_vertnum[mesh]
        triangles = slice(
            model.mesh_faceadr[mesh], model.mesh_faceadr[mesh] + model.mesh_facenum[mesh]
        )
        vertices = model.mesh_vert[first : first + number].astype(np.float64)
        return Mesh(vertices, model.mesh_face[triangles].astype(np.int64))
    return primitive_mesh(kind, model.geom_size[geom])


def primitive_mesh(kind: mujoco.mjtGeom, size: Floats) -> Mesh:
    """Return the surface of a shape of MuJoCo's sizes (3,); without triangles for any other."""
    if kind == mujoco.mjtGeom.mjGEOM_BOX:
        return _box(size)
    if kind == mujoco.mjtGeom.mjGEOM_SPHERE:
        return _sphere(np.full(3, size[0]), 0.0)
    if kind == mujoco.mjtGeom.mjGEOM_ELLIPSOID:
        return _sphere(size, 0.0)
    if kind == mujoco.mjtGeom.mjGEOM_CAPSULE:
        return _sphere(np.full(3, size[0]), size[1])
    if kind == mujoco.mjtGeom.mjGEOM_CYLINDER:
        radius, half = size[:2]
        # Twice each edge, so that light breaks there.
        ends = [[0, -half], [radius, -half], [radius, -half], [radius, half], [radius, half]]
        return _revolved(np.array([*ends, [0, half]]))
    if kind == mujoco.mjtGeom.mjGEOM_PLANE:
        x, y = (half or ENDLESS for half in size[:2])
        return Mesh(np.array([[-x, -y, 0], [x, -y, 0], [x, y, 0], [-x, y, 0]]), _SQUARE)
    return Mesh(np.empty((0, 3)), np.empty((0, 3), np.int64))


def _box(half: ArrayLike) -> Mesh:
    """Box with four vertices to each face, so that its faces are flat."""
    corners = np.array([[-1, -1, 1], [1, -1, 1], [1, 1, 1], [-1, 1, 1]], np.float64)
    faces = []
    for axis in range(3):
        top = np.roll(corners, axis, axis=1)
        faces += [top, -top[::-1]]
    vertices = np.concatenate(faces) * np.asarray(half, np.float64)
    return Mesh(vertices, np.concatenate([_SQUARE + 4 * side for side in range(6)]))


def _sphere(radii: Floats, half_length: float) -> Mesh:
    """Ellipsoid, or a capsule: a sphere whose halves are apart along z."""
    angle = np.linspace(-np.pi / 2, np.pi / 2, SIDES // 2 + 2)  # an even number: none at the middle
    unit = _revolved(np.column_stack([np.cos(angle), np.sin(angle)]))
    apart = np.sign(unit.vertices[:, 2:]) * [0.0, 0.0, half_length]
    return Mesh(unit.vertices * radii + apart, unit.faces)


def _revolved(profile: Floats) -> Mesh:
    """Turn a profile (N, 2) of radius and z, from below to above, about the z axis."""
    turn = np.arange(SIDES) * (2 * np.pi / SIDES)
    ring = np.column_stack([np.cos(turn), np.sin(turn)])
    vertices = [np.column_stack([r * ring, np.full(SIDES, z)]) for r, z in profile]
    i, j = np.meshgrid(np.arange(len(profile) - 1), np.arange(SIDES), indexing="ij")
    low, right = (SIDES * i + j).ravel(), (SIDES * i + (j + 1) % SIDES).ravel()
    high, high_right = low + SIDES, right + SIDES
    faces = np.concatenate(
        [np.stack([low, right, high], 1), np.stack([right, high_right, high], 1)]
    )
    return Mesh(np.concatenate(vertices), faces)


def joined(parts: list[Mesh]) -> Mesh:
    """Join meshes to one."""
    offsets = np.cumsum([0, *(len(mesh.vertices) for mesh in parts)])
    faces = [mesh.faces + offset for mesh, offset in zip(parts, offsets, strict=False)]
    return Mesh(np.concatenate([mesh.vertices for mesh in parts]), np.concatenate(faces))


# -- skins ----------------------------------------------------------------------------------------


def skin_mesh(model: mujoco.MjModel, skin: int) -> Mesh:
    """Return a skin's surface as it is bound to its bodies."""
    first, number = model.skin_vertadr[skin], model.skin_vertnum[skin]
    triangles = slice(model.skin_faceadr[skin], model.skin_faceadr[skin] + model.skin_facenum[skin])
    vertices = model.skin_vert[first : first + number].astype(np.float64)
    return Mesh(vertices, model.skin_face[triangles].astype(np.int64))


def _skin_weights(model: mujoco.MjModel, skin: int) -> Floats:
    """(V, B): share of each bone in the place of each vertex."""
    first, number = model.skin_boneadr[skin], model.skin_bonenum[skin]
    weights = np.zeros((model.skin_vertnum[skin], number))
    for column, bone in enumerate(range(first, first + number)):
        rows = slice(model.skin_bonevertadr[bone], None)
        count = model.skin_bonevertnum[bone]
        vertices = model.skin_bonevertid[rows][:count]
        weights[vertices, column] = model.skin_bonevertweight[rows][:count]
    return weights / weights.sum(axis=1, keepdims=True)


def skin_colours(model: mujoco.MjModel, skin: int) -> Floats:
    """(F, 3) RGB, 0 to 255: the colour of each triangle, from the texture at its centre."""
    material = model.skin_matid[skin]
    faces = skin_mesh(model, skin).faces
    plain = model.mat_rgba[material] if material >= 0 else model.skin_rgba[skin]
    colours = np.tile(255 * plain[:3].astype(np.float64), (len(faces), 1))
    role = int(mujoco.mjtTextureRole.mjTEXROLE_RGB)
    texture = model.mat_texid[material, role] if material >= 0 else -1
    first = model.skin_texcoordadr[skin]
    if texture < 0 or first < 0:
        return colours
    height, width = model.tex_height[texture], model.tex_width[texture]
    channels, start = model.tex_nchannel[texture], model.tex_adr[texture]
    pixels = model.tex_data[start : start + height * width * channels]
    image = pixels.reshape(height, width, channels)[..., :3]
    number = model.skin_vertnum[skin]
    u, v = model.skin_texcoord[first : first + number][faces].mean(axis=1).T
    column = np.clip((u * width).astype(int), 0, width - 1)
    row = np.clip((v * height).astype(int), 0, height - 1)
    return colours / 255 * image[row, column]


def colour_patches(
    colours: Floats, number: int = PATCH_COLOURS
) -> list[tuple[tuple[int, int, int], NDArray[np.int64]]]:
    """Group triangles by colour.

    Args:
        colours: (F, 3) RGB, 0 to 255, of the triangles.
        number: most groups.

    Returns:
        Colour and triangles of each group.
    """
    centres = colours[:1]
    # The colour that is farthest from those chosen so far comes next: the same on every run.
    for _ in range(number - 1):
        distance = _distances(colours, centres).min(axis=1)
        if distance.max() < 1.0:
            break
        centres = np.concatenate([centres, colours[[distance.argmax()]]])
    nearest = _distances(colours, centres).argmin(axis=1)
    for _ in range(10):
        means = [colours[nearest == index].mean(axis=0) for index in np.unique(nearest)]
        centres = np.array(means)
        nearest = _distances(colours, centres).argmin(axis=1)
    found = []
    for index, centre in enumerate(centres):
        triangles = np.flatnonzero(nearest == index)
        if len(triangles):
            red, green, blue = np.round(centre).astype(int).tolist()
            found.append(((red, green, blue), triangles))
    return found


def _distances(colours: Floats, centres: Floats) -> Floats:
    """(F, C) distances between colours."""
    return np.linalg.norm(colours[:, None] - centres[None], axis=2)
