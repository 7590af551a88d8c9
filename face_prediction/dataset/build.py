"""Clips of a dataset made from tracks and their videos, and tables of a dataset.

Legend: T frames, S decoded frames, N sequences, F frames of one, P images.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from face_prediction.dataset.clip_file import (
    EncodedImages,
    open_clip,
    read_array,
    read_record,
    write_clip,
)
from face_prediction.dataset.manifest import CLIP_FOLDER, ClipEntry, SequenceRow
from face_prediction.dataset.sequences import (
    KINDS,
    REASONS,
    ClipFrames,
    Sequences,
    SequenceSettings,
    clip_frames,
    find_sequences,
    kind_of,
    sequence_statistics,
)
from face_prediction.motion.attribution import Attribution
from face_prediction.tracking.tracks import FaceTrack, load_track
from face_prediction.tracking.video import VideoReader, with_bar
from robo_manip_baselines.runs.errors import RequestError
from robo_manip_baselines.runs.files import file_digest
from robo_manip_baselines.runs.images import encode_image
from robo_manip_baselines.runs.markdown import markdown_table

SAME_CLOCK = 1e-6
"""Two clocks of one video agree to this many seconds; they are read from the same file."""

# column heading, statistics, factor, decimals
_MEDIANS = (
    ("mouth range u, v crop", ("mouth_range_u", "mouth_range_v"), 1.0, 3),
    ("mouth range x, y mm", ("mouth_range_x", "mouth_range_y"), 1000.0, 1),
    ("head deg", ("head_rotation_range",), 1.0, 1),
    ("mouth opening mm", ("mouth_opening_range",), 1000.0, 1),
    ("interpolated %", ("interpolated_share",), 100.0, 0),
)


def find_videos(folders: Iterable[Path]) -> dict[str, list[Path]]:
    """File name to the files of that name in ``folders``.

    Raises:
        RequestError: one is no folder.
    """
    found: dict[str, list[Path]] = {}
    for folder in folders:
        if not folder.is_dir():
            raise RequestError(f"--videos {folder}: no such folder")
        for path in sorted(folder.iterdir()):
            if path.is_file():
                found.setdefault(path.name, []).append(path)
    return found


def source_video(path: Path, track: FaceTrack, videos: dict[str, list[Path]]) -> tuple[Path, str]:
    """The video that the track from ``path`` was made from, and its SHA-256.

    Raises:
        RequestError: there is none of its name, or several, or it is another one; where the video
            breaks off, the message says that.
    """
    name = str(track.source.get("name", ""))
    found = videos.get(name, [])
    if not found:
        raise RequestError(f"{path}: its video '{name}' is in no folder of --videos")
    if len(found) > 1:
        raise RequestError(f"{path}: {' and '.join(map(str, found))} are both named '{name}'")
    video = found[0]
    digest = file_digest(video)
    if track.source.get("sha256") == digest:
        return video, digest
    with VideoReader(video) as reader:
        for _ in reader.frames():  # raises where the file breaks off, which explains the hash
            pass
    raise RequestError(
        f"{path}: was not made from {video} (its SHA-256 is another); extract the track again"
    )


def build_clip(
    path: Path,
    videos: dict[str, list[Path]],
    out: Path,
    settings: SequenceSettings,
    bar: str | None = None,
) -> bool:
    """Make the file of the clip with the track at ``path``, unless it is up to date.

    ``videos`` are as `find_videos` gives them, ``out`` is the folder of the dataset, and ``bar``
    holds the first words of a progress bar (None: no bar).

    Returns:
        True: it was made; False: it was there, from the same sources, and is kept.

    Raises:
        RequestError: the track or the video cannot be used, they do not belong together, or
            the clip's file is of another kind.
    """
    track = load_track(path)
    video, video_sha256 = source_video(path, track, videos)
    record = {
        "clip": path.stem,
        "track_sha256": file_digest(path),
        "video": video.name,
        "video_sha256": video_sha256,
        "settings": settings.to_json(),
    }
    target = out / CLIP_FOLDER / f"{path.stem}.h5"
    if target.exists():
        try:
            with open_clip(target) as file:
                found = read_record(target, file)
        except RequestError as error:
            raise RequestError(f"{error}; it is in the way, so remove it first") from None
        if all(found.get(key) == value for key, value in record.items()):
            return False
    frames = clip_frames(track, settings)
    sequences = find_sequences(frames, settings)
    statistics = sequence_statistics(frames, sequences, settings)
    label = None if bar is None else bar + video.name
    images = cut_images(video, track, frames, sequences, settings, label)
    write_clip(target, frames, sequences, images, statistics, record)
    return True


def clip_entry(out: Path, row: Attribution) -> ClipEntry:
    """The entry of a clip whose file is in the dataset ``out``, not yet in a fold."""
    path = out / CLIP_FOLDER / f"{row.clip}.h5"
    with open_clip(path) as file:
        record: dict[str, Any] = read_record(path, file)
        rotations = read_array(path, file, "sequences/head_rotation_range").tolist()
    kept = ("track_sha256", "video", "video_sha256", "sequences", "candidates", "dropped")
    record.setdefault("content_sha256", "")  # files of older releases
    return ClipEntry(
        clip=row.clip,
        subject=row.subject,
        kind=kind_of(row, rotations),
        fold=None,
        ship=row.ship,
        licence=row.licence,
        source=row.source,
        **{name: record[name] for name in (*kept, "content_sha256")},
    )


def track_frames(
    path: Path, track: FaceTrack, label: str | None = None
) -> Iterator[tuple[int, np.ndarray]]:
    """Numbers and images (H, W, 3) of the decoded frames of a track's video at ``path``.

    ``label`` is that of a progress bar; None: no bar.

    Raises:
        RequestError: the video breaks off, or its frames are not those of the track.
    """

    def wrong(problem: str) -> RequestError:
        return RequestError(f"{path}: {problem}; extract the track again")

    times = track.source_timestamps
    count = 0
    with VideoReader(path) as video:
        for frame in with_bar(video.frames(), len(times), label):
            height, width = frame.image.shape[:2]
            if (width, height) != track.image_size:
                theirs = "x".join(map(str, track.image_size))
                raise wrong(f"{width}x{height} pixels, its track says {theirs}")
            if count < len(times):
                if abs(frame.time - times[count]) > SAME_CLOCK:
                    at = f"frame {count} is at {frame.time:.4f} s"
                    raise wrong(f"{at}, its track says {times[count]:.4f} s")
                yield count, frame.image
            count += 1
    if count != len(times):
        raise wrong(f"{count} frames, its track says {len(times)}")


def cut_images(
    path: Path,
    track: FaceTrack,
    frames: ClipFrames,
    sequences: Sequences,
    settings: SequenceSettings,
    label: str | None = None,
) -> EncodedImages:
    """Decode the video once and cut the images of all sequences out of it.

    Raises:
        RequestError: the video breaks off, or its frames are not those of the track.
    """
    rows = sequences.start[:, None] + np.arange(settings.length)  # (N, F) frame of the clip
    wanted = frames.source_frame[rows]  # (N, F) decoded frame
    users: dict[int, list[int]] = defaultdict(list)  # decoded frame -> sequences with it
    for number, row in enumerate(wanted):
        for decoded in np.unique(row).tolist():
            users[decoded].append(number)
    encoded: list[dict[int, np.ndarray]] = [{} for _ in range(len(sequences))]
    for decoded, image in track_frames(path, track, label):
        for number in users.get(decoded, ()):
            cut = sequences.crops[number].cut(image, settings.crop_size)
            encoded[number][decoded] = encode_image(cut, quality=settings.quality)
    index = np.zeros(wanted.shape, dtype=np.int64)
    ordered: list[np.ndarray] = []
    for number, row in enumerate(wanted):
        present, place = np.unique(row, return_inverse=True)
        index[number] = len(ordered) + place
        ordered += [encoded[number][decoded] for decoded in present.tolist()]
    return EncodedImages(ordered, index)


def kind_table(clips: Sequence[ClipEntry], rows: Sequence[SequenceRow]) -> str:
    """Markdown: per kind of footage, counts and the medians of statistics."""
    head = ["footage", "subjects", "clips", "too short", "sequences"]
    head += [name.replace("_", " ") for name in REASONS] + [heading for heading, *_ in _MEDIANS]
    table: list[list[object]] = []
    for kind in (*KINDS, "all"):
        part = [clip for clip in clips if kind in ("all", clip.kind)]
        found = [row.statistics for row in rows if kind in ("all", row.kind)]
        if not part and kind != "all":
            continue
        people = len({clip.subject for clip in part if clip.sequences})
        sums = [sum(clip.sequences > 0 for clip in part), sum(not c.candidates for c in part)]
        sums.append(sum(clip.sequences for clip in part))
        sums += [sum(clip.dropped.get(reason, 0) for clip in part) for reason in REASONS]
        table.append([kind, people, *sums])
        for _, keys, factor, digits in _MEDIANS:
            columns = [[row[key] for row in found] for key in keys] if found else []
            medians = [factor * float(np.median(column)) for column in columns]
            table[-1].append(" ".join(f"{value:.{digits}f}" for value in medians) or "–")
    return markdown_table(head, table)


def fold_table(clips: Sequence[ClipEntry], folds: int) -> str:
    """Markdown: per fold, subjects and sequences of each kind."""
    kinds = [kind for kind in KINDS if any(clip.kind == kind for clip in clips)]
    rows: list[list[int]] = []
    for fold in range(folds):
        part = [clip for clip in clips if clip.fold == fold]
        counts = [sum(c.sequences for c in part if c.kind == kind) for kind in kinds]
        rows.append([fold, len({clip.subject for clip in part}), sum(counts), *counts])
    return markdown_table(["fold", "subjects", "sequences", *kinds], rows)
