"""``live`` with the real detector on a real clip (needs the development clips)."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from face_prediction.commands.live import LiveOptions, run_live
from face_prediction.live.sources import face_finder
from face_prediction.tracking.video import VideoReader

pytestmark = [pytest.mark.shared, pytest.mark.long]

pytest.importorskip(
    "mediapipe", reason="MediaPipe is not installed (extra face_prediction)", exc_type=ImportError
)


def test_a_second_of_a_talking_face(shared_dir: Path, tmp_path: Path, capfd) -> None:
    faces = shared_dir / "faces"
    clip, model = faces / "clips" / "carphone.mp4", faces / "face_landmarker.task"
    out = tmp_path / "out.mp4"
    options = LiveOptions(
        video=clip, checkpoint="constant_velocity", out=out, detector_model=model, seconds=1.0
    )
    assert run_live(options) == 0
    told = capfd.readouterr()
    assert told.err == ""  # MediaPipe's native messages are kept off the terminal
    with VideoReader(clip) as video:
        before = [frame for frame in video.frames() if frame.time < 1.0]
    with VideoReader(out) as video:
        after = list(video.frames())
    assert len(after) == len(before)
    assert f"| detector | {len(before)} |" in told.out
    # something green where the detector finds the mouth, and was not green before
    with face_finder(model) as find:
        landmarks = find(before[-1].image, before[-1].time)
    assert landmarks is not None
    height, width = before[-1].image.shape[:2]
    x, y = (landmarks[[13, 14], :2].mean(axis=0) * (width, height)).astype(int)
    old, new = (f.image[y - 3 : y + 4, x - 3 : x + 4].astype(int) for f in (before[-1], after[-1]))
    assert np.max(new[..., 1] - new[..., 0]) > np.max(old[..., 1] - old[..., 0]) + 20
