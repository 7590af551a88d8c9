"""Cut files are refused by their structure, and whole ones of every kind are not."""

from __future__ import annotations

from pathlib import Path

import av
import numpy as np
import pytest

from face_prediction.tracking.containers import missing_bytes
from face_prediction.tracking.video import VideoReader
from robo_manip_baselines.runs.errors import RequestError

pytestmark = pytest.mark.long

VARIABLE = [*np.arange(20) / 30, *(20 / 30 + np.arange(10) / 7), 4.0]
"""Times of a recording that slows down and then stands still."""

FORMS = {
    "mp4": {"name": "v.mp4"},
    "mp4, index first": {"name": "v.mp4", "container_options": {"movflags": "faststart"}},
    "mp4, fragments": {
        "name": "v.mp4",
        "container_options": {"movflags": "frag_keyframe+empty_moov"},
        "options": {"g": "5"},
    },
    "mov": {"name": "v.mov"},
    "matroska": {"name": "v.mkv"},
    "webm": {"name": "v.webm", "codec": "libvpx-vp9", "options": {"deadline": "realtime"}},
    "avi": {"name": "v.avi", "codec": "mpeg4", "options": {}},
    "flv": {"name": "v.flv"},
    "ts": {"name": "v.ts"},
    "ogg": {"name": "v.ogv", "codec": "libvpx", "options": {"deadline": "realtime"}},
}


@pytest.fixture(scope="module")
def noise() -> list[np.ndarray]:
    random = np.random.default_rng(0)
    return [random.integers(0, 255, (48, 64, 3)).astype(np.uint8) for _ in range(31)]


@pytest.fixture(params=FORMS.values(), ids=FORMS.keys())
def whole(request, tmp_path: Path, encode, noise) -> Path:
    settings = dict(request.param)
    return encode(tmp_path / settings.pop("name"), noise, **settings)


def test_whole_files_are_read_and_cut_ones_refused(whole: Path, read) -> None:
    assert len(read(whole)) == 31
    data = whole.read_bytes()
    shares = np.random.default_rng(1).uniform(0.05, 0.99, 6)
    for share in (0.5, 0.95, 0.99, *shares):
        kept = int(len(data) * share)
        # a transport stream has no end but that of its last packet
        kept += whole.suffix == ".ts" and kept % 188 == 0
        whole.write_bytes(data[:kept])
        with pytest.raises(RequestError, match="truncated") as caught:
            read(whole)
        assert str(whole) in str(caught.value)
        assert "\n" not in str(caught.value)


def test_whatever_follows_a_whole_file_is_passed_over(whole: Path, read) -> None:
    if whole.suffix == ".ts":
        return
    data = whole.read_bytes()
    for rest in (b"\0" * 40, b"\n", b"appended by someone, long ago"):
        whole.write_bytes(data + rest)
        assert missing_bytes(whole) == 0
        assert len(read(whole)) == 31


@pytest.mark.parametrize("name", ["v.mp4", "v.mkv", "v.webm"])
def test_a_variable_rate_is_whole(tmp_path: Path, encode, noise, read, name: str) -> None:
    settings = {"codec": "libvpx-vp9", "options": {}} if name.endswith("webm") else {}
    frames = read(encode(tmp_path / name, noise, times=VARIABLE, **settings))
    # Matroska counts milliseconds
    np.testing.assert_allclose([frame.time for frame in frames], VARIABLE, atol=6e-4)


def test_a_recording_of_unknown_length_is_whole(tmp_path: Path, encode, noise, read) -> None:
    """As a browser records it: no sizes, no duration."""
    path = encode(tmp_path / "v.mkv", noise, container_options={"live": "1"})
    assert len(read(path)) == 31
    assert missing_bytes(path) == 0


def test_sound_that_is_longer_than_the_video_is_no_loss(tmp_path: Path, noise, read) -> None:
    path = tmp_path / "v.mkv"
    with av.open(str(path), "w") as container:
        video = container.add_stream("libx264", rate=30)
        video.width, video.height, video.pix_fmt = 64, 48, "yuv420p"
        sound = container.add_stream("pcm_s16le", rate=8000)
        silence = av.AudioFrame.from_ndarray(np.zeros((1, 8000), np.int16), layout="mono")
        silence.sample_rate = 8000
        for second in range(6):
            silence.pts = 8000 * second
            container.mux(sound.encode(silence))
        for image in noise:
            container.mux(video.encode(av.VideoFrame.from_ndarray(image, format="rgb24")))
        container.mux(video.encode(None))
        container.mux(sound.encode(None))
    assert len(read(path)) == 31


def test_lengths_are_read_and_not_believed(tmp_path: Path) -> None:
    """Any bytes after a known beginning give a number, and no error."""
    random = np.random.default_rng(2)
    for head in (b"\0\0\0\x18ftypisom", b"\x1a\x45\xdf\xa3\x80\x18\x53\x80\x67", b"RIFF", b"FLV\1",
                 b"OggS", b"G"):  # fmt: skip
        for count in (0, 1, 5, 40, 400):
            path = tmp_path / "v"
            path.write_bytes(head + random.bytes(count))
            assert missing_bytes(path) >= 0
            with pytest.raises(RequestError):
                VideoReader(path)
