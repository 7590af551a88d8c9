"""Spliced motion: blends are smooth, what is recorded stays as recorded, marks are true."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from face_prediction.motion.motion import ClipMotion, MotionSettings, lift
from face_prediction.motion.splice import (
    SpliceSettings,
    Stretch,
    best_join,
    join_stretches,
    smooth_step,
    splice_clips,
)
from face_prediction.tracking.geometry import rotation_angle
from robo_manip_baselines.runs.errors import RequestError

FPS = 30.0
BLEND, SEARCH = 12, 9  # frames of the default settings
SETTINGS = SpliceSettings(splice=True)


def turned(angle: np.ndarray) -> np.ndarray:
    """Quaternions (T, 4) of turns by (T,) degrees about y."""
    half = np.radians(angle) / 2
    return np.stack([np.cos(half), 0 * half, np.sin(half), 0 * half], axis=1)


def stretch(name: str, frames: int, phase: float, place: float = 0.0) -> Stretch:
    """A mouth that sways, a head that turns with it, and a jaw; all smooth."""
    time = np.arange(frames) / FPS + phase
    swing = np.sin(2 * np.pi * 0.4 * time)
    mouth = np.stack([0.02 * swing + place, 0.005 * np.cos(time), -0.5 + 0 * time], axis=1)
    return Stretch(name, 0, False, mouth, turned(8 * swing), 0.01 + 0.005 * np.cos(3 * time))


def test_the_weight_of_a_blend_has_no_slope_and_no_bend_at_its_ends() -> None:
    # Oracle: central differences of the polynomial continued by 0 and 1.
    step = 1e-4
    phases = np.array([-step, 0, step, 1 - step, 1, 1 + step])
    values = np.where(phases < 0, 0.0, np.where(phases > 1, 1.0, smooth_step(phases)))
    for low, middle, high in (values[:3], values[3:]):
        assert abs(high - low) / (2 * step) < 1e-6
        assert abs(high - 2 * middle + low) / step**2 < 1e-2  # 60 step, its third derivative
    assert smooth_step(np.array([0.0, 0.5, 1.0])).tolist() == [0.0, 0.5, 1.0]


def test_a_stretch_goes_on_in_its_own_future() -> None:
    """Cut in two with an overlap, a motion is put together again as it was."""
    whole = stretch("whole", 200, 0.0)
    first = replace(whole, clip="first", **part(whole, 0, 110))
    second = replace(whole, clip="second", **part(whole, 95, 200))
    (chain,) = join_stretches([first, second], SETTINGS, FPS)
    mouth, orientation, jaw, blended, mirrored = chain.parts
    np.testing.assert_allclose(mouth, whole.mouth, atol=1e-12)
    np.testing.assert_allclose(jaw, whole.jaw, atol=1e-12)
    assert rotation_angle(orientation, whole.orientation).max() < 1e-6
    assert blended.sum() == BLEND - 1
    assert not mirrored.any()


def part(whole: Stretch, start: int, stop: int) -> dict[str, np.ndarray]:
    names = ("mouth", "orientation", "jaw")
    return {name: getattr(whole, name)[start:stop] for name in names}


def test_the_best_place_is_that_of_an_exhaustive_search() -> None:
    first, second = stretch("a", 60, 0.0), stretch("b", 70, 0.37, place=0.03)
    found = best_join(first, second, BLEND, BLEND, SEARCH, FPS)
    assert found is not None
    velocity = [np.gradient(s.mouth, axis=0) * FPS for s in (first, second)]
    costs = {}
    for leave in range(60 - BLEND - 1 - SEARCH, 60 - BLEND):
        for enter in range(SEARCH + 1):
            total = 0.0
            for ahead in range(BLEND + 1):
                i, j = leave + ahead, enter + ahead
                angle = np.degrees(rotation_angle(first.orientation[i], second.orientation[j]))
                speed = np.linalg.norm(velocity[0][i] - velocity[1][j])
                jaw = first.jaw[i] - second.jaw[j]
                gap = np.linalg.norm(first.mouth[i] - second.mouth[j])
                total += (angle / 5) ** 2 + (speed / 0.05) ** 2 + (jaw / 0.003) ** 2
                total += (gap / 0.005) ** 2
            costs[leave, enter] = total / (BLEND + 1)
    assert (found.leave, found.enter) == min(costs, key=costs.__getitem__)
    assert found.cost == pytest.approx(min(costs.values()))


def test_samples_outside_blends_are_as_recorded() -> None:
    stretches = [stretch(name, 80, phase, place) for name, phase, place in
                 (("a", 0.0, 0.0), ("b", 0.4, 0.01), ("c", 1.1, -0.005))]  # fmt: skip
    (chain,) = join_stretches(stretches, SETTINGS, FPS)
    mouth, orientation, jaw, blended, _ = chain.parts
    assert blended.sum() == 2 * (BLEND - 1)
    edges = np.flatnonzero(np.diff(np.r_[0, ~blended, 0]))
    pieces = list(zip(edges[::2], edges[1::2], strict=True))
    assert len(pieces) == 3
    for (start, stop), source in zip(pieces, chain.stretches, strict=True):
        first = int(np.argmin(np.linalg.norm(source.mouth - mouth[start], axis=1)))
        same = slice(first, first + stop - start)
        np.testing.assert_array_equal(mouth[start:stop], source.mouth[same])
        np.testing.assert_array_equal(jaw[start:stop], source.jaw[same])
        assert rotation_angle(orientation[start:stop], source.orientation[same]).max() < 1e-6


def test_no_step_is_larger_for_the_blend() -> None:
    """Position and velocity go from one stretch to the other without a jump."""
    stretches = [stretch("a", 80, 0.0), stretch("b", 80, 1.7, place=0.01)]
    (chain,) = join_stretches(stretches, replace(SETTINGS, max_turn=60.0, max_gap=0.1), FPS)
    gap, duration = max(join.gap for join in chain.joins if join), BLEND / FPS
    acceleration = np.abs(np.diff(chain.parts[0], n=2, axis=0)) * FPS**2
    recorded = max(np.abs(np.diff(s.mouth, n=2, axis=0)).max() for s in stretches) * FPS**2
    # The weight's slope reaches 1.9 / duration and its bend 5.8 / duration²; the stretches differ
    # by at most twice the mean gap, and by 0.1 m/s, twice what either moves at.
    assert acceleration.max() < recorded + 5.8 * 2 * gap / duration**2 + 2 * 1.9 * 0.1 / duration


def test_a_mirrored_stretch_follows_where_none_forwards_fits() -> None:
    only = stretch("a", 90, 0.0)
    (chain,) = join_stretches([only], SETTINGS, FPS)
    assert len(chain) == 90
    (chain,) = join_stretches([only], replace(SETTINGS, mirror=True), FPS)
    assert [s.is_mirrored for s in chain.stretches] == [False, True]
    mirrored = chain.parts[4]
    turn = int(np.flatnonzero(mirrored)[0])
    assert not mirrored[:turn].any()
    assert mirrored[turn:].all()
    np.testing.assert_allclose(
        np.diff(chain.parts[0][-20:], axis=0), np.diff(only.mouth[19::-1], axis=0)
    )


def test_heads_that_differ_too_much_are_not_joined() -> None:
    one, other = stretch("a", 80, 0.0), stretch("b", 80, 0.0)
    other = replace(other, orientation=turned(np.full(80, 30.0)))
    chains = join_stretches([one, other], SETTINGS, FPS)
    assert [len(chain) for chain in chains] == [80, 80]


def test_mouths_that_are_too_far_apart_are_not_joined() -> None:
    chains = join_stretches([stretch("a", 80, 0.0), stretch("b", 80, 0.0, 0.1)], SETTINGS, FPS)
    assert [len(chain) for chain in chains] == [80, 80]


def test_a_blend_shorter_than_a_frame_is_a_cut() -> None:
    settings = replace(SETTINGS, blend=0.001)
    (chain,) = join_stretches([stretch("a", 60, 0.0), stretch("b", 60, 0.1)], settings, FPS)
    assert not chain.parts[3].any()
    assert np.isfinite(chain.parts[0]).all()


def test_no_more_than_is_wanted_of_one_person() -> None:
    stretches = [stretch(str(i), 90, 0.1 * i) for i in range(10)]
    (chain,) = join_stretches(stretches, replace(SETTINGS, max_spliced=6.0), FPS)
    assert 6.0 * FPS <= len(chain) < 6.0 * FPS + 90


@pytest.fixture
def clips(make_track) -> list[tuple[str, str, ClipMotion]]:
    """Five clips of 3 s of one person and one of another, none as long as a run."""
    cuts = MotionSettings(min_run=8.0)
    found = []
    for number in range(6):
        mouth = stretch("", 90, 0.3 * number, place=0.05 * number).mouth  # another take each
        motion = lift(make_track(mouth, name=f"{number}.mp4"), cuts)
        assert not motion.runs
        found.append((str(number), "ann" if number < 5 else "bob", motion))
    return found


def test_clips_of_one_person_become_a_run(clips: list[tuple[str, str, ClipMotion]]) -> None:
    cuts = MotionSettings(min_run=8.0)
    (spliced,) = splice_clips(clips, SETTINGS, cuts)
    assert (spliced.name, spliced.subject) == ("ann_spliced", "ann")
    assert set(spliced.clips) == {"0", "1", "2", "3", "4"}
    assert spliced.motion.seconds >= 8.0
    assert len(spliced.blended) == len(spliced.mirrored) == len(spliced.motion.jaw)
    assert spliced.kept(spliced.blended).sum() == 4 * (BLEND - 1)
    assert all(stretch["frames"] == 90 for stretch in spliced.stretches)
    # The takes, 0.05 m apart, are brought together: it stays where a person who sways is.
    assert np.ptp(spliced.motion.mouth, axis=0).max() < 0.06


def test_frames_of_a_run_are_not_spliced(clips: list[tuple[str, str, ClipMotion]]) -> None:
    name, subject, motion = clips[0]
    taken = replace(motion, runs=[(0, len(motion.jaw))])
    (spliced,) = splice_clips(
        [(name, subject, taken), *clips[1:]], SETTINGS, MotionSettings(min_run=8.0)
    )
    assert set(spliced.clips) == {"1", "2", "3", "4"}


@pytest.mark.parametrize("name", ["blend", "search", "min_stretch", "max_turn", "max_spliced"])
def test_settings_are_checked(name: str) -> None:
    with pytest.raises(RequestError, match=f"--{name} -1"):
        SpliceSettings(**{name: -1.0})
