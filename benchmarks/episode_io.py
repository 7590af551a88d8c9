"""Size and speed of episode files with each image codec.

Writes and reads one episode of three 480 x 640 cameras whose pictures are drawn here: shapes on a
shaded background, as hard to compress as a rendered scene.
Prints a Markdown table. Run: ``python benchmarks/episode_io.py``.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from robo_manip_baselines.data import EpisodeReader, write_episode
from robo_manip_baselines.data.example import make_arrays, make_attributes
from robo_manip_baselines.data.verify import verify_file
from robo_manip_baselines.runs.command import parse, run_command
from robo_manip_baselines.runs.images import CODECS, encode_image

# So many that a picture takes as many bytes as one of FeedingEnv: 26 to 34 kB as JPEG at 90.
NUM_SHAPES = 35

CAMERAS = ("angle", "front_close", "top")


@dataclass(frozen=True)
class Options:
    """Measure episode files: size, writing, reading, checking, for each image codec."""

    num_steps: int = 600
    """Control steps; 600 are an episode of 12 s. Raw images need 2.8 MB of memory a step."""
    random_reads: int = 300
    """Frames read at random places, as training does."""


def draw_frames(num_steps: int, seed: int) -> Iterator[np.ndarray]:
    """(480, 640, 3) uint8 pictures of a made-up scene."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[:480, :640].astype(np.float32)
    shade = np.stack([90 + 60 * x / 640, 100 + 50 * y / 480, 120 - 30 * x / 640], axis=-1)
    background = np.ascontiguousarray(shade.astype(np.uint8))
    for _ in range(NUM_SHAPES):
        centre = (int(rng.integers(640)), int(rng.integers(480)))
        axes = (int(rng.integers(4, 60)), int(rng.integers(4, 30)))
        colour = rng.integers(20, 220, 3).tolist()
        cv2.ellipse(background, centre, axes, rng.uniform(0, 180), 0, 360, colour, -1, cv2.LINE_AA)
    for step in range(num_steps):
        frame = background.copy()
        centre = (320 + round(120 * np.cos(step / 60)), 240 + round(90 * np.sin(step / 45)))
        cv2.ellipse(frame, centre, (90, 120), 0, 0, 360, (205, 160, 140), -1, cv2.LINE_AA)
        cv2.line(frame, (20, 460), centre, (35, 35, 40), 30, cv2.LINE_AA)
        cv2.rectangle(frame, (centre[0] - 14, centre[1] - 14), centre, (200, 30, 35), -1)
        yield frame


def measure(codec: str, options: Options, folder: Path) -> str:
    """One row of the table."""
    images: dict[str, list[np.ndarray]] = {}
    encoding = 0.0
    for seed, camera in enumerate(CAMERAS):
        images[camera] = []
        for frame in draw_frames(options.num_steps, seed):
            start = time.perf_counter()
            images[camera].append(encode_image(frame, codec))
            encoding += time.perf_counter() - start
    start = time.perf_counter()
    path = write_episode(
        folder / f"{codec}.hdf5",
        make_arrays(options.num_steps),
        images,
        make_attributes(codec=codec),
    )
    writing = time.perf_counter() - start
    rng = np.random.default_rng(0)
    with EpisodeReader(path) as episode:
        start = time.perf_counter()
        for _ in range(options.random_reads):
            episode.frame(CAMERAS[rng.integers(3)], int(rng.integers(options.num_steps)))
        reading = time.perf_counter() - start
        error = np.mean(
            [
                np.mean((episode.frame(CAMERAS[0], step).astype(np.float32) - frame) ** 2)
                for step, frame in enumerate(draw_frames(min(20, options.num_steps), 0))
            ]
        )
    start = time.perf_counter()
    if verify_file(path):
        raise RuntimeError(f"{path} was written damaged")
    verifying = time.perf_counter() - start
    size = path.stat().st_size
    path.unlink()
    number = options.num_steps * len(CAMERAS)
    quality = f"{10 * np.log10(255**2 / error):.1f} dB" if error else "lossless"
    return (
        f"| {codec} | {size / 1e6:.1f} | {size / number / 1e3:.1f} | {quality} "
        f"| {encoding / number * 1e3:.2f} | {writing:.2f} "
        f"| {reading / options.random_reads * 1e3:.2f} | {verifying:.1f} |"
    )


def main() -> None:
    """Print the table."""
    options = parse(Options, example="python benchmarks/episode_io.py --num_steps 100")
    print(f"{options.num_steps} steps, {len(CAMERAS)} cameras of 480x640")
    print(
        "| codec | MB an episode | kB a frame | PSNR | encode, ms a frame | write, s an episode "
        "| read a random frame, ms | verify, s an episode |"
    )
    print("|---|---|---|---|---|---|---|---|")
    with tempfile.TemporaryDirectory() as folder:
        for codec in CODECS:
            print(measure(codec, options, Path(folder)), flush=True)


if __name__ == "__main__":
    run_command(main)
