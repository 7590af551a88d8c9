"""Damaged data: every frame that they reach is marked, and no other."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path

import av
import numpy as np
import pytest

from face_prediction.tracking.damage import is_reference, nal_length_bytes
from face_prediction.tracking.video import VideoReader

pytestmark = pytest.mark.long

COUNT, GROUP = 60, 20
"""Frames, and frames from one key frame to the next."""


@pytest.fixture(scope="module")
def images(pattern) -> list[np.ndarray]:
    """A pattern that goes to the right; its motion is what frames are predicted by."""
    return [np.roll(image, 3 * n, axis=1) for n, image in enumerate(pattern(COUNT, 160, 96))]


@pytest.fixture(scope="module")
def video(encode, images, tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("video") / "v.mp4"
    # several slices a frame: with a thread for each, FFmpeg does not flag every damaged frame
    options = {"crf": "16", "g": str(GROUP), "bf": "3", "x264-params": "scenecut=0:slices=4"}
    return encode(path, images, options=options)


@pytest.fixture(scope="module")
def packets(video: Path) -> list[av.Packet]:
    with av.open(str(video)) as container:
        return [packet for packet in container.demux(video=0) if packet.size]


def flipped(video: Path, packets: list[av.Packet], number: int, path: Path) -> Path:
    """The video with bytes in the middle of a packet flipped."""
    data = bytearray(video.read_bytes())
    packet = packets[number]
    assert packet.pos is not None
    middle = packet.pos + packet.size // 2
    data[middle : middle + 6] = bytes(byte ^ 0x55 for byte in data[middle : middle + 6])
    path.write_bytes(data)
    return path


def flagged(path: Path) -> list[int]:
    """Numbers of the frames that the decoder itself calls damaged."""
    numbers = []
    with av.open(str(path)) as container:
        container.streams.video[0].codec_context.thread_count = 1
        for packet in container.demux(video=0):
            with suppress(av.error.InvalidDataError):
                numbers += [round(f.time * 30) for f in packet.decode() if f.is_corrupt]
    return numbers


def test_marks_reach_as_far_as_the_damage(tmp_path, video, packets, read) -> None:
    clean = {round(frame.time, 3): frame.image for frame in read(video)}
    assert len(clean) == COUNT
    marked_later = marked_alone = 0
    for number in range(3, len(packets) - 1, 5):
        path = flipped(video, packets, number, tmp_path / "d.mp4")
        if not flagged(path):
            continue  # nothing in these data tells that they are wrong
        damaged = read(path)
        marks = [round(frame.time * 30) for frame in damaged if frame.is_damaged]
        for frame in damaged:
            if not frame.is_damaged:
                np.testing.assert_array_equal(frame.image, clean[round(frame.time, 3)])
        if marks:
            last = number // GROUP * GROUP + GROUP  # next key frame
            assert max(marks) < last
            marked_later += len(marks) > 1
            marked_alone += len(marks) == 1
    assert marked_later  # frames that others are predicted from
    assert marked_alone


def test_what_a_player_is_given_is_kept(video: Path, read) -> None:
    assert not any(frame.is_damaged for frame in read(video))


def test_frames_before_the_damaged_one_can_be_predicted_from_it(tmp_path, encode, pattern) -> None:
    """Frames are put out in display order; one shown before the damage can be decoded after it."""
    images = [np.roll(image, 3 * n, axis=1) for n, image in enumerate(pattern(40, 160, 96))]
    options = {"crf": "16", "bf": "4", "b_strategy": "0", "x264-params": "b-pyramid=0"}
    path = encode(tmp_path / "v.mp4", images, options=options)
    with av.open(str(path)) as container:
        every = [packet for packet in container.demux(video=0) if packet.size]
        lengths = nal_length_bytes("h264", container.streams.video[0].codec_context.extradata)
    references = [is_reference("h264", bytes(packet), lengths) for packet in every]
    number = [n for n, is_one in enumerate(references) if is_one][2]
    shown = round(float(every[number].pts * every[number].time_base) * 30)
    with VideoReader(flipped(path, every, number, tmp_path / "d.mp4")) as reader:
        marks = [round(frame.time * 30) for frame in reader.frames() if frame.is_damaged]
    assert marks == list(range(shown - 4, 40))


def test_a_packet_that_gives_no_frame_is_counted(tmp_path, video, packets) -> None:
    data = bytearray(video.read_bytes())
    packet = packets[30]
    data[packet.pos : packet.pos + packet.size] = bytes(packet.size)
    path = tmp_path / "d.mp4"
    path.write_bytes(data)
    with VideoReader(path) as reader:
        frames = list(reader.frames())
    assert reader.lost_frames == 1
    assert len(frames) == COUNT - 1


def test_few_frames_are_held(video: Path, monkeypatch) -> None:
    """Decoded frames are let go as soon as no later one can tell that they are damaged."""
    from face_prediction.tracking import damage

    most = 0
    put = damage.DamageTracker.put

    def counting(self, frame):
        nonlocal most
        for item in put(self, frame):
            most = max(most, len(self._held))
            yield item

    monkeypatch.setattr(damage.DamageTracker, "put", counting)
    with VideoReader(video) as reader:
        assert sum(1 for _ in reader.frames()) == COUNT
    assert most <= 4


@pytest.mark.parametrize(
    ("codec", "data", "length_bytes", "expected"),
    [
        ("h264", b"\0\0\0\x02\x06\x05" + b"\0\0\0\x01\x41", 4, True),
        ("h264", b"\0\0\0\x02\x06\x05" + b"\0\0\0\x01\x01", 4, False),
        ("h264", b"\0\0\0\x01\x09\x10\0\0\x01\x01\x88", 0, False),
        ("hevc", b"\0\0\x01\x40\x01\0\0\x01\x00\x01", 0, False),
        ("hevc", b"\0\0\x01\x02\x01", 0, True),
        ("hevc", b"\0\0\x01\x26\x01", 0, True),
        ("vp9", b"\0", 0, True),
        ("h264", b"", 4, True),
    ],
)
def test_references(codec: str, data: bytes, length_bytes: int, expected: bool) -> None:
    assert is_reference(codec, data, length_bytes) == expected
