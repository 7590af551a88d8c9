"""``face-prediction export-surface``: face tracks in, one mean face with a jaw out.

The surface is the mean of real faces: frames are lifted to metres, aligned over the parts of a
face that keep still when it speaks, and read off where the lips touch; how vertices move as the
mouth opens gives the jaw. Each subject counts once, however many clips there are of it.
"""

from __future__ import annotations

import json
import logging
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tyro

from face_prediction.commands.export_motion import attribution_of, track_files
from face_prediction.motion.library import Attribution, read_attributions
from face_prediction.motion.surface import (
    JawFit,
    align_subjects,
    closed_mean,
    fit_jaw,
    lip_distance,
    metric_landmarks,
    mirror_partners,
    opening_velocity,
    symmetric,
)
from face_prediction.tracking.tracks import FaceTrack, load_track
from robo_manip_baselines.runs.errors import RequestError
from robo_manip_baselines.runs.npz import write_npz

logger = logging.getLogger(__name__)

SCHEMA, VERSION = "face_surface", 1

_CHIN = 152
_METHOD = (
    "landmarks lifted to metres with MediaPipe's camera and head pose; rigid alignment (no scale) "
    "over the vertices above the nostrils, iterated; per-vertex regression on lip distance and "
    "mouth width within subjects; mean over subjects at lip distance 0; mirrored halves averaged; "
    "jaw weights smoothed over the mesh, anchored at lips, chin and nose"
)


@dataclass(frozen=True)
class ExportSurfaceOptions:
    """Average face tracks into one surface with a jaw.

    Only clips whose row says ship=yes are taken; without --attribution every clip is taken, each
    as a subject of its own.

    Example: face-prediction export-surface face_tracks --attribution clips.csv \
        --out face_surface.npz
    """

    #: Folders of tracks, or single tracks.
    tracks: tyro.conf.Positional[tuple[Path, ...]]
    #: The surface to write.
    out: Path = Path("face_surface.npz")
    #: Table (.csv, or Markdown) with the columns clip, subject, ship (yes or no), licence, source.
    attribution: Path | None = None
    #: Most frames taken of a clip, evenly spread.
    max_frames: int = 600
    #: Clips with fewer valid frames are left out.
    min_frames: int = 20


@dataclass(frozen=True)
class Topology:
    """How MediaPipe's 468 vertices are joined."""

    #: (M, 3) int32, counter-clockwise from outside; none in the mouth or the eyes
    triangles: np.ndarray
    #: ordered rings and sorted lists of vertices, by the names of the surface file
    groups: dict[str, np.ndarray]

    @property
    def edges(self) -> np.ndarray:
        """Every edge once, (E, 2)."""
        sides = np.concatenate([self.triangles[:, [i, (i + 1) % 3]] for i in range(3)])
        return np.unique(np.sort(sides, axis=1), axis=0)


def export_surface(options: ExportSurfaceOptions) -> int:
    """Write the surface.

    Raises:
        RequestError: a number is out of range, a track or the table cannot be used, no clip is
            left, the mouth never opens, or MediaPipe, which knows the mesh, is not installed.
    """
    if options.max_frames < 1 or options.min_frames < 2:
        raise RequestError(
            f"--max_frames {options.max_frames} --min_frames {options.min_frames}: "
            "at least 1 and 2 are needed"
        )
    if options.out.is_dir():
        raise RequestError(f"--out {options.out}: is a folder; name a file")
    rows = None if options.attribution is None else read_attributions(options.attribution)
    clips: list[tuple[Attribution, np.ndarray]] = []
    for path in track_files(options.tracks):
        row = attribution_of(path, rows, options.attribution)
        if row.ship:
            faces = faces_of(load_track(path), options.max_frames)
            if len(faces) >= options.min_frames:
                clips.append((row, faces))
    if not clips:
        raise RequestError(
            f"no clip with ship=yes and {options.min_frames} valid frames among the tracks given"
        )
    topology = mediapipe_topology()
    vertices, jaw = measure(pool_subjects(clips), topology)
    topology = Topology(facing_out(topology.triangles, vertices), topology.groups)
    write_npz(options.out, surface_arrays(vertices, jaw, topology, metadata(clips, jaw)))
    subjects = len({row.subject for row, _ in clips})
    logger.info("%s: mean of %d subjects in %d clips", options.out, subjects, len(clips))
    return 0


def faces_of(track: FaceTrack, max_frames: int) -> np.ndarray:
    """Measured faces (T, 468, 3) of a track, metres, head frame; nothing interpolated."""
    usable = np.flatnonzero(track.valid & ~track.interpolated)
    if len(usable) < max_frames // 10:  # a rate conversion interpolates most frames
        usable = np.flatnonzero(track.valid)
    chosen = usable[:: -(-len(usable) // max_frames) or 1]
    return metric_landmarks(track.landmarks[chosen], track.head_pose[chosen], track.image_size)


def pool_subjects(clips: Iterable[tuple[Attribution, np.ndarray]]) -> list[np.ndarray]:
    """All faces (T, 468, 3) of each subject."""
    pooled: dict[str, list[np.ndarray]] = {}
    for row, faces in clips:
        pooled.setdefault(row.subject, []).append(faces)
    return [np.concatenate(parts) for parts in pooled.values()]


def measure(subjects: Sequence[np.ndarray], topology: Topology) -> tuple[np.ndarray, JawFit]:
    """The symmetric mean face (468, 3) with its mouth closed, and its jaw.

    Raises:
        RequestError: nobody opens the mouth.
    """
    if max(float(np.ptp(lip_distance(faces))) for faces in subjects) < 0.005:
        raise RequestError("no mouth opens by more than 5 mm; add clips of people who speak")
    aligned = align_subjects(subjects)
    velocity = opening_velocity(aligned)
    mean = closed_mean(aligned, velocity)
    partner = mirror_partners(mean)
    vertices, velocity = symmetric(mean, partner), symmetric(velocity, partner)
    fit = fit_jaw(vertices, velocity, topology.edges)
    weight = (fit.weight + fit.weight[partner]) / 2
    return vertices, JawFit(fit.hinge, weight, fit.measured)


def mediapipe_topology() -> Topology:
    """Triangles and groups as MediaPipe lists them.

    Raises:
        RequestError: MediaPipe is not installed.
    """
    try:
        from mediapipe.tasks.python.vision import FaceLandmarksConnections as Mesh
    except ImportError:
        raise RequestError(
            "export-surface takes the triangles from MediaPipe, which is not installed; "
            "run: pip install 'robo_manip_baselines[face_prediction]'"
        ) from None

    def pairs(connections: Any) -> np.ndarray:
        return np.array([(edge.start, edge.end) for edge in connections])

    loops = ordered_loops(pairs(Mesh.FACE_LANDMARKS_LIPS))
    groups = {
        "lips_outer": next(loop for loop in loops if 0 in loop),
        "lips_inner": next(loop for loop in loops if 13 in loop),
        "eye_left": ordered_loops(pairs(Mesh.FACE_LANDMARKS_LEFT_EYE))[0],
        "eye_right": ordered_loops(pairs(Mesh.FACE_LANDMARKS_RIGHT_EYE))[0],
        "eyebrow_left": np.unique(pairs(Mesh.FACE_LANDMARKS_LEFT_EYEBROW)).tolist(),
        "eyebrow_right": np.unique(pairs(Mesh.FACE_LANDMARKS_RIGHT_EYEBROW)).tolist(),
    }
    # the list of edges goes round one triangle after the other
    triangles = pairs(Mesh.FACE_LANDMARKS_TESSELATION).reshape(-1, 3, 2)[:, :, 0]
    return Topology(
        triangles.astype(np.int32), {name: np.array(group) for name, group in groups.items()}
    )


def ordered_loops(edges: np.ndarray) -> list[list[int]]:
    """The closed loops that edges (E, 2) form, each as an ordered list of vertices."""
    beside: dict[int, list[int]] = {}
    for a, b in edges.tolist():
        beside.setdefault(a, []).append(b)
        beside.setdefault(b, []).append(a)
    loops: list[list[int]] = []
    while beside:
        loop = [next(iter(beside))]
        while ahead := [v for v in beside.pop(loop[-1]) if v in beside and v not in loop]:
            loop.append(ahead[0])
        loops.append(loop)
    return loops


def facing_out(triangles: np.ndarray, vertices: np.ndarray) -> np.ndarray:
    """The same triangles (M, 3), all counter-clockwise seen from outside.

    Neighbours are made to agree edge by edge; then the whole is turned if it faces inward.
    """
    sides: dict[tuple[int, int], list[int]] = {}
    for i, (a, b, c) in enumerate(triangles.tolist()):
        for pair in ((a, b), (b, c), (c, a)):
            sides.setdefault((min(pair), max(pair)), []).append(i)
    result, done, queue = triangles.copy(), {0}, [0]
    while queue:
        a, b, c = result[queue[-1]].tolist()
        queue.pop()
        for start, end in ((a, b), (b, c), (c, a)):
            for i in sides[min(start, end), max(start, end)]:
                if i in done:
                    continue
                p, q, r = result[i].tolist()
                if (start, end) in ((p, q), (q, r), (r, p)):
                    result[i] = (p, r, q)
                done.add(i)
                queue.append(i)
    corner = vertices[result]
    normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    return result if normal[:, 2].sum() > 0 else result[:, [0, 2, 1]]


def metadata(clips: Sequence[tuple[Attribution, np.ndarray]], jaw: JawFit) -> dict[str, Any]:
    """What the surface is made of, and how."""
    return {
        "method": _METHOD,
        "clips": len(clips),
        "subjects": len({row.subject for row, _ in clips}),
        "frames": sum(len(faces) for _, faces in clips),
        "frames_per_subject": dict(
            sum((Counter({row.subject: len(faces)}) for row, faces in clips), Counter())
        ),
        "measured_chin_weight": round(float(jaw.measured[_CHIN]), 3),
        "attribution": {row.clip: row.record() for row, _ in clips},
        "topology": "MediaPipe face mesh (Apache-2.0)",
    }


def surface_arrays(
    vertices: np.ndarray, jaw: JawFit, topology: Topology, about: dict[str, Any]
) -> dict[str, np.ndarray]:
    """The arrays of a surface file."""
    return {
        "schema": np.array(SCHEMA),
        "version": np.array(VERSION),
        "vertices": vertices,
        "triangles": topology.triangles.astype(np.int32),
        "jaw_weight": jaw.weight,
        "jaw_hinge": jaw.hinge,
        **{name: group.astype(np.int32) for name, group in topology.groups.items()},
        "metadata": np.array(json.dumps(about, sort_keys=True)),
    }
