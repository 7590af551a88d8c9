"""Videos are what was written, and drawing is where it was asked for."""

from __future__ import annotations

from pathlib import Path

import av
import numpy as np
import pytest

from robo_manip_baselines.rollout.videos import (
    YELLOW,
    VideoWriter,
    _paint,
    draw_track,
    pad_to_even,
    put_caption,
    side_by_side,
)

GREY = np.full((60, 80, 3), 90, dtype=np.uint8)


def make_movie(path: Path, number: int, shape: tuple[int, int], fps: float) -> list[np.ndarray]:
    frames = []
    with VideoWriter(path, fps) as video:
        for index in range(number):
            frame = np.full((*shape, 3), (40, 90, 160), dtype=np.uint8)
            frame[: shape[0] // 2, : (index + 1) * shape[1] // number] = (200, 60, 30)
            video.write(frame)
            frames.append(frame)
    return frames


@pytest.mark.parametrize(
    ("number", "shape", "fps"),
    [(1, (64, 96), 30.0), (25, (48, 64), 50.0), (10, (49, 65), 25.0), (12, (48, 64), 30000 / 1001)],
)
def test_opened_video_is_what_was_written(
    tmp_path: Path, number: int, shape: tuple[int, int], fps: float
) -> None:
    path = tmp_path / "preview.mp4"
    frames = make_movie(path, number, shape, fps)
    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        decoded = [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]
        assert stream.codec_context.name == "h264"
        assert stream.codec_context.pix_fmt == "yuv420p"  # the only one that browsers all play
        assert (stream.height, stream.width) == (shape[0] + shape[0] % 2, shape[1] + shape[1] % 2)
        assert len(decoded) == stream.frames == number
        assert float(stream.average_rate or 0) == pytest.approx(fps)
        # A container keeps its length in milliseconds.
        assert float(container.duration or 0) / 1e6 == pytest.approx(number / fps, abs=2e-3)
    for image, truth in zip(decoded, frames, strict=True):
        cropped = image[: shape[0], : shape[1]].astype(int)
        # libx264 at its default quality; red and blue swapped would be off by 100.
        assert np.abs(cropped - truth).mean() < 8


def test_index_is_in_front(tmp_path: Path) -> None:
    make_movie(tmp_path / "a.mp4", 5, (48, 64), 50)
    data = (tmp_path / "a.mp4").read_bytes()
    assert 0 < data.index(b"moov") < data.index(b"mdat")


def test_same_frames_give_same_bytes(tmp_path: Path) -> None:
    for name in ("a.mp4", "b.mp4"):
        make_movie(tmp_path / name, 8, (48, 64), 50)
    assert (tmp_path / "a.mp4").read_bytes() == (tmp_path / "b.mp4").read_bytes()


@pytest.mark.parametrize("error", [KeyboardInterrupt, RuntimeError])
def test_interrupted_video_leaves_nothing(tmp_path: Path, error: type[BaseException]) -> None:
    with pytest.raises(error), VideoWriter(tmp_path / "a.mp4", 50) as video:  # noqa: PT012
        video.write(GREY)
        raise error
    assert list(tmp_path.iterdir()) == []


def test_empty_video_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="no frame was written"), VideoWriter(tmp_path / "a", 50):
        pass
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("frame", "message"),
    [
        (GREY[:40], "in a video of"),
        (GREY.astype(np.float32), "uint8, not"),
        (GREY[..., 0], r"\(H, W, 3\)"),
    ],
)
def test_wrong_frames_are_refused(tmp_path: Path, frame: np.ndarray, message: str) -> None:
    with (  # noqa: PT012
        pytest.raises(ValueError, match=message),
        VideoWriter(tmp_path / "a.mp4", 50) as video,
    ):
        video.write(GREY)
        video.write(frame)
    assert list(tmp_path.iterdir()) == []


def test_padding_repeats_the_edge() -> None:
    image = np.arange(3 * 5 * 3, dtype=np.uint8).reshape(3, 5, 3)
    padded = pad_to_even(image)
    assert padded.shape == (4, 6, 3)
    np.testing.assert_array_equal(padded[:3, :5], image)
    np.testing.assert_array_equal(padded[3, :5], image[2])
    np.testing.assert_array_equal(padded[:3, 5], image[:, 4])
    assert pad_to_even(GREY).shape == GREY.shape


def test_side_by_side_keeps_order_and_height() -> None:
    images = [np.full((60, 80, 3), value, np.uint8) for value in (10, 120, 250)]
    joined = side_by_side(images)
    assert joined.shape == (60, 240, 3)
    np.testing.assert_array_equal(joined[30, [40, 120, 200], 0], [10, 120, 250])
    other = np.full((30, 20, 3), 77, np.uint8)
    joined = side_by_side([images[0], other])
    assert joined.shape == (60, 120, 3)
    assert (joined[:, 80:] == 77).all()
    with pytest.raises(ValueError, match="no image"):
        side_by_side([])


def test_track_ends_in_a_ring_and_fades_towards_its_past() -> None:
    points = np.array([[10.0, 30.0], [30.0, 30.0], [50.0, 30.0], [65.0, 30.0]])
    before = GREY.copy()
    drawn = draw_track(GREY, points, YELLOW)
    np.testing.assert_array_equal(GREY, before)
    distance = np.abs(drawn.astype(int) - YELLOW).sum(axis=2)
    assert distance[30, 52] == 0  # the newest piece, in full colour
    assert distance[30, 52] < distance[30, 40] < distance[30, 15] < distance[10, 10]
    assert distance[30, 73] < 60  # the ring's radius is 8
    changed = np.argwhere((drawn != GREY).any(axis=2))
    assert changed[:, 0].min() >= 30 - 12
    assert changed[:, 0].max() <= 30 + 12
    assert changed[:, 1].max() <= 65 + 12


def test_point_out_of_view_interrupts_the_track() -> None:
    gap = np.array([[10.0, 30.0], [np.nan, np.nan], [70.0, 30.0]])
    drawn = draw_track(GREY, gap)
    np.testing.assert_array_equal(drawn[:, 20:60], GREY[:, 20:60])
    assert (drawn[:, 60:] != GREY[:, 60:]).any()
    np.testing.assert_array_equal(draw_track(GREY, gap[:2]), GREY)
    np.testing.assert_array_equal(draw_track(GREY, np.zeros((0, 2))), GREY)


def test_points_far_outside_do_no_harm() -> None:
    rng = np.random.default_rng(0)
    for _ in range(50):
        points = rng.normal(size=(6, 2)) * 10.0 ** rng.integers(0, 12)
        drawn = draw_track(GREY, points)
        assert drawn.shape == GREY.shape
    inside = draw_track(GREY, np.array([[-200.0, 30.0], [200.0, 30.0]]))
    assert (inside[30] != GREY[30]).any(axis=1).all()  # the line crosses the whole picture


@pytest.mark.parametrize("text", ["seed 3", "a caption that is far wider than this small picture"])
def test_caption_stays_in_the_lower_left(text: str) -> None:
    drawn = put_caption(GREY, text)
    changed = np.argwhere((drawn != GREY).any(axis=2))
    assert len(changed) > 20
    assert changed[:, 0].min() > 30
    assert changed[:, 1].min() < 20
    assert not (drawn[:, -1] != GREY[:, -1]).any()  # nothing is cut off at the right
    assert drawn.max() > 200  # white letters
    assert drawn.min() < 30  # with a dark rim


@pytest.mark.parametrize("size", [(60, 80), (1, 1), (7, 5)])
def test_paint_is_a_mixture_pixel_by_pixel(size: tuple[int, int]) -> None:
    rng = np.random.default_rng(0)
    image = rng.integers(0, 256, (*size, 3), dtype=np.uint8)
    for opacity in (
        np.where(rng.random(size) < 0.3, rng.integers(0, 256, size), 0).astype(np.uint8),
        np.zeros(size, np.uint8),
        np.full(size, 255, np.uint8),
    ):
        before, weight = image.copy(), opacity[..., None] / 255
        wanted = image * (1 - weight) + np.array(YELLOW) * weight
        painted = _paint(image, opacity, YELLOW)
        np.testing.assert_array_equal(image, before)
        assert np.abs(painted - wanted).max() <= 0.5 + 1e-4  # rounded from float32
        np.testing.assert_array_equal(painted[opacity == 0], image[opacity == 0])
