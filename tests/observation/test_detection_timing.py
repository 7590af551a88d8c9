"""Times at which the observed mouth was seen: delay, losses and rates, against tables."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from robo_manip_baselines.observation import Corruption
from robo_manip_baselines.observation.corruption import DetectionTiming, draw_lost, frame_of

FRAMES = 40
STEP = 0.02


def schedule(
    lost: tuple[int, ...] = (), frames: int = FRAMES, **settings: float
) -> DetectionTiming:
    is_lost = np.zeros(frames, np.bool_)
    is_lost[list(lost)] = True
    return DetectionTiming.of(Corruption(**settings), is_lost)  # pyright: ignore[reportArgumentType]


def test_a_delay_shows_the_first_report_until_the_second_arrives() -> None:
    """At the camera's own rate: the table in the docstring of `DetectionTiming.seen_at`."""
    seen, frame = schedule(delay=3).seen_at(np.arange(6) / 30)
    np.testing.assert_allclose(seen * 30, [0, 0, 0, 0, 1, 2], atol=1e-9)
    assert frame.tolist() == [0, 0, 0, 0, 1, 2]


def test_a_delay_is_exact_between_frames() -> None:
    """Two frames are 3 1/3 control steps; three frames are 5."""
    seen, _ = schedule(delay=2).seen_at(np.arange(8) * STEP)
    np.testing.assert_allclose(seen / STEP, [0, 0, 0, 0, 2 / 3, 5 / 3, 8 / 3, 11 / 3], atol=1e-9)
    seen, _ = schedule(delay=3).seen_at(np.arange(8) * STEP)
    np.testing.assert_allclose(seen / STEP, [0, 0, 0, 0, 0, 0, 1, 2], atol=1e-9)


def test_without_settings_everything_is_seen_at_once() -> None:
    time = np.arange(50) * STEP
    seen, frame = schedule().seen_at(time)
    np.testing.assert_array_equal(seen, time)
    assert frame.tolist() == [3 * step // 5 for step in range(50)]


def test_a_rate_holds_each_report() -> None:
    """10 Hz: a report every 5 steps, of frames 0, 3, 6."""
    seen, frame = schedule(detector_rate=10.0).seen_at(np.arange(12) * STEP)
    np.testing.assert_allclose(seen * 10, [0] * 5 + [1] * 5 + [2] * 2, atol=1e-9)
    assert frame.tolist() == [0] * 5 + [3] * 5 + [6] * 2


def test_a_loss_holds_what_was_seen_last() -> None:
    """Frames 2 and 3 are lost, from 66.7 to 133.3 ms: steps 4, 5 and 6 see what was so at 66.7."""
    seen, frame = schedule((2, 3)).seen_at(np.arange(9) * STEP)
    np.testing.assert_allclose(seen * 30, [0, 0.6, 1.2, 1.8, 2, 2, 2, 4.2, 4.8], atol=1e-9)
    assert frame.tolist() == [0, 0, 1, 1, 1, 1, 1, 4, 4]


def test_a_loss_takes_the_looks_that_fall_into_it() -> None:
    """15 Hz looks at frames 0, 2, 4, 6; frame 4 is lost."""
    seen, frame = schedule((4, 5), detector_rate=15.0).seen_at(np.arange(9) / 30)
    assert frame.tolist() == [0, 0, 2, 2, 2, 2, 6, 6, 8]
    np.testing.assert_allclose(seen * 30, frame, atol=1e-9)


def slow_detector(lost: set[int], delay: int, rate: float | None, time: float) -> tuple[float, int]:
    """Go back from ``time``, in steps of 1/1200 s or look by look, until the face was found."""
    latest = time - delay / 30
    if rate is None:
        if latest <= 0:
            return 0.0, 0
        frame = int(latest * 30 + 1e-6)
        if frame not in lost:
            return latest, frame
        while frame in lost:
            frame -= 1
        return (frame + 1) / 30, frame
    look = 0
    found = 0
    while (look + 1) / rate <= latest + 1e-7:
        look += 1
        if int(look / rate * 30 + 1e-6) not in lost:
            found = look
    return found / rate, int(found / rate * 30 + 1e-6)


@given(
    lost=st.sets(st.integers(1, FRAMES - 1)),
    delay=st.integers(0, 12),
    rate=st.one_of(st.none(), st.floats(0.5, 30.0), st.sampled_from([5.0, 10.0, 15.0, 30.0])),
)
def test_a_slow_detector_agrees(lost: set[int], delay: int, rate: float | None) -> None:
    time = np.arange(int(FRAMES / 30 / STEP)) * STEP
    laid_out = schedule(tuple(lost), delay=delay, detector_rate=rate)  # pyright: ignore
    seen, frame = laid_out.seen_at(time)
    for now, then, at in zip(time, seen, frame, strict=True):
        wanted, wanted_frame = slow_detector(lost, delay, rate, float(now))
        assert abs(then - wanted) < 1e-7
        assert at == wanted_frame
    assert (seen <= time).all()  # never the future, not by a rounding
    assert (np.diff(seen) >= 0).all()
    assert (frame_of(seen) >= frame).all()
    assert not lost & set(frame.tolist())
    # One moment at a time is the same, bit for bit.
    alone = [laid_out.seen_at(now) for now in time]
    np.testing.assert_array_equal([a[0] for a in alone], seen)


def test_a_rounding_is_no_look_into_the_future() -> None:
    """A clock that falls short of a frame by a rounding shows it, but as of that very moment."""
    time = np.nextafter(np.arange(1, 30) / 30, 0.0)
    for laid_out in (schedule(detector_rate=30.0), schedule(tuple(range(2, 39)))):
        seen, _ = laid_out.seen_at(time)
        assert (seen <= time).all()
    np.testing.assert_allclose(schedule(detector_rate=30.0).seen_at(time)[0], time, rtol=1e-12)


@pytest.mark.parametrize(("share", "length"), [(0.1, 15.0), (0.4, 3.0), (0.5, 1.0)])
def test_losses_have_the_asked_share_and_length(share: float, length: float) -> None:
    corruption = Corruption(face_dropout=share, face_dropout_length=length)
    lost = draw_lost(corruption, np.random.default_rng(0), 400_000)
    assert not lost[0]
    edges = np.flatnonzero(np.diff(lost.astype(int)))
    bursts = np.diff(edges)[::1][0::2] if lost[edges[0] + 1] else np.diff(edges)[1::2]
    # Five standard errors: a geometric length scatters by up to itself.
    slack = 5.0 / np.sqrt(len(bursts))
    assert abs(bursts.mean() / length - 1.0) < slack
    assert abs(lost.mean() / share - 1.0) < 1.5 * slack
    if length > 1:
        # Geometric: of the losses that have lasted so long, the same share goes on.
        goes_on = 1.0 - 1.0 / length
        assert abs((bursts > 1).mean() - goes_on) < slack
        assert abs((bursts > 2).mean() - goes_on**2) < slack


def test_losses_begin_the_same_however_many_are_drawn() -> None:
    corruption = Corruption(face_dropout=0.3)
    long, short = (draw_lost(corruption, np.random.default_rng(5), frames) for frames in (700, 90))
    np.testing.assert_array_equal(long[:90], short)
    assert short.any()
    assert not draw_lost(Corruption(delay=2), np.random.default_rng(5), 9).any()
