"""``extract`` from the command line, with a stand-in for the detector."""

from __future__ import annotations

import errno
import hashlib
import logging
import subprocess
import sys
import threading
import weakref
from dataclasses import replace
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from face_prediction.commands import extract as extract_command
from face_prediction.tracking import detector as detector_module
from face_prediction.tracking import detector as model_file
from face_prediction.tracking import extract as extract_module
from face_prediction.tracking.detector import (
    DetectorSettings,
    FaceDetection,
    FaceDetector,
    default_model_path,
    find_model,
)
from face_prediction.tracking.tracks import TRACK_FILE, load_track, save_track
from face_prediction.tracking.video import VideoReader
from robo_manip_baselines.runs.errors import RequestError, WriteError


def picture(left: int | None) -> np.ndarray:
    image = np.zeros((48, 64, 3), dtype=np.uint8)
    if left is not None:
        image[16:32, left : left + 16] = 255
    return image


class StandIn:
    """Finds a bright square; the pose is at its left edge, 0.5 m away."""

    looked = 0

    def __init__(self, model: Path, settings: DetectorSettings) -> None:
        self.model = model
        self.settings = settings

    def __enter__(self) -> StandIn:
        return self

    def __exit__(self, *_: object) -> None: ...

    def detect(self, image: np.ndarray, time: float) -> list[FaceDetection]:
        StandIn.looked += 1
        columns = np.flatnonzero(image[24, :, 0] > 128)
        if len(columns) == 0:
            return []
        landmarks = np.full((468, 3), 0.5)
        landmarks[:, 0] = np.linspace(columns[0] / 64, (columns[-1] + 1) / 64, 468)
        pose = np.eye(4)
        pose[:3, 3] = (columns[0] / 100, 0.0, -0.5)
        return [FaceDetection(landmarks, pose)]

    def description(self) -> dict[str, object]:
        return {"name": "stand-in", **vars(self.settings)}


@pytest.fixture
def model(tmp_path: Path) -> Path:
    path = tmp_path / "model.task"
    path.write_bytes(b"model")
    return path


@pytest.fixture(autouse=True)
def stand_in(monkeypatch) -> type[StandIn]:
    monkeypatch.setattr(extract_command, "FaceDetector", StandIn)
    StandIn.looked = 0
    return StandIn


@pytest.fixture
def run(tmp_path: Path, model: Path, caplog, exit_code):
    """Run ``extract`` and return its exit code; messages are in ``caplog``."""
    caplog.set_level(logging.INFO)

    def extract(*arguments: object) -> int:
        words = ["extract", *map(str, arguments), "--model", str(model), "--no_zoom"]
        return exit_code([*words, "--out", str(tmp_path / "tracks")])

    return extract


def test_a_video_becomes_a_track(tmp_path: Path, write_video, run) -> None:
    images = [picture(10 + index // 2) for index in range(26)]
    video = write_video(tmp_path / "ann.mp4", images, np.arange(26) / 25)
    assert run(video) == 0
    track = load_track(tmp_path / "tracks" / "ann.npz")
    assert len(track) == 31
    assert track.fps == 30.0
    assert track.valid.all()
    assert track.image_size == (64, 48)
    assert len(track.source_timestamps) == 26
    assert track.source["sha256"] == hashlib.sha256(video.read_bytes()).hexdigest()
    assert track.detector["settings"] == {"fps": 30.0, "max_gap": 0.1, "zoom": False}
    # frame 12 is at 0.4 s: decoded frame 10 (square at 15), to a tick of the encoder
    assert track.head_pose[12, 0, 3] == pytest.approx(0.15, abs=0.011)


def test_frames_without_a_face_are_invalid(tmp_path: Path, write_video, run) -> None:
    images = [picture(None if 10 <= index < 13 else 20) for index in range(30)]
    assert run(write_video(tmp_path / "ann.mp4", images)) == 0
    track = load_track(tmp_path / "tracks" / "ann.npz")
    assert np.flatnonzero(~track.valid).tolist() == [10, 11, 12]


def test_a_second_run_does_nothing_and_other_settings_do(tmp_path, write_video, run) -> None:
    video = write_video(tmp_path / "ann.mp4", [picture(20)] * 10)
    assert run(video) == 0
    assert StandIn.looked == 10
    written = (tmp_path / "tracks" / "ann.npz").stat().st_mtime_ns
    assert run(video) == 0
    assert StandIn.looked == 10
    assert (tmp_path / "tracks" / "ann.npz").stat().st_mtime_ns == written
    assert run(video, "--max_gap", 0.2) == 0
    assert StandIn.looked == 20
    write_video(video, [picture(30)] * 10)
    assert run(video, "--max_gap", 0.2) == 0
    assert StandIn.looked == 30


def test_fps_none_keeps_the_decoded_frames(tmp_path: Path, write_video, run) -> None:
    times = [0.0, 0.05, 0.1, 0.25, 0.3]
    assert run(write_video(tmp_path / "ann.mp4", [picture(20)] * 5, times), "--fps", "None") == 0
    track = load_track(tmp_path / "tracks" / "ann.npz")
    np.testing.assert_allclose(track.timestamps, times, atol=1e-4)
    assert not track.interpolated.any()


def test_bad_videos_are_named_and_the_others_done(tmp_path, write_video, run, caplog) -> None:
    good = write_video(tmp_path / "good.mp4", [picture(20)] * 5)
    empty = write_video(tmp_path / "nobody.mp4", [picture(None)] * 5)
    broken = tmp_path / "broken.mp4"
    broken.write_bytes(good.read_bytes()[:500])
    assert run(empty, broken, tmp_path / "absent.mp4", good) == 2
    assert [path.name for path in (tmp_path / "tracks").iterdir()] == ["good.npz"]
    assert "nobody.mp4: no face found in any of its 5 frames" in caplog.text
    assert "broken.mp4: truncated: 326 of its 826 bytes are missing" in caplog.text
    assert "absent.mp4: no such file" in caplog.text
    names = "nobody.mp4, broken.mp4, absent.mp4"
    assert f"1 made, 0 already up to date, 3 refused ({names})" in caplog.text


def test_a_failure_of_the_program_ends_one_video(tmp_path, write_video, run, monkeypatch, caplog):
    """The others are made, the exit code is 1, and a second run makes the rest."""
    videos = [write_video(tmp_path / f"{name}.mp4", [picture(20)] * 5) for name in "abc"]
    detect = StandIn.detect

    def fails(self, image: np.ndarray, time: float) -> list[FaceDetection]:
        if StandIn.looked == 7:
            StandIn.looked += 1
            raise ValueError("Input timestamp must be monotonically increasing.")
        return detect(self, image, time)

    monkeypatch.setattr(StandIn, "detect", fails)
    assert run(*videos) == 1
    assert "b.mp4: ValueError: Input timestamp must be" in caplog.text
    assert "2 made, 0 already up to date, 0 refused, 1 failed (b.mp4)" in caplog.text
    assert run(*videos) == 0
    assert "1 made, 2 already up to date, 0 refused" in caplog.text
    assert sorted(path.name for path in (tmp_path / "tracks").iterdir()) == [
        "a.npz", "b.npz", "c.npz",
    ]  # fmt: skip


def test_a_full_disk_ends_the_batch_with_whole_files(
    tmp_path, write_video, run, monkeypatch
) -> None:
    videos = [write_video(tmp_path / f"{name}.mp4", [picture(20)] * 5) for name in "abc"]
    write = np.savez_compressed

    def full(stream, **arrays) -> None:
        if len(list((tmp_path / "tracks").glob("*.npz"))) == 1:
            stream.write(b"half")
            raise OSError(errno.ENOSPC, "No space left on device")
        write(stream, **arrays)

    monkeypatch.setattr(np, "savez_compressed", full)
    with pytest.raises(WriteError, match="No space left"):
        run(*videos)
    assert StandIn.looked == 10  # the third video is not begun
    assert [path.name for path in (tmp_path / "tracks").iterdir()] == ["a.npz"]


def test_damaged_frames_are_not_looked_at(tmp_path, write_video, run, monkeypatch, caplog) -> None:
    video = write_video(tmp_path / "ann.mp4", [picture(20)] * 30)
    frames = VideoReader.frames

    def damaged(self):
        for number, frame in enumerate(frames(self)):
            yield replace(frame, is_damaged=10 <= number < 14)
        self.lost_frames = 2

    monkeypatch.setattr(VideoReader, "frames", damaged)
    assert run(video) == 0
    assert StandIn.looked == 26
    track = load_track(tmp_path / "tracks" / "ann.npz")
    assert np.flatnonzero(~track.valid).tolist() == [10, 11, 12, 13]
    assert "30 frames, face in 86.7 %; 4 damaged and 2 lost of the video's 32" in caplog.text
    monkeypatch.setattr(
        VideoReader, "frames", lambda self: (replace(f, is_damaged=True) for f in frames(self))
    )
    assert run(video, "--max_gap", 0.2) == 2
    assert "no face found in any of its 30 frames, 30 of which are damaged" in caplog.text


def test_a_track_of_an_older_decoding_is_made_again(tmp_path, write_video, run) -> None:
    video = write_video(tmp_path / "ann.mp4", [picture(20)] * 5)
    assert run(video) == 0
    path = tmp_path / "tracks" / "ann.npz"
    track = load_track(path)
    save_track(path, replace(track, source={**track.source, "decoding": 1}))
    assert run(video) == 0
    assert StandIn.looked == 10


def test_few_frames_and_faces_are_held(tmp_path, write_video, run, monkeypatch) -> None:
    """However long the video is: a chunk of faces, and a handful of images."""
    monkeypatch.setattr(extract_module, "CHUNK", 8)
    alive = {"images": 0, "faces": 0}
    most = {"images": 0, "faces": 0}

    def follow(what: str, item: object) -> None:
        alive[what] += 1
        most[what] = max(most[what], alive[what])
        weakref.finalize(item, lambda: alive.update({what: alive[what] - 1}))

    frames, detect = VideoReader.frames, StandIn.detect

    def followed_frames(self):
        for frame in frames(self):
            follow("images", frame)
            yield frame
            del frame

    def followed_faces(self, image: np.ndarray, time: float) -> list[FaceDetection]:
        faces = detect(self, image, time)
        for face in faces:
            follow("faces", face)
        return faces

    video = write_video(tmp_path / "ann.mp4", [picture(10 + n // 4) for n in range(120)])
    monkeypatch.setattr(VideoReader, "frames", followed_frames)
    monkeypatch.setattr(StandIn, "detect", followed_faces)
    assert run(video) == 0
    assert len(load_track(tmp_path / "tracks" / "ann.npz")) == 120
    assert most["images"] <= 3
    assert most["faces"] <= 8 + 3  # the chunk, the newest, and the one that is followed


@pytest.mark.parametrize(("limit", "arguments"), [("T", ()), ("T", ("--fps", "None")), ("S", ())])
def test_a_track_that_could_not_be_read_back_is_not_made(
    tmp_path: Path, write_video, run, monkeypatch, caplog, limit: str, arguments: tuple[str, ...]
) -> None:
    video = write_video(tmp_path / "ann.mp4", [picture(20)] * 30)
    monkeypatch.setitem(TRACK_FILE.limits, limit, 30)
    assert run(video, *arguments) == 0
    (tmp_path / "tracks" / "ann.npz").unlink()
    monkeypatch.setitem(TRACK_FILE.limits, limit, 20)
    assert run(video, *arguments) == 2
    assert "decoded ones at most; cut the video, or give a lower --fps" in caplog.text
    assert StandIn.looked < 60
    assert not any((tmp_path / "tracks").iterdir())


def test_a_killed_run_leaves_whole_files_and_carries_on(
    tmp_path: Path, write_video, run, monkeypatch, caplog
) -> None:
    videos = [write_video(tmp_path / f"{name}.mp4", [picture(20)] * 5) for name in "abc"]
    calls = []

    def killed(self, image: np.ndarray, time: float) -> list[FaceDetection]:
        calls.append(time)
        if len(calls) == 8:
            raise KeyboardInterrupt
        return detect(self, image, time)

    detect = StandIn.detect
    monkeypatch.setattr(StandIn, "detect", killed)
    assert run(*videos) == 130
    assert [path.name for path in (tmp_path / "tracks").iterdir()] == ["a.npz"]
    monkeypatch.setattr(StandIn, "detect", detect)
    (tmp_path / "tracks" / ".b.npz.99999999.partial").write_bytes(b"as SIGKILL leaves it")
    assert run(*videos) == 0
    assert len(list((tmp_path / "tracks").iterdir())) == 3
    assert "2 made, 1 already up to date, 0 refused" in caplog.text


def test_what_is_in_the_way_is_not_overwritten(tmp_path: Path, write_video, run, caplog) -> None:
    video = write_video(tmp_path / "ann.mp4", [picture(20)] * 5)
    (tmp_path / "tracks").mkdir()
    other = tmp_path / "tracks" / "ann.npz"
    np.savez(other, precious=np.arange(3))
    before = other.read_bytes()
    assert run(video) == 2
    assert "in the way of a track" in caplog.text
    assert other.read_bytes() == before


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((), "no video given"),
        (("a/x.mp4", "b/x.avi"), "a/x.mp4 and b/x.avi would both become"),
        (("x.mp4", "--fps", "0"), "--fps 0.0"),
        (("x.mp4", "--max_gap", "-1"), "--max_gap -1.0"),
        (("x.mp4", "--num_faces", "0"), "num_faces 0"),
        (("x.mp4", "--min_detection_confidence", "2"), "min_detection_confidence 2.0"),
        (("x.mp4",), "x.mp4: no such file"),
    ],
)
def test_bad_requests(run, caplog, arguments, message) -> None:
    assert run(*arguments) == 2
    assert message in caplog.text
    assert len(caplog.messages) == 1


def test_video_mode_and_zoom_exclude_one_another(model: Path, caplog, exit_code) -> None:
    assert exit_code(["extract", "x.mp4", "--model", str(model), "--running_mode", "video"]) == 2
    assert "--no_zoom" in caplog.text


def test_without_mediapipe_the_extra_is_named(model: Path, monkeypatch) -> None:
    monkeypatch.setitem(sys.modules, "mediapipe", None)
    with pytest.raises(RequestError, match=r"pip install .*\[face-prediction\]'"):
        FaceDetector(model, DetectorSettings())


def test_native_noise_is_shown_only_when_something_fails(capfd) -> None:
    script = "import os; os.write(2, b'noise')"
    with detector_module.native_stderr_silenced():
        subprocess.run([sys.executable, "-c", script], check=True)
    assert capfd.readouterr().err == ""

    def fail() -> None:
        with detector_module.native_stderr_silenced():
            subprocess.run([sys.executable, "-c", script], check=True)
            raise RuntimeError

    with pytest.raises(RuntimeError):
        fail()
    assert capfd.readouterr().err == "noise"


def test_the_clock_of_video_mode_goes_forward(tmp_path: Path) -> None:
    """Times that share a millisecond, begin below 0, or begin late."""
    clocks: list[int] = []

    class Landmarker:
        def detect_for_video(self, image: object, clock: int) -> SimpleNamespace:
            clocks.append(clock)
            return SimpleNamespace(face_landmarks=[], facial_transformation_matrixes=[])

    def detector() -> FaceDetector:
        made = object.__new__(FaceDetector)
        formats = SimpleNamespace(SRGB=0)
        made._mediapipe = SimpleNamespace(ImageFormat=formats, Image=lambda **_: None)
        made._landmarker, made._follows, made._warm = Landmarker(), True, True
        made._begun, made._clock = None, -1
        return made

    for times, expected in (
        ([0.0, 0.0333, 0.0334, 0.0337, 0.0667], [0, 33, 34, 35, 67]),
        ([-0.1, -0.0667, 0.0], [0, 33, 100]),
        ([7.5, 7.5333], [7500, 7533]),
    ):
        clocks.clear()
        looking = detector()
        for time in times:
            looking.detect(np.zeros((4, 4, 3), dtype=np.uint8), time)
        assert clocks == expected


class TestModelFile:
    """Source of the model."""

    @pytest.fixture(autouse=True)
    def cache(self, tmp_path: Path, monkeypatch) -> Path:
        monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
        return tmp_path / "cache"

    def test_the_cache_folder(self, cache: Path, monkeypatch) -> None:
        assert default_model_path() == cache / "face_prediction" / "face_landmarker.task"
        monkeypatch.delenv("XDG_CACHE_HOME")
        monkeypatch.setenv("HOME", "/home/ann")
        assert str(default_model_path()).startswith("/home/ann/.cache/face_prediction/")

    def test_it_is_downloaded_once(self, tmp_path: Path, model: Path) -> None:
        expected = hashlib.sha256(b"model").hexdigest()
        path = find_model(None, model.as_uri(), expected)
        assert path.read_bytes() == b"model"
        assert list(path.parent.iterdir()) == [path]
        model.unlink()
        assert find_model(None, model.as_uri(), expected) == path

    def test_a_wrong_download_is_not_kept(self, cache: Path, model: Path) -> None:
        with pytest.raises(RequestError, match="nothing was kept"):
            find_model(None, model.as_uri(), "0" * 64)
        assert not cache.exists()

    def test_a_damaged_cached_model_is_refused(self, model: Path) -> None:
        path = default_model_path()
        path.parent.mkdir(parents=True)
        path.write_bytes(b"half a mod")
        with pytest.raises(RequestError, match=r"not the expected file.*delete it"):
            find_model(None, model.as_uri(), hashlib.sha256(b"model").hexdigest())

    def test_without_a_network_it_says_what_to_do(self, tmp_path: Path) -> None:
        nowhere = (tmp_path / "nothing").as_uri()
        with pytest.raises(RequestError, match=r"fetch file:.*--detector_model") as caught:
            find_model(None, nowhere, "0")
        assert "\n" not in str(caught.value)

    def test_a_download_that_breaks_off_is_not_kept(self, cache: Path) -> None:
        class HalfAModel(BaseHTTPRequestHandler):
            def do_GET(self) -> None:
                self.send_response(200)
                self.send_header("Content-Length", "1000")
                self.end_headers()
                self.wfile.write(b"half a mod")

            def log_message(self, *_: object) -> None: ...

        with HTTPServer(("127.0.0.1", 0), HalfAModel) as server:
            threading.Thread(target=server.handle_request, daemon=True).start()
            address = f"http://127.0.0.1:{server.server_port}/model.task"
            with pytest.raises(RequestError, match=r"none could be downloaded \(IncompleteRead"):
                find_model(None, address, "0" * 64)
        assert not cache.exists()

    def test_the_option_of_the_command_is_named(self, tmp_path: Path) -> None:
        nowhere = (tmp_path / "nothing").as_uri()
        with pytest.raises(RequestError, match=r"name it with --detector_model$"):
            find_model(None, nowhere, "0", option="--detector_model")
        with pytest.raises(RequestError, match=r"^--detector_model .*no such file"):
            find_model(tmp_path / "absent.task", option="--detector_model")

    def test_a_named_model_must_exist(self, tmp_path: Path) -> None:
        with pytest.raises(RequestError, match=r"no such file; download it from https://"):
            find_model(tmp_path / "absent.task")

    def test_the_address_and_hash_are_mediapipes(self) -> None:
        assert model_file.MODEL_URL.startswith("https://storage.googleapis.com/mediapipe-models/")
        assert model_file.MODEL_SHA256.startswith("64184e22")
