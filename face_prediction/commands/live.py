"""``face-prediction live``: a camera or a video, with the mouth drawn ahead of itself."""

from __future__ import annotations

import logging
from contextlib import ExitStack, closing, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
from annotated_types import Interval

from face_prediction.dataset.reader import FaceDataset
from face_prediction.dataset.sequences import SequenceSettings
from face_prediction.evaluation.predictors import UNFITTED, BaselinePredictor, dataset_landmarks
from face_prediction.forecast import FORECASTERS, LandmarkSequences, fit_forecaster
from face_prediction.live.loop import LiveStatistics, run_loop, video_sink, window_sink
from face_prediction.live.sources import face_finder, live_frames
from face_prediction.live.streaming import (
    AnyForecaster,
    FollowingForecaster,
    LandmarkForecaster,
    NetworkForecaster,
    StreamingPredictor,
)
from face_prediction.models.loading import SHIPPED
from face_prediction.tracking.detector import find_model
from face_prediction.tracking.tracks import NUM_LANDMARKS
from face_prediction.tracking.video import VideoReader, require_video
from robo_manip_baselines.runs.command import EXIT_INTERRUPTED
from robo_manip_baselines.runs.errors import RequestError
from robo_manip_baselines.runs.files import locked_file, require_out_file
from robo_manip_baselines.runs.ranges import Positive, require_ranges
from robo_manip_baselines.runs.videos import VIDEO

logger = logging.getLogger(__name__)

MAX_CAMERAS = 100
"""OpenCV reads hundreds as the name of a driver, and crashes at numbers below 0."""
HORIZON = 5
"""Frames ahead (paper, IV.A)."""


@dataclass(frozen=True)
class LiveOptions:
    """Follow a face, forecast its mouth, and draw both on the image, with the times they take.

    Example: face-prediction live --video clip.mp4 --out forecast.mp4

    Attributes:
        camera: number of a camera, 0 being the first.
        video: a video file, instead.
        checkpoint: folder of a trained network; shipped: the one that comes with the package; or
            the name of a baseline.
        dataset: folder made by build-dataset, that a baseline with parameters is fitted to.
        out: video file (H.264, .mp4) to write; by default a window is opened.
        detector_model: MediaPipe's face_landmarker.task. By default the one in
            ~/.cache/face_prediction (or $XDG_CACHE_HOME/face_prediction), downloaded once if there
            is a network.
        seconds: stop after so many seconds of video; None: at its end, with Escape or q in the
            window, or with Ctrl-C.
    """

    camera: Annotated[int, Interval(ge=0, le=MAX_CAMERAS - 1)] | None = None
    video: Path | None = None
    checkpoint: str = SHIPPED
    dataset: Path | None = None
    out: Path | None = None
    detector_model: Path | None = None
    seconds: Positive | None = None


def run_live(options: LiveOptions) -> int:
    """Run until the video ends or the user stops.

    Returns:
        0, or 130 when it was interrupted; a file that was being written is then complete.

    Raises:
        RequestError: camera, video, network or detector cannot be used, or there is no display.
    """
    check_live_options(options)
    name, forecaster, settings = load_forecaster(options.checkpoint, options.dataset)
    model = find_model(options.detector_model)
    rate = settings.fps
    if options.video is not None:
        with VideoReader(options.video) as reader:
            rate = reader.average_rate or rate
    statistics = LiveStatistics()
    code = 0
    with ExitStack() as stack:
        if options.out is not None:
            stack.enter_context(locked_file(options.out))
        sink = window_sink() if options.out is None else video_sink(options.out, rate)
        show = stack.enter_context(sink)
        find = stack.enter_context(face_finder(model))
        frames = live_frames(options.video, options.camera, options.seconds)
        stack.enter_context(closing(frames))
        predictor = StreamingPredictor(forecaster, settings)
        try:
            run_loop(frames, find, predictor, show, name, settings.history, statistics)
        except KeyboardInterrupt:
            if not statistics.frames:
                raise
            code = EXIT_INTERRUPTED
    if options.out is not None:
        logger.info("%s: %d frames", options.out, statistics.frames)
    counts = (statistics.faces, statistics.frames, statistics.crops)
    logger.info("face in %d of %d frames, crops laid: %d", *counts)
    print(statistics.times_table())  # noqa: T201
    return code


def check_live_options(options: LiveOptions) -> None:
    """Raise RequestError if an option is out of its range, or the file to write is the one read."""
    out, video = options.out, options.video
    if (options.camera is None) == (video is None):
        raise RequestError("give either --camera NUMBER or --video FILE")
    require_ranges(options, "--{} {}")
    if video is not None:
        require_video(video)
    if out is None:
        return
    with suppress(OSError):  # there is no such file
        if video is not None and out.samefile(video):
            raise RequestError(f"--out {out}: is the video itself; name another file")
    require_out_file(out, VIDEO, [options.detector_model])


def load_forecaster(
    checkpoint: str, dataset: Path | None
) -> tuple[str, AnyForecaster, SequenceSettings]:
    """Name, forecasts and sequence settings of a network or a baseline.

    A baseline with parameters is fitted to every sequence of the dataset.

    Raises:
        RequestError: it is neither, cannot be used, or needs a dataset.
    """
    if checkpoint in FORECASTERS:
        settings = SequenceSettings()
        known = LandmarkSequences(np.zeros((1, 1, NUM_LANDMARKS, 2), np.float32), ("nobody",))
        if checkpoint not in UNFITTED:
            if dataset is None:
                missing = "has parameters; name a --dataset to fit it to"
                raise RequestError(f"--checkpoint {checkpoint}: {missing}")
            with FaceDataset(dataset) as opened:
                settings = opened.manifest.settings
                known = dataset_landmarks(opened, opened.indices())
        predictor = BaselinePredictor(fit_forecaster(checkpoint, known))
        return checkpoint, LandmarkForecaster(predictor, HORIZON), settings
    import torch  # only where it is needed

    from face_prediction.models.learned import LearnedPredictor
    from face_prediction.models.loading import load_predictor

    if checkpoint != SHIPPED and not Path(checkpoint).is_dir():
        raise RequestError(
            f"--checkpoint {checkpoint}: no such folder; name a folder written by face-prediction "
            f"fit or train, or a baseline ({', '.join(FORECASTERS)})"
        )
    # one frame is too little work to share: a second thread gains nothing on an idle machine, and
    # where the cores are busy its waiting costs several times the frame
    torch.set_num_threads(1)
    predictor, record = load_predictor(checkpoint)
    settings = SequenceSettings.from_json(record.dataset)
    if not isinstance(predictor, LearnedPredictor):
        return predictor.name, FollowingForecaster(predictor, HORIZON), settings
    if predictor.needs.frames == 0:
        return predictor.name, LandmarkForecaster(predictor, HORIZON), settings
    return predictor.name, NetworkForecaster(predictor.model, predictor.name), settings
