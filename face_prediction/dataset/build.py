"""One clip of the dataset: its track and its video to its file.

Legend: T frames, S decoded frames, N sequences, F frames of one, P pictures.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from face_prediction.dataset.clip_file import (
    EncodedPictures,
    encode_picture,
    open_clip,
    read_record,
    write_clip,
)
from face_prediction.dataset.manifest import ClipEntry, SequenceRow, sequence_facts
from face_prediction.dataset.sequences import (
    REASONS,
    ClipFrames,
    Sequences,
    clip_frames,
    find_sequences,
)
from face_prediction.dataset.settings import KINDS, SequenceSettings
from face_prediction.tracking.tracks import FaceTrack, load_track
from face_prediction.tracking.video import VideoFrame, VideoReader, sha256_of
from robo_manip_baselines.runs.errors import RequestError

#: Two clocks of one video agree to this many seconds; they are read from the same file.
SAME_CLOCK = 1e-6

Progress = Callable[[Iterable[VideoFrame], int, str], Iterable[VideoFrame]]


def no_progress(frames: Iterable[VideoFrame], total: int, name: str) -> Iterable[VideoFrame]:
    """Shows nothing."""
    return frames


@dataclass(frozen=True)
class ClipSource:
    """One clip to be built: its name, its track and its video."""

    clip: str
    track: Path
    video: Path


def clip_record(source: ClipSource, settings: SequenceSettings) -> dict[str, Any]:
    """What decides the content of a clip's file: names and hashes of its sources, settings."""
    return {
        "clip": source.clip,
        "track_sha256": sha256_of(source.track),
        "video": source.video.name,
        "video_sha256": sha256_of(source.video),
        "settings": settings.to_json(),
    }


def build_clip(
    source: ClipSource, out: Path, settings: SequenceSettings, progress: Progress = no_progress
) -> bool:
    """Make the file ``out`` of one clip, unless it is there already, from the same sources.

    Returns:
        Whether it was made; False: it was there and is kept.

    Raises:
        RequestError: the track or the video cannot be used, they do not belong together, or
            ``out`` is a file of another kind.
    """
    track = load_track(source.track)
    record = clip_record(source, settings)
    require_same_video(source, track, record["video_sha256"])
    if is_up_to_date(out, record):
        return False
    frames = clip_frames(track, settings)
    sequences = find_sequences(frames, settings)
    facts = sequence_facts(frames, sequences, settings)
    pictures = cut_pictures(source.video, track, frames, sequences, settings, progress)
    write_clip(out, frames, sequences, pictures, facts, record)
    return True


def require_same_video(source: ClipSource, track: FaceTrack, video_hash: str) -> None:
    """Check that the track was made from this very video.

    Raises:
        RequestError: it was not; where the video breaks off, the message says that.
    """
    if track.source.get("sha256") == video_hash:
        return
    with VideoReader(source.video) as video:
        for _ in video.frames():  # raises where the file breaks off, which explains the hash
            pass
    raise RequestError(
        f"{source.track}: was not made from {source.video} (its SHA-256 is another); "
        "extract the track again"
    )


def is_up_to_date(out: Path, record: dict[str, Any]) -> bool:
    """Whether ``out`` holds what ``record`` describes.

    Raises:
        RequestError: ``out`` exists and is damaged or of another kind.
    """
    if not out.exists():
        return False
    try:
        with open_clip(out) as file:
            found = read_record(out, file)
    except RequestError as error:
        raise RequestError(f"{error}; it is in the way, so remove it first") from None
    return all(found.get(key) == value for key, value in record.items())


def cut_pictures(
    path: Path,
    track: FaceTrack,
    frames: ClipFrames,
    sequences: Sequences,
    settings: SequenceSettings,
    progress: Progress = no_progress,
) -> EncodedPictures:
    """Decode the video once and cut the pictures of all sequences out of it.

    Raises:
        RequestError: the video breaks off, or its frames are not those of the track.
    """
    rows = sequences.start[:, None] + np.arange(settings.length)  # (N, F) frame of the clip
    wanted = frames.source_frame[rows]  # (N, F) decoded frame
    users: dict[int, list[int]] = defaultdict(list)  # decoded frame -> sequences that show it
    for number, row in enumerate(wanted):
        for decoded in np.unique(row):
            users[int(decoded)].append(number)
    encoded: list[dict[int, np.ndarray]] = [{} for _ in range(len(sequences))]
    times = track.source_timestamps
    count = 0
    with VideoReader(path) as video:
        for frame in progress(video.frames(), len(times), path.name):
            height, width = frame.image.shape[:2]
            if (width, height) != track.image_size:
                raise RequestError(
                    f"{path}: {width}x{height} pixels, its track says "
                    f"{track.image_size[0]}x{track.image_size[1]}; extract the track again"
                )
            if count < len(times) and abs(frame.time - times[count]) > SAME_CLOCK:
                raise RequestError(
                    f"{path}: frame {count} is at {frame.time:.4f} s, its track says "
                    f"{times[count]:.4f} s; extract the track again"
                )
            for number in users.get(count, ()):
                picture = sequences.crops[number].cut(frame.image, settings.crop_size)
                encoded[number][count] = encode_picture(picture, settings.quality)
            count += 1
    if count != len(times):
        raise RequestError(
            f"{path}: {count} frames, its track says {len(times)}; extract the track again"
        )
    index = np.zeros(wanted.shape, dtype=np.int64)
    ordered: list[np.ndarray] = []
    for number, row in enumerate(wanted):
        present, place = np.unique(row, return_inverse=True)
        index[number] = len(ordered) + place
        ordered += [encoded[number][int(decoded)] for decoded in present]
    return EncodedPictures(ordered, index)


#: column heading, fact, factor, decimals
_MEDIANS = (
    ("mouth range u, v crop", ("mouth_range_u", "mouth_range_v"), 1.0, 3),
    ("mouth range x, y mm", ("mouth_range_x", "mouth_range_y"), 1000.0, 1),
    ("head deg", ("head_rotation_range",), 1.0, 1),
    ("mouth opening mm", ("mouth_opening_range",), 1000.0, 1),
    ("interpolated %", ("interpolated_share",), 100.0, 0),
)


def kind_table(clips: Sequence[ClipEntry], rows: Sequence[SequenceRow]) -> str:
    """Markdown: per kind of footage, counts and the medians of the facts."""
    names = [name.replace("_", " ") for name in REASONS]
    head = ["footage", "subjects", "clips", "too short", "sequences", *names]
    head += [heading for heading, *_ in _MEDIANS]
    lines = [_line(head), _line(["---"] * len(head))]
    for kind in KINDS:
        of_kind = [clip for clip in clips if clip.kind == kind]
        if of_kind:
            part = [row for row in rows if row.kind == kind]
            lines.append(_line([kind, *_counts(of_kind), *_medians(part)]))
    lines.append(_line(["all", *_counts(clips), *_medians(rows)]))
    return "\n".join(lines)


def fold_table(clips: Sequence[ClipEntry], folds: int) -> str:
    """Markdown: per fold, subjects and sequences of each kind."""
    kinds = [kind for kind in KINDS if any(clip.kind == kind for clip in clips)]
    lines = [_line(["fold", "subjects", "sequences", *kinds])]
    lines.append(_line(["---"] * (3 + len(kinds))))
    for fold in range(folds):
        part = [clip for clip in clips if clip.fold == fold]
        of_kind = [sum(c.sequences for c in part if c.kind == kind) for kind in kinds]
        subjects = len({clip.subject for clip in part})
        lines.append(_line([str(fold), str(subjects), str(sum(of_kind)), *map(str, of_kind)]))
    return "\n".join(lines)


def _line(cells: Sequence[str]) -> str:
    return f"| {' | '.join(cells)} |"


def _counts(clips: Sequence[ClipEntry]) -> list[str]:
    numbers = [
        len({clip.subject for clip in clips if clip.sequences}),
        sum(clip.sequences > 0 for clip in clips),
        sum(clip.candidates == 0 for clip in clips),
        sum(clip.sequences for clip in clips),
        *(sum(clip.dropped.get(reason, 0) for clip in clips) for reason in REASONS),
    ]
    return [str(number) for number in numbers]


def _medians(rows: Sequence[SequenceRow]) -> list[str]:
    if not rows:
        return ["–"] * len(_MEDIANS)
    return [
        " ".join(
            f"{factor * float(np.median([row.facts[fact] for row in rows])):.{digits}f}"
            for fact in facts
        )
        for _, facts, factor, digits in _MEDIANS
    ]
