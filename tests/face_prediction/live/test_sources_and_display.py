"""Cameras, videos, windows and files."""

from __future__ import annotations

import threading
from pathlib import Path

import cv2
import numpy as np
import pytest

from face_prediction.live import sources
from face_prediction.live.loop import video_sink, window_sink
from face_prediction.live.sources import camera_frames, live_frames
from face_prediction.tracking.video import VideoFrame, VideoReader
from robo_manip_baselines.runs.errors import RequestError

pytestmark = pytest.mark.long

SIZE = (320, 240)


def read(path: Path) -> list[VideoFrame]:
    with VideoReader(path) as video:
        return list(video.frames())


@pytest.mark.parametrize(
    ("key", "is_open", "goes_on"),
    [(-1, 1.0, True), (27, 1.0, False), (ord("q"), 1.0, False), (-1, 0.0, False)],
)
def test_a_window_ends_with_escape_q_or_its_button(monkeypatch, key, is_open, goes_on) -> None:
    shown: list[np.ndarray] = []
    monkeypatch.setattr(cv2, "getBuildInformation", lambda: "  GUI:                   QT5\n")
    monkeypatch.setenv("DISPLAY", ":0")
    monkeypatch.setattr(cv2, "namedWindow", lambda *_: None)
    monkeypatch.setattr(cv2, "destroyAllWindows", lambda: shown.clear())
    monkeypatch.setattr(cv2, "imshow", lambda _, image: shown.append(image))
    monkeypatch.setattr(cv2, "waitKey", lambda _: key)
    monkeypatch.setattr(cv2, "getWindowProperty", lambda *_: is_open)
    image = np.zeros((4, 4, 3), dtype=np.uint8)
    image[..., 0] = 200
    with window_sink() as show:
        assert show(image, 0.0) == goes_on
        assert shown[0][0, 0].tolist() == [0, 0, 200]  # OpenCV's order
    assert shown == []


class FakeCamera:
    """Gives ``count`` images, each when the test says so."""

    def __init__(self, count: int) -> None:
        self.left = count
        self.go = threading.Semaphore(0)
        self.done = threading.Semaphore(0)
        self.is_released = False

    def read(self):
        self.go.acquire(timeout=5)
        if self.left == 0:
            return False, None
        self.left -= 1
        self.done.release()
        return True, np.full((2, 2, 3), (1, 2, self.left), dtype=np.uint8)

    def release(self) -> None:
        self.is_released = True


def test_a_camera_gives_its_newest_image() -> None:
    camera, clock = FakeCamera(5), iter(range(100, 200))
    frames = camera_frames(camera, clock=lambda: float(next(clock)))
    camera.go.release()
    first = next(frames)
    assert first.time == 0.0
    assert first.image[0, 0].tolist() == [4, 2, 1]  # RGB
    for _ in range(3):  # three more come while the first is worked on
        camera.done.acquire(timeout=5)
        camera.go.release()
    camera.done.acquire(timeout=5)
    newest = next(frames)  # the last one, or, if that is just being read, the one before
    assert newest.image[0, 0, 0] <= 2
    assert newest.time > 0.0
    frames.close()
    camera.go.release()
    assert camera.is_released


def test_a_camera_that_ends_is_let_go() -> None:
    camera = FakeCamera(1)
    camera.go.release()
    camera.go.release()
    assert len(list(camera_frames(camera))) <= 1
    assert camera.is_released


def test_a_silent_camera_is_said(monkeypatch) -> None:
    monkeypatch.setattr(sources, "CAMERA_TIMEOUT", 0.05)
    camera = FakeCamera(0)
    with pytest.raises(RequestError, match=r"gave no image for 0.05 s"):
        next(camera_frames(camera))
    assert camera.is_released


def test_no_such_camera() -> None:
    with pytest.raises(RequestError, match="--camera 97: cannot be opened"):
        sources.open_camera(97)


def test_a_video_gives_every_frame(clip: Path) -> None:
    assert [frame.time for frame in live_frames(clip, None)] == pytest.approx(np.arange(20) / 30)


def test_a_file_keeps_the_times_of_its_images(tmp_path: Path) -> None:
    times = [0.0, 0.04, 0.05, 0.5, 0.51]
    path = tmp_path / "new" / "odd.mp4"
    with video_sink(path, 25.0) as show:
        for index, time in enumerate(times):
            assert show(np.full((33, 47, 3), 40 * index, dtype=np.uint8), time)
    frames = read(path)
    assert [frame.time for frame in frames] == pytest.approx(times, abs=1e-4)
    assert frames[0].image.shape == (32, 46, 3)
    assert [int(frame.image.mean()) for frame in frames] == pytest.approx(
        [0, 40, 80, 120, 160], abs=3
    )


def test_times_below_zero_begin_a_file_at_zero(tmp_path: Path) -> None:
    """A file holds no such times; the images keep their distances."""
    times = np.array([-0.5, -0.4, -0.05, 0.0, 0.1])
    path = tmp_path / "early.mp4"
    with video_sink(path, 25.0) as show:
        for time in times:
            assert show(np.zeros((32, 32, 3), dtype=np.uint8), time)
    assert [frame.time for frame in read(path)] == pytest.approx(times + 0.5, abs=1e-4)


def test_a_file_without_images_is_refused(tmp_path: Path) -> None:
    with pytest.raises(RequestError, match="no image to write"), video_sink(tmp_path / "a.mp4", 30):
        pass
    assert list(tmp_path.iterdir()) == []
