"""``live`` from the command line: frames in, a drawn video out, and what is refused."""

from __future__ import annotations

import resource
from contextlib import nullcontext
from dataclasses import replace
from functools import partial
from pathlib import Path

import av
import cv2
import numpy as np
import pytest

from face_prediction.commands import live as live_command
from face_prediction.commands.live import LiveOptions, run_live
from face_prediction.dataset.manifest import Manifest, write_manifest
from face_prediction.dataset.sequences import SequenceSettings
from face_prediction.live import loop as display
from face_prediction.tracking.detector import find_model
from face_prediction.tracking.video import VideoFrame, VideoReader
from robo_manip_baselines.runs.errors import RequestError, WriteError

pytestmark = pytest.mark.long

SIZE = (320, 240)


class DrawnFaces:
    """A detector of a face that goes to the right, and hides in the frames of ``hidden``."""

    hidden: tuple[int, ...] = ()
    interrupt_at: int | None = None

    def __init__(self, landmarks: np.ndarray) -> None:
        self.landmarks = landmarks
        self.count = -1

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
    monkeypatch.setattr(live_command, "face_finder", lambda model: nullcontext(drawn.find))
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

    monkeypatch.setattr("face_prediction.live.loop.draw_text", note)
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
        ({"seconds": 0.0}, "--seconds 0.0: must be more than 0, and finite"),
        ({"seconds": float("nan")}, "--seconds nan: must be more than 0, and finite"),
        ({"video": None, "camera": -1}, "--camera -1: must be 0 to 99"),
        ({"video": None, "camera": 100}, "--camera 100: must be 0 to 99"),
        ({"video": None, "camera": 2**63}, "--camera 9223372036854775808: must be 0 to 99"),
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


def test_a_dataset_without_sequences_is_refused(clip, faces, tmp_path: Path) -> None:
    dataset = tmp_path / "faces"
    write_manifest(dataset, Manifest(SequenceSettings(), folds=2, seed=0, clips=()))
    options = LiveOptions(video=clip, checkpoint="ar_landmarks", dataset=dataset)
    with pytest.raises(RequestError, match="faces: no sequence of anybody to fit to"):
        run_live(options)


def test_without_a_model_the_option_that_live_has_is_named(clip, tmp_path, monkeypatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    nowhere = (tmp_path / "nothing").as_uri()
    monkeypatch.setattr(live_command, "find_model", partial(find_model, url=nowhere))
    with pytest.raises(RequestError, match=r"name it with --detector_model$"):
        run_live(LiveOptions(video=clip, checkpoint="line", out=tmp_path / "out.mp4"))
    assert not (tmp_path / "out.mp4").exists()


def test_damaged_frames_are_shown_and_not_measured(clip, faces, tmp_path, monkeypatch, caplog):
    caplog.set_level("INFO")
    frames = VideoReader.frames
    monkeypatch.setattr(
        VideoReader,
        "frames",
        lambda self: (replace(f, is_damaged=n > 14) for n, f in enumerate(frames(self))),
    )
    out = tmp_path / "out.mp4"
    assert run_live(LiveOptions(video=clip, checkpoint="persistence", out=out)) == 0
    assert faces.count == 14
    assert "face in 15 of 20 frames" in caplog.text
    assert len(read(out)) == 20


def test_a_full_disk_leaves_no_file(clip: Path, faces, tmp_path: Path) -> None:
    out = tmp_path / "out.mp4"
    options = LiveOptions(video=clip, checkpoint="line", out=out)
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (400, before[1]))
    try:
        with pytest.raises(WriteError, match="File too large"):
            run_live(options)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["clip.mp4"]


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
    monkeypatch.setattr(display.sys, "platform", "linux")
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    with pytest.raises(RequestError, match=r"no screen .* --out"), display.window_sink():
        pass
