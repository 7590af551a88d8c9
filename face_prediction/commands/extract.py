"""``face-prediction extract``: videos in, one ``FaceTrack`` file each out."""

from __future__ import annotations

import logging
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import tyro
from tqdm.contrib.logging import logging_redirect_tqdm

from face_prediction.tracking.detector import (
    DetectorSettings,
    FaceDetector,
    RunningMode,
    find_model,
)
from face_prediction.tracking.extract import ExtractSettings, extract_track, is_up_to_date
from face_prediction.tracking.tracks import save_track
from face_prediction.tracking.video import FrameBar, require_video, sha256_of
from robo_manip_baselines.runs.errors import RequestError

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class ExtractOptions:
    """Follow one face through each video: VIDEO.mp4 to OUT/VIDEO.npz.

    A track that is already there, of the same video with the same settings, is kept: a run that
    was killed carries on when started again.

    Example: face-prediction extract clips/*.mp4 --model face_landmarker.task --out face_tracks
    """

    #: Video files, of any kind that PyAV (FFmpeg) opens.
    videos: tyro.conf.Positional[tuple[Path, ...]]
    #: Folder for the tracks.
    out: Path = Path("face_tracks")
    #: MediaPipe's face_landmarker.task. By default the one in ~/.cache/face_prediction (or
    #: $XDG_CACHE_HOME/face_prediction), downloaded once if there is a network.
    model: Path | None = None
    #: Frames per second of the tracks; None keeps the decoded frames as they are.
    fps: float | None = 30.0
    #: Longest time in seconds between two decoded frames that is interpolated across.
    max_gap: float = 0.1
    #: image: every frame on its own, unsmoothed. video: MediaPipe's own smoothing.
    running_mode: RunningMode = "image"
    #: Faces looked for in a frame, so that the tracked one is among them.
    num_faces: int = 4
    #: Least score of the face detector.
    min_detection_confidence: float = 0.5
    #: Least score of the landmark network's "a face is present".
    min_presence_confidence: float = 0.5
    #: Look at small faces through a still window three faces wide (with image only).
    zoom: bool = True
    #: Show a progress bar for every video.
    progress: bool = True


def run_extract(options: ExtractOptions) -> int:
    """Extract every video; one that cannot be used is named and the others go on.

    Returns:
        0, or 2 when some video could not be used.

    Raises:
        RequestError: nothing could be started.
    """
    settings = ExtractSettings(
        detector=DetectorSettings(
            running_mode=options.running_mode,
            num_faces=options.num_faces,
            min_detection_confidence=options.min_detection_confidence,
            min_presence_confidence=options.min_presence_confidence,
        ),
        fps=options.fps,
        max_gap=options.max_gap,
        zoom=options.zoom,
    )
    outputs = output_paths(options.videos, options.out)
    model = find_model(options.model)
    made = kept = refused = 0
    for number, (video, out) in enumerate(outputs, start=1):
        prefix = f"[{number}/{len(outputs)}] "
        try:
            require_video(video)
            # a detector for each video: in video mode its clock may not run backwards
            with FaceDetector(model, settings.detector) as detector, logging_redirect_tqdm():
                if is_up_to_date(out, sha256_of(video), settings, detector.description()):
                    kept += 1
                    logger.info("%s%s: up to date", prefix, out)
                    continue
                bar = FrameBar(prefix, options.progress)
                track = extract_track(video, detector, settings, bar)
            save_track(out, track)
        except RequestError as error:
            if len(outputs) == 1:
                raise
            refused += 1
            logger.error("%s%s", prefix, error)
            continue
        made += 1
        logger.info(
            "%s%s: %d frames, face in %.1f %%",
            prefix,
            out,
            len(track),
            100 * float(track.valid.mean()),
        )
    if len(outputs) > 1:
        logger.info("%d made, %d already up to date, %d refused", made, kept, refused)
    return 2 if refused else 0


def output_paths(videos: Iterable[Path], out: Path) -> list[tuple[Path, Path]]:
    """(video, track file) pairs.

    Raises:
        RequestError: no video, or two of the same name, which would overwrite one another.
    """
    pairs = [(video, out / f"{video.stem}.npz") for video in videos]
    if not pairs:
        raise RequestError("no video given; name one or more video files")
    if out.exists() and not out.is_dir():
        raise RequestError(f"--out {out}: is a file; name a folder")
    seen: dict[Path, Path] = {}
    for video, path in pairs:
        if path in seen:
            raise RequestError(
                f"{seen[path]} and {video} would both become {path}; extract them to two folders"
            )
        seen[path] = video
    return pairs
