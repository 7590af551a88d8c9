"""Images as a player shows them: turned, mirrored, cropped, with square pixels, in true colours."""

from __future__ import annotations

import itertools
import struct
from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np
import pytest

from face_prediction.tracking.display import (
    Margins,
    NotShownError,
    opaque_rgb,
    turned,
    with_square_pixels,
)
from face_prediction.tracking.video import VideoReader
from robo_manip_baselines.runs.errors import RequestError

pytestmark = pytest.mark.long

DIHEDRAL = [
    (a, b, c, d)
    for a, b, c, d in itertools.product((-1, 0, 1), repeat=4)
    if abs(a) + abs(b) == abs(c) + abs(d) == abs(a) + abs(c) == 1
]
ENCODED = 12
"""Largest difference that 4:2:0 and quantisation leave in smooth parts of the pattern, of 255."""


def shown(image: np.ndarray, matrix: tuple[int, ...]) -> np.ndarray:
    """Each pixel carried to (a x + c y, b x + d y), one by one."""
    a, b, c, d = matrix
    height, width = image.shape[:2]
    places = {(x, y): (a * x + c * y, b * x + d * y) for x in range(width) for y in range(height)}
    left = min(x for x, _ in places.values())
    top = min(y for _, y in places.values())
    out = np.zeros((width, height, 3) if a == 0 else image.shape, dtype=np.uint8)
    for (x, y), (to_x, to_y) in places.items():
        out[to_y - top, to_x - left] = image[y, x]
    return out


def differs(got: np.ndarray, expected: np.ndarray) -> float:
    """Mean difference of two images of one shape, 0...255."""
    assert got.shape == expected.shape
    return float(np.abs(got.astype(int) - expected).mean())


@pytest.mark.parametrize("matrix", DIHEDRAL)
def test_every_turn_and_mirror_image(tmp_path, encode, pattern, set_matrix, read, matrix) -> None:
    path = encode(tmp_path / "v.mp4", pattern(3))
    plain = read(path)[0].image
    set_matrix(path, matrix)
    image = read(path)[0].image
    np.testing.assert_array_equal(image, shown(plain, matrix))
    np.testing.assert_array_equal(image, turned(plain, np.array(matrix).reshape(2, 2).T))
    assert image.flags.c_contiguous


@pytest.mark.parametrize("rotation", [0, 90, 180, 270])
def test_turns_as_opencv_shows_them(tmp_path: Path, write_video, pattern, read, rotation) -> None:
    path = write_video(tmp_path / "v.mp4", pattern(3), rotation=rotation)
    capture = cv2.VideoCapture(str(path))
    _, expected = capture.read()
    capture.release()
    # both decode to the same YUV; the two colour conversions differ by rounding
    np.testing.assert_allclose(read(path)[0].image, expected[..., ::-1], atol=3)


def test_a_uniform_scale_shows_the_same(tmp_path, encode, pattern, set_matrix, read) -> None:
    path = encode(tmp_path / "v.mp4", pattern(3))
    plain = read(path)[0].image
    set_matrix(path, (0, 2, -2, 0))
    np.testing.assert_array_equal(read(path)[0].image, shown(plain, (0, 1, -1, 0)))


@pytest.mark.parametrize(
    "matrix",
    [(0.8, 0.6, -0.6, 0.8), (1, 0.5, 0, 1), (0.7071, 0.7071, -0.7071, 0.7071), (1, 1, 1, 1)],
)
def test_other_matrices_are_refused(tmp_path, encode, pattern, set_matrix, read, matrix) -> None:
    path = encode(tmp_path / "v.mp4", pattern(3))
    set_matrix(path, matrix)
    with pytest.raises(RequestError, match=r"display matrix .* no turn by a multiple of 90") as e:
        read(path)
    assert str(path) in str(e.value)


@pytest.mark.parametrize("name", ["v.mp4", "v.mkv", "v.h264"])
@pytest.mark.parametrize("sar", [Fraction(2), Fraction(1, 2), Fraction(16, 11), Fraction(15, 16)])
def test_pixels_become_square(tmp_path, encode, pattern, read, name, sar) -> None:
    """A pattern squeezed by the aspect ratio of its pixels looks like the one that was not."""
    size = (max(96, round(96 * sar)), max(64, round(64 / sar)))
    wanted = cv2.resize(pattern(1, *size)[0], size)
    squeezed = cv2.resize(wanted, (96, 64), interpolation=cv2.INTER_AREA)
    path = encode(tmp_path / name, [squeezed] * 3, sar=sar)
    assert differs(read(path)[0].image, wanted) < ENCODED


def test_pixels_are_squared_before_the_turn(tmp_path, encode, pattern, set_matrix, read) -> None:
    path = encode(tmp_path / "v.mp4", pattern(3), sar=Fraction(2))
    straight = read(path)[0].image
    assert straight.shape == (64, 192, 3)
    set_matrix(path, (0, 1, -1, 0))
    np.testing.assert_array_equal(read(path)[0].image, shown(straight, (0, 1, -1, 0)))


def test_absurd_pixels_are_refused() -> None:
    image = np.zeros((4, 4, 3), dtype=np.uint8)
    for aspect in (Fraction(1, 60000), Fraction(9)):
        with pytest.raises(NotShownError, match="times as wide as high"):
            with_square_pixels(image, aspect)
    assert with_square_pixels(image, Fraction(0)) is image
    assert with_square_pixels(image, Fraction(4095, 4096)) is image


def test_a_change_of_pixels_is_refused(tmp_path, encode, pattern, read) -> None:
    parts = [encode(tmp_path / f"{n}.h264", pattern(5), sar=Fraction(n)) for n in (1, 2)]
    path = tmp_path / "v.h264"
    path.write_bytes(b"".join(part.read_bytes() for part in parts))
    with pytest.raises(RequestError, match="the shape of its pixels changes from 1 to 2"):
        read(path)


def test_a_change_of_size_is_refused(tmp_path, encode, pattern, read) -> None:
    parts = [encode(tmp_path / f"{n}.h264", pattern(5, 96, n)) for n in (64, 80)]
    path = tmp_path / "v.h264"
    path.write_bytes(b"".join(part.read_bytes() for part in parts))
    with pytest.raises(RequestError, match="image size changes from 96x64 to 96x80"):
        read(path)


def test_a_clean_aperture_is_cropped(tmp_path, encode, pattern, set_aperture, set_matrix, read):
    path = encode(tmp_path / "v.mp4", pattern(3))
    whole = read(path)[0].image
    set_aperture(path, 64, 48, 8, -4)
    cropped = whole[4:-12, 24:-8]
    np.testing.assert_array_equal(read(path)[0].image, cropped)
    set_matrix(path, (-1, 0, 0, 1))
    np.testing.assert_array_equal(read(path)[0].image, cropped[:, ::-1])


def test_the_crop_of_matroska(tmp_path, encode, pattern, extend_matroska, read) -> None:
    path = encode(tmp_path / "v.mkv", pattern(3))
    whole = read(path)[0].image
    # RFC 9559, 5.1.4.1.28: PixelCropBottom, Top, Left, Right; the size that is shown is of the rest
    crop = {"54AA": 4, "54BB": 12, "54CC": 6, "54DD": 10, "54B0": 80, "54BA": 48}
    extend_matroska(path, crop)
    image = read(path)[0].image
    assert differs(cv2.resize(whole[12:-4, 6:-10], (80, 48)), image) < 1


def test_a_stereo_mode_of_matroska_is_refused(tmp_path, encode, pattern, extend_matroska, read):
    path = encode(tmp_path / "v.mkv", pattern(3))
    extend_matroska(path, {"53B8": 1})
    with pytest.raises(RequestError, match=r"stereoscopic video \(side by side\)"):
        read(path)


def test_the_codecs_own_crop_is_exact(tmp_path, encode, pattern, read) -> None:
    images = pattern(3)
    options = {"qp": "4", "x264-params": "crop-rect=6,2,10,4"}
    path = encode(tmp_path / "v.mp4", images, options=options)
    assert differs(read(path)[0].image, images[0][2:-4, 6:-10]) < ENCODED


def test_a_crop_of_everything_is_refused() -> None:
    image = np.zeros((8, 8, 3), dtype=np.uint8)
    with pytest.raises(NotShownError, match="leaves nothing"):
        Margins(left=5, right=3).crop(image)
    assert Margins(left=5, right=2).crop(image).shape == (8, 1, 3)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"options": {"x264-params": "tff=1"}}, "frames are interlaced"),
        ({"options": {"x264-params": "frame-packing=3"}}, r"stereoscopic video \(side by side\)"),
        ({"options": {"x264-params": "frame-packing=4"}}, r"stereoscopic .* \(top and bottom\)"),
        ({"color_trc": 16}, r"high dynamic range \(PQ\)"),
        ({"color_trc": 18, "layout": "yuv420p10le"}, r"high dynamic range \(HLG\)"),
        ({"colorspace": 8}, "colour matrix 8 is unknown"),
    ],
)
def test_what_is_not_shown_is_refused(tmp_path, encode, pattern, read, settings, message) -> None:
    path = encode(tmp_path / "v.mp4", pattern(4), **settings)
    with pytest.raises(RequestError, match=message) as caught:
        read(path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("full", [False, True], ids=["limited", "full"])
@pytest.mark.parametrize(("matrix", "kr", "kb"), [(1, 0.2126, 0.0722), (6, 0.299, 0.114)])
@pytest.mark.parametrize("layout", ["yuv420p", "yuv420p10le"])
def test_colours(tmp_path: Path, encode, read, full: bool, matrix, kr, kb, layout) -> None:
    """A grey that is a little red, from its Y, Cb, Cr by the formulas of ITU-T H.273, 8.3."""
    y, cb, cr = 120, 100, 170
    flat = np.zeros((64, 64, 3), dtype=np.uint8)
    path = tmp_path / "v.mp4"
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=30, options={"qp": "0"})
        stream.width = stream.height = 64
        stream.pix_fmt = layout
        stream.codec_context.colorspace = matrix
        stream.codec_context.color_range = 2 if full else 1
        deep = layout.endswith("10le")
        for _ in range(2):
            frame = av.VideoFrame(64, 64, layout)
            for plane, value in zip(frame.planes, (y, cb, cr), strict=True):
                kind, scaled = (np.uint16, value * 4) if deep else (np.uint8, value)
                plane.update(
                    np.full(plane.buffer_size // (2 if deep else 1), scaled, kind).tobytes()
                )
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    luma, blue, red = (
        (y / 255, (cb - 128) / 255, (cr - 128) / 255)
        if full and not deep
        else (y / 255.75, (cb - 128) / 255.75, (cr - 128) / 255.75)
        if full
        else ((y - 16) / 219, (cb - 128) / 224, (cr - 128) / 224)
    )
    r, b = luma + 2 * (1 - kr) * red, luma + 2 * (1 - kb) * blue
    flat[:] = np.round(255 * np.array([r, (luma - kr * r - kb * b) / (1 - kr - kb), b]))
    # swscale's tables round by up to 3 of 255
    np.testing.assert_allclose(read(path)[0].image.astype(int), flat, atol=3)


def test_transparency_is_refused_and_opacity_is_not(tmp_path, encode, pattern, read) -> None:
    images = [np.dstack([image, np.full((64, 96), 255, np.uint8)]) for image in pattern(3)]
    path = encode(tmp_path / "v.mov", images, codec="png", layout="rgba", options={})
    np.testing.assert_array_equal(read(path)[0].image, pattern(3)[0])
    images[1][5, 5, 3] = 100
    encode(path, images, codec="png", layout="rgba", options={})
    with pytest.raises(RequestError, match="a part of its image is transparent"):
        read(path)


def test_an_animated_image_is_a_video(tmp_path, encode, pattern, read) -> None:
    path = encode(tmp_path / "v.gif", pattern(4), codec="gif", layout="rgb8", options={})
    frames = read(path)
    assert len(frames) == 4
    assert frames[0].image.shape == (64, 96, 3)


def test_the_orientation_of_motion_jpeg(tmp_path, encode, pattern, read) -> None:
    """EXIF orientation 6 inside each JPEG image, as some cameras write it."""
    path = encode(tmp_path / "v.avi", pattern(3), codec="mjpeg", layout="yuvj420p", options={})
    plain = read(path)[0].image
    exif = b"Exif\0\0II*\0" + struct.pack("<IHHHIHHI", 8, 1, 0x112, 3, 1, 6, 0, 0)
    marker = b"\xff\xe1" + struct.pack(">H", len(exif) + 2) + exif
    with av.open(str(path)) as source, av.open(str(tmp_path / "o.mkv"), "w") as target:
        stream = target.add_stream_from_template(source.streams.video[0])
        for packet in source.demux(video=0):
            if packet.size:
                data = bytes(packet)
                copy = av.Packet(data[:2] + marker + data[2:])
                copy.pts, copy.dts, copy.time_base = packet.pts, packet.dts, packet.time_base
                copy.stream, copy.is_keyframe = stream, True
                target.mux(copy)
    image = read(tmp_path / "o.mkv")[0].image
    np.testing.assert_array_equal(image, shown(plain, (0, 1, -1, 0)))


def test_the_video_among_covers_and_others(tmp_path, encode, pattern, read) -> None:
    """A cover picture is no video, and of two videos the default one counts."""
    first, second = pattern(4), [255 - image for image in pattern(4)]
    path = tmp_path / "v.mkv"
    with av.open(str(path), "w") as container:
        streams = []
        for kind in ("cover", "other", "default"):
            stream = container.add_stream("libx264", rate=30, options={"crf": "10"})
            stream.width, stream.height, stream.pix_fmt = 96, 64, "yuv420p"
            stream.disposition = {
                "cover": av.stream.Disposition.attached_pic,
                "other": av.stream.Disposition(0),
                "default": av.stream.Disposition.default,
            }[kind]
            streams.append(stream)
        for index in range(4):
            for stream, images in zip(streams, (second, second, first), strict=True):
                frame = av.VideoFrame.from_ndarray(images[index], format="rgb24")
                container.mux(stream.encode(frame))
        for stream in streams:
            container.mux(stream.encode(None))
    assert differs(read(path)[0].image, first[0]) < ENCODED


def test_only_a_cover_picture_is_no_video(tmp_path: Path, encode, pattern) -> None:
    path = tmp_path / "v.mp4"
    with av.open(str(path), "w") as container:
        stream = container.add_stream("mjpeg", rate=30)
        stream.width, stream.height, stream.pix_fmt = 96, 64, "yuvj420p"
        stream.disposition = av.stream.Disposition.attached_pic
        container.mux(stream.encode(av.VideoFrame.from_ndarray(pattern(1)[0], format="rgb24")))
        container.mux(stream.encode(None))
    with pytest.raises(RequestError, match="holds no video stream"):
        VideoReader(path)


def test_rows_of_any_width(tmp_path: Path, encode, pattern, read) -> None:
    """Rows of widths that are no multiple of 32 come padded, which MediaPipe does not see."""
    image = read(encode(tmp_path / "v.mp4", pattern(2, 90)))[0].image
    assert image.shape == (64, 90, 3)
    assert image.flags.c_contiguous
    assert opaque_rgb(av.VideoFrame.from_ndarray(image, format="rgb24")).shape == (64, 90, 3)
