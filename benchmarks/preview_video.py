"""Speed of a preview video, part by part: frames are drawn, encoded, and both at once.

Drawing is replay and rendering, or the decoding of recorded images, with tracks and caption. The
processor time is that of all threads together, so that other programs change it little; on a
machine with nothing else to do, the whole takes about the wall time of its slowest thread.

Example: python benchmarks/preview_video.py dataset/FeedingEnv --frames 100
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

import numpy as np
import tyro
from numpy.typing import NDArray

from robo_manip_baselines.data import list_episodes
from robo_manip_baselines.rollout.videos import (
    FPS,
    VideoWriter,
    preview_frames,
    preview_writer,
    write_preview,
)
from robo_manip_baselines.runs.command import parse, run_command
from robo_manip_baselines.runs.errors import RequestError


@dataclass(frozen=True)
class Options:
    """Draw and encode the preview of an episode, and print frames per second."""

    episodes: tyro.conf.Positional[Path]
    """An episode file, or a folder of them; the first one is shown."""
    frames: int = 100
    """Frames that are drawn alone and encoded alone."""


def measure(label: str, function: Callable[[], int]) -> None:
    """Print how many frames a second a function makes that returns how many it has made."""
    cpu, wall = time.process_time(), time.perf_counter()
    frames = function()
    cpu, wall = time.process_time() - cpu, time.perf_counter() - wall
    print(f"{label:<30}{frames / cpu:10.0f}{frames / wall:10.0f}", flush=True)


def encode(writer: VideoWriter, frames: list[NDArray[np.uint8]]) -> int:
    """Encode frames, as the thread of a preview does; return their number."""
    with writer as video:
        for frame in frames:
            video.write(frame)
    return len(frames)


def main() -> None:
    """Measure and print."""
    options = parse(Options, "python benchmarks/preview_video.py dataset/FeedingEnv")
    if options.frames < 1:
        raise RequestError("frames: must be 1 or more")
    found = options.episodes
    episodes = list_episodes(found)[:1] if found.is_dir() else [found]
    if not episodes:
        raise RequestError(f"no episode in '{found}'")
    frames: list[NDArray[np.uint8]] = []

    def draw() -> int:
        frames.clear()
        frames.extend(islice(preview_frames(episodes[0]), options.frames))
        return len(frames)

    def whole(path: Path) -> int:
        write_preview(path, episodes)
        return sum(1 for _ in _packets(path))

    print(f"{'frames a second of':<30}{'CPU':>10}{'wall':>10}")
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "preview.mp4")
        draw()  # what is made once, such as the face's surface, is left out
        measure("drawn", draw)
        measure("encoded", lambda: encode(preview_writer(path), frames))
        own = path.stat().st_size
        measure("encoded, as other videos", lambda: encode(VideoWriter(path, FPS), frames))
        other = path.stat().st_size
        measure("drawn and encoded", lambda: whole(path))
    print(f"bytes a frame: {own / len(frames):.0f}, as other videos {other / len(frames):.0f}")


def _packets(path: Path) -> list[object]:
    import av  # slow to import

    with av.open(str(path)) as container:
        return [packet for packet in container.demux(video=0) if packet.size]


if __name__ == "__main__":
    run_command(main)
