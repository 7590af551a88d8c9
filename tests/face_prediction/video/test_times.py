"""Frames at their own times: edit lists, negative times, raw streams, clocks that go back."""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import pytest

from robo_manip_baselines.runs.errors import RequestError

pytestmark = pytest.mark.long


def numbers(frames, pattern, count: int) -> list[int]:
    """Images of the pattern that the frames show, by their brightness."""
    blues = [image[40:, 40:, 2].mean() for image in pattern(count)]
    return [int(np.argmin([abs(f.image[40:, 40:, 2].mean() - b) for b in blues])) for f in frames]


def test_an_edit_list_that_discards_frames(tmp_path, encode, pattern, set_edits, read) -> None:
    path = encode(tmp_path / "v.mp4", pattern(30))
    set_edits(path, [(0.4, 10 / 30 + 2 / 30)])  # two frames of reordering come before time 0
    frames = read(path)
    assert numbers(frames, pattern, 30) == list(range(10, 22))
    np.testing.assert_allclose([frame.time for frame in frames], np.arange(12) / 30, atol=1e-3)


def test_an_empty_edit_delays(tmp_path, encode, pattern, set_edits, read) -> None:
    path = encode(tmp_path / "v.mp4", pattern(10))
    set_edits(path, [(0.5, -1), (10 / 30, 2 / 30)])
    frames = read(path)
    assert numbers(frames, pattern, 10) == list(range(10))
    np.testing.assert_allclose([f.time for f in frames], 0.5 + np.arange(10) / 30, atol=1e-3)


@pytest.mark.parametrize("name", ["v.mkv", "v.ts", "v.mp4"])
def test_a_late_start(tmp_path: Path, encode, pattern, read, name: str) -> None:
    times = 7.25 + np.arange(8) / 30
    path = encode(tmp_path / name, pattern(8), times=list(times), options={"bf": "0"})
    offset = [frame.time for frame in read(path)] - times
    assert np.ptp(offset) < 1.1e-3
    assert name == "v.ts" or abs(offset[0]) < 1.1e-3  # transport streams begin somewhat later


def test_times_below_zero(tmp_path: Path, encode, pattern, read) -> None:
    times = np.arange(-5, 5) / 30
    path = encode(
        tmp_path / "v.ts", pattern(10), times=list(times), options={"bf": "0"},
        container_options={"avoid_negative_ts": "disabled"},
    )  # fmt: skip
    np.testing.assert_allclose([frame.time for frame in read(path)], times, atol=1e-3)


@pytest.mark.parametrize(
    ("codec", "form", "options"),
    [
        ("libx264", "h264", None),
        ("libx265", "hevc", {"x265-params": "log-level=none"}),
        ("mpeg2video", "mpeg2video", {"qmin": "2", "qmax": "2"}),
    ],
)
def test_raw_streams_run_at_the_rate_in_their_header(
    tmp_path, encode, pattern, read, codec, form, options
) -> None:
    path = encode(tmp_path / "v", pattern(12), codec=codec, form=form, options=options)
    frames = read(path)
    assert numbers(frames, pattern, 12) == list(range(12))
    np.testing.assert_allclose(np.diff([frame.time for frame in frames]), 1 / 30, atol=1e-4)


def test_a_raw_stream_without_a_rate_is_refused(tmp_path: Path, encode, pattern, read) -> None:
    path = encode(
        tmp_path / "v.mjpeg", pattern(3), codec="mjpeg", layout="yuvj420p", options={}, form="mjpeg"
    )
    with pytest.raises(
        RequestError, match=r"raw stream without times and frame rate; .*-framerate"
    ):
        read(path)


def test_avi_holds_times_of_decoding_only(tmp_path: Path, encode, pattern, read) -> None:
    """FFmpeg's guesses of H.264's times in it are in another order than the images."""
    frames = read(encode(tmp_path / "v.avi", pattern(20), options={"bf": "3", "crf": "10"}))
    assert numbers(frames, pattern, 20) == list(range(20))
    np.testing.assert_allclose(np.diff([frame.time for frame in frames]), 1 / 30, atol=1e-6)


def rewritten(source: Path, target: Path, change) -> Path:
    """The packets of a video under times that ``change`` makes of number and time."""
    with av.open(str(source)) as before, av.open(str(target), "w") as after:
        stream = after.add_stream_from_template(before.streams.video[0])
        for number, packet in enumerate(before.demux(video=0)):
            if packet.size:
                packet.stream = stream
                seconds = Fraction(change(number, float(packet.pts * packet.time_base)))
                packet.pts = packet.dts = round(seconds / packet.time_base)
                after.mux(packet)
    return target


def test_two_frames_at_one_time(tmp_path: Path, encode, pattern, read) -> None:
    """The first of them is kept."""
    source = encode(tmp_path / "v.mp4", pattern(6), options={"bf": "0"})
    path = rewritten(source, tmp_path / "w.mkv", lambda n, t: 2 / 30 if n == 3 else t)
    assert numbers(read(path), pattern, 6) == [0, 1, 2, 4, 5]


def test_clocks_that_jump(tmp_path: Path, encode, pattern, read) -> None:
    source = encode(tmp_path / "v.mp4", pattern(12), options={"bf": "0"})
    path = rewritten(source, tmp_path / "w.mkv", lambda n, t: t + 5000 * (n > 5))
    with pytest.raises(RequestError, match=r"its times jump from 0\.17 s to 5000\.2"):
        read(path)
    parts = [encode(tmp_path / f"{n}.ts", pattern(12)) for n in "ab"]
    path = tmp_path / "joined.ts"
    path.write_bytes(b"".join(part.read_bytes() for part in parts))
    with pytest.raises(RequestError, match="its times go back from"):
        read(path)
