"""Reading videos: times, upright contiguous images, and refusal of what is broken."""

from __future__ import annotations

from pathlib import Path

import cv2
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


def noise(frames: int = 90) -> list[np.ndarray]:
    random = np.random.default_rng(0)
    return [random.integers(0, 255, (48, 64, 3)).astype(np.uint8) for _ in range(frames)]


def read(path: Path) -> list:
    with VideoReader(path) as video:
        return list(video.frames())


def test_times_of_a_variable_rate(tmp_path: Path, write_video) -> None:
    times = [0.0, 0.04, 0.1, 0.15, 0.35, 0.36, 0.5]
    frames = read(write_video(tmp_path / "v.mp4", [corner()] * 7, times))
    np.testing.assert_allclose([frame.time for frame in frames], times, atol=1e-4)


@pytest.mark.parametrize("width", [64, 80, 360, 90])
def test_images_are_contiguous_whatever_their_width(tmp_path: Path, write_video, width) -> None:
    """Rows of widths that are no multiple of 32 come padded, which MediaPipe does not see."""
    frame = read(write_video(tmp_path / "v.mp4", [corner(width)] * 3))[0]
    assert frame.image.shape == (48, width, 3)
    assert frame.image.dtype == np.uint8
    assert frame.image.flags.c_contiguous


@pytest.mark.parametrize("rotation", [0, 90, 180, 270])
def test_pictures_are_upright_as_opencv_shows_them(tmp_path: Path, write_video, rotation) -> None:
    path = write_video(tmp_path / "v.mp4", [corner()] * 3, rotation=rotation)
    capture = cv2.VideoCapture(str(path))
    _, expected = capture.read()
    capture.release()
    got = read(path)[0].image
    assert got.shape == ((48, 80, 3) if rotation % 180 == 0 else (80, 48, 3))
    # both decode to the same YUV; the two colour conversions differ by rounding
    np.testing.assert_allclose(got, expected[..., ::-1], atol=3)


@pytest.mark.parametrize("options", [{}, {"movflags": "faststart"}], ids=["plain", "faststart"])
@pytest.mark.parametrize("share", [0.02, 0.3, 0.7, 0.95, 0.98])
def test_a_truncated_file_is_refused_by_name(
    tmp_path: Path, write_video, options: dict[str, str], share: float
) -> None:
    path = write_video(tmp_path / "v.mp4", noise(), options=options)
    assert len(read(path)) == 90
    data = path.read_bytes()
    path.write_bytes(data[: int(len(data) * share)])
    with pytest.raises(RequestError, match="truncated") as caught:
        read(path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_truncated_matroska_file_is_refused(tmp_path: Path, write_video) -> None:
    path = write_video(tmp_path / "v.mkv", noise())
    data = path.read_bytes()
    path.write_bytes(data[: int(len(data) * 0.7)])
    with pytest.raises(RequestError, match=r"truncated, its header promises 90 frames"):
        read(path)


def test_what_is_no_video_is_refused(tmp_path: Path) -> None:
    text = tmp_path / "notes.mp4"
    text.write_text("not a video at all\n" * 50)
    with pytest.raises(RequestError, match="cannot be opened as a video"):
        VideoReader(text)
    empty = tmp_path / "empty.mp4"
    empty.touch()
    for path, message in (
        (tmp_path, "is a folder"),
        (empty, "is empty"),
        (tmp_path / "absent.mp4", "no such file"),
    ):
        with pytest.raises(RequestError, match=message) as caught:
            require_video(path)
        assert str(path) in str(caught.value)


def test_hash_of_a_file(tmp_path: Path) -> None:
    path = tmp_path / "abc"
    path.write_bytes(b"abc")
    # FIPS 180-2, appendix B.1
    assert file_digest(path) == "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"
