"""``face-prediction export-surface``: face tracks in, one mean face with a jaw out.

Each subject counts once, however many clips there are of it.
"""

from __future__ import annotations

import json
import logging
from collections import defaultdict
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro

from face_prediction.motion.attribution import Attribution
from face_prediction.motion.library import attributed_tracks
from face_prediction.motion.surface import facing_out, measure, mediapipe_topology, metric_landmarks
from face_prediction.tracking.tracks import load_track
from robo_manip_baselines.runs.errors import RequestError
from robo_manip_baselines.runs.files import FileKind, require_out_file
from robo_manip_baselines.runs.npz import FileType, read_npz, write_npz
from robo_manip_baselines.runs.ranges import Count

logger = logging.getLogger(__name__)

SCHEMA, VERSION = "face_surface", 1

_FILE = FileType(SCHEMA, VERSION, {}, has_others=True)
_SURFACE = FileKind("face surface", lambda path: read_npz(path, _FILE))

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

    Example: face-prediction export-surface face_tracks --attribution clips.csv
    --out face_surface.npz

    Attributes:
        tracks: Folders of tracks, or single tracks.
        out: The surface to write.
        attribution: Table (.csv, or Markdown) with the columns clip, subject, ship (yes or no),
            licence, source.
        max_frames: Most frames taken of a clip, evenly spread.
        min_frames: Clips with fewer valid frames are left out.
    """

    tracks: tyro.conf.Positional[tuple[Path, ...]]
    out: Path = Path("face_surface.npz")
    attribution: Path | None = None
    max_frames: Count = 600
    min_frames: Count = 20


def run_export_surface(options: ExportSurfaceOptions) -> None:
    """Write the surface.

    Raises:
        RequestError: a number is out of range, a track or the table cannot be used, no clip is
            left, the mouth never opens, or MediaPipe, which knows the mesh, is not installed.
    """
    if options.max_frames < 1 or options.min_frames < 2:
        given = f"--max_frames {options.max_frames} --min_frames {options.min_frames}"
        raise RequestError(f"{given}: at least 1 and 2 are needed")
    inputs = [*options.tracks, options.attribution]
    require_out_file(options.out, _SURFACE, inputs)
    clips: list[Attribution] = []
    subjects: dict[str, list[np.ndarray]] = defaultdict(list)  # faces (T, 468, 3) of each clip
    for path, row in attributed_tracks(options.tracks, options.attribution):
        if row.ship:
            faces = measured_faces(path, options.max_frames)
            if len(faces) >= options.min_frames:
                clips.append(row)
                subjects[row.subject].append(faces)
    if not clips:
        raise RequestError(
            f"no clip with ship=yes and {options.min_frames} valid frames among the tracks given"
        )
    topology = mediapipe_topology()
    pooled = {name: np.concatenate(parts) for name, parts in subjects.items()}
    vertices, jaw = measure(list(pooled.values()), topology)
    frames = {name: len(faces) for name, faces in pooled.items()}
    metadata = {
        "method": _METHOD,
        "clips": len(clips),
        "subjects": len(frames),
        "frames": sum(frames.values()),
        "frames_per_subject": frames,
        "measured_chin_weight": round(float(jaw.measured[_CHIN]), 3),
        "attribution": {row.clip: row.record() for row in clips},
        "topology": "MediaPipe face mesh (Apache-2.0)",
    }
    arrays = {
        "schema": np.array(SCHEMA),
        "version": np.array(VERSION),
        "vertices": vertices,
        "triangles": facing_out(topology.triangles, vertices).astype(np.int32),
        "jaw_weight": jaw.weight,
        "jaw_hinge": jaw.hinge,
        **{name: group.astype(np.int32) for name, group in topology.groups.items()},
        "metadata": np.array(json.dumps(metadata, sort_keys=True)),
    }
    write_npz(options.out, arrays)
    logger.info("%s: mean of %d subjects in %d clips", options.out, len(frames), len(clips))


def measured_faces(path: Path, max_frames: int) -> np.ndarray:
    """Measured faces (T, 468, 3) of a track file, metres, head frame; nothing interpolated."""
    track = load_track(path)
    usable = np.flatnonzero(track.valid & ~track.interpolated)
    if len(usable) < max_frames // 10:  # a rate conversion interpolates most frames
        usable = np.flatnonzero(track.valid)
    chosen = usable[:: -(-len(usable) // max_frames) or 1]
    return metric_landmarks(track.landmarks[chosen], track.head_pose[chosen], track.image_size)
