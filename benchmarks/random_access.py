"""Random access to samples, a step with all its images: episode files against MP4.

Training reads such samples in random order. The episodes of a folder are exported as LeRobot
datasets with several encodings, and the same random samples are read from the episode files and
from each dataset, whose frames are found by their times from the key frame before them, as LeRobot
does; files stay open, and every decoder has one thread. Times are of the processor, so that other
programs on the machine do not count. Prints a Markdown table.
Run: ``python benchmarks/random_access.py dataset/FeedingEnv``.
"""

from __future__ import annotations

import json
import os
import platform
import tempfile
import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import cv2
import numpy as np
import pyarrow.parquet
import tyro
from numpy.typing import NDArray

from robo_manip_baselines.data import EpisodeReader, list_episodes
from robo_manip_baselines.data.formats.lerobot import LeRobotRequest, export_lerobot
from robo_manip_baselines.data.formats.lerobot_dataset import EPISODES_PATH
from robo_manip_baselines.data.formats.video import VideoEncoding, VideoReader
from robo_manip_baselines.runs.command import parse, run_command
from robo_manip_baselines.runs.errors import RequestError

ENCODINGS = {
    "LeRobot's default: AV1, a key frame every 2": VideoEncoding(),
    "H.264, a key frame every 2": VideoEncoding("h264", 23, gop=2),
    "H.264, a key frame every 10": VideoEncoding("h264", 23, gop=10),
    "H.264, a key frame every 250 (x264's default)": VideoEncoding("h264", 23, gop=250),
    "H.264 lossless, a key frame every 2": VideoEncoding("lossless", 0, gop=2),
}

Sample = tuple[int, int]  # episode, step
Images = list[NDArray[np.uint8]]


@dataclass(frozen=True)
class Options:
    """Measure random access to samples of a step with all its images."""

    folder: Annotated[
        Path, tyro.conf.arg(metavar="DIR", help="Folder of episodes."), tyro.conf.Positional
    ]
    samples: int = 200
    """Samples read at random places, the same from every file."""


def draw(lengths: list[int], number: int) -> list[Sample]:
    """Return random samples."""
    rng = np.random.default_rng(0)
    episodes = rng.integers(len(lengths), size=number)
    return [(int(e), int(rng.integers(lengths[e]))) for e in episodes]


def episode_reader(paths: list[Path], stack: ExitStack) -> Callable[[Sample], Images]:
    """Return a reader of samples of episode files."""
    episodes = [stack.enter_context(EpisodeReader(path)) for path in paths]
    return lambda sample: [
        episodes[sample[0]].frame(camera, sample[1]) for camera in episodes[0].cameras
    ]


def dataset_reader(
    root: Path, cameras: tuple[str, ...], stack: ExitStack
) -> Callable[[Sample], Images]:
    """Return a reader of samples of a LeRobot dataset."""
    info = json.loads((root / "meta/info.json").read_text(encoding="utf-8"))
    path = root / EPISODES_PATH.format(chunk_index=0, file_index=0)
    rows = pyarrow.parquet.read_table(path).to_pylist()
    readers: dict[Path, VideoReader] = {}
    places: dict[tuple[int, str], tuple[VideoReader, int]] = {}
    for number, row in enumerate(rows):
        for camera in cameras:
            key = f"observation.images.{camera}"
            where = {n: row[f"videos/{key}/{n}"] for n in ("chunk_index", "file_index")}
            video = root / info["video_path"].format(video_key=key, **where)
            if video not in readers:
                readers[video] = stack.enter_context(VideoReader(video, threads=1))
            first = round(row[f"videos/{key}/from_timestamp"] * info["fps"])
            places[number, camera] = readers[video], first

    def read(sample: Sample) -> Images:
        found = [places[sample[0], camera] for camera in cameras]
        return [video.frame(first + sample[1]) for video, first in found]

    return read


def measure(
    name: str,
    read: Callable[[Sample], Images],
    samples: list[Sample],
    original: Callable[[Sample], Images],
    size: float,
) -> str:
    """Return a row of the table."""
    for episode in dict(samples):
        read((episode, 0))  # opens it
    times = []
    for sample in samples:
        start = time.process_time()
        read(sample)
        times.append(time.process_time() - start)
    error = np.mean(
        [
            np.mean((a.astype(np.float64) - b) ** 2)
            for sample in samples[:20]
            for a, b in zip(read(sample), original(sample), strict=True)
        ]
    )
    quality = f"{10.0 * np.log10(255.0**2 / error):.1f} dB" if error else "the same pixels"
    median, slow = np.quantile(times, [0.5, 0.9]) * 1e3
    return f"| {name} | {size / 1e6:.1f} | {quality} | {median:.1f} | {slow:.1f} |"


def main() -> None:
    """Print the table."""
    options = parse(Options, example="python benchmarks/random_access.py dataset/FeedingEnv")
    cv2.setNumThreads(1)
    paths = list_episodes(options.folder)
    if not paths:
        raise RequestError(f"'{options.folder}' holds no episode_*.hdf5 file")
    with ExitStack() as stack:
        episodes = [stack.enter_context(EpisodeReader(path)) for path in paths]
        lengths, first = [len(episode) for episode in episodes], episodes[0]
        cameras, (height, width) = first.cameras, first.attributes["image_size"]
        codec = first.attributes["image_codec"]
    samples = draw(lengths, options.samples)
    print(
        f"{len(paths)} episodes of {sum(lengths)} steps, {len(cameras)} cameras of "
        f"{height}x{width}; {len(samples)} samples; {os.cpu_count()} cores, {processor()}"
    )
    print(
        "| files | images, MB an episode | against the recorded images "
        "| read a sample, median CPU ms | 90 % within, CPU ms |"
    )
    print("|---|---|---|---|---|")
    with ExitStack() as stack:
        original = episode_reader(paths, stack)
        size = sum(path.stat().st_size for path in paths) / len(paths)
        print(measure(f"episode files ({codec})", original, samples, original, size), flush=True)
        for name, encoding in ENCODINGS.items():
            with tempfile.TemporaryDirectory() as folder, ExitStack() as own:
                root = Path(folder) / "dataset"
                export_lerobot(
                    options.folder, root, LeRobotRequest(encoding=encoding, recorded=False)
                )
                videos = sum(path.stat().st_size for path in root.glob("videos/**/*.mp4"))
                read = dataset_reader(root, cameras, own)
                row = measure(name, read, samples, original, videos / len(paths))
                print(row, flush=True)


def processor() -> str:
    """Return the name of the processor."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
        return next(line.partition(": ")[2] for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        return platform.processor()


if __name__ == "__main__":
    run_command(main)
