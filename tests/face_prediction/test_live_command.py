"""``live`` from a drawn video to a drawn-over one, without camera, screen or detector."""

from __future__ import annotations

import threading
from dataclasses import replace
from pathlib import Path

import av
import cv2
import numpy as np
import pytest

from face_prediction import live_command
from face_prediction.dataset.crop import Crop
from face_prediction.errors import RequestError
from face_prediction.live import sinks, sources
from face_prediction.live.loop import Summary, Times, captions, run_loop
from face_prediction.live.overlay import FAR, GREEN, NEAR, draw_lines, draw_mouth
from face_prediction.live.sinks import VideoFile, Window
from face_prediction.live.sources import camera_frames, video_frames
from face_prediction.live.streaming import LiveForecast
from face_prediction.live_command import LiveOptions, run_live
from face_prediction.video import VideoFrame, VideoReader

pytestmark = pytest.mark.long

SIZE = (320, 240)


@pytest.fixture
def landmarks(make_track) -> np.ndarray:
    return make_track(np.array([[0.0, 0.0, -0.5]]), image_size=SIZE).landmarks[0]


@pytest.fixture
def clip(tmp_path: Path, write_video) -> Path:
    images = [np.full((SIZE[1], SIZE[0], 3), 40 + 5 * i, dtype=np.uint8) for i in range(20)]
    return write_video(tmp_path / "clip.mp4", images)


class DrawnFaces:
    """A detector of a face that goes to the right, and hides in the frames of ``hidden``."""

    hidden: tuple[int, ...] = ()
    interrupt_at: int | None = None

    def __init__(self, landmarks: np.ndarray) -> None:
        self.landmarks = landmarks
        self.count = -1

    def __enter__(self) -> DrawnFaces:
        return self

    def __exit__(self, *_: object) -> None:
        pass

    def find(self, image: np.ndarray, time: float) -> np.ndarray | None:
        self.count += 1
        if self.count == self.interrupt_at:
            raise KeyboardInterrupt
        moved = self.landmarks.copy()
        moved[:, 0] += 0.01 * self.count
        return None if self.count in self.hidden else moved


@pytest.fixture
def faces(monkeypatch, landmarks) -> DrawnFaces:
    drawn = DrawnFaces(landmarks)
    monkeypatch.setattr(live_command, "FaceFinder", lambda model: drawn)
    monkeypatch.setattr(live_command, "find_model", lambda given: given)
    return drawn


def read(path: Path) -> list[VideoFrame]:
    with VideoReader(path) as video:
        return list(video.frames())


def test_a_video_is_drawn_over_frame_by_frame(clip: Path, faces, tmp_path: Path, capsys) -> None:
    out = tmp_path / "out.mp4"
    assert run_live(LiveOptions(video=clip, checkpoint="constant_velocity", out=out)) == 0
    before, after = read(clip), read(out)
    assert len(after) == 20
    for old, new in zip(before, after, strict=True):
        assert new.time == pytest.approx(old.time, abs=1e-4)
        assert new.image.shape == old.image.shape
        assert np.abs(new.image[150:180, 5:60].astype(int) - old.image[150:180, 5:60]).max() < 6
        assert new.image[:40, :60].max() > 150  # the times are written at the top
    with av.open(str(out)) as container:
        assert container.streams.video[0].codec_context.name == "h264"
        assert container.streams.video[0].codec_context.pix_fmt == "yuv420p"
    shown = capsys.readouterr().out
    assert "| detector | 20 |" in shown
    assert "| predictor | 20 |" in shown
    assert "| whole | 20 |" in shown
    assert list(tmp_path.glob(".*partial")) == []


def test_a_lost_face_is_said(clip: Path, faces, tmp_path: Path, monkeypatch, caplog) -> None:
    caplog.set_level("INFO")
    told: list[list[str]] = []

    def note(image, lines) -> None:
        told.append([text for text, _ in lines])

    monkeypatch.setattr("face_prediction.live.loop.draw_lines", note)
    faces.hidden = (8, 9, 10, 11)
    out = tmp_path / "out.mp4"
    assert run_live(LiveOptions(video=clip, checkpoint="persistence", out=out)) == 0
    last = [lines[-1] for lines in told]
    assert last[7] == "persistence: 8 of 70 frames seen"
    assert last[8:12] == ["face lost"] * 4
    assert last[12] == "persistence: 1 of 70 frames seen"
    assert "face in 16 of 20 frames" in caplog.text


def test_it_stops_when_it_is_told_to(clip: Path, faces, tmp_path: Path) -> None:
    options = LiveOptions(video=clip, checkpoint="line", out=tmp_path / "out.mp4")
    assert run_live(replace(options, seconds=0.25)) == 0
    assert len(read(tmp_path / "out.mp4")) == 8  # 0 ... 7 / 30 s


def test_an_interrupted_run_leaves_a_whole_file(clip, faces, tmp_path: Path, capsys) -> None:
    faces.interrupt_at = 6
    out = tmp_path / "out.mp4"
    assert run_live(LiveOptions(video=clip, checkpoint="line", out=out)) == 130
    assert len(read(out)) == 6
    assert "| whole | 6 |" in capsys.readouterr().out


def test_one_that_saw_nothing_leaves_none(clip: Path, faces, tmp_path: Path) -> None:
    faces.interrupt_at = 0
    with pytest.raises(KeyboardInterrupt):
        run_live(LiveOptions(video=clip, checkpoint="line", out=tmp_path / "out.mp4"))
    assert sorted(p.name for p in tmp_path.iterdir()) == ["clip.mp4"]


def test_a_truncated_video_leaves_no_file(clip: Path, faces, tmp_path: Path) -> None:
    clip.write_bytes(clip.read_bytes()[:3000])
    with pytest.raises(RequestError, match=str(clip)):
        run_live(LiveOptions(video=clip, checkpoint="line", out=tmp_path / "out.mp4"))
    assert sorted(p.name for p in tmp_path.iterdir()) == ["clip.mp4"]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"video": None}, "either --camera NUMBER or --video FILE"),
        ({"camera": 0}, "either --camera NUMBER or --video FILE"),
        ({"video": Path("/nowhere.mp4")}, "no such file"),
        ({"seconds": 0.0}, "--seconds 0.0: must be positive"),
        ({"out": Path("/")}, "is a folder"),
        ({"out": Path("film.avi")}, "name an .mp4 file"),
        ({"checkpoint": "ar_landmarks"}, "has parameters; name a --dataset"),
        ({"checkpoint": "nowhere"}, "no such folder; name a folder written by .* or a baseline"),
    ],
)
def test_what_cannot_be_done_is_refused(clip, faces, tmp_path, changes, message: str) -> None:
    options = LiveOptions(video=clip, checkpoint="line", out=tmp_path / "out.mp4")
    with pytest.raises(RequestError, match=message) as caught:
        run_live(replace(options, **changes))
    assert "\n" not in str(caught.value)
    assert not (tmp_path / "out.mp4").exists()


def test_the_video_itself_is_not_overwritten(clip: Path, faces) -> None:
    before = clip.read_bytes()
    with pytest.raises(RequestError, match="is the video itself"):
        run_live(LiveOptions(video=clip, checkpoint="line", out=clip))
    assert clip.read_bytes() == before


def test_without_a_screen_a_file_must_be_named(clip: Path, faces, monkeypatch) -> None:
    monkeypatch.setattr(cv2, "getBuildInformation", lambda: "  GUI:                   NONE\n")
    with pytest.raises(RequestError, match=r"opens no window.*--out"):
        run_live(LiveOptions(video=clip, checkpoint="line"))
    monkeypatch.setattr(cv2, "getBuildInformation", lambda: "  GUI:                   QT5\n")
    monkeypatch.setattr(sinks.sys, "platform", "linux")
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    with pytest.raises(RequestError, match=r"no screen .* --out"):
        Window()


@pytest.mark.parametrize(
    ("key", "is_open", "goes_on"),
    [(-1, 1.0, True), (27, 1.0, False), (ord("q"), 1.0, False), (-1, 0.0, False)],
)
def test_a_window_ends_with_escape_q_or_its_button(monkeypatch, key, is_open, goes_on) -> None:
    shown: list[np.ndarray] = []
    monkeypatch.setattr(sinks, "window_problem", lambda: None)
    monkeypatch.setattr(cv2, "namedWindow", lambda *_: None)
    monkeypatch.setattr(cv2, "destroyAllWindows", lambda: shown.clear())
    monkeypatch.setattr(cv2, "imshow", lambda _, image: shown.append(image))
    monkeypatch.setattr(cv2, "waitKey", lambda _: key)
    monkeypatch.setattr(cv2, "getWindowProperty", lambda *_: is_open)
    image = np.zeros((4, 4, 3), dtype=np.uint8)
    image[..., 0] = 200
    with Window() as window:
        assert window.show(image, 0.0) == goes_on
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
    assert [frame.time for frame in video_frames(clip)] == pytest.approx(np.arange(20) / 30)


def test_a_file_keeps_the_times_of_its_images(tmp_path: Path) -> None:
    times = [0.0, 0.04, 0.05, 0.5, 0.51]
    path = tmp_path / "new" / "odd.mp4"
    with VideoFile(path, 25.0) as file:
        for index, time in enumerate(times):
            assert file.show(np.full((33, 47, 3), 40 * index, dtype=np.uint8), time)
    frames = read(path)
    assert [frame.time for frame in frames] == pytest.approx(times, abs=1e-4)
    assert frames[0].image.shape == (32, 46, 3)
    assert [int(frame.image.mean()) for frame in frames] == pytest.approx(
        [0, 40, 80, 120, 160], abs=3
    )


def test_a_file_without_images_is_refused(tmp_path: Path) -> None:
    with pytest.raises(RequestError, match="no image to write"), VideoFile(tmp_path / "a.mp4", 30):
        pass
    assert list(tmp_path.iterdir()) == []


def colour_at(image: np.ndarray, x: float, y: float) -> tuple[int, ...]:
    return tuple(image[int(y), int(x)].tolist())


def test_the_mouth_is_drawn_where_it_is_and_will_be(landmarks) -> None:
    image = np.full((480, 640, 3), 60, dtype=np.uint8)
    ahead = np.repeat(landmarks[None, :, :2], 5, axis=0)
    ahead[..., 0] += np.arange(1, 6)[:, None] * 0.03  # 19 pixels a frame
    draw_mouth(image, landmarks, ahead)
    x, y = landmarks[[13, 14], :2].mean(axis=0) * (640, 480)
    assert colour_at(image, x, y) == GREEN
    assert colour_at(image, x + 0.03 * 640, y) == NEAR
    assert colour_at(image, x + 0.15 * 640, y) == FAR
    assert (image[:100, :100] == 60).all()
    # magnified at the lower right, the mouth in the middle
    inset = image[-163:, -163:]
    assert colour_at(inset, 81, 81) == GREEN


def test_a_mouth_at_the_edge_is_no_trouble(landmarks) -> None:
    for shift in (-0.6, 0.0, 0.6, 30.0):
        image = np.zeros((120, 160, 3), dtype=np.uint8)
        moved = landmarks + np.array([shift, -shift, 0.0])
        draw_mouth(image, moved, np.repeat(moved[None, :, :2], 5, axis=0))


@pytest.mark.parametrize("shape", [(1080, 1920), (240, 320), (1280, 720), (120, 160)])
def test_text_fits_its_image(shape: tuple[int, int]) -> None:
    image = np.full((*shape, 3), 200, dtype=np.uint8)
    draw_lines(image, [("residual: mouth now (green) and in 1 to 5 frames", GREEN)] * 4)
    touched = np.flatnonzero((image != 200).any(axis=(0, 2)))
    assert touched.max() <= shape[1] - 1
    ink = np.flatnonzero((image[..., 1] > 200).any(axis=0))
    assert ink.max() < shape[1] - 2  # the last letter is whole
    empty = np.full((8, 8, 3), 200, dtype=np.uint8)
    draw_lines(empty, [])
    assert (empty == 200).all()


def test_times_are_of_the_last_second_or_so() -> None:
    times = Times()
    times.seconds["detector"] += [1.0] * 50 + [0.02] * 30
    assert times.recent("detector") == pytest.approx(0.02)
    assert np.isnan(times.recent("predictor"))
    assert "| detector | 80 | 632.5 | 1000.0 | 1.6 |" in times.table()
    assert "predictor" not in times.table()
    assert captions(times, None, "line", 70)[0][0] == "detector 20.0 ms, 50 a second"


def test_each_stage_is_timed_on_its_own(landmarks) -> None:
    now = iter(np.cumsum([0.0, 0.010, 0.004, 0.001] * 3))  # found, forecast, shown, next image

    class Fixed:
        def update(self, time, landmarks, image) -> LiveForecast:
            ahead = np.repeat(landmarks[None, :, :2], 5, axis=0)
            return LiveForecast(ahead, Crop(0, 0, 100), False, 70)

    class Nowhere:
        def show(self, image, time) -> bool:
            return True

    frames = [VideoFrame(i / 30, np.zeros((240, 320, 3), dtype=np.uint8)) for i in range(3)]
    summary = Summary()
    run_loop(
        frames,
        lambda image, time: landmarks,
        Fixed(),  # pyright: ignore[reportArgumentType]
        Nowhere(),
        "fixed",
        70,
        summary,
        clock=lambda: float(next(now)),
    )
    seconds = summary.times.seconds
    assert seconds["detector"] == pytest.approx([0.010] * 3)
    assert seconds["predictor"] == pytest.approx([0.004] * 3)
    assert seconds["whole"] == pytest.approx([0.015] * 3)
    assert (summary.frames, summary.faces, summary.crops) == (3, 3, 0)
