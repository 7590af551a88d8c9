"""Images as a player shows them, from decoded frames.

A container or codec may ask a player to crop a frame, to stretch its pixels, and to turn or mirror
it, in this order. What a player would do and this module does not is refused by name.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Mapping
from dataclasses import dataclass
from fractions import Fraction
from typing import TYPE_CHECKING, Any, cast

import numpy as np

if TYPE_CHECKING:
    import av
    from av.container import InputContainer
    from av.video.stream import VideoStream

MAX_STRETCH = 8
"""Pixels further from square than this are refused: no camera has them, and an image that is
stretched by a number out of a damaged header takes all memory."""

_MATRICES = frozenset((0, 1, 2, 4, 5, 6, 7, 9))
"""Colour matrices (ITU-T H.273, table 4) that FFmpeg's swscale converts: RGB, BT.709, unspecified
(read as BT.601), FCC, BT.470, BT.601, SMPTE 240M, BT.2020."""
_HDR_TRANSFERS = {16: "PQ", 18: "HLG"}  # ITU-T H.273, table 3
_STEREO = {
    1: "side by side", 2: "top and bottom", 3: "alternating frames", 4: "chequered",
    5: "side by side", 6: "alternating lines", 7: "alternating columns",
}  # fmt: skip
"""Packings of FFmpeg's ``AVStereo3DType`` in which one frame holds two views."""
_RECTILINEAR = 4
"""Projection of FFmpeg's ``AVSphericalProjection`` that a player shows as it is."""
_CROPPING = re.compile(r"Frame cropping: (\d+)/(\d+)/(\d+)/(\d+)", re.IGNORECASE)


SideData = Mapping[str, bytes]


class NotShownError(Exception):
    """A player would do something to the frame that is not done here; the message says what."""


@dataclass(frozen=True)
class Margins:
    """Pixels that the container crops from each side of the coded frame."""

    left: int = 0
    right: int = 0
    top: int = 0
    bottom: int = 0

    def crop(self, image: np.ndarray) -> np.ndarray:
        """The part of ``image`` (H, W, C) inside the margins.

        Raises:
            NotShownError: nothing is left.
        """
        height, width = image.shape[:2]
        part = image[self.top : height - self.bottom, self.left : width - self.right]
        if self.left + self.right >= width or self.top + self.bottom >= height:
            raise NotShownError("its cropping leaves nothing of the frame")
        return part


def container_margins(container: InputContainer, stream: VideoStream) -> Margins:
    """The clean aperture (MP4) or PixelCrop (Matroska) of ``stream``.

    PyAV has no attribute for it; FFmpeg's description of the file has.
    """
    import av.logging

    level = av.logging.get_level()
    av.logging.set_level(av.logging.INFO)  # the description is a message of this level
    try:
        text = str(cast("Any", container).dumps_format())  # not in PyAV's stubs
    finally:
        av.logging.set_level(level)
    parts = re.split(r"^  Stream #0:(\d+)", text, flags=re.MULTILINE)
    own = dict(zip(parts[1::2], parts[2::2], strict=True)).get(str(stream.index), "")
    found = _CROPPING.search(own)
    return Margins(*map(int, found.groups())) if found else Margins()


class Display:
    """Makes RGB images of the decoded frames of one stream.

    Attributes:
        size: width and height of the coded frames.
    """

    def __init__(self, container: InputContainer, stream: VideoStream) -> None:
        self._stream = stream
        self._margins = container_margins(container, stream)
        self._aspect = self._codec_aspect()
        self.size: tuple[int, int] | None = None

    def image(self, frame: av.VideoFrame) -> np.ndarray:
        """The image (H, W, 3) uint8 RGB, C-contiguous, that a player shows for ``frame``.

        Contiguous because PyAV pads the rows of images whose width is no multiple of 32, and
        MediaPipe reads such an array as if it had no padding: a sheared image without a face.

        Raises:
            NotShownError: a player shows something else.
        """
        self._require_unchanged(frame)
        data = side_data(frame, self._stream)
        require_flat(frame, data)
        require_colours(frame, data, self._stream)
        image = self._margins.crop(opaque_rgb(frame))
        # the container's aspect ratio goes before the codec's, as in av_guess_sample_aspect_ratio
        image = with_square_pixels(image, self._stream.sample_aspect_ratio or self._aspect)
        return np.ascontiguousarray(turned(image, display_matrix(data)))

    def _require_unchanged(self, frame: av.VideoFrame) -> None:
        if self.size is None:
            self.size, self._aspect = (frame.width, frame.height), self._codec_aspect()
        if (frame.width, frame.height) != self.size:
            change = f"{self.size[0]}x{self.size[1]} to {frame.width}x{frame.height}"
            raise NotShownError(f"its image size changes from {change}; cut it there")
        if (aspect := self._codec_aspect()) != self._aspect:
            change = f"{self._aspect} to {aspect}"
            raise NotShownError(f"the shape of its pixels changes from {change}; cut it there")

    def _codec_aspect(self) -> Fraction:
        return self._stream.codec_context.sample_aspect_ratio or Fraction(1)


def require_flat(frame: av.VideoFrame, data: SideData) -> None:
    """Raise NotShownError if ``frame`` holds two views, a sphere, or two half-images."""
    if frame.interlaced_frame:
        raise NotShownError(
            "its frames are interlaced (two half-images each); deinterlace it first "
            "(ffmpeg -i VIDEO -vf bwdif OUT.mp4)"
        )
    if "STEREO3D" in data and (packing := _STEREO.get(_first_int(data["STEREO3D"]))):
        raise NotShownError(f"it is a stereoscopic video ({packing}); cut one view out of it")
    if "SPHERICAL" in data and _first_int(data["SPHERICAL"]) != _RECTILINEAR:
        raise NotShownError("it is a spherical video; render a flat view of it first")


def require_colours(frame: av.VideoFrame, data: SideData, stream: VideoStream) -> None:
    """Raise NotShownError if colours of ``frame`` need a conversion that swscale does not have."""
    transfer = _HDR_TRANSFERS.get(int(stream.codec_context.color_trc))
    if transfer is None and "DOVI_METADATA" in data:
        transfer = "Dolby Vision"
    if transfer:
        raise NotShownError(f"its colours are high dynamic range ({transfer}); tone-map it first")
    if int(frame.colorspace) not in _MATRICES:
        known = "BT.601, BT.709, BT.2020, RGB"
        raise NotShownError(f"its colour matrix {int(frame.colorspace)} is unknown; valid: {known}")


def opaque_rgb(frame: av.VideoFrame) -> np.ndarray:
    """Pixels (H, W, 3) uint8 RGB of ``frame``, with the colour matrix and range that it names.

    Raises:
        NotShownError: a part of it is transparent.
    """
    layout = frame.format
    if not (layout.has_palette or any(part.is_alpha for part in layout.components)):
        return frame.to_ndarray(format="rgb24")
    pixels = frame.to_ndarray(format="rgba")
    if np.any(pixels[..., 3] != 255):
        raise NotShownError("a part of its image is transparent; lay it on a background first")
    return pixels[..., :3]


def with_square_pixels(image: np.ndarray, aspect: Fraction) -> np.ndarray:
    """``image`` (H, W, 3), its pixels ``aspect`` times as wide as high, enlarged to square ones.

    Raises:
        NotShownError: the pixels are too far from square.
    """
    if aspect <= 0:
        return image
    if not Fraction(1, MAX_STRETCH) <= aspect <= MAX_STRETCH:
        raise NotShownError(f"its pixels are {aspect} times as wide as high; at most {MAX_STRETCH}")
    height, width = image.shape[:2]
    size = (max(width, round(width * aspect)), max(height, round(height / aspect)))
    if size == (width, height):
        return image
    import cv2  # most videos have square pixels

    return np.asarray(cv2.resize(np.ascontiguousarray(image), size), dtype=np.uint8)


def display_matrix(data: SideData) -> np.ndarray:
    """Signed permutation (2, 2) that carries (x right, y down) of a frame to the screen's.

    Raises:
        NotShownError: the display matrix turns by no multiple of 90 degrees, shears, or stretches.
    """
    if "DISPLAYMATRIX" not in data:
        return np.eye(2, dtype=int)
    a, b, u, c, d, v, _, _, w = struct.unpack("=9i", data["DISPLAYMATRIX"][:36])
    matrix = np.array([[a, c], [b, d]], dtype=float)
    scale = np.abs(matrix).max()
    # entries are 16.16 fixed point: cosines of 90 degrees round to 0 within a part or two
    unit = np.round(matrix / scale, 3) if scale > 0 else matrix
    is_permutation = np.array_equal(np.abs(unit).sum(axis=0), [1.0, 1.0]) and np.array_equal(
        np.abs(unit).sum(axis=1), [1.0, 1.0]
    )
    if u or v or w <= 0 or not (is_permutation and set(np.abs(unit).flat) == {0.0, 1.0}):
        entries = ", ".join(f"{value / 65536:.3g}" for value in (a, b, c, d))
        raise NotShownError(
            f"its display matrix ({entries}) is no turn by a multiple of 90 degrees "
            "or mirror image; render it first (ffmpeg -i VIDEO OUT.mp4)"
        )
    return unit.astype(int)


def turned(image: np.ndarray, matrix: np.ndarray) -> np.ndarray:
    """``image`` (H, W, C) with its pixels carried by ``matrix`` (2, 2), a signed permutation."""
    if matrix[0, 0] == 0:
        image = image.swapaxes(0, 1)
    x, y = matrix.sum(axis=1)
    return image[:: int(y), :: int(x)]


def side_data(frame: av.VideoFrame, stream: VideoStream) -> SideData:
    """Side data of ``frame`` by the name of their type; the first of each, as players take it."""
    unknown: list[str] = []
    while True:
        try:
            listed: list[Any] = [*frame.side_data]  # PyAV's stubs call its elements keys
            break
        except ValueError as error:
            # PyAV lists none where it has no name for one, such as EXIF: without that one it does
            found = re.match(r"\d+", str(error))
            if found is None or found.group() in unknown:
                raise NotShownError(f"its side data cannot be read ({error})") from None
            unknown.append(found.group())
            frame = _without_side_data(frame, stream, unknown[-1])
    return {data.type.name: bytes(data) for data in reversed(listed)}


def _without_side_data(frame: av.VideoFrame, stream: VideoStream, kind: str) -> av.VideoFrame:
    """``frame`` without its side data of one type, a number of FFmpeg."""
    from av.filter import Graph

    graph = Graph()
    source, sink = graph.add_buffer(template=stream), graph.add("buffersink")
    removal = graph.add("sidedata", f"mode=delete:type={kind}")
    source.link_to(removal)
    removal.link_to(sink)
    graph.configure()
    graph.push(frame)
    return cast("av.VideoFrame", graph.pull())


def _first_int(data: bytes) -> int:
    return int(struct.unpack("=i", data[:4])[0])
