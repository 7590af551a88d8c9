"""Frames that damage in a video reaches.

A decoder flags the frame whose data are damaged. Frames that are predicted from it show the same
damage and carry no flag, up to the next key frame. Some of them are displayed before it.
"""

from __future__ import annotations

from bisect import bisect_left
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import av

LONGEST_DELAY = 64
"""Frames that a decoder may hold back, with a margin: H.264 has at most 16."""

_B_IS_NO_REFERENCE = frozenset(("mpeg1video", "mpeg2video", "mpeg4"))
_ONE_TO_ONE = frozenset(("h264", "hevc", "mpeg1video", "mpeg2video", "mjpeg", "prores", "dnxhd"))
"""Codecs of which every packet gives a frame."""
_B_PICTURE = 3  # FFmpeg's AV_PICTURE_TYPE_B


@dataclass(frozen=True)
class _Packet:
    """A packet's number in decoding order, and whether frames may be predicted from it."""

    number: int
    is_reference: bool


class DamageTracker:
    """Puts decoded frames back out in display order, each with whether damage reaches it.

    A frame is held back until every frame that was decoded before it and is displayed after it
    (which it may be predicted from) has come out of the decoder: for most videos a handful.

    Args:
        stream: the stream that is decoded.
        has_times: its packets have times of presentation.

    Attributes:
        lost: packets that gave no frame because they are damaged.
    """

    def __init__(self, stream: av.VideoStream, *, has_times: bool = True) -> None:
        self._has_times = has_times
        codec = stream.codec_context
        self._codec = codec.name
        self._length_bytes = nal_length_bytes(codec.name, codec.extradata or b"")
        self._count = 0  # packets taken
        self._waiting: dict[int, _Packet] = {}  # presentation time -> packet inside the decoder
        self._keys: deque[tuple[int, int]] = deque(maxlen=64)  # number and time of key frames
        self._damaged: list[int] = []  # numbers of damaged reference frames, increasing
        self._held: deque[tuple[av.VideoFrame, int, bool]] = deque()
        self.lost = 0

    def take(self, packet: av.Packet) -> None:
        """Note a packet before it is decoded."""
        time = self._count if packet.pts is None else packet.pts
        if not packet.is_discard:  # of an edit list: decoded, and never displayed
            reference = is_reference(self._codec, bytes(packet), self._length_bytes)
            self._waiting[time] = _Packet(self._count, reference)
        if packet.is_keyframe:
            self._keys.append((self._count, time))
        if packet.is_corrupt:
            self._note(self._count)
        self._count += 1

    def lose(self) -> None:
        """Note that the decoder refused a packet: the one taken last, or one that it held back."""
        waiting = {packet.number: time for time, packet in self._waiting.items()}
        number = self._count - 1 if self._codec in _ONE_TO_ONE else min(waiting, default=-1)
        if number in waiting:
            self._drop(waiting[number], is_refused=True)

    def put(self, frame: av.VideoFrame) -> Iterator[tuple[av.VideoFrame, bool]]:
        """Note a frame that came out of the decoder, and yield those that are ready."""
        time = frame.pts
        packet = None if time is None else self._waiting.pop(time, None)
        if packet is None:  # no times to match by: as if in decoding order
            oldest = min(self._waiting, key=lambda t: self._waiting[t].number, default=None)
            packet = _Packet(self._count, True) if oldest is None else self._waiting.pop(oldest)
        if frame.is_corrupt:
            is_b = int(frame.pict_type) == _B_PICTURE and self._codec in _B_IS_NO_REFERENCE
            if packet.is_reference and not is_b:
                self._note(packet.number)
        self._held.append((frame, packet.number, frame.is_corrupt))
        for at, other in list(self._waiting.items()):
            if self._is_over(other, at, packet, time):
                self._drop(at)
        yield from self._ready()

    def rest(self) -> Iterator[tuple[av.VideoFrame, bool]]:
        """Yield the frames still held, when there are no more packets."""
        for time in list(self._waiting):
            self._drop(time)
        yield from self._ready()

    def _ready(self) -> Iterator[tuple[av.VideoFrame, bool]]:
        while self._held:
            frame, number, is_damaged = self._held[0]
            if any(packet.number < number for packet in self._waiting.values()):
                return
            self._held.popleft()
            yield frame, is_damaged or self._is_reached(number, frame.pts)

    def _is_over(self, other: _Packet, at: int, packet: _Packet, time: int | None) -> bool:
        """Return True if ``other``, due at ``at``, will give no frame once ``packet`` has."""
        if self._has_times and time is not None:
            return at < time
        return other.number < packet.number - LONGEST_DELAY

    def _drop(self, time: int, *, is_refused: bool = False) -> None:
        """Note that the packet due at ``time`` gave no frame.

        For some codecs that is no sign of damage. Nor is it for frames that are displayed before
        their key frame: a decoder that begins there leaves them out, and none is predicted from
        them.
        """
        packet = self._waiting.pop(time)
        _, key_time = self._key_before(packet.number)
        if is_refused or (self._codec in _ONE_TO_ONE and time >= key_time):
            self.lost += 1
            if packet.is_reference:
                self._note(packet.number)

    def _key_before(self, number: int) -> tuple[int, int]:
        """Number and time of the last key frame decoded by then; 0, 0 if there is none."""
        return max((key for key in self._keys if key[0] <= number), default=(0, 0))

    def _note(self, number: int) -> None:
        place = bisect_left(self._damaged, number)
        if self._damaged[place : place + 1] != [number]:
            self._damaged.insert(place, number)

    def _is_reached(self, number: int, time: int | None) -> bool:
        """Return True if a reference was damaged since the key frame that this frame begins at."""
        begins = 0
        for key, key_time in self._keys:
            # frames displayed before a key frame may be predicted from what was before it
            if key <= number and (time is None or time >= key_time):
                begins = key
        place = bisect_left(self._damaged, begins)
        return place < len(self._damaged) and self._damaged[place] <= number


def nal_length_bytes(codec: str, extradata: bytes) -> int:
    """Bytes of the length before every NAL unit (ISO/IEC 14496-15); 0: there are start codes."""
    if codec == "h264" and len(extradata) > 6 and extradata[0] == 1:
        return (extradata[4] & 3) + 1
    if codec == "hevc" and len(extradata) > 22 and extradata[0] == 1:
        return (extradata[21] & 3) + 1
    return 0


def is_reference(codec: str, data: bytes, length_bytes: int) -> bool:
    """Return False if the frame in a packet's ``data`` is known to be no reference for others.

    H.264 says so in ``nal_ref_idc`` (ITU-T H.264, 7.4.1), H.265 in the type of the NAL unit
    (ITU-T H.265, table 7-1). ``length_bytes`` are those of `nal_length_bytes`.
    """
    if codec not in ("h264", "hevc"):
        return True
    for first in _nal_headers(data, length_bytes):
        if codec == "h264" and 1 <= first & 0x1F <= 5:
            return bool(first >> 5 & 3)
        if codec == "hevc" and (kind := first >> 1 & 0x3F) < 32:
            return kind >= 16 or kind % 2 == 1
    return True


def _nal_headers(data: bytes, length_bytes: int) -> Iterator[int]:
    """First byte of every NAL unit in ``data``."""
    place = 0
    if length_bytes:
        while place + length_bytes < len(data):
            begin = place + length_bytes
            yield data[begin]
            place = begin + int.from_bytes(data[place:begin], "big")
        return
    while (place := data.find(b"\0\0\1", place)) >= 0 and place + 3 < len(data):
        yield data[place + 3]
        place += 3
