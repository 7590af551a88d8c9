"""Residual prediction: no look-ahead, invariances, learning against an oracle, intervals."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy import stats

from face_prediction.dataset.sequences import SequenceSettings
from face_prediction.forecast.interface import mouth_centre
from face_prediction.live.streaming import FollowingForecaster, StreamingPredictor
from face_prediction.models.residual.adaptive import (
    BANDS,
    CALM,
    HORIZONS,
    LEARNT_MEMORY,
    OVERLAP,
    ROBUST,
    SHARPNESS,
    FaceState,
    Mixture,
    Ring,
)
from face_prediction.models.residual.experts import (
    EXPERTS,
    SERIES,
    SLOW,
    LinearExpert,
    frames_needed,
    linear_features,
    slow_means,
)
from face_prediction.models.residual.fit import (
    RIDGE,
    Rows,
    fit_linear,
    fit_people,
    fit_residual,
    missed,
    mix_again,
    trial,
)
from face_prediction.models.residual.intervals import (
    LEVELS,
    IntervalFit,
    IntervalTracker,
    student_t,
)
from face_prediction.models.residual.predictor import (
    ResidualFit,
    ResidualPredictor,
    face_series,
    face_side,
)
from robo_manip_baselines.runs.errors import RequestError

FRAMES = 140


def swaying(people: int, frames: int = FRAMES, seed: int = 0) -> np.ndarray:
    """Heads (people, frames, 468, 2) that sway at 0.4 to 1 Hz, seen by a detector that jitters."""
    rng = np.random.default_rng(seed)
    shape = rng.uniform(0.25, 0.75, (468, 2))
    time = np.arange(frames) / 30
    rate, phase = rng.uniform(0.4, 1.0, (2, people, 2)) * [[[1.0]], [[6.0]]]
    sway = 0.03 * np.sin(2 * np.pi * rate[:, None] * time[:, None] + phase[:, None])
    jitter = rng.normal(0, 2e-4, (people, frames, 468, 2))
    return shape + sway[:, :, None] + jitter


@pytest.fixture(scope="module")
def predictor() -> ResidualPredictor:
    """Fitted to six people."""
    return ResidualPredictor(fit_residual(list(swaying(6)), list("abcdef")))


@pytest.fixture(scope="module")
def faces() -> np.ndarray:
    """Two people whom nobody was fitted to."""
    return swaying(2, seed=1)


def test_nothing_later_changes_a_forecast(predictor: ResidualPredictor, faces) -> None:
    whole, part = predictor.forecast_tracks([faces[0], faces[0, :60]], 24)
    for name in ("mouth", "scale", "degrees_of_freedom"):
        np.testing.assert_allclose(getattr(whole, name)[:60], getattr(part, name), rtol=1e-9)


def test_a_history_a_track_and_a_stream_agree(predictor: ResidualPredictor, faces) -> None:
    track = predictor.forecast_tracks([faces[1]], 24)[0]
    follower = predictor.follow()
    for frame in range(70):
        follower.update(faces[1, frame])
    histories = predictor.predict(faces[:, :70], None, 24)
    moved = mouth_centre(histories.landmarks[1]) - mouth_centre(faces[1, 69])
    np.testing.assert_allclose(moved, track.mouth[69], atol=1e-6)  # float32
    recent = faces[1, 70 - predictor.recent : 70]
    streamed = mouth_centre(follower.forecast(recent, 24)) - mouth_centre(faces[1, 69])
    np.testing.assert_allclose(streamed, track.mouth[69], rtol=1e-9, atol=1e-12)
    assert histories.mouth_scale is not None
    assert track.scale is not None
    np.testing.assert_allclose(histories.mouth_scale[1], track.scale[69], rtol=1e-5)


@pytest.mark.parametrize("rate", [30.0, 25.0])
def test_live_follows_the_face(predictor: ResidualPredictor, faces, rate: float) -> None:
    stream = StreamingPredictor(FollowingForecaster(predictor, 5), SequenceSettings())
    size, image = np.array([400, 300]), np.zeros((300, 400, 3), np.uint8)
    track = predictor.forecast_tracks([faces[0, :60] * 300], 5)[0]
    forecast = None
    for number in range(int(59 * rate / 30) + 1):
        time = 30 * number / rate  # in frames of 30 a second
        before = min(int(time), 58)
        seen = faces[0, before] + (time - before) * (faces[0, before + 1] - faces[0, before])
        landmarks = np.concatenate([seen * 300 / size, np.zeros((468, 1))], axis=1)
        forecast = stream.update(number / rate, landmarks, image)
    assert forecast is not None
    moved = mouth_centre(forecast.landmarks * size) - mouth_centre(seen * 300)
    if rate == 30.0:
        np.testing.assert_allclose(moved, track.mouth[59], rtol=1e-6, atol=1e-9)
    else:  # the last frame is 58.8; what was learnt is nearly the same
        np.testing.assert_allclose(moved, track.mouth[59], atol=0.25 * np.abs(track.mouth).max())
    assert stream.update(9.0, None, image) is None  # long gone: another face would begin anew


def test_units_and_place_do_not_matter(predictor: ResidualPredictor, faces) -> None:
    here = predictor.forecast_tracks([faces[0, :50]], 5)[0]
    there = predictor.forecast_tracks([700 * faces[0, :50] + [100.0, -40.0]], 5)[0]
    np.testing.assert_allclose(there.mouth, 700 * here.mouth, rtol=1e-6, atol=1e-9)
    assert here.scale is not None
    assert there.scale is not None
    np.testing.assert_allclose(there.scale, 700 * here.scale, rtol=1e-6)


def test_a_shorter_horizon_is_the_beginning_of_a_longer_one(predictor, faces) -> None:
    near = predictor.predict(faces[:, :40], None, 3)
    far = predictor.predict(faces[:, :40], None, 24)
    np.testing.assert_allclose(near.landmarks, far.landmarks[:, :3], rtol=1e-6)
    np.testing.assert_allclose(near.mouth_scale, far.mouth_scale[:, :3], rtol=1e-5)


def test_a_still_face_stays_still_and_one_frame_is_enough(predictor, faces) -> None:
    still = np.repeat(faces[:1, :1], 30, axis=1)
    for history in (still, still[:, :1]):
        ahead = predictor.predict(history, None, 24).landmarks
        np.testing.assert_allclose(ahead, np.repeat(still[:, :1], 24, axis=1), atol=1e-6)


def test_it_forecasts_better_than_copying(predictor: ResidualPredictor, faces) -> None:
    ahead = mouth_centre(predictor.predict(faces[:, :100], None, 24).landmarks)
    truth = mouth_centre(faces[:, 100:124])
    ours = np.abs(ahead - truth).mean(axis=(0, 2))
    still = np.abs(mouth_centre(faces[:, 99:100]) - truth).mean(axis=(0, 2))
    assert np.all(ours[:5] < 0.5 * still[:5])
    assert ours.mean() < 0.6 * still.mean()


def test_what_cannot_be_forecast_is_refused(predictor: ResidualPredictor, faces) -> None:
    with pytest.raises(RequestError, match="horizon 25: residual forecasts 1 to 24"):
        predictor.predict(faces, None, 25)
    with pytest.raises(RequestError, match=r"landmarks of shape \(468, 2\); expected"):
        predictor.predict(faces[0, 0], None, 5)
    broken = faces.copy()
    broken[0, 3, 7, 1] = np.nan
    with pytest.raises(RequestError, match="NaN or infinity"):
        predictor.predict(broken, None, 5)
    with pytest.raises(RequestError, match=r"tracks of b: 34 frames at most; .* more than 34"):
        fit_residual([*swaying(1, 150), *swaying(1, 34)], ["a", "b"])
    with pytest.raises(RequestError, match="tracks of 1 people; residual needs 2 or more"):
        fit_residual(list(faces), ["ann", "ann"])


def test_the_numbers_are_restored_from_their_arrays(predictor: ResidualPredictor, faces) -> None:
    arrays = predictor.fit.arrays()
    again = ResidualPredictor(ResidualFit.from_arrays(arrays))
    np.testing.assert_array_equal(
        again.predict(faces, None, 5).landmarks, predictor.predict(faces, None, 5).landmarks
    )
    del arrays["people_1"]
    with pytest.raises(RequestError, match="people_1 not as expected; fit it again"):
        ResidualFit.from_arrays(arrays)


def test_weights_and_baselines_beside_them_are_read_back(predictor, faces, tmp_path: Path) -> None:
    pytest.importorskip("torch", reason="PyTorch is not installed (extra face-prediction)")
    from face_prediction.forecast import LandmarkSequences, fit_forecaster
    from face_prediction.models.learned import CheckpointRecord
    from face_prediction.models.loading import load_baselines, load_predictor, save_residual

    sequences = LandmarkSequences(swaying(3, 75), tuple("abc"))
    fitted = [fit_forecaster(name, sequences) for name in ("ar_mouth", "kalman")]
    record = CheckpointRecord(
        model="residual",
        settings={},
        preset="fitted",
        training={},
        seed=0,
        dataset={},
        dataset_sha256="0" * 64,
        folds={"train": [0], "validation": [], "test": []},
        train_subjects=list("abcdef"),
        step=0,
        validation={},
        versions={},
    )
    save_residual(tmp_path, record, predictor.fit, fitted)
    loaded, found = load_predictor(tmp_path)
    assert found == record
    ours = loaded.predict(faces, None, 24).landmarks
    np.testing.assert_allclose(ours, predictor.predict(faces, None, 24).landmarks, atol=1e-5)
    restored, people = load_baselines(tmp_path)
    assert people == set("abcdef")
    for before, after in zip(fitted, restored, strict=True):
        assert before.name == after.name
        np.testing.assert_array_equal(
            before.predict(faces[0], 5),
            after.predict(faces[0], 5),
        )
    with pytest.raises(RequestError, match="nowhere: no such folder; valid: shipped, or a folder"):
        load_predictor(tmp_path / "nowhere")


def test_learning_is_weighted_ridge_regression() -> None:
    """Against the sums written out, for one expert, at the last frame."""
    rng = np.random.default_rng(3)
    tracks = [np.cumsum(rng.normal(0, 0.01, (150, SERIES)), axis=0) for _ in range(4)]
    fit = fit_people(tracks, list("abcd"))
    index = 1  # the first that adapts
    expert, part = EXPERTS[index], fit.linear[index]
    assert part.precision is not None
    state = FaceState(fit, 1)
    path = np.cumsum(rng.normal(0, 0.01, (60, SERIES)), axis=0)
    rows, made, expected, error = [], [], [], []
    for frame in path:
        state.take(frame[None])
        expected.append(state.mixture.expected_errors()[1][0])
        forecast = state.forecast()
        state.remember(forecast)
        rows.append(forecast.features[index][0])
        made.append(forecast.experts[0, index])
    error = np.array(made)
    last = len(path) - 1
    for band, precision in zip(BANDS, part.precision, strict=True):
        first = HORIZONS[band.knots.start]
        for place in (band.knots.start, band.knots.stop - 1):
            horizon = HORIZONS[place]
            gram, cross = precision.copy(), np.zeros((expert.size, SERIES))
            for row in range(last - horizon + 1):
                decided = row + first  # the frame whose outcome weights the row
                missed = error[row, band.knots.start, :2] - (path[decided] - path[row])[:2]
                known = expected[decided]
                ratio = np.abs(missed).mean() / known[band.knots.start]
                usual, at = known[band.usual], HORIZONS[band.usual]
                weight = 1 / (1 + OVERLAP * (at - 1)) / usual**2 / np.hypot(ratio, ROBUST)
                weight *= np.exp(-(last - horizon - row) / LEARNT_MEMORY)
                x = rows[row]
                outcome = path[row + horizon] - path[row] - x @ part.people[place]
                gram += weight * np.outer(x, x)
                cross += weight * np.outer(x, outcome)
            change = np.linalg.solve(gram, cross)
            oracle = rows[last] @ (part.people[place] + change)
            np.testing.assert_allclose(error[last, place], oracle, rtol=1e-6, atol=1e-9)


def test_what_was_learnt_counts_little_at_rest(predictor: ResidualPredictor) -> None:
    people = predictor.fit.people
    mixture = Mixture(replace(people, usual=np.zeros_like(people.usual)), 2)
    adapts = np.array([not expert.iterated for expert in EXPERTS], dtype=float)
    experts = np.tile(adapts[None, :, None, None], (2, 1, len(HORIZONS), SERIES))
    steps = np.array([0.02, 3.0])[:, None, None] * CALM
    recent = steps * np.arange(9)[:, None] * np.ones(SERIES)
    for step in steps[:, 0, 0] * np.ones((70, 1)):
        mixture.take(step)
    moved, _ = mixture.mix(experts, recent)
    assert np.all(moved[0] < 0.01)  # the share of the experts that adapt
    np.testing.assert_allclose(moved[1], adapts.mean())
    for _ in range(3000):
        mixture.take(steps[:, 0, 0])
    assert np.all(mixture.mix(experts, recent)[0][0] > 0.1)  # proven by now


def test_weights_fall_with_errors_less_so_far_ahead(predictor: ResidualPredictor) -> None:
    people = predictor.fit.people
    usual = np.zeros_like(people.usual)
    usual[0, :, 0] = np.log(1.1)  # the first expert errs 10 % more than the others
    mixture = Mixture(replace(people, usual=usual), 1)
    mixture.take(np.array([CALM]))
    experts = np.zeros((1, len(EXPERTS), len(HORIZONS), SERIES))
    experts[:, 0] = 1.0
    moving = 3 * CALM * np.arange(9)[:, None] * np.ones((1, 1, SERIES))
    share = mixture.mix(experts, moving)[0][0, :, 0]
    for place, horizon in enumerate(HORIZONS):
        weight = np.exp(-SHARPNESS * 0.1 / np.sqrt(1 + OVERLAP * (horizon - 1)))
        assert share[place] == pytest.approx(weight / (weight + len(EXPERTS) - 1))


def test_mixing_again_is_what_following_does(predictor: ResidualPredictor) -> None:
    faces = swaying(2, 60, seed=4)
    tracks = [
        face_series(face, predictor.fit.basis)[:length] / float(face_side(face[0]))
        for face, length in zip(faces, (45, 60), strict=True)
    ]
    tried = trial(predictor.fit, tracks)
    signs, errors = mix_again(predictor.fit.people, [made for made, _ in tried], tracks)
    expected = [missed(mixed, track) for (_, mixed), track in zip(tried, tracks, strict=True)]
    np.testing.assert_allclose(errors, np.concatenate(expected), rtol=1e-9, atol=1e-12)
    assert np.all(np.isfinite(signs))


def test_the_iterated_expert_forecasts_frame_by_frame() -> None:
    rng = np.random.default_rng(5)
    steps = rng.normal(0, 0.01, (400, SERIES))
    for frame in range(1, 400):
        steps[frame] += 0.6 * steps[frame - 1]
    expert = LinearExpert(4, 2, 0, iterated=True)
    rows = Rows.of([np.cumsum(steps, axis=0)] * 2, ["ann", "bob"], frames_needed([expert]))
    fit = fit_linear(expert, rows, np.array(HORIZONS), RIDGE)
    assert fit.precision is None
    once = fit_linear(expert, rows, np.array([1]), RIDGE).people[0] / fit.scale[:, None]  # (F, D)
    past = steps[-2:, 2:6].copy()
    moved = []
    for _ in range(HORIZONS[-1]):
        step = past.reshape(-1) @ once
        past = np.stack([past[1], step[2:6]])
        moved.append(step)
    expected = np.cumsum(moved, axis=0)[np.array(HORIZONS) - 1]
    found = steps[-2:, 2:6].reshape(-1) / fit.scale @ fit.people
    np.testing.assert_allclose(found, expected, rtol=1e-9)


def test_differences_of_a_cube_end_at_the_third() -> None:
    expert = LinearExpert(0, 5, 1, differences=True)
    frames = np.arange(frames_needed([expert]), dtype=np.float64)
    recent = np.stack([frames**3, -2 * frames], axis=1)[None]
    found = linear_features(expert, recent, np.zeros((1, 1, 2)))[0].reshape(6, 2)
    np.testing.assert_array_equal(found[:, 0], [61, 24, 6, 0, 0, 125])
    np.testing.assert_array_equal(found[:, 1], [-2, 0, 0, 0, 0, -10])


def test_slow_means_begin_as_the_mean() -> None:
    series = np.arange(30.0)[:, None] * np.ones(SERIES)
    means = slow_means(series)
    for frame in range(10):  # of the shortest memory
        expected = np.tile(series[: frame + 1].mean(axis=0), (len(SLOW), 1))
        np.testing.assert_allclose(means[frame], expected)


def test_a_ring_keeps_the_last_rows() -> None:
    ring = Ring(3, (2, 4))
    for row in range(5):
        ring.push(np.full((2, 4), row) + np.arange(4))
    assert [float(ring.row(age)[0, 0]) for age in (1, 2, 3)] == [4.0, 3.0, 2.0]
    np.testing.assert_array_equal(ring.of_horizons(np.array([1, 3])), [[4.0, 3.0]] * 2)
    ring.keep(1)
    assert ring.row(1).shape == (1, 4)


def test_student_t_has_the_quantiles_it_is_made_of() -> None:
    for freedom in (1.5, 4.0, 30.0):
        quantiles = 0.02 * stats.t.ppf((1 + np.array(LEVELS)) / 2, freedom)
        scale, found = student_t(np.log(quantiles))
        assert float(found) == pytest.approx(freedom, rel=0.03)
        assert float(scale) == pytest.approx(0.02, rel=0.01)


def test_far_ahead_quantiles_follow_more_slowly() -> None:
    fit = IntervalFit(np.zeros((2, 2, 5)), np.zeros((2, 2, 2)))
    tracker = IntervalTracker(fit, 1, 5)
    for _ in range(5):
        tracker.remember(np.zeros((1, 2, 4)))
    before, _ = tracker.student_t(np.zeros((1, 2, 4)))
    tracker.learn(np.ones((1, 2, 2)), np.array([1, 5]))  # larger than both quantiles
    after, _ = tracker.student_t(np.zeros((1, 2, 4)))
    near, far = np.log(after / before)[0, :, 0]
    assert near == pytest.approx(5 * far, rel=0.02)


def test_quantiles_follow_a_face_that_errs_more() -> None:
    """The quantiles waver, and hold in the mean what was promised, from the 40th error on."""
    fit = IntervalFit(np.zeros((1, 2, 5)), np.log(np.tile([0.01, 0.03], (1, 2, 1))))
    tracker = IntervalTracker(fit, 1, 1)
    rng = np.random.default_rng(0)
    held = np.empty((2000, len(LEVELS), 2))
    for number in range(len(held)):
        scale, freedom = tracker.student_t(np.zeros((1, 1, 4)))
        for place, level in enumerate(LEVELS):
            reach = scale[0, 0] * stats.t.ppf((1 + level) / 2, freedom[0, 0])
            held[number, place] = 2 * stats.norm.cdf(reach / 0.1) - 1
        tracker.remember(np.zeros((1, 1, 4)))
        tracker.learn(rng.normal(0, 0.1, (1, 1, 2)), np.array([1]))
    np.testing.assert_allclose(held[0].mean(axis=-1), [0.08, 0.236], atol=0.01)  # a tenth of it
    for after in (40, 1000):
        mean = held[after:].mean(axis=(0, 2))
        np.testing.assert_allclose(mean, LEVELS, atol=0.02)
