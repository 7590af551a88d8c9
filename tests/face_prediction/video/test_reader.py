"""Reading videos: times of frames, and refusal of what is no video."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

from face_prediction.tracking.video import VideoReader, require_video
from robo_manip_baselines.runs.errors import RequestError
from robo_manip_baselines.runs.files import file_digest

pytestmark = pytest.mark.long


def corner(width: int = 80, height: int = 48) -> np.ndarray:
    """A dark picture with a bright red square in its top left corner."""
    image = np.zeros((height, width, 3), dtype=np.uint8)
    image[:16, :16, 0] = 255
    return image


def read(path: Path) -> list:
    with VideoReader(path) as video:
        return list(video.frames())


def test_times_of_a_variable_rate(tmp_path: Path, write_video) -> None:
    times = [0.0, 0.04, 0.1, 0.15, 0.35, 0.36, 0.5]
    frames = read(write_video(tmp_path / "v.mp4", [corner()] * 7, times))
    np.testing.assert_allclose([frame.time for frame in frames], times, atol=1e-4)


def test_what_is_no_video_is_refused(tmp_path: Path) -> None:
    text = tmp_path / "notes.mp4"
    text.write_text("not a video at all\n" * 50)
    with pytest.raises(RequestError, match="cannot be opened as a video"):
        VideoReader(text)
    empty = tmp_path / "empty.mp4"
    empty.touch()
    pipe = tmp_path / "pipe.mp4"
    os.mkfifo(pipe)
    for path, message in (
        (pipe, "is a pipe or device"),
        (tmp_path, "is a folder"),
        (empty, "is empty"),
        (tmp_path / "absent.mp4", "no such file"),
    ):
        with pytest.raises(RequestError, match=message) as caught:
            require_video(path)
        assert str(path) in str(caught.value)


@pytest.mark.parametrize("name", [b"talk: 1.mp4", b"caf\xe9.mp4", b"100%03d.mp4", b"-i.mp4"])
def test_any_name_of_a_file(tmp_path: Path, write_video, monkeypatch, name: bytes) -> None:
    write_video(tmp_path / "v.mp4", [corner()] * 3).rename(tmp_path / os.fsdecode(name))
    monkeypatch.chdir(tmp_path)
    assert len(read(Path(os.fsdecode(name)))) == 3


def test_any_damage_gives_frames_or_one_line(tmp_path: Path, write_video) -> None:
    """Bytes anywhere, headers and texts among them: no other error, and no line break."""
    random = np.random.default_rng(0)
    problems: list[str] = []
    for suffix in ("mp4", "mkv", "avi"):
        path = write_video(tmp_path / f"v.{suffix}", [corner()] * 6)
        whole = path.read_bytes()
        for _ in range(40):
            data = bytearray(whole)
            for place in random.integers(0, len(data), random.integers(1, 9)):
                data[place] = random.integers(256)
            path.write_bytes(data)
            try:
                read(path)
            except RequestError as error:
                problems.append(str(error))
    assert problems
    assert all(str(tmp_path) in problem and "\n" not in problem for problem in problems)


def test_texts_that_are_not_utf8(tmp_path: Path, write_video) -> None:
    path = write_video(tmp_path / "v.mkv", [corner()] * 3)
    path.write_bytes(path.read_bytes().replace(b"ENCODER", b"ENC\xd6DER"))
    assert len(read(path)) == 3


def test_hash_of_a_file(tmp_path: Path) -> None:
    path = tmp_path / "abc"
    path.write_bytes(b"abc")
    # FIPS 180-2, appendix B.1
    assert file_digest(path) == "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"
