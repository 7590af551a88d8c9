"""Sizes that the structure of a video file declares, and what of them is there.

A file that was cut off decodes without an error up to the cut. Its boxes, elements or chunks, each
of which begins with its own size, reveal it: the last one runs past the end of the file. That
needs no count of frames, which variable rates, edit lists and pauses make unreliable.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import BinaryIO

ISO_BOXES = frozenset(
    b"ftyp styp pdin moov moof mfra mdat free skip wide udta uuid meta sidx ssix prft emsg pnot"
    b" PICT".split()
)
"""Boxes on the top level of MP4 and QuickTime files (ISO/IEC 14496-12, 6.2.3)."""

_EBML = 0x1A45DFA3  # RFC 8794, 11.2.1
_SEGMENT = 0x18538067  # RFC 9559, 5.1, as are its parts: SeekHead, Info, Tracks, Cluster, Cues …
_SEGMENT_PARTS = frozenset(
    (0x114D9B74, 0x1549A966, 0x1654AE6B, 0x1F43B675, 0x1C53BB6B, 0x1254C367, 0x1043A770, 0x1941A469)
)
_TS_PACKET = 188  # bytes, ISO/IEC 13818-1, 2.4.3.2


def missing_bytes(path: Path) -> int:
    """Bytes that are missing at the end of the file at ``path``.

    0 where nothing is missing, and for files whose structure does not declare its size (raw
    streams, recordings that were never finished).
    """
    size = path.stat().st_size
    with path.open("rb") as stream:
        head = stream.read(_TS_PACKET + 1)
        end = _declared_end(head)(stream, size)
    return max(0, end - size)


def _declared_end(head: bytes) -> Callable[[BinaryIO, int], int]:
    """The function that finds the declared end of a file that begins with ``head``."""
    if head[4:8] in ISO_BOXES:
        return _end_of_boxes
    if head[:4] == _EBML.to_bytes(4, "big"):
        return _end_of_matroska
    if head[:4] == b"RIFF":
        return _end_of_riff
    if head[:3] == b"FLV":
        return _end_of_flv
    if head[:4] == b"OggS":
        return _end_of_ogg
    if head[:1] == b"G" == head[_TS_PACKET:]:
        return lambda _, size: -(-size // _TS_PACKET) * _TS_PACKET
    return lambda _, size: size


def _end_of_boxes(stream: BinaryIO, size: int) -> int:
    place = 0
    while place < size:
        head = _read(stream, place, 16)
        length, kind = int.from_bytes(head[:4], "big"), head[4:8]
        if kind not in ISO_BOXES:
            return place  # padding, or something that was appended
        if length == 1:
            length = int.from_bytes(head[8:16], "big")
        elif length == 0:  # up to the end of the file
            return size
        if length < 8:
            return place
        place += length
    return place


def _end_of_matroska(stream: BinaryIO, size: int) -> int:
    place, known = 0, frozenset((_EBML, _SEGMENT))
    while place < size:
        head = _read(stream, place, 12)
        name, name_bytes = _ebml_number(head, keep_marker=True)
        length, length_bytes = _ebml_number(head[name_bytes:], keep_marker=False)
        if name not in known:
            return place
        begin = place + name_bytes + length_bytes
        if length != (1 << 7 * length_bytes) - 1:
            place = begin + length
        elif name == _SEGMENT:  # of unknown size: its parts may have one
            place, known = begin, _SEGMENT_PARTS
        else:
            return size
    return place


def _ebml_number(data: bytes, *, keep_marker: bool) -> tuple[int, int]:
    """A variable-length integer at the start of ``data`` (RFC 8794, 4), and its bytes."""
    first = data[0] if data else 0
    count = 9 - first.bit_length()
    value = int.from_bytes(data[:count], "big")
    return (value if keep_marker else value & ((1 << 7 * count) - 1)), count


def _end_of_riff(stream: BinaryIO, size: int) -> int:
    place = 0
    while place < size:
        head = _read(stream, place, 8)
        length = int.from_bytes(head[4:8], "little")
        if head[:4] != b"RIFF" or length == 0:  # 0: never finished
            return place or size
        place += 8 + length
        if place == size + 1:  # the last chunk's padding byte is often left out
            return size
    return place


def _end_of_flv(stream: BinaryIO, size: int) -> int:
    place = int.from_bytes(_read(stream, 5, 4), "big") + 4
    while place < size:
        head = _read(stream, place, 4)
        if head[0] & 0x1F not in (8, 9, 18):  # sound, video, script
            return place
        place += 11 + int.from_bytes(head[1:4], "big") + 4
    return place


def _end_of_ogg(stream: BinaryIO, size: int) -> int:
    place = 0
    while place < size:
        head = _read(stream, place, 27 + 255)
        if head[:4] != b"OggS"[: len(head)]:
            return place
        segments = head[26] if len(head) > 26 else 0
        place += 27 + segments + sum(head[27 : 27 + segments])
    return place


def _read(stream: BinaryIO, place: int, count: int) -> bytes:
    stream.seek(place, os.SEEK_SET)
    return stream.read(count)
