"""Milliseconds a frame of a live predictor, without the detector.

Wall-clock time, and beside it processor time, summed over threads, which other programs on the
machine hardly touch. Networks have random weights: a trained one takes as long. Each is fed a face
that moves in drawn images; the history is whole and the crop holds, as it does most of the time.
``residual`` is the one that ships.
Beside it, the same network encodes its whole history again in every frame, and makes its pictures.
Prints a Markdown table::

    python benchmarks/live_predictor.py --threads 2

``--models`` and ``--presets`` choose; persistence stands for what is not the network.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch

from face_prediction.dataset.histories import dataset_image
from face_prediction.dataset.sequences import SequenceSettings
from face_prediction.evaluation.predictors import BaselinePredictor
from face_prediction.forecast.extrapolation import Persistence
from face_prediction.live.streaming import (
    AnyForecaster,
    FollowingForecaster,
    LandmarkForecaster,
    NetworkForecaster,
    StreamingPredictor,
)
from face_prediction.models.interface import History, PredictorModel
from face_prediction.models.loading import RESIDUAL, SHIPPED, load_predictor
from face_prediction.models.residual.predictor import ResidualPredictor
from face_prediction.models.settings import MODELS, PRESETS, make_predictor_model, preset_settings
from face_prediction.tracking.tracks import NUM_LANDMARKS
from robo_manip_baselines.runs.command import run_command
from robo_manip_baselines.runs.errors import RequestError

IMAGE = (640, 480)
SETTINGS = SequenceSettings()
PERSISTENCE = "persistence"
FORECASTERS = [PERSISTENCE, RESIDUAL, *(name for name in MODELS if name != "image_only")]
"""Predictors of landmarks."""


def drawn_faces(count: int) -> tuple[np.ndarray, list[np.ndarray]]:
    """Landmarks (count, 468, 3) of a face that sways by a few pixels, and as many images."""
    rng = np.random.default_rng(0)
    face = 0.5 + np.array([0.2, 0.3, 0.05]) * (rng.uniform(size=(NUM_LANDMARKS, 3)) - 0.5)
    phase = np.arange(count)[:, None] / 10
    moved = 0.005 * np.sin(phase + np.array([0.0, 1.0]))
    landmarks = np.repeat(face[None], count, axis=0)
    landmarks[:, :, :2] += moved[:, None]
    base = rng.integers(0, 256, size=(IMAGE[1], IMAGE[0], 3), dtype=np.uint8)
    base = (base // 8 + np.linspace(0, 200, IMAGE[0], dtype=np.uint8)[None, :, None]).astype(
        np.uint8
    )
    return landmarks, [np.roll(base, shift, axis=1) for shift in range(count)]


@dataclass(frozen=True)
class Taken:
    """Milliseconds of each frame on the clock, and of processor time."""

    wall: np.ndarray
    processor: np.ndarray


def frame_times(run: Callable[[int], object], first: int, count: int) -> Taken:
    """Durations of ``run(number)``, for ``count`` numbers from ``first`` on."""
    taken = np.empty((2, count))
    for place in range(count):
        begun, worked = time.perf_counter(), time.process_time()
        run(first + place)
        taken[:, place] = time.perf_counter() - begun, time.process_time() - worked
    return Taken(*1e3 * taken)


def streamed(forecaster: AnyForecaster, frames: int) -> Taken:
    """Of a streaming predictor, once it knows a whole history."""
    warm = SETTINGS.history + 5
    landmarks, images = drawn_faces(warm + frames)
    stream = StreamingPredictor(forecaster, SETTINGS)

    def run(number: int) -> None:
        stream.update(number / SETTINGS.fps, landmarks[number], images[number])

    frame_times(run, 0, warm)
    return frame_times(run, warm, frames)


def whole(network: PredictorModel, frames: int) -> Taken:
    """Of a network that encodes its whole history in every frame."""
    warm = SETTINGS.history
    landmarks, images = drawn_faces(warm + frames)
    crop = StreamingPredictor(LandmarkForecaster(_persistence(), 5), SETTINGS).update(
        0.0, landmarks[0], images[0]
    )
    assert crop is not None
    needs = network.needs
    shown = [dataset_image(image, crop.crop, SETTINGS, needs.size) for image in images[:warm]]

    def run(number: int) -> None:
        shown.append(dataset_image(images[number], crop.crop, SETTINGS, needs.size))
        points = crop.crop.normalise(landmarks[number - network.history + 1 : number + 1], IMAGE)
        pictures = np.stack(shown[len(shown) - needs.frames :])
        with torch.inference_mode():
            network(
                History(
                    torch.from_numpy(points[None, ..., :2].astype(np.float32)),
                    torch.from_numpy(pictures[None]),
                )
            )

    frame_times(run, warm, 1)
    return frame_times(run, warm + 1, frames - 1)


def _persistence() -> BaselinePredictor:
    return BaselinePredictor(Persistence())


def row(name: str, preset: str, frames: int) -> str:
    """One line of the table."""
    if name == PERSISTENCE:
        ours = streamed(LandmarkForecaster(_persistence(), 5), frames)
        return f"| {name} | | | {_cells(ours)} | | |"
    if name == RESIDUAL:
        predictor, _ = load_predictor(SHIPPED)
        assert isinstance(predictor, ResidualPredictor)
        return (
            f"| {name} | | | {_cells(streamed(FollowingForecaster(predictor, 24), frames))} | | |"
        )
    torch.manual_seed(0)
    network = make_predictor_model(name, preset_settings(name, preset)[0]).eval()
    needs = network.needs
    ours = streamed(NetworkForecaster(network, name), frames)
    theirs = whole(network, max(frames // 5, 4))
    ratio = theirs.processor.mean() / ours.processor.mean()
    return (
        f"| {name} | {preset} | {needs.frames} of {needs.size} | {_cells(ours)} "
        f"| {theirs.processor.mean():.1f} | {ratio:.1f} |"
    )


def _cells(taken: Taken) -> str:
    high = np.quantile(taken.wall, 0.95)
    return f"{taken.wall.mean():.1f} | {high:.1f} | {taken.processor.mean():.1f}"


def main() -> None:
    """Time and print."""
    parser = argparse.ArgumentParser(description="Time a frame takes a live predictor.")
    parser.add_argument(
        "--models",
        nargs="*",
        choices=FORECASTERS,
        default=FORECASTERS,
        help="that forecast landmarks",
    )
    parser.add_argument("--presets", nargs="*", choices=PRESETS, default=["cpu", "paper"])
    parser.add_argument("--frames", type=int, default=60, help="timed, of each")
    parser.add_argument("--threads", type=int, default=2, help="of PyTorch")
    options = parser.parse_args()
    if min(options.frames, options.threads) < 1:
        raise RequestError("--frames and --threads must be 1 or more")
    torch.set_num_threads(options.threads)
    print(f"{options.threads} threads, {options.frames} frames, images of {IMAGE[0]}x{IMAGE[1]}.\n")
    print(
        "| predictor | preset | pictures | mean ms | 95 % ms | processor ms "
        "| whole history, processor ms | ratio |"
    )
    print("|---|---|---|---|---|---|---|---|")
    for name in options.models:
        for preset in options.presets if name in MODELS else [""]:
            print(row(name, preset, options.frames), flush=True)


if __name__ == "__main__":
    run_command(main)
