"""Draws the image of the README: ``python docs/images/draw_demo.py``, after ``make demo``."""

from __future__ import annotations

from itertools import islice
from pathlib import Path

import cv2

from robo_manip_baselines.rollout.videos import VIEW_SIZE, preview_frames
from robo_manip_baselines.runs.command import run_command

EPISODE = Path("dataset/demo/episode_000000.hdf5")
FRAME = 150  # 6 s, on the way to the mouth


def main() -> None:
    frame = next(islice(preview_frames(EPISODE, VIEW_SIZE), FRAME, None))
    path = Path(__file__).parent / "demo.png"
    cv2.imwrite(str(path), cv2.cvtColor(frame, cv2.COLOR_RGB2BGR))
    print(path)


if __name__ == "__main__":
    run_command(main)
