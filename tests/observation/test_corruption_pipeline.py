"""One detector, step by step and over a whole recorded episode: the same numbers, bit for bit."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from robo_manip_baselines.observation import (
    Corruption,
    CorruptionPipeline,
    ObservationSpec,
    State,
    TargetObservation,
)
from robo_manip_baselines.observation.error_stats import load_error_stats
from robo_manip_baselines.runs.errors import RequestError

from .conftest import PERIOD, made_up_stats, observe, step_of, wandering_truth, write_stats

MEASURED = ("uniform", "gaussian", "empirical")


def step_by_step(detector: CorruptionPipeline, truth: State, seed: int) -> TargetObservation:
    detector.reset(seed)
    reports = [detector.observe(step_of(truth, index)) for index in range(len(truth.time))]
    past = [r.past for r in reports if r.past is not None]
    return TargetObservation(
        np.stack([r.time for r in reports]),
        np.stack([r.position for r in reports]),
        np.stack(past) if past else None,
    )


def corrupted(corruption: Corruption, truth: State, seed: int = 0) -> TargetObservation:
    return CorruptionPipeline(corruption).observe_episode(truth, seed)


def assert_same(one: TargetObservation, other: TargetObservation) -> None:
    np.testing.assert_array_equal(one.time, other.time)
    np.testing.assert_array_equal(one.position, other.position)
    assert (one.past is None) == (other.past is None)
    if one.past is not None:
        np.testing.assert_array_equal(one.past, other.past)


corruptions = st.builds(
    Corruption,
    error=st.sampled_from(["none", *MEASURED, "model"]),
    delay=st.integers(0, 20),
    face_dropout=st.sampled_from([0.0, 0.05, 0.4]),
    face_dropout_length=st.sampled_from([1.0, 6.0, 15.0]),
    detector_rate=st.one_of(st.none(), st.sampled_from([4.0, 10.0, 30.0]), st.floats(1.0, 30.0)),
    seed=st.integers(0, 3),
)


@pytest.mark.long
@settings(max_examples=40)
@given(
    corruptions,
    st.integers(0, 2**32),
    st.integers(1, 60),
    st.integers(0, 9),
    st.sampled_from([0, 1, 5]),
)
def test_online_is_offline(
    corruption: Corruption, seed: int, steps: int, drawn: int, past: int
) -> None:
    truth = wandering_truth(steps, drawn, predicted=True)
    detector = CorruptionPipeline(corruption, past=past)
    offline = detector.observe_episode(truth, seed)
    online = step_by_step(detector, truth, seed)
    assert_same(online, offline)
    assert_same(step_by_step(CorruptionPipeline(corruption, past=past), truth, seed), offline)
    assert offline.position.shape == (steps, 6, 3)
    assert (offline.time <= truth.time).all()


@pytest.mark.long
@settings(max_examples=25)
@given(corruptions, st.integers(1, 60), st.integers(0, 9))
def test_the_past_is_what_was_reported_then(corruption: Corruption, steps: int, drawn: int) -> None:
    """Steps at 30 a second: the report k frames ago is that of the k-th step before."""
    truth = wandering_truth(steps, drawn, predicted=True)
    truth = replace(truth, time=np.arange(steps) / 30.0)
    report = CorruptionPipeline(corruption, past=5).observe_episode(truth, 3)
    alone = CorruptionPipeline(corruption).observe_episode(truth, 3)
    np.testing.assert_array_equal(report.position, alone.position)
    assert report.past is not None
    for step in range(steps):
        for k in range(1, 6):
            earlier = alone.position[max(step - k, 0), 0]
            # Times are sums of thirtieths: between two steps lies a part of 1e-14.
            np.testing.assert_allclose(report.past[step, k - 1], earlier, atol=1e-9)


def test_the_past_between_steps_is_interpolated() -> None:
    truth = wandering_truth(8)
    truth.target_position[:] = 0.0
    truth.target_position[:, 0, 0] = 0.01 * np.arange(8)  # 0.5 m/s
    report = CorruptionPipeline(Corruption(delay=1), past=2).observe_episode(truth, 0)
    assert report.past is not None
    wanted = 0.5 * np.maximum(truth.time[:, None] - np.arange(1, 4) / 30, 0.0)
    np.testing.assert_allclose(report.position[:, 0, 0], wanted[:, 0], atol=1e-12)
    np.testing.assert_allclose(report.past[:, :, 0], wanted[:, 1:], atol=1e-12)


@pytest.mark.long
@settings(max_examples=50)
@given(corruptions, st.integers(2, 60), st.integers(1, 59))
def test_nothing_of_later_steps_is_used(corruption: Corruption, steps: int, cut: int) -> None:
    cut = min(cut, steps - 1)
    truth = wandering_truth(steps, predicted=True)
    assert truth.predicted_target is not None
    pipeline = CorruptionPipeline(corruption, past=5)
    whole = pipeline.observe_episode(truth, 1)
    truth.target_position[cut:] += 100.0
    truth.predicted_target[cut:] -= 100.0
    other = pipeline.observe_episode(truth, 1)
    assert whole.past is not None
    assert other.past is not None
    np.testing.assert_array_equal(other.past[:cut], whole.past[:cut])
    np.testing.assert_array_equal(other.position[:cut], whole.position[:cut])
    is_changed = not np.array_equal(other.position[-1], whole.position[-1])
    assert is_changed or whole.time[-1] < truth.time[cut]


def test_an_episode_may_be_longer_than_what_is_drawn_at_first() -> None:
    truth = wandering_truth(2200)  # 44 s
    for error in ("empirical", "gaussian"):
        corruption = Corruption(error, delay=2, face_dropout=0.2, detector_rate=7.0)
        detector = CorruptionPipeline(corruption)
        assert_same(step_by_step(detector, truth, 4), detector.observe_episode(truth, 4))


def test_looking_twice_changes_nothing() -> None:
    truth = wandering_truth(30)
    detector = CorruptionPipeline(Corruption(error="gaussian", delay=1, face_dropout=0.3))
    detector.reset(7)
    twice = [[detector.observe(step_of(truth, i)).position for _ in range(2)][1] for i in range(30)]
    np.testing.assert_array_equal(twice, detector.observe_episode(truth, 7).position)


@pytest.mark.parametrize("error", MEASURED)
def test_an_error_lies_in_the_image_plane_and_lasts_a_frame(stats_file: Path, error: str) -> None:
    truth = wandering_truth(200)
    shown = corrupted(Corruption(error, str(stats_file)), truth, 3)
    added = shown.position - truth.target_position
    np.testing.assert_array_equal(shown.time, truth.time)
    np.testing.assert_array_equal(added[:, 0], 0.0)  # now: the detector's, not the forecast's
    np.testing.assert_array_equal(added[..., 0], 0.0)  # depth
    assert (np.abs(added[:, 1:, 1:]) > 0).all()
    frame = 3 * np.arange(200) // 5
    for first in range(0, 120):
        of_frame = added[frame == first]
        np.testing.assert_allclose(of_frame, of_frame[:1].repeat(len(of_frame), 0), atol=1e-12)
    each = added[np.unique(frame, return_index=True)[1]][:, 1:, 1:]
    assert (np.abs(np.diff(each, axis=0)) > 0).all()


def test_what_is_injected_is_what_the_paper_injects(tmp_path: Path) -> None:
    """0.015 and 0.017 of the picture: y within 0.0115 m, z within 0.0074 m (section IV.C)."""
    content = made_up_stats()
    for row in content["horizons"]:
        row["mean_abs_m"] = [0.0115, 0.0074]
    stats = str(write_stats(tmp_path, content))
    truth = wandering_truth(20_000)
    added = corrupted(Corruption("uniform", stats), truth).position - truth.target_position
    most = np.abs(added).max(axis=0)[1:]
    np.testing.assert_allclose(most[:, 1:], np.tile([0.0115, 0.0074], (5, 1)), rtol=2e-3)


def test_right_in_the_image_is_plus_y_and_down_is_minus_z(tmp_path: Path) -> None:
    content = made_up_stats()
    content["covariance"] = np.zeros((10, 10)).tolist()
    for row in content["horizons"]:
        row["bias"] = [0.01, 0.02]  # right and down
    stats = str(write_stats(tmp_path, content))
    truth = wandering_truth(3)
    added = corrupted(Corruption("gaussian", stats), truth).position - truth.target_position
    metres = load_error_stats(stats).bias[0]
    for k in range(1, 6):
        np.testing.assert_allclose(added[:, k], [[0.0, metres[0], -metres[1]]] * 3, atol=1e-12)


def test_every_arm_has_the_same_errors() -> None:
    """A longer horizon, a delay or losses change when errors are shown, not which they are."""
    truth = wandering_truth(120)

    def shown(**more: float) -> TargetObservation:
        corruption = Corruption(error="gaussian", **more)  # pyright: ignore[reportArgumentType]
        return corrupted(corruption, truth, 11)

    plain, late = shown(), shown(delay=3)  # 5 steps
    np.testing.assert_allclose(late.position[5:], plain.position[:-5], atol=1e-12)
    np.testing.assert_allclose(late.time[5:], plain.time[:-5], atol=1e-12)
    held = shown(detector_rate=30.0)
    every = np.arange(0, 120, 5)  # where a frame falls on a step
    np.testing.assert_allclose(held.position[every], plain.position[every], atol=1e-12)
    lost = shown(face_dropout=0.2, face_dropout_length=3.0)
    found = lost.time == truth.time
    found[:-1] &= np.diff(lost.time) > 0  # but for the very moments at which it gets lost
    assert 0.5 < found.mean() < 1.0
    np.testing.assert_array_equal(lost.position[found], plain.position[found])
    two = ObservationSpec("current_pred", 2, cameras=(), corruption=Corruption("gaussian"))
    five = replace(two, horizon=5)
    near, far = (observe(spec, truth, plain)["prediction"] for spec in (two, five))
    np.testing.assert_array_equal(near[:, :12], far[:, :12])


def test_errors_are_drawn_from_the_episodes_seed() -> None:
    truth = wandering_truth(60)
    for corruption in (Corruption("uniform"), Corruption(face_dropout=0.4)):
        again = [corrupted(corruption, truth, seed).position for seed in (0, 0, 1)]
        np.testing.assert_array_equal(again[0], again[1])
        assert not np.array_equal(again[0], again[2])
        other = corrupted(replace(corruption, seed=1), truth).position
        assert not np.array_equal(other, again[0])


def test_the_predictors_own_output_is_shown_at_video_frames() -> None:
    truth = wandering_truth(61, predicted=True)
    assert truth.predicted_target is not None
    shown = corrupted(Corruption("model"), truth)
    np.testing.assert_array_equal(shown.position[:, 0], truth.target_position[:, 0])
    every = np.arange(0, 61, 5)  # frames 0, 3, 6 ...
    np.testing.assert_allclose(shown.position[every, 1:], truth.predicted_target[every], atol=1e-12)
    # Between them the error of the last frame is held: frame 1 begins with step 2.
    error = shown.position[:, 1:] - truth.target_position[:, 1:]
    np.testing.assert_allclose(error[1], error[0], atol=1e-12)
    np.testing.assert_allclose(error[3], error[2], atol=1e-12)
    made = truth.predicted_target[2] - truth.target_position[2, 1:]
    np.testing.assert_allclose(error[2], made, atol=1e-12)


@pytest.mark.parametrize("error", ["none", *MEASURED, "model"])
def test_the_first_frames_are_the_same_however_far_ahead_the_truth_goes(error: str) -> None:
    """Files of older versions know 5 frames, environments 24; a predictor may know fewer."""
    near = wandering_truth(80, predicted=True)
    beyond = np.random.default_rng(9).normal(size=(80, 19, 3))
    far = replace(near, target_position=np.concatenate([near.target_position, beyond], axis=1))
    corruption = Corruption(error, delay=3, face_dropout=0.2)
    one, other = (corrupted(corruption, truth, 5) for truth in (near, far))
    np.testing.assert_array_equal(one.time, other.time)
    np.testing.assert_array_equal(one.position, other.position[:, :6])


@pytest.mark.parametrize(
    ("frames", "horizon", "message"),
    [
        (5, 5, ""),
        (5, 6, r"holds the predicted mouth 5 frames ahead, not 6; choose a horizon up to 5, "),
        (1, 1, ""),
        (1, 2, "1 frames ahead, not 2"),
        (24, 24, ""),
    ],
)
def test_predictions_must_reach_as_far_as_what_is_shown(
    frames: int, horizon: int, message: str
) -> None:
    truth = replace(
        wandering_truth(10),
        target_position=np.zeros((10, 25, 3)),
        predicted_target=np.ones((10, frames, 3)),
    )
    pipeline = CorruptionPipeline(Corruption("model"), horizon)
    if message:
        with pytest.raises(RequestError, match=message):
            pipeline.observe_episode(truth, 0)
        return
    shown = pipeline.observe_episode(truth, 0).position
    np.testing.assert_array_equal(shown[:, 1 : frames + 1], 1.0)
    np.testing.assert_array_equal(shown[:, frames + 1 :], 0.0)


def test_without_predictions_the_model_has_nothing_to_show() -> None:
    truth = wandering_truth(4)
    detector = CorruptionPipeline(Corruption("model"))
    with pytest.raises(RequestError, match=r"no predicted mouth.*face_prediction predict"):
        detector.observe_episode(truth, 0)
    with pytest.raises(RequestError, match=r"no predicted mouth"):
        step_by_step(detector, truth, 0)


def test_statistics_must_reach_as_far_as_what_is_shown(tmp_path: Path) -> None:
    stats = str(write_stats(tmp_path, made_up_stats(horizons=3)))
    for horizon in (1, 3, 4):
        corruption = Corruption("uniform", stats)
        spec = ObservationSpec("current_pred", horizon, corruption=corruption)
        if horizon <= 3:
            assert spec.make_pipeline()
            continue
        with pytest.raises(RequestError, match="go 3 frames ahead; choose a horizon up to that"):
            spec.make_pipeline()
    assert ObservationSpec().make_pipeline() is None


def test_a_report_is_shown_with_its_time_and_the_gripper_of_now() -> None:
    truth = wandering_truth(30)
    corruption = Corruption(delay=3)
    spec = ObservationSpec(obs="current_pred", horizon=1, cameras=(), corruption=corruption)
    report = corrupted(corruption, truth)
    shown = observe(spec, truth, report)["prediction"]
    assert shown.shape == (30, 10)
    late = step_of(truth, slice(0, 25))
    np.testing.assert_allclose(shown[5:, 0], late.time, atol=1e-6)
    np.testing.assert_allclose(shown[5:, 4], late.time + 1 / 30, atol=1e-6)
    np.testing.assert_allclose(shown[5:, 1:4], late.target_position[:, 0], rtol=1e-6, atol=1e-6)
    apart = late.target_position[:, 1] - truth.end_effector_position[5:]
    np.testing.assert_allclose(shown[5:, 9], np.linalg.norm(apart, axis=1), rtol=1e-6)
    current = ObservationSpec(obs="current", cameras=(), corruption=corruption)
    np.testing.assert_array_equal(observe(current, truth, report)["mouth"][:, :3], shown[:, 1:4])
    plain = observe(ObservationSpec(cameras=()), truth)
    np.testing.assert_array_equal(observe(current, truth, report)["state"], plain["state"])
    with pytest.raises(ValueError, match="goes with a pipeline"):
        ObservationSpec("history", cameras=()).pack(truth)
    for wrong in ((spec, None), (ObservationSpec(), report)):
        with pytest.raises(ValueError, match="goes with a pipeline"):
            observe(wrong[0], truth, wrong[1])
    assert report.time[-1] == pytest.approx(29 * PERIOD - 0.1)
