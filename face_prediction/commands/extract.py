"""``face-prediction extract``: videos in, one ``FaceTrack`` file each out."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro
from tqdm.contrib.logging import logging_redirect_tqdm

from face_prediction.tracking.detector import FaceDetector, find_model
from face_prediction.tracking.extract import ExtractSettings, extract_track, is_track_up_to_date
from face_prediction.tracking.tracks import FaceTrack, save_track
from face_prediction.tracking.video import require_video
from robo_manip_baselines.runs.errors import RequestError, WriteError, disk_problem
from robo_manip_baselines.runs.files import (
    FileKind,
    file_digest,
    locked_file,
    remove_temporaries,
    require_out_file,
    require_out_folder,
)

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class ExtractOptions:
    """Follow one face through each video: VIDEO.mp4 to OUT/VIDEO.npz.

    A track that is already there, of the same video with the same settings, is kept: a run that
    was killed carries on when started again.

    Example: face-prediction extract clips/*.mp4 --detector_model face_landmarker.task

    Attributes:
        videos: Video files, of any kind that PyAV (FFmpeg) opens.
        out: Folder for the tracks.
        detector_model: MediaPipe's face_landmarker.task. By default the one in
            ~/.cache/face_prediction (or $XDG_CACHE_HOME/face_prediction), downloaded once if there
            is a network.
        settings: Settings of the tracks.
        progress: Show a progress bar for every video.
    """

    videos: tyro.conf.Positional[tuple[Path, ...]]
    out: Path = Path("face_tracks")
    detector_model: Annotated[Path | None, tyro.conf.arg(aliases=["--model"])] = None
    settings: tyro.conf.OmitArgPrefixes[ExtractSettings] = field(default_factory=ExtractSettings)
    progress: bool = True


def run_extract(options: ExtractOptions) -> int:
    """Extract every video; one that cannot be used is named and the others go on.

    Returns:
        0; 2 when some video could not be used; 1 when the program failed on one.

    Raises:
        RequestError: nothing could be started.
        WriteError: there is no room to write tracks.
    """
    outputs = output_paths(options.videos, options.out)
    model = find_model(options.detector_model)
    remove_temporaries(options.out)
    made = kept = 0
    refused: list[str] = []
    failed: list[str] = []
    for number, (video, out) in enumerate(outputs, start=1):
        prefix = f"[{number}/{len(outputs)}] "
        try:
            track = extract_one(video, out, model, options, prefix)
        except RequestError as error:
            if len(outputs) == 1:
                raise
            refused.append(video.name)
            logger.error("%s%s", prefix, error)
            continue
        except Exception as error:
            # The next video would meet a full disk, too.
            if len(outputs) == 1 or isinstance(error, WriteError) or disk_problem(error):
                raise
            failed.append(video.name)
            logger.error("%s%s: %s: %s", prefix, video, type(error).__name__, error)
            logger.debug("", exc_info=True)
            continue
        if track is None:
            kept += 1
            logger.info("%s%s: up to date", prefix, out)
            continue
        made += 1
        logger.info("%s%s: %s", prefix, out, summary(track))
    if len(outputs) > 1:
        counts = [f"{made} made", f"{kept} already up to date", named("refused", refused)]
        counts += [named("failed", failed)] if failed else []
        logger.info("%s", ", ".join(counts))
    return 1 if failed else 2 if refused else 0


def summary(track: FaceTrack) -> str:
    """Frames of a track, how many of them show the face, and how many could not be used."""
    text = f"{len(track)} frames, face in {100 * float(track.valid.mean()):.1f} %"
    counts = {what: track.source[f"frames_{what}"] for what in ("damaged", "lost")}
    bad = " and ".join(f"{count} {what}" for what, count in counts.items() if count)
    decoded = track.source["frames"] + counts["lost"]
    return text + (f"; {bad} of the video's {decoded} frames left out" if bad else "")


def named(what: str, names: Sequence[str]) -> str:
    """Count and names of the videos with one result."""
    return f"{len(names)} {what}" + (f" ({', '.join(names)})" if names else "")


def extract_one(
    video: Path, out: Path, model: Path, options: ExtractOptions, prefix: str
) -> FaceTrack | None:
    """Write the track of one video and return it; None: it is there already.

    Raises:
        RequestError: the video cannot be used, or something else is at ``out``.
    """
    settings = options.settings
    require_video(video)
    require_out_file(out, FileKind("face track", Path.stat), [video, model])
    with (
        locked_file(out, wait=True),
        # a detector for each video: in video mode its clock may not run backwards
        FaceDetector(model, settings.detector) as detector,
        logging_redirect_tqdm(),
    ):
        if is_track_up_to_date(out, file_digest(video), settings, detector.description()):
            return None
        label = prefix + video.name if options.progress else None
        track = extract_track(video, detector, settings, label)
        save_track(out, track)
        return track


def output_paths(videos: Iterable[Path], out: Path) -> list[tuple[Path, Path]]:
    """(video, track file) pairs.

    Raises:
        RequestError: no video, or two of the same name, which would overwrite one another.
    """
    pairs = [(video, out / f"{video.stem}.npz") for video in videos]
    if not pairs:
        raise RequestError("no video given; name one or more video files")
    require_out_folder(out)
    seen: dict[Path, Path] = {}
    for video, path in pairs:
        if path in seen:
            two = f"{seen[path]} and {video}"
            raise RequestError(f"{two} would both become {path}; extract them to two folders")
        seen[path] = video
    return pairs
