"""Face motions by name: spectrum, size, reach, determinism, sums, use in an environment."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from robo_manip_baselines.envs.mujoco.cell.scene import MOUTH_BASE
from robo_manip_baselines.envs.mujoco.face import REST_OPENING, FaceModel
from robo_manip_baselines.envs.mujoco.face.motion import MotionLibrary, MotionSegment
from robo_manip_baselines.envs.mujoco.face.motions import MOTIONS, parse_motion, there_and_back
from robo_manip_baselines.envs.mujoco.face.synthetic import (
    REACH,
    Tremor,
    event_times,
    tremor_displacement,
)
from robo_manip_baselines.envs.mujoco.tasks.face_env import world_of
from robo_manip_baselines.envs.mujoco.tasks.registry import make_env
from robo_manip_baselines.runs.errors import RequestError

SUMS = ["recorded+tremor", "recorded:speed=2+chew", "sway+nod+tremor:rating=3"]
CONTROL_TIMES = np.arange(601) * 0.02


@pytest.fixture(scope="module")
def library() -> MotionLibrary:
    return MotionLibrary.load()


def draw(name: Any, library: MotionLibrary, seed: int = 0) -> MotionSegment:
    return parse_motion(name).draw(np.random.default_rng(seed), library, seed=seed)


def rotations(segment: MotionSegment) -> Rotation:
    return Rotation.from_quat(segment.orientation, scalar_first=True)


def band_share(signal: np.ndarray, fps: float, low: float, high: float) -> float:
    """Share of a signal's power, (M, J), between two frequencies: the textbook periodogram."""
    centred = (signal - signal.mean(axis=0)) * np.hanning(len(signal))[:, None]
    power = (np.abs(np.fft.rfft(centred, axis=0)) ** 2).sum(axis=1)
    frequency = np.fft.rfftfreq(len(signal), 1.0 / fps)
    return float(power[(frequency >= low) & (frequency <= high)].sum() / power.sum())


# -- names ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("given", "text"),
    [
        ("recorded", "recorded"),
        ("recorded:speed=1", "recorded"),
        (" recorded : speed = 3 + tremor:rating=1", "recorded:speed=3+tremor:rating=1"),
        ("sway:amplitude=3e-2,frequency=0.3..0.5", "sway:frequency=0.3..0.5,amplitude=0.03"),
        ({"name": "sway", "amplitude": 0.03}, "sway:amplitude=0.03"),
        ({"name": "sway", "amplitude": [0.01, 0.03]}, "sway:amplitude=0.01..0.03"),
        (["recorded", {"name": "tremor", "rating": 3}], "recorded+tremor:rating=3"),
    ],
)
def test_a_motion_is_read_from_text_mappings_and_lists(given: Any, text: str) -> None:
    motion = parse_motion(given)
    assert str(motion) == text
    assert parse_motion(text) == motion


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ("swai", r"unknown motion 'swai' \(did you mean 'sway'\?\); valid: chew, dyskinetic"),
        ("", "unknown motion ''"),
        ("sway+", r"unknown motion 'sway\+'"),
        ("sway:size=1", "unknown parameter of the motion 'sway' 'size'; valid: amplitude"),
        ("sway:amplitude", "'amplitude' is no setting; write it as in"),
        ("sway:amplitude=big", "'amplitude=big' is no setting"),
        ("sway:amplitude=0.01,amplitude=0.02", "is no setting"),
        ("sway:amplitude=0.2", "amplitude 0.2: must be a number, or two .* of 0 to 0.09 m"),
        ("sway:amplitude=0.03..0.02", "must be a number, or two in ascending order"),
        ("sway:amplitude=nan", "amplitude nan: must be"),
        ("tremor:rating=1..2", "rating \\[1.0, 2.0\\]: must be a number of 0 to 4"),
        ("recorded:speed=0.5", "speed 0.5: must be a number of 1 to 4"),
        ("recorded:speed=4.5", "speed 4.5: must be"),
        ("still:rate=1", "'still' has no parameters; leave 'rate' out"),
        ("tremor+tremor:rating=1", "'tremor' is there twice"),
        ({"amplitude": 0.03}, "has no name; valid: recorded, still"),
        ({"name": "tremor", "rating": "2"}, "rating 2: must be a number"),
        ({"name": "tremor", "rating": True}, "rating True: must be a number"),
        ([], "must be a name, a mapping or a list"),
        (None, "motion None: must be a name"),
    ],
)
def test_a_motion_that_is_not_valid_is_refused_in_one_line(given: Any, message: str) -> None:
    with pytest.raises(RequestError, match=message) as caught:
        parse_motion(given)
    assert "\n" not in str(caught.value)


# -- what all motions have in common --------------------------------------------------------------


def test_recorded_is_the_librarys_own_draw(library: MotionLibrary) -> None:
    mine, its = np.random.default_rng(7), np.random.default_rng(7)
    segment, plain = parse_motion("recorded").draw(mine, library, seed=7), library.draw(its)
    assert (segment.clip, segment.index) == (plain.clip, plain.index)
    for name in ("displacement", "orientation", "jaw", "predicted"):
        np.testing.assert_array_equal(getattr(segment, name), getattr(plain, name))
    assert mine.bit_generator.state == its.bit_generator.state


@pytest.mark.parametrize("name", [*MOTIONS, *SUMS])
def test_a_seed_gives_one_motion_and_leaves_the_rest_of_the_episode_alone(
    name: str, library: MotionLibrary
) -> None:
    rng, recorded = np.random.default_rng(3), np.random.default_rng(3)
    first = parse_motion(name).draw(rng, library, seed=3)
    library.draw(recorded)
    assert rng.random() == recorded.random()  # as the objects are drawn, after the motion
    again, other = draw(name, library, 3), draw(name, library, 4)
    for part in ("displacement", "orientation", "jaw"):
        np.testing.assert_array_equal(getattr(first, part), getattr(again, part))
    if name != "still":
        assert (first.displacement[:300] != other.displacement[:300]).any()
    assert (first.predicted is not None) == (name == "recorded")


@pytest.mark.parametrize("name", [*MOTIONS, "tremor:rating=4", "recorded:speed=4", *SUMS])
def test_every_motion_stays_within_reach_and_is_continuous(
    name: str, library: MotionLibrary
) -> None:
    turn_limits = {"recorded:speed=4": 1200.0, "recorded:speed=2+chew": 600.0}  # deg/s
    turn_limits["tremor:rating=4"] = 600.0  # 3.3 deg at 11 Hz, and stronger at times
    for seed in range(8):
        segment = draw(name, library, seed)
        displacement, orientation, jaw = segment.at(CONTROL_TIMES)
        assert np.abs(segment.displacement).max() <= REACH
        assert (jaw >= 0.0).all()
        assert len(segment.jaw) >= 12.0 * segment.fps
        np.testing.assert_allclose(np.linalg.norm(segment.orientation, axis=1), 1.0, atol=1e-6)
        # A recorded mouth moves at up to 0.45 m/s, four times as fast at up to 1.8 m/s; a jerk of a
        # spasm is as fast as the slower one. A jump of 1 cm would be 0.5 m/s.
        limit = 2.0 if "recorded:speed" in name else 0.7 if "rating=4" in name else 0.5
        assert np.linalg.norm(np.diff(displacement, axis=0), axis=1).max() < limit * 0.02
        turn = Rotation.from_quat(orientation, scalar_first=True)
        step = np.degrees((turn[:-1].inv() * turn[1:]).magnitude())
        assert step.max() < turn_limits.get(name, 320.0) * 0.02  # deg


def test_a_motion_out_of_reach_is_refused(library: MotionLibrary) -> None:
    motion = parse_motion("sway:amplitude=0.09,direction=0+spasm:amplitude=0.08,interval=0")
    with pytest.raises(RequestError, match=r"always left the reach of the arm, 0\.09 m"):
        motion.draw(np.random.default_rng(0), library, seed=0)


def test_a_sum_adds_displacements_and_jaws_and_multiplies_rotations(library: MotionLibrary) -> None:
    total = draw("recorded+dyskinetic+tremor:rating=1", library, 5)
    parts = [draw(name, library, 5) for name in ("recorded", "dyskinetic", "tremor:rating=1")]
    assert (total.clip, total.index) == (parts[0].clip, parts[0].index)
    assert total.fps == 150.0  # as tremor needs
    # At the frames of the tremor; the noise is sampled there, too, instead of interpolated.
    frames = slice(0, 1500, 5)
    shown = [part.at(np.arange(0, 1500, 5) / 150.0) for part in parts]
    np.testing.assert_allclose(
        total.displacement[frames], sum(d for d, _, _ in shown), atol=2e-5
    )  # m: the rms of the noise is set from other samples of it
    np.testing.assert_allclose(total.jaw[frames], sum(j for _, _, j in shown), atol=1e-12)
    product = Rotation.identity()
    for _, orientation, _ in shown:
        product = product * Rotation.from_quat(orientation, scalar_first=True)
    assert (product.inv() * rotations(total)[frames]).magnitude().max() < 1e-3  # rad, likewise


# -- each motion ----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "band"),
    [
        ("sway", (0.2, 0.7)),
        ("sway:frequency=0.5", (0.35, 0.65)),
        ("tremor", (3.7, 11.3)),
        ("tremor:frequency=5", (4.5, 5.5)),
        ("dyskinetic", (0.1, 1.6)),
        ("dyskinetic:band=2..3", (1.9, 3.1)),
    ],
)
def test_power_lies_in_the_band(name: str, band: tuple[float, float], library: Any) -> None:
    for seed in range(5):
        segment = draw(name, library, seed)
        assert band_share(segment.displacement, segment.fps, *band) > 0.97


def test_the_noise_of_dyskinesia_fills_its_band(library: MotionLibrary) -> None:
    power = np.zeros((12, 196))
    for seed in range(12):
        moved = draw("dyskinetic", library, seed).displacement
        power[seed] = (np.abs(np.fft.rfft(moved * np.hanning(391)[:, None], axis=0)) ** 2).sum(1)
    frequency, mean = np.fft.rfftfreq(391, 1 / 30), power.mean(axis=0)
    low, high = (mean[(frequency > f) & (frequency < f + 0.45)].mean() for f in (0.3, 0.95))
    assert 0.7 < low / high < 1.4  # flat; 12 episodes x 3 axes x 5 bins have a spread of 7 %


@pytest.mark.parametrize(("rms", "rotation"), [(0.015, 3.0), (0.008, 1.0)])
def test_dyskinesia_has_its_rms(rms: float, rotation: float, library: MotionLibrary) -> None:
    segment = draw({"name": "dyskinetic", "rms": rms, "rotation": rotation}, library)
    assert np.sqrt((segment.displacement**2).sum(axis=1).mean()) == pytest.approx(rms)
    turned = np.degrees(rotations(segment).magnitude())
    assert np.sqrt((turned**2).mean()) == pytest.approx(rotation)


def test_tremor_follows_the_relation_of_elble(library: MotionLibrary) -> None:
    """log10(T / cm) = 0.47 rating - 1.8, from end to end, worked out by hand."""
    sizes = [1e3 * tremor_displacement(rating) for rating in range(5)]  # mm
    np.testing.assert_allclose(sizes, [0.1585, 0.468, 1.380, 4.074, 12.02], rtol=1e-3)
    for rating in (1, 4):
        moved = draw(f"tremor:rating={rating}", library, rating).displacement
        rms = np.sqrt((moved**2).sum(axis=1).mean())
        assert 2.0 * np.sqrt(2.0) * rms == pytest.approx(tremor_displacement(rating))


def test_tremor_turns_nods_or_both_as_in_patients() -> None:
    rng, time, tremor = np.random.default_rng(0), np.arange(40) / 150.0, Tremor()
    counts = np.zeros(3)
    for _ in range(300):
        angles = tremor.sample(rng, time).rotation.as_rotvec()
        nod, turn, tilt = np.abs(angles).max(axis=0) > 1e-9
        assert not tilt
        counts[0 if turn and not nod else 1 if nod and not turn else 2] += 1
    wanted = np.array([14, 9, 28]) / 51
    # Four standard deviations of a binomial share.
    assert (np.abs(counts / 300 - wanted) < 4 * np.sqrt(wanted * (1 - wanted) / 300)).all()


def test_sway_is_level_and_of_its_amplitude(library: MotionLibrary) -> None:
    segment = draw("sway:amplitude=0.03,frequency=0.5,direction=0", library)
    assert np.ptp(segment.displacement[:, 1]) == pytest.approx(0.06, rel=0.01)
    np.testing.assert_array_equal(segment.displacement[:, [0, 2]], 0.0)
    assert rotations(segment).magnitude().max() == 0.0


def test_nods_go_down_and_come_back_and_decline(library: MotionLibrary) -> None:
    segment = draw("nod:angle=10,frequency=1,pause=2,decline=0.5", library, 1)
    angle = np.degrees(rotations(segment).as_rotvec())
    np.testing.assert_allclose(angle[:, 1:], 0.0, atol=1e-9)
    assert angle[:, 0].min() > -1e-9
    assert angle[:, 0].max() == pytest.approx(10.0, abs=0.2)
    assert segment.displacement[:, 2].min() < -0.01  # chin and mouth go down
    peaks = [
        value for before, value, after in zip(*(angle[i : len(angle) - 2 + i, 0] for i in range(3)),
                                              strict=True) if before < value >= after
    ]  # fmt: skip
    assert {round(peak / 10.0, 1) for peak in peaks} <= {1.0, 0.5, 0.2, 0.3}


def test_turning_away_leaves_and_comes_back(library: MotionLibrary) -> None:
    away = 0
    for seed in range(10):
        angle = np.degrees(rotations(draw("turn_away", library, seed)).as_rotvec())[:, 1]
        assert np.abs(angle).max() < 45.1
        away += np.abs(angle).max() > 34.9
        assert (np.abs(angle) < 1e-6).mean() > 0.3  # most of the time it is there
    assert away == 10  # in every episode: the first refusal starts within 6 s


def test_spasms_rise_at_once_and_return_slowly(library: MotionLibrary) -> None:
    for seed in range(5):
        moved = np.linalg.norm(draw("spasm", library, seed).displacement, axis=1)
        peak = int(moved.argmax())
        assert 0.02 <= moved[peak] <= 0.041
        start = peak - 6  # 0.2 s
        assert moved[max(start, 0)] < 1e-3
        half = moved[peak : peak + 60] > 0.5 * moved[peak]
        assert 15 <= half.sum() <= 30  # half of it is still there after half of 1.5 s, not 2 s


def test_turns_reach_both_sides(library: MotionLibrary) -> None:
    angles = [np.degrees(rotations(draw("turn", library, s)).as_rotvec())[:, 1] for s in range(10)]
    assert all(angle.max() > 4.0 and angle.min() < -4.0 for angle in angles)
    assert max(np.abs(angle).max() for angle in angles) <= 20.1


def test_chewing_opens_the_jaw_and_leaves_the_head(library: MotionLibrary) -> None:
    segment, face = draw("chew:opening=0.012,frequency=1.2,nod=0", library), FaceModel.load()
    assert np.ptp(segment.jaw) == pytest.approx(0.012, rel=0.02)
    assert band_share(segment.jaw[:, None], 30.0, 1.0, 1.4) > 0.97
    poses = face.body_poses(segment.displacement, segment.orientation, segment.jaw + REST_OPENING)
    head, _ = poses["face/head"]
    assert np.ptp(head, axis=0).max() < 5e-4  # m: the lips' way is taken as a straight line


def test_events_do_not_overlap() -> None:
    events = event_times(np.random.default_rng(0), (0.5, 1.0), lambda: 0.7)
    starts = np.array([start for start, _ in events])
    assert starts[0] < 1.0
    assert (np.diff(starts) >= 1.2).all()
    assert starts[-1] < 12.0


# -- faster recordings ----------------------------------------------------------------------------


def test_faster_is_the_same_recording_in_less_time(library: MotionLibrary) -> None:
    for seed in range(10):
        plain, fast = draw("recorded", library, seed), draw("recorded:speed=2", library, seed)
        assert (fast.clip, fast.start, fast.index) == (plain.clip, plain.start, plain.index)
        assert fast.fps == plain.fps
        # The run goes on for 12 s at least, and turns round in its last second at the earliest.
        times = np.arange(0, 5.5, 1 / 30)
        for quick, slow in zip(fast.at(times), plain.at(2.0 * times), strict=True):
            np.testing.assert_allclose(quick, slow, atol=1e-6)
        assert np.ptp(fast.displacement[-60:], axis=0).max() > 0.0  # still moving


def test_every_person_can_be_replayed_at_four_times_the_speed(library: MotionLibrary) -> None:
    segments = [draw("recorded:speed=4", library, seed) for seed in range(60)]
    assert {segment.subject for segment in segments} == set(library.run_subject)


def test_there_and_back() -> None:
    frames = np.array([0.0, 2.0, 3.0, 9.0, 10.0, 11.5, 17.0, 18.0, 24.0, 25.0])
    folded = [0.0, 2.0, 3.0, 9.0, 10.0, 8.5, 3.0, 4.0, 10.0, 9.0]
    np.testing.assert_allclose(there_and_back(frames, 3, 10), folded)


# -- in an environment ----------------------------------------------------------------------------


def test_the_face_of_an_environment_follows_the_motion() -> None:
    env = make_env("FeedingEnv", cameras=(), motion={"name": "sway", "amplitude": 0.03})
    world = world_of(env)
    env.reset(seed=2)
    place = MOUTH_BASE + world.face_offset
    action = np.asarray(world.data.ctrl[-7:], np.float32)
    for _ in range(20):
        moved = world.segment.displacement_at(world.time)
        np.testing.assert_allclose(world.mouth_track[0], place + moved, atol=1e-12)
        times = world.time + np.arange(25) / 30
        np.testing.assert_allclose(world.mouth_at(times), world.mouth_track, atol=1e-12)
        np.testing.assert_allclose(world.data.body("face/mouth").xpos, place + moved, atol=1e-3)
        env.step(action)
    assert world.start_attributes()["motion_clip"] == "synthetic"
    assert env.spec is not None
    assert env.spec.kwargs["motion"] == {"name": "sway", "amplitude": 0.03}
    env.close()


def test_the_mouth_waits_for_the_lift_where_the_motion_does() -> None:
    env = make_env("FeedingEnv", cameras=(), motion="sway", face_motion="after_lift")
    world = world_of(env)
    env.reset(seed=0)
    np.testing.assert_array_equal(world.mouth_at([0.0, 3.0]), np.tile(world.mouth_track[0], (2, 1)))
    world.step_count = 100
    world.start_motion()
    moved = world.segment.displacement_at(0.5) - world.segment.displacement_at(0.0)
    np.testing.assert_allclose(world.mouth_at(2.5) - world.mouth_at(1.0), moved, atol=1e-12)
    env.close()


def test_episodes_of_a_seed_differ_in_the_motion_only() -> None:
    cubes, offsets = [], []
    for motion in ("recorded", "dyskinetic", "recorded:speed=3", "recorded+tremor"):
        env = make_env("FeedingEnv", cameras=(), motion=motion)
        env.reset(seed=11)
        cubes.append(world_of(env).object_position()[0])
        offsets.append(world_of(env).face_offset)
        env.close()
    assert np.ptp(cubes, axis=0).max() == np.ptp(offsets, axis=0).max() == 0.0


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"motion": "hop"}, "unknown motion 'hop'"),
        ({"motion": "sway", "clips": ["clm_cap12"]}, "clips clm_cap12: the motion 'sway' has no"),
        (
            {"motion": "recorded:speed=2", "obs": "current_pred", "corruption": {"error": "model"}},
            "error model: predictors have seen recorded motion, not 'recorded:speed=2'",
        ),
    ],
)
def test_arguments_that_do_not_go_with_a_motion_are_refused(
    arguments: dict[str, Any], message: str
) -> None:
    with pytest.raises(RequestError, match=message):
        make_env("FeedingEnv", **{"cameras": (), **arguments})
