"""Horizons of 1 to 24 frames, from the spec to the files of every schema version."""

from __future__ import annotations

import shutil
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from robo_manip_baselines.data import EpisodeReader, episode_path, read_metadata, write_episode
from robo_manip_baselines.data.demonstrations import load_demonstrations, recorded_state
from robo_manip_baselines.data.example import make_arrays, make_attributes
from robo_manip_baselines.data.schema import EpisodeSchema
from robo_manip_baselines.data.verify import verify_dataset, verify_file
from robo_manip_baselines.envs.mujoco.cell.scene import CONTROL_PERIOD
from robo_manip_baselines.envs.mujoco.face.motion import LIBRARY_FILE, MotionLibrary, read_library
from robo_manip_baselines.envs.mujoco.tasks.face_env import world_of
from robo_manip_baselines.envs.mujoco.tasks.registry import make_env
from robo_manip_baselines.observation import Corruption, ObservationSpec
from robo_manip_baselines.rollout.demonstrate import Collection, collect, deviation
from robo_manip_baselines.runs.errors import RequestError
from robo_manip_baselines.runs.npz import write_npz

from .conftest import NAMES, made_up_stats, write_stats

HORIZONS = (0, 1, 5, 6, 24, 25)

SCHEMA_2 = Path(__file__).parents[1] / "data" / "schema_2.hdf5"
"""An episode of `make_arrays` (4 steps, seed 3, version 2), written by the last release before
schema 3 held more frames; nothing writes it any more."""

SEED = 4


def ahead(horizon: int, corruption: Corruption | None = None) -> ObservationSpec:
    return ObservationSpec(
        "current_pred", horizon, cameras=(), corruption=corruption or Corruption()
    )


def as_version_2(path: Path, out: Path) -> Path:
    """Write an episode as releases before schema 3 did, with the truth 5 frames ahead."""
    with EpisodeReader(path) as episode:
        later = ("region_force", "region_impulse")  # of schema 4
        arrays = {name: array for name, array in episode.arrays.items() if name not in later}
        arrays["mouth_position"] = episode.array("mouth_position")[:, :6]
        arrays["predicted_mouth"] = episode.array("predicted_mouth")[:, :5]
        items = [item for item in episode.schema.attributes if not item.is_derived]
        given = [item.name for item in items if not item.is_optional]
        attributes = {name: episode.attributes[name] for name in given}
    return write_episode(out / path.name, arrays, {}, attributes)


def library_ahead(path: Path, frames: int) -> Path:
    """Write the shipped motion with the true future of so many frames as its predictions."""
    library = MotionLibrary.load()
    ends = np.repeat(library.run_start + library.run_length, library.run_length)[:, None]
    later = np.minimum(np.arange(len(ends))[:, None] + np.arange(1, frames + 1), ends - 1)
    content = read_library(library.source)
    content["predicted_mouth"] = content["mouth"][later]
    write_npz(
        path,
        {
            "schema": np.array(LIBRARY_FILE.schema),
            "version": np.array(LIBRARY_FILE.version),
            **content,
        },
    )
    return path


@pytest.mark.parametrize("horizon", HORIZONS)
def test_a_spec_takes_1_to_24(horizon: int) -> None:
    if not 1 <= horizon <= 24:
        with pytest.raises(RequestError, match=f"horizon {horizon}: must be 1 to 24"):
            ahead(horizon)
        return
    spec = ahead(horizon)
    assert len(spec.components(NAMES)["prediction"]) == 5 * (horizon + 1)
    assert ObservationSpec.from_json(spec.to_json()) == spec
    assert spec.name == f"current_pred_h{horizon}"


@pytest.mark.parametrize("horizon", [1, 5, 6, 24])
@pytest.mark.parametrize(
    ("delay", "motion"), [(0, "recorded"), (12, "recorded:speed=4"), (3, "dyskinetic")]
)
def test_an_environment_shows_the_mouth_that_will_be(horizon: int, delay: int, motion: str) -> None:
    corruption = {"delay": delay} if delay else None
    kwargs = {"horizon": horizon, "corruption": corruption, "motion": motion}
    with closing(make_env("FeedingEnv", obs="current_pred", cameras=(), **kwargs)) as env:
        observation, _ = env.reset(seed=SEED)
        world = world_of(env)
        action = np.asarray(world.data.ctrl[-7:], np.float32)
        for _ in range(40):
            shown = observation["prediction"][: 4 * (horizon + 1)].reshape(-1, 4)
            seen = max(world.time - delay / 30, 0.0)
            times = seen + np.arange(horizon + 1) / 30
            np.testing.assert_allclose(shown[:, 0], times, atol=1e-6)  # float32
            if seen / CONTROL_PERIOD % 1.0 < 1e-9:  # between steps the truth is interpolated
                np.testing.assert_allclose(shown[:, 1:], world.mouth_at(times), atol=1e-6)
            observation, *_ = env.step(action)


def test_the_future_of_the_last_step_is_recorded_motion() -> None:
    """A segment holds as many frames after its end as the longest horizon, where its run does."""
    library = MotionLibrary.load()
    assert library.run_length[0] > 400
    with closing(make_env("FeedingEnv", obs="current_pred", horizon=24, cameras=())) as env:
        env.reset(seed=SEED)
        world = world_of(env)
        world.segment = library.segment(0, 0)
        assert len(world.segment.displacement) == 360 + 1 + 24
        last = world.segment.displacement_at(12.0 + 24 / 30)
        moved = library.mouth[library.run_start[0] + 384] - library.mouth[library.run_start[0]]
        np.testing.assert_allclose(last, moved[[2, 0, 1]], atol=1e-12)
        # A run that ends before is held there.
        short = library.segment(0, int(library.run_length[0]) - 361)
        np.testing.assert_array_equal(short.displacement_at(12.8), short.displacement[-1])


@pytest.mark.parametrize("version", [1, 2, 3])
@pytest.mark.parametrize("horizon", HORIZONS[1:-1])
def test_a_file_shows_as_far_as_it_looks(tmp_path: Path, version: int, horizon: int) -> None:
    arrays = make_arrays(6, 3, version=version)
    path = write_episode(episode_path(tmp_path, 3, True), arrays, {}, make_attributes(3))
    assert verify_file(path) == []
    assert read_metadata(path)["schema_version"] == version
    frames = 5 if version < 3 else 24
    assert arrays["mouth_position"].shape == (6, frames + 1, 3)
    if horizon <= frames:
        loaded = load_demonstrations(tmp_path, ahead(horizon))
        shown = loaded.state[:, 14 : 14 + 4 * (horizon + 1)].reshape(6, -1, 4)[..., 1:]
        wanted = arrays["mouth_position"][:, : horizon + 1].astype(np.float32)
        np.testing.assert_array_equal(shown, wanted)
        return
    message = (
        rf"episode_000003.hdf5' holds the mouth 5 frames ahead, not {horizon}; choose a horizon up "
        r"to 5, or record again: python bin/Rollout.py FeedingEnv .*_longer --cameras none$"
    )
    with pytest.raises(RequestError, match=message):
        load_demonstrations(tmp_path, ahead(horizon))


def test_a_file_of_an_older_release_is_read(tmp_path: Path) -> None:
    shutil.copy(SCHEMA_2, episode_path(tmp_path, 3, True))
    assert verify_dataset(tmp_path) == []
    wanted = make_arrays(4, 3, version=2)
    with EpisodeReader(SCHEMA_2) as episode:
        assert episode.attributes["schema_version"] == 2
        assert set(episode.fields) == set(wanted)
        for name, values in wanted.items():
            np.testing.assert_array_equal(episode.array(name), values, strict=True)
    assert load_demonstrations(tmp_path, ahead(5)).state.shape == (4, 44)
    corruption = Corruption("model", delay=1)
    assert load_demonstrations(tmp_path, ahead(5, corruption)).state.shape == (4, 44)
    with pytest.raises(RequestError, match="5 frames ahead, not 6"):
        load_demonstrations(tmp_path, ahead(6))


def test_a_folder_of_several_versions_serves_the_shortest(tmp_path: Path) -> None:
    for seed, version in ((0, 3), (1, 3), (2, 1)):
        path, arrays = episode_path(tmp_path, seed, True), make_arrays(5, seed, version=version)
        write_episode(path, arrays, {}, make_attributes(seed))
    found = verify_dataset(tmp_path)
    assert [str(problem) for problem in found] == [
        f"{tmp_path}/episode_000002.hdf5: warning: schema_version is 1, but 3 in 2 other files"
    ]
    assert load_demonstrations(tmp_path, ahead(5)).state.shape == (15, 44)
    assert load_demonstrations(tmp_path, ahead(24), limit=2).state.shape == (10, 139)
    with pytest.raises(RequestError, match=r"000002.hdf5' holds the mouth 5 frames ahead, not 24"):
        load_demonstrations(tmp_path, ahead(24))


@pytest.mark.parametrize("frames", [5, 7, 24, 26])
def test_only_declared_numbers_of_frames_are_written(tmp_path: Path, frames: int) -> None:
    arrays = make_arrays(4)
    arrays["mouth_position"] = np.zeros((4, frames + 1, 3))
    if frames in (5, 24):
        path = write_episode(tmp_path / "a.hdf5", arrays, {}, make_attributes())
        assert read_metadata(path)["schema_version"] == (1 if frames == 5 else 3)
        return
    with pytest.raises(ValueError, match=f"'mouth_position' has K={frames + 1}, not 6 or 25"):
        write_episode(tmp_path / "a.hdf5", arrays, {}, make_attributes())


@pytest.mark.parametrize("frames", [0, 1, 24, 25])
def test_episodes_hold_predictions_of_1_to_24_frames(tmp_path: Path, frames: int) -> None:
    arrays = make_arrays(4, version=3)
    assert "predicted_mouth" not in arrays
    arrays["predicted_mouth"] = np.zeros((4, frames, 3))
    if 1 <= frames <= 24:
        path = write_episode(tmp_path / "a.hdf5", arrays, {}, make_attributes())
        assert verify_file(path) == []
        with EpisodeReader(path) as episode:
            predicted = recorded_state(episode).predicted_target
            assert predicted is not None
            assert predicted.shape == (4, frames, 3)
        return
    with pytest.raises(ValueError, match=f"'predicted_mouth' has H={frames}, "):
        write_episode(tmp_path / "a.hdf5", arrays, {}, make_attributes())


@pytest.mark.parametrize("frames", [1, 5, 24])
def test_a_library_shows_as_far_as_it_predicts(tmp_path: Path, frames: int) -> None:
    library = library_ahead(tmp_path / "l.npz", frames)
    assert MotionLibrary.load(library).predicted_frames == frames
    kwargs = {"obs": "current_pred", "cameras": (), "motion_library": str(library)}
    model = {"error": "model"}
    shown = []
    for corruption in (None, model):
        with closing(
            make_env("FeedingEnv", horizon=frames, corruption=corruption, **kwargs)
        ) as env:
            env.reset(seed=SEED)
            predicted = world_of(env).predicted_mouth
            assert predicted is not None
            assert predicted.shape == (frames, 3)
            action = np.asarray(world_of(env).data.ctrl[-7:], np.float32)
            steps = [env.step(action)[0] for _ in range(20)]
            shown.append([step["prediction"] for step in steps])
    # The predictions are the truth, in float32, relative to a mouth in float32.
    np.testing.assert_allclose(shown[0], shown[1], atol=1e-6)
    if frames < 24:
        message = rf"l.npz' holds the predicted mouth {frames} frames ahead, not {frames + 1}; "
        with pytest.raises(RequestError, match=message):
            make_env("FeedingEnv", horizon=frames + 1, corruption=model, **kwargs)


@pytest.mark.parametrize("error", ["uniform", "gaussian", "empirical"])
def test_drawn_errors_go_as_far_as_they_were_measured(tmp_path: Path, error: str) -> None:
    kwargs = {"obs": "current_pred", "cameras": ()}
    make_env("FeedingEnv", horizon=24, corruption={"error": error}, **kwargs).close()
    near = tmp_path / "near"
    near.mkdir()
    short = str(write_stats(near, made_up_stats(horizons=5, runs=2)))
    message = r"stats_.*json' go 5 frames ahead; choose a horizon up to that, not 6"
    corruption = {"error": error, "error_stats": short}
    with pytest.raises(RequestError, match=message):
        make_env("FeedingEnv", horizon=6, corruption=corruption, **kwargs)
    longer = str(write_stats(tmp_path, made_up_stats(horizons=24, runs=2)))
    pipeline = ahead(24, Corruption(error, longer)).make_pipeline()
    assert pipeline is not None
    write_episode(
        episode_path(tmp_path, 3, True), make_arrays(9, 3, version=3), {}, make_attributes(3)
    )
    state = load_demonstrations(tmp_path, ahead(24, Corruption(error, longer))).state
    plain = load_demonstrations(tmp_path, ahead(24)).state
    changed = (state != plain)[:, 14:114].reshape(9, 25, 4)
    assert not changed[:, 0].any()
    assert changed[:, 1:, 2:].all()  # y and z: the image plane


@pytest.mark.long
def test_old_and_new_files_of_a_seed_show_the_same_and_replay(tmp_path: Path) -> None:
    new, old = tmp_path / "new", tmp_path / "old"
    wanted = Collection("FeedingEnv", new, "reactive", range(SEED, SEED + 1), {"cameras": ()})
    collect(wanted)
    path = episode_path(new, SEED, success=True)
    with EpisodeReader(path) as episode:
        assert episode.attributes["schema_version"] == 4
        assert episode.array("mouth_position").shape[1:] == (25, 3)
        assert episode.array("predicted_mouth").shape[1:] == (24, 3)
        assert "predicted_mouth" in EpisodeSchema.of(episode.task).by_name
    old.mkdir()
    other = as_version_2(path, old)
    assert verify_dataset(old) == verify_dataset(new) == []
    for file in (path, other):
        assert deviation(file).qpos == deviation(file).qvel == 0.0
    for spec in (
        ahead(5),
        ahead(2, Corruption("uniform", delay=4)),
        ahead(5, Corruption("gaussian", face_dropout=0.2)),
        ahead(5, Corruption("model", delay=2)),
    ):
        one, two = (load_demonstrations(folder, spec) for folder in (old, new))
        np.testing.assert_array_equal(one.state, two.state, strict=True)
    with pytest.raises(RequestError, match=r"holds episodes with schema_version 2, not 4 \(epis"):
        collect(replace(wanted, out=old, seeds=range(SEED, SEED + 2)))
