"""Small videos of moving patterns, and edits of their files that no encoder makes."""

from __future__ import annotations

import struct
from collections.abc import Callable, Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest

from face_prediction.tracking.video import VideoFrame, VideoReader

CONTAINERS = (b"moov", b"trak", b"mdia", b"minf", b"stbl", b"edts")


def _pattern(count: int, width: int = 96, height: int = 64) -> list[np.ndarray]:
    """Gradients to the right and down, with a red corner and a brightness that grows."""
    rows, columns = np.mgrid[:height, :width]
    images = []
    for index in range(count):
        blue = np.full_like(rows, 40 + 180 * index // max(count, 1))
        image = np.stack([rows * 0 + 20, columns * 255 // width, blue], axis=-1)
        image[..., 2] += rows * 30 // height
        image[: height // 4, : width // 4] = (250, 0, 0)
        images.append(image.clip(0, 255).astype(np.uint8))
    return images


@pytest.fixture(scope="session")
def pattern() -> Callable[..., list[np.ndarray]]:
    """``pattern(count)``: images (64, 96, 3) that no turn or mirror leaves as they are."""
    return _pattern


def _encode(
    path: Path,
    images: Sequence[np.ndarray],
    *,
    times: Sequence[float] | None = None,
    codec: str = "libx264",
    layout: str = "yuv420p",
    form: str | None = None,
    options: dict[str, str] | None = None,
    container_options: dict[str, str] | None = None,
    sar: Fraction | None = None,
    **context: Any,
) -> Path:
    tick = Fraction(1, 90000)
    with av.open(str(path), "w", format=form, options=container_options or {}) as container:
        stream = container.add_stream(codec, rate=30)
        stream.height, stream.width = images[0].shape[:2]
        stream.pix_fmt = layout
        stream.options = {"crf": "10"} if options is None else options
        if times is not None:
            stream.codec_context.time_base = tick
        if sar is not None:
            stream.codec_context.sample_aspect_ratio = sar
        for name, value in context.items():
            setattr(stream.codec_context, name, value)
        for index, image in enumerate(images):
            shape = "rgba" if image.shape[2] == 4 else "rgb24"
            frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(image), format=shape)
            if times is not None:
                frame.time_base, frame.pts = tick, round(times[index] / tick)
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    return path


@pytest.fixture(scope="session")
def encode() -> Callable[..., Path]:
    """Encode RGB or RGBA images with PyAV; other keywords go to the codec context."""
    return _encode


@pytest.fixture(scope="session")
def read() -> Callable[[Path], list[VideoFrame]]:
    """All frames of a video."""

    def frames(path: Path) -> list[VideoFrame]:
        with VideoReader(path) as video:
            return list(video.frames())

    return frames


def _boxes(data: bytes, begin: int, end: int) -> list[tuple[bytes, int, int]]:
    """Kind, begin and end of the boxes of an MP4 file between two places."""
    found = []
    while begin < end:
        size, kind = struct.unpack(">I4s", data[begin : begin + 8])
        found.append((kind, begin, begin + size))
        begin += size
    return found


def _find(data: bytes, path: Sequence[bytes]) -> list[int]:
    """Begins of the boxes along a path of kinds, outermost first."""
    begin, end, begins = 0, len(data), []
    for kind in path:
        _, begin, end = next(box for box in _boxes(data, begin, end) if box[0] == kind)
        begins.append(begin)
        begin += 8
    return begins


def _insert(data: bytes, parents: Sequence[int], place: int, box: bytes) -> bytes:
    """``data`` with a box at ``place``, and the boxes that begin at ``parents`` longer by it."""
    changed = bytearray(data)
    for begin in parents:
        (size,) = struct.unpack(">I", changed[begin : begin + 4])
        changed[begin : begin + 4] = struct.pack(">I", size + len(box))
    changed[place:place] = box
    return bytes(changed)


@pytest.fixture(scope="session")
def set_matrix() -> Callable[[Path, Sequence[float]], None]:
    """Write the display matrix (a, b, c, d) of an MP4 file with version-0 headers."""

    def write(path: Path, matrix: Sequence[float]) -> None:
        data = bytearray(path.read_bytes())
        place = _find(data, (b"moov", b"trak", b"tkhd"))[-1] + 12 + 20 + 16
        a, b, c, d = (round(value * 65536) for value in matrix)
        data[place : place + 36] = struct.pack(">9i", a, b, 0, c, d, 0, 0, 0, 1 << 30)
        path.write_bytes(data)

    return write


@pytest.fixture(scope="session")
def set_aperture() -> Callable[[Path, int, int, int, int], None]:
    """Give an MP4 file a clean aperture: width, height, and offset of its middle in pixels."""

    def write(path: Path, width: int, height: int, right: int, down: int) -> None:
        data = path.read_bytes()
        begins = _find(data, (b"moov", b"trak", b"mdia", b"minf", b"stbl", b"stsd"))
        entry = begins[-1] + 16
        (size,) = struct.unpack(">I", data[entry : entry + 4])
        box = struct.pack(">I4s8i", 40, b"clap", width, 1, height, 1, right, 1, down, 1)
        path.write_bytes(_insert(data, [*begins, entry], entry + size, box))

    return write


@pytest.fixture(scope="session")
def set_edits() -> Callable[[Path, Sequence[tuple[float, float]]], None]:
    """Replace the edit list of an MP4 file: (duration, media time) in s; -1: an empty edit."""

    def write(path: Path, edits: Sequence[tuple[float, float]]) -> None:
        data = path.read_bytes()
        trak = _find(data, (b"moov", b"trak"))
        header = _find(data, (b"moov", b"mvhd"))[-1]
        (movie,) = struct.unpack(">I", data[header + 20 : header + 24])
        header = _find(data, (b"moov", b"trak", b"mdia", b"mdhd"))[-1]
        (media,) = struct.unpack(">I", data[header + 20 : header + 24])
        entries = b"".join(
            struct.pack(">IiI", round(long * movie), -1 if at < 0 else round(at * media), 65536)
            for long, at in edits
        )
        box = struct.pack(">I4sII", 16 + len(entries), b"elst", 0, len(edits)) + entries
        box = struct.pack(">I4s", 8 + len(box), b"edts") + box
        children = _boxes(
            data, trak[-1] + 8, trak[-1] + struct.unpack_from(">I", data, trak[-1])[0]
        )
        for kind, begin, end in children:
            if kind == b"edts":  # made free, so that nothing moves
                data = data[: begin + 4] + b"free" + data[begin + 8 : end] + data[end:]
        place = next(end for kind, _, end in children if kind == b"tkhd")
        path.write_bytes(_insert(data, trak, place, box))

    return write


def _element(name: bytes, content: bytes) -> bytes:
    """A Matroska element with a size of eight bytes."""
    return name + (1 << 56 | len(content)).to_bytes(8, "big") + content


def _extended(data: bytes, path: Sequence[bytes], extra: bytes) -> bytes:
    """Matroska ``data`` with ``extra`` at the end of the first element along ``path``."""
    place, out = 0, b""
    while place < len(data):
        name = data[place : place + 9 - data[place].bit_length()]
        begin = place + len(name)
        count = 9 - data[begin].bit_length()
        size = int.from_bytes(data[begin : begin + count], "big") & ((1 << 7 * count) - 1)
        end = begin + count + size
        if path and name == path[0]:
            content = data[begin + count : end]
            inside = _extended(content, path[1:], extra) if path[1:] else content + extra
            return out + _element(name, inside) + data[end:]
        out += data[place:end]
        place = end
    raise AssertionError(f"no element {path[0].hex()}")


@pytest.fixture(scope="session")
def extend_matroska() -> Callable[[Path, dict[str, int]], None]:
    """Add integer elements (by the hexadecimal id) to the description of a Matroska video."""

    def write(path: Path, elements: dict[str, int]) -> None:
        extra = b"".join(
            _element(bytes.fromhex(name), value.to_bytes(2, "big"))
            for name, value in elements.items()
        )
        segment, tracks, entry, video = map(bytes.fromhex, ("18538067", "1654AE6B", "AE", "E0"))
        path.write_bytes(_extended(path.read_bytes(), (segment, tracks, entry, video), extra))

    return write
