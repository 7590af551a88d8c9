"""``face-prediction live``: a camera or a video, with the mouth drawn ahead of itself."""

from __future__ import annotations

import logging
from collections.abc import Generator
from contextlib import ExitStack, closing
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path

import numpy as np

from face_prediction.dataset.reader import FaceDataset
from face_prediction.dataset.sequences import SequenceSettings
from face_prediction.evaluation.setup import BaselinePredictor
from face_prediction.forecast import FORECASTERS, LandmarkSequences, fit_forecaster
from face_prediction.live.loop import Summary, run_loop
from face_prediction.live.sinks import VideoFile, Window
from face_prediction.live.sources import FaceFinder, camera_frames, open_camera, video_frames
from face_prediction.live.streaming import (
    Forecasting,
    LandmarkForecasting,
    NetworkForecasting,
    StreamingPredictor,
)
from face_prediction.tracking.detector import find_model
from face_prediction.tracking.tracks import NUM_LANDMARKS
from face_prediction.tracking.video import VideoFrame, VideoReader, require_video
from robo_manip_baselines.runs.errors import RequestError

logger = logging.getLogger(__name__)

#: Frames ahead (paper, IV.A).
HORIZON = 5
SHIPPED = "shipped"
#: Baselines that are fitted to nothing.
UNFITTED = ("persistence", "constant_velocity", "line")


@dataclass(frozen=True)
class LiveOptions:
    """Follow a face, forecast its mouth, and show both on the picture, with the times they take.

    Example: face-prediction live --video clip.mp4 --out forecast.mp4
    """

    #: Number of a camera, 0 being the first.
    camera: int | None = None
    #: A video file, instead.
    video: Path | None = None
    #: Folder of a trained network; shipped: the one that comes with the package; or the name of a
    #: baseline.
    checkpoint: str = SHIPPED
    #: Folder made by build-dataset, that a baseline with parameters is fitted to.
    dataset: Path | None = None
    #: Video file (H.264, .mp4) to write; by default a window is opened.
    out: Path | None = None
    #: MediaPipe's face_landmarker.task. By default the one in ~/.cache/face_prediction (or
    #: $XDG_CACHE_HOME/face_prediction), downloaded once if there is a network.
    detector_model: Path | None = None
    #: Stop after so many seconds of video; None: at its end, with Escape or q in the window, or
    #: with Ctrl-C.
    seconds: float | None = None


def run_live(options: LiveOptions) -> int:
    """Run until the video ends or the user stops.

    Returns:
        0, or 130 when it was interrupted; a file that was being written is then complete.

    Raises:
        RequestError: camera, video, network or detector cannot be used, or nothing can be shown.
    """
    if (options.camera is None) == (options.video is None):
        raise RequestError("give either --camera NUMBER or --video FILE")
    if options.seconds is not None and not options.seconds > 0:
        raise RequestError(f"--seconds {options.seconds}: must be positive")
    if options.video is not None:
        require_video(options.video)
    refuse_folder_or_source(options)
    name, forecasting, settings = load_forecasting(options.checkpoint, options.dataset)
    model = find_model(options.detector_model)
    summary = Summary()
    is_interrupted = False
    with ExitStack() as stack:
        sink = VideoFile(options.out, rate_of(options.video)) if options.out else Window()
        finder = stack.enter_context(FaceFinder(model))
        frames = stack.enter_context(closing(frames_of(options)))
        stack.enter_context(sink)
        try:
            run_loop(
                frames,
                finder.find,
                StreamingPredictor(forecasting, settings),
                sink,
                name,
                settings.history,
                summary,
            )
        except KeyboardInterrupt:
            is_interrupted = True
            if not summary.frames:
                raise
    if options.out is not None:
        logger.info("%s: %d frames", options.out, summary.frames)
    logger.info(
        "face in %d of %d frames, crops laid: %d", summary.faces, summary.frames, summary.crops
    )
    print(summary.times.table())  # noqa: T201
    return 130 if is_interrupted else 0


def frames_of(options: LiveOptions) -> Generator[VideoFrame, None, None]:
    """The images of the camera or the video, as long as they are wanted.

    Raises:
        RequestError: there are none.
    """
    if options.video is not None:
        frames = video_frames(options.video)
    else:
        assert options.camera is not None
        frames = camera_frames(open_camera(options.camera))
    limit = np.inf if options.seconds is None else options.seconds
    with closing(frames):
        first: float | None = None
        for frame in frames:
            first = frame.time if first is None else first
            if frame.time - first >= limit:
                return
            yield frame


def rate_of(video: Path | None) -> float:
    """About how many frames a second will come."""
    if video is None:
        return SequenceSettings.fps
    with VideoReader(video) as reader:
        return reader.info.average_rate


def refuse_folder_or_source(options: LiveOptions) -> None:
    """Check that the file to write is none that is read, and no folder.

    Raises:
        RequestError: it is.
    """
    if options.out is None:
        return
    if options.out.is_dir():
        raise RequestError(f"--out {options.out}: is a folder; name a file")
    if options.out.suffix.lower() != ".mp4":
        raise RequestError(f"--out {options.out}: name an .mp4 file")
    if options.video is not None and options.out.exists() and options.out.samefile(options.video):
        raise RequestError(f"--out {options.out}: is the video itself; name another file")


def load_forecasting(
    checkpoint: str, dataset: Path | None
) -> tuple[str, Forecasting, SequenceSettings]:
    """Name, forecasts and sequence settings of a network or a baseline.

    Raises:
        RequestError: it is neither, or cannot be used.
    """
    if checkpoint in FORECASTERS:
        return fit_baseline(checkpoint, dataset)
    folder = Path(str(files("face_prediction"))) / "assets" / "residual"
    if checkpoint != SHIPPED:
        folder = Path(checkpoint)
    if not folder.is_dir():
        what = "no network is in this package" if checkpoint == SHIPPED else "no such folder"
        raise RequestError(
            f"--checkpoint {checkpoint}: {what}; name a folder written by face-prediction train, "
            f"or a baseline ({', '.join(FORECASTERS)})"
        )
    import torch  # only where it is needed

    from face_prediction.models.learned import LearnedPredictor

    # one frame is too little work to share: a second thread gains nothing on an idle machine, and
    # where the cores are busy its waiting costs several times the frame
    torch.set_num_threads(1)
    predictor = LearnedPredictor.load(folder)
    settings = SequenceSettings.from_json(predictor.record.dataset)
    if predictor.needs.frames == 0:
        return predictor.name, LandmarkForecasting(predictor, HORIZON), settings
    return predictor.name, NetworkForecasting(predictor.model, predictor.name), settings


def fit_baseline(name: str, dataset: Path | None) -> tuple[str, Forecasting, SequenceSettings]:
    """A baseline, fitted to every sequence of a dataset where it has parameters.

    Raises:
        RequestError: it has parameters and there is no dataset.
    """
    settings = SequenceSettings()
    if name in UNFITTED:
        still = np.zeros((1, 1, NUM_LANDMARKS, 2), dtype=np.float32)
        known = LandmarkSequences(still, ("nobody",))
    elif dataset is None:
        raise RequestError(f"--checkpoint {name}: has parameters; name a --dataset to fit it to")
    else:
        with FaceDataset(dataset) as opened:
            settings = opened.manifest.settings
            every = opened.indices().tolist()
            known = LandmarkSequences(
                np.stack([opened.landmarks(i)[..., :2] for i in every]),
                tuple(opened.entry(i).subject for i in every),
            )
    predictor = BaselinePredictor(fit_forecaster(name, known))
    return name, LandmarkForecasting(predictor, HORIZON), settings
