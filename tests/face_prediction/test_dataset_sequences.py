"""Tracks to sequences: rate, what is dropped and why, and what the found say."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from face_prediction.dataset.sequences import (
    STATISTICS,
    SequenceSettings,
    clip_frames,
    find_sequences,
    largest_angle,
    sequence_statistics,
)
from face_prediction.tracking.geometry import LIPS
from robo_manip_baselines.runs.errors import RequestError

SETTINGS = SequenceSettings(history=8, future=2, stride=5)


def still(frames: int) -> np.ndarray:
    return np.tile([0.0, 0.0, -0.5], (frames, 1))


def cut(track, settings=SETTINGS):
    frames = clip_frames(track, settings)
    return frames, find_sequences(frames, settings)


@pytest.mark.parametrize(
    ("frames", "starts"), [(9, []), (10, [0]), (14, [0]), (15, [0, 5]), (40, range(0, 31, 5))]
)
def test_starts(make_track, frames: int, starts) -> None:
    _, sequences = cut(make_track(still(frames)))
    assert sequences.start.tolist() == list(starts)
    assert sequences.candidates == len(starts)
    assert sum(sequences.dropped.values()) == 0


def test_a_lost_face_drops_every_sequence_that_holds_it(make_track) -> None:
    valid = np.ones(40, dtype=bool)
    valid[12] = False  # in those that start at 5 and 10
    _, sequences = cut(make_track(still(40), valid=valid))
    assert sequences.start.tolist() == [0, 15, 20, 25, 30]
    assert sequences.dropped == {"no_face": 2, "jump": 0, "spike": 0}
    assert sequences.candidates == 7


def test_a_jump_drops_those_that_hold_both_its_sides(make_track) -> None:
    mouth = still(40)
    mouth[15:, 0] += 0.05  # 5 cm in one frame: from 14 to 15
    _, sequences = cut(make_track(mouth))
    # 5 ... 14 ends before it, 15 ... begins after it; its sides are a spike of acceleration too
    kept = {0, 20, 25, 30}
    assert kept <= set(sequences.start.tolist())
    assert 10 not in sequences.start
    assert sequences.dropped["jump"] == 1
    assert sum(sequences.dropped.values()) == 7 - len(sequences)


def test_a_spike_is_counted_as_that(make_track) -> None:
    mouth = still(40)
    mouth[17, 1] += 0.012  # 0.36 m/s there and back: no jump, and 21.6 m/s² at its top
    _, sequences = cut(make_track(mouth))
    assert sequences.dropped == {"no_face": 0, "jump": 0, "spike": 2}
    assert sequences.start.tolist() == [0, 5, 20, 25, 30]


def test_a_track_without_a_face_is_refused_by_name(make_track) -> None:
    track = make_track(still(20), valid=np.zeros(20, dtype=bool), name="empty.mp4")
    with pytest.raises(RequestError, match=r"empty\.mp4: its track holds no frame with a face"):
        clip_frames(track, SETTINGS)


def moving(frames: int, fps: float) -> np.ndarray:
    """A mouth that goes 3 cm/s to the right."""
    mouth = still(frames)
    mouth[:, 0] = 0.03 * np.arange(frames) / fps
    return mouth


def test_another_rate_is_brought_to_thirty(make_track) -> None:
    frames = clip_frames(make_track(moving(26, 25.0), fps=25.0), SETTINGS)
    assert len(frames) == 31  # 25 steps of 1/25 s are 30 of 1/30 s
    np.testing.assert_allclose(np.diff(frames.timestamps), 1 / 30)
    np.testing.assert_allclose(np.diff(frames.mouth[:, 0]), 0.001, atol=1e-5)
    # every sixth of thirty is one of the twenty-five
    assert frames.interpolated.tolist() == [i % 6 != 0 for i in range(31)]
    # the nearest; halfway, the earlier
    np.testing.assert_array_equal(
        frames.source_frame, np.ceil(np.arange(31) * 25 / 30 - 0.5 - 1e-9)
    )
    assert np.abs(frames.image_lag).max() <= 0.02 + 1e-9
    np.testing.assert_allclose(frames.image_lag, frames.source_frame / 25 - np.arange(31) / 30)


def test_frames_made_by_extract_stay_marked(make_track) -> None:
    track = make_track(moving(31, 30.0))
    marked = np.arange(31) % 6 != 0
    frames = clip_frames(replace(track, interpolated=marked), SETTINGS)
    np.testing.assert_array_equal(frames.interpolated, marked)
    np.testing.assert_array_equal(frames.landmarks, track.landmarks.astype(np.float32))
    # brought from 60 to 30 a second, every second frame is that of the track, mark and all
    fast = make_track(moving(61, 60.0), fps=60.0)
    for rest in (1, 2):
        marked = np.arange(61) % 4 == rest
        frames = clip_frames(replace(fast, interpolated=marked), SETTINGS)
        np.testing.assert_array_equal(frames.interpolated, marked[::2])


def test_the_crop_of_the_history_knows_nothing_of_the_future(make_track) -> None:
    mouth = moving(20, 30.0)
    later = mouth.copy()
    later[8:10, 0] += 0.004  # only in frames to be predicted of the first sequence
    crops = [cut(make_track(path))[1].crops[0] for path in (mouth, later)]
    assert crops[0] == crops[1]
    whole = replace(SETTINGS, crop_from="sequence")
    wider = [cut(make_track(path), whole)[1].crops[0] for path in (mouth, later)]
    assert wider[0].side < wider[1].side
    assert crops[0].side < wider[0].side


def test_found_of_a_motion_that_is_known(make_track) -> None:
    frames = 10
    mouth = still(frames)
    mouth[:, 0] = np.linspace(0.0, 0.018, frames)
    mouth[:, 1] = np.linspace(0.0, -0.009, frames)
    angle = np.radians(np.linspace(-6.0, 6.0, frames))
    rotation = np.tile(np.eye(3), (frames, 1, 1))
    rotation[:, 0, 0] = rotation[:, 1, 1] = np.cos(angle)
    rotation[:, 1, 0] = np.sin(angle)
    rotation[:, 0, 1] = -np.sin(angle)
    track = make_track(mouth, rotation=rotation, jaw=np.linspace(0.004, 0.016, frames))
    marked = np.zeros(frames, dtype=bool)
    marked[:3] = True
    clip, sequences = cut(replace(track, interpolated=marked))
    columns = sequence_statistics(clip, sequences, SETTINGS)
    found = {name: column[0] for name, column in columns.items()}
    assert list(found) == list(STATISTICS)
    # micrometres: landmarks are kept in single precision
    assert found["mouth_range_x"] == pytest.approx(0.018, abs=2e-5)
    assert found["mouth_range_y"] == pytest.approx(0.009, abs=2e-5)
    assert found["mouth_range_z"] == pytest.approx(0.0, abs=1e-4)
    assert found["head_rotation_range"] == pytest.approx(12.0, abs=0.01)
    assert found["mouth_opening_range"] == pytest.approx(0.012, abs=1e-5)
    assert found["interpolated_share"] == pytest.approx(0.3)
    assert found["image_lag"] == 0.0
    assert found["crop_side"] == sequences.crops[0].side
    centre = track.landmarks[:, list(LIPS), :2].mean(axis=1) * [640, 480]
    u, v = np.ptp(centre, axis=0) / sequences.crops[0].side
    assert found["mouth_range_u"] == pytest.approx(u, rel=1e-5)
    assert found["mouth_range_v"] == pytest.approx(v, rel=1e-5)


@pytest.mark.parametrize(("axis", "step"), [(0, 0.015), (0, -0.015), (1, 0.015), (1, -0.015)])
def test_a_face_that_leaves_the_crop_is_counted(make_track, axis, step) -> None:
    mouth = still(10)
    mouth[8, axis], mouth[9, axis] = step, 2 * step
    tight = replace(SETTINGS, margin=0.0)
    clip, sequences = cut(make_track(mouth), tight)
    assert sequence_statistics(clip, sequences, tight)["outside_share"].tolist() == [1.0]
    wide = replace(SETTINGS, margin=0.5)
    clip, sequences = cut(make_track(mouth), wide)
    assert sequence_statistics(clip, sequences, wide)["outside_share"].tolist() == [0.0]


def test_largest_angle_is_between_any_two() -> None:
    half = np.radians(np.array([0.0, 40.0, -25.0, 10.0])) / 2
    q = np.stack([np.cos(half), np.zeros(4), np.sin(half), np.zeros(4)], axis=1)
    assert largest_angle(q) == pytest.approx(65.0)
    assert largest_angle(-q[:1]) == pytest.approx(0.0, abs=1e-5)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"history": 0}, "--history 0: must be 1 to"),
        ({"future": 0}, "--future 0: must be 1 to"),
        ({"stride": 0}, "--stride 0: must be 1 to"),
        ({"crop_size": 8}, "--crop_size 8: must be 16 to"),
        ({"quality": 101}, "--quality 101: must be 1 to 100"),
        ({"fps": 0.0}, "--fps 0.0: must be more than 0"),
        ({"margin": -0.1}, "--margin -0.1: must be 0 to 2"),
        ({"margin": float("nan")}, "--margin nan: must be 0 to 2"),
        ({"crop_from": "future"}, "--crop_from 'future': unknown; valid: history, sequence"),
    ],
)
def test_settings_out_of_range(change, message) -> None:
    with pytest.raises(RequestError, match=message):
        replace(SETTINGS, **change)


def test_settings_survive_json() -> None:
    import json

    settings = SequenceSettings(margin=0.3, crop_from="sequence")
    assert SequenceSettings.from_json(json.loads(json.dumps(settings.to_json()))) == settings
    with pytest.raises(RequestError, match="future: is missing"):
        SequenceSettings.from_json({"history": 70})
