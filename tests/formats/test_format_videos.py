"""Videos: every frame, in order or at random, whatever the codec; joined without a loss."""

from __future__ import annotations

import os
import wave
from pathlib import Path

import numpy as np
import pytest

from robo_manip_baselines.data.example import make_frames
from robo_manip_baselines.data.formats.video import (
    VIDEO_CODECS,
    VideoEncoding,
    VideoReader,
    VideoWriter,
    join_videos,
)
from robo_manip_baselines.runs.errors import RequestError

SIZE = (64, 96)


def write(path: Path, frames: np.ndarray, encoding: VideoEncoding) -> Path:
    with VideoWriter(path, (frames.shape[1], frames.shape[2]), 50, encoding) as video:
        for frame in frames:
            video.add(frame)
    return path


@pytest.mark.parametrize("codec", VIDEO_CODECS)
def test_joined_parts_hold_every_frame_in_order(codec: str, tmp_path: Path) -> None:
    encoding = VideoEncoding(codec, VIDEO_CODECS[codec], gop=4)
    # Grey levels apart by more than any codec here errs.
    frames = np.repeat(np.arange(10, 240, 10, dtype=np.uint8), SIZE[0] * SIZE[1] * 3)
    frames = frames.reshape(23, *SIZE, 3)
    parts = [write(tmp_path / "a.mp4", frames[:9], encoding)]
    parts.append(write(tmp_path / "b.mp4", frames[9:], encoding))
    join_videos(parts, tmp_path / "joined.mp4")
    with VideoReader(tmp_path / "joined.mp4") as video:
        info = video.info
        assert (info.frames, info.size, info.fps) == (23, SIZE, 50)
        read = np.stack(list(video))
        at_random = {k: video.frame(k) for k in (22, 0, 8, 9, 3, 10)}
        for outside in (-1, 23):
            with pytest.raises(RequestError, match=f"has no frame {outside}"):
                video.frame(outside)
    assert read.shape == frames.shape
    for index, frame in at_random.items():
        np.testing.assert_array_equal(frame, read[index])
    assert np.abs(read.astype(int) - frames).max() < 5
    if codec == "lossless":
        np.testing.assert_array_equal(read, frames)


@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="cores cannot be taken away here")
@pytest.mark.parametrize("codec", VIDEO_CODECS)
def test_the_same_frames_give_the_same_bytes_on_any_number_of_cores(
    codec: str, tmp_path: Path
) -> None:
    frames, encoding = make_frames(4, size=(480, 640)), VideoEncoding(codec, VIDEO_CODECS[codec])
    first = write(tmp_path / "all.mp4", frames, encoding)
    cores = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {min(cores)})
    try:
        second = write(tmp_path / "one.mp4", frames, encoding)
    finally:
        os.sched_setaffinity(0, cores)
    assert first.read_bytes() == second.read_bytes()


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"codec": "h265"}, "unknown video codec 'h265'"),
        ({"crf": 64}, "crf 64: must be 0 to 63"),
        ({"codec": "h264", "crf": 52}, "crf 52: must be 0 to 51"),
        ({"gop": 0}, "gop 0"),
    ],
)
def test_wrong_encodings_are_refused(values: dict[str, object], message: str) -> None:
    with pytest.raises(RequestError, match=message):
        VideoEncoding(**values)  # type: ignore[arg-type]


def test_odd_sizes_need_the_lossless_codec(tmp_path: Path) -> None:
    frames = make_frames(3, size=(33, 45))
    with pytest.raises(RequestError, match="takes even sizes"):
        write(tmp_path / "odd.mp4", frames, VideoEncoding("h264", 23))
    path = write(tmp_path / "odd.mp4", frames, VideoEncoding("lossless", 0))
    with VideoReader(path) as video:
        np.testing.assert_array_equal(np.stack(list(video)), frames)


def test_damaged_videos_are_one_line(tmp_path: Path) -> None:
    (tmp_path / "bad.mp4").write_bytes(b"no video")
    with pytest.raises(RequestError, match="is no video"):
        VideoReader(tmp_path / "bad.mp4")


def test_a_refused_file_is_closed(tmp_path: Path) -> None:
    sound = tmp_path / "sound.wav"
    with wave.open(str(sound), "wb") as file:
        file.setparams((1, 2, 8000, 0, "NONE", ""))
        file.writeframes(bytes(16000))
    with pytest.raises(RequestError, match="is no video") as caught:
        VideoReader(sound)
    assert caught.value.__traceback__ is not None  # which holds what was being made
    files = [link.resolve() for link in Path("/proc/self/fd").iterdir()]
    assert sound.resolve() not in files
