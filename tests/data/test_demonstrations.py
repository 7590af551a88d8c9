"""A folder of episodes as a policy sees it, and folders that no policy can learn from."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from robo_manip_baselines.data import EpisodeReader, episode_path, write_episode
from robo_manip_baselines.data.demonstrations import (
    Demonstrations,
    load_demonstrations,
    recorded_state,
    split_episodes,
)
from robo_manip_baselines.data.example import make_arrays, make_attributes, make_images
from robo_manip_baselines.data.normalization import mean_std
from robo_manip_baselines.observation import ObservationSpec
from robo_manip_baselines.runs.errors import RequestError

BLIND = ObservationSpec(obs="current_pred", cameras=(), object_pose=True)
SHOWN = ObservationSpec(cameras=("top",), image_size=(24, 32))
BOTH_ARMS = ObservationSpec(cameras=(), arms="both")


def write(
    folder: Path, seed: int, steps: int = 6, *, cameras: tuple[str, ...] = (), **changes: Any
) -> Path:
    """Write a made-up episode of one kind; ``changes`` are of its attributes."""
    arms = changes.pop("arms", 1)
    attributes = {**make_attributes(seed, arms=arms), "env_kwargs": {"face_motion": "episode"}}
    return write_episode(
        episode_path(folder, seed, success=True),
        make_arrays(steps, seed, arms=arms),
        make_images(steps, cameras=cameras),
        {**attributes, **changes},
    )


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for seed, steps in ((12, 7), (3, 5), (40, 1), (4, 9)):
        write(tmp_path, seed, steps)
    return tmp_path


def test_what_is_loaded_is_what_the_files_show(folder: Path) -> None:
    loaded = load_demonstrations(folder, BLIND)
    assert loaded.seeds == (3, 4, 12, 40)
    assert [path.name for path in loaded.paths] == [f"episode_{s:06d}.hdf5" for s in loaded.seeds]
    assert loaded.lengths.tolist() == [5, 9, 7, 1]
    assert loaded.offsets.tolist() == [0, 5, 14, 21, 22]
    for index, path in enumerate(loaded.paths):
        rows = loaded.rows([index])
        with EpisodeReader(path) as episode:
            state = BLIND.pack(recorded_state(episode))
            action = episode.array("action").astype(np.float32)
        np.testing.assert_array_equal(loaded.state[rows], state, strict=True)
        np.testing.assert_array_equal(loaded.action[rows], action, strict=True)
    assert loaded.spec == BLIND
    assert loaded.env_id == "robo_manip_baselines/FeedingEnv-v0"
    assert loaded.control_period == 0.02
    assert loaded.xml_hash == "0" * 64
    assert loaded.env_kwargs == {"face_motion": "episode"}
    assert loaded.action_names[0] == "right/waist"
    assert len(loaded.action_names) == loaded.action.shape[1] == 7


def test_rows_and_indices(folder: Path) -> None:
    loaded = load_demonstrations(folder, BLIND)
    assert loaded.rows([3, 0]).tolist() == [21, 0, 1, 2, 3, 4]
    assert loaded.rows([]).dtype == np.int64
    assert loaded.indices([40, 3]) == (3, 0)
    with pytest.raises(RequestError, match="no episode of seed 5; it holds 4, seeds 3 to 40"):
        loaded.indices([3, 5])


def test_two_arms(tmp_path: Path) -> None:
    write(tmp_path, 0, arms=2)
    loaded = load_demonstrations(tmp_path, BOTH_ARMS)
    assert loaded.state.shape == (6, 28)
    assert loaded.action.shape == (6, 14)


def test_failures_and_leftovers_are_left_out(folder: Path) -> None:
    failure = make_attributes(5) | {"is_success": False}
    write_episode(episode_path(folder, 5, success=False), make_arrays(), {}, failure)
    (folder / ".episode_000006.hdf5.1.partial").touch()
    (folder / "summary.json").touch()
    assert load_demonstrations(folder, BLIND).seeds == (3, 4, 12, 40)


def test_limit_takes_the_lowest_seeds(folder: Path) -> None:
    assert load_demonstrations(folder, BLIND, limit=2).seeds == (3, 4)
    assert load_demonstrations(folder, BLIND, limit=4).seeds == (3, 4, 12, 40)
    # Seed 40 is the last that was tried: one more episode needs one more seed.
    line = r"holds 4 episodes, not 5; .*--num_episodes 42 --out \S+ --cameras none$"
    with pytest.raises(RequestError, match=line):
        load_demonstrations(folder, SHOWN, limit=5)
    with pytest.raises(RequestError, match="0 episodes: must be 1 or more"):
        load_demonstrations(folder, BLIND, limit=0)


def test_more_episodes_are_recorded_as_those_that_are_there(tmp_path: Path) -> None:
    write(tmp_path, 0, cameras=("top",))
    with pytest.raises(RequestError, match=r"--num_episodes 3 --out \S+ --image_size 24x32$"):
        load_demonstrations(tmp_path, BLIND, limit=3)


def test_content_hash_tells_datasets_apart(folder: Path) -> None:
    def content(limit: int | None = None) -> str:
        return load_demonstrations(folder, BLIND, limit=limit).content_hash

    whole, part = content(), content(2)
    assert re.fullmatch("[0-9a-f]{64}", whole)
    assert whole != part
    write(folder, 12, 7)
    assert content() == whole
    write(folder, 12, 7, motion_subject="someone else")
    assert content() != whole
    assert content(2) == part


def test_what_was_shown_while_recording_does_not_matter(tmp_path: Path) -> None:
    write(tmp_path, 0, env_kwargs={"cameras": ["top"], "obs": "baseline"})
    write(tmp_path, 1, env_kwargs={"cameras": [], "obs": "current", "image_size": [48, 64]})
    assert load_demonstrations(tmp_path, BLIND).env_kwargs == {}


def test_statistics_do_not_see_what_is_held_out(folder: Path) -> None:
    def statistics(loaded: Demonstrations) -> dict[str, list[float]]:
        split = split_episodes(loaded.seeds, 0.3, 0)
        assert split.validation == (40,)
        rows = loaded.rows(loaded.indices(split.train))
        return mean_std(loaded.state[rows], loaded.action[rows]).to_json()

    before = statistics(load_demonstrations(folder, BLIND))
    write(folder, 40, 30)
    assert statistics(load_demonstrations(folder, BLIND)) == before
    write(folder, 12, 30)
    assert statistics(load_demonstrations(folder, BLIND)) != before


@pytest.mark.parametrize("is_there", [False, True])
def test_without_episodes_there_is_the_line_that_makes_them(tmp_path: Path, is_there: bool) -> None:
    folder = tmp_path / "my demos"
    if is_there:
        folder.mkdir()
    line = f"python bin/Rollout.py FeedingEnv --scripted --num_episodes 50 --out '{folder}'"
    what = "holds no episode_*.hdf5 file" if is_there else "is no folder"
    small = ObservationSpec(image_size=(120, 160))
    endings = {BLIND: " --cameras none", ObservationSpec(): "", small: " --image_size 120x160"}
    for spec, ending in endings.items():
        with pytest.raises(RequestError) as caught:
            load_demonstrations(folder, spec, env="FeedingEnv")
        assert str(caught.value) == f"'{folder}' {what}; record it: {line}{ending}"


@pytest.mark.usefixtures("other_task")
@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"env_id": "robo_manip_baselines/OtherEnv-v0"}, 'env_id "robo_manip_baselines/OtherEnv'),
        ({"xml_hash": "1" * 64}, 'xml_hash "1111'),
        ({"control_period": 0.04}, "control_period 0.04 where .* has 0.02"),
        ({"prediction_period": 0.04}, "prediction_period 0.04"),
        ({"action_names": list("abcdefg")}, 'action_names ..a", "b"'),
        ({"env_kwargs": {"face_motion": "after_lift"}}, 'env_kwargs {"face_motion": "after_lift"}'),
        ({"arms": 2}, "action_names .*left/waist"),
    ],
)
def test_episodes_of_two_kinds_are_refused(
    tmp_path: Path, changes: dict[str, Any], message: str
) -> None:
    first, other = write(tmp_path, 0), write(tmp_path, 1, **changes)
    with pytest.raises(RequestError, match=message) as caught:
        load_demonstrations(tmp_path, BLIND)
    assert str(caught.value).startswith(f"'{other}' has ")
    assert f"where '{first}' has " in str(caught.value)


@pytest.mark.parametrize(
    ("changes", "spec", "message"),
    [
        ({}, BOTH_ARMS, "recorded with the arms right; arms 'both' needs left, right"),
        ({"arms": 2}, BLIND, "recorded with the arms left, right; arms 'right' needs right"),
        (
            {},
            SHOWN,
            "no images of top; its cameras: none; choose --cameras none, or record others: "
            "python bin/Rollout.py FeedingEnv --scripted --num_episodes 50 --out .*_images "
            "--image_size 24x32$",
        ),
        (
            {"cameras": ("top", "angle")},
            replace(SHOWN, cameras=("top", "front_close")),
            "no images of front_close; its cameras: angle, top; choose --cameras angle top, or",
        ),
        (
            {"cameras": ("top",)},
            replace(SHOWN, image_size=(25, 32)),
            "image size 25x32: .* holds 24x32; choose --image_size 24x32 or less, or record: "
            ".*_images --image_size 25x32$",
        ),
        ({"cameras": ("top",)}, replace(SHOWN, image_size=(24, 33)), "24x33: .* holds 24x32"),
        ({"is_success": False}, BLIND, "is a failure: move it to .*failed"),
    ],
)
def test_episodes_that_do_not_hold_what_is_asked_for(
    tmp_path: Path, changes: dict[str, Any], spec: ObservationSpec, message: str
) -> None:
    write(tmp_path, 0, **changes)
    with pytest.raises(RequestError, match=message):
        load_demonstrations(tmp_path, spec)


def test_a_renamed_episode_is_refused(tmp_path: Path) -> None:
    write(tmp_path, 0).rename(tmp_path / "episode_000009.hdf5")
    with pytest.raises(RequestError, match=r"episode_000009.hdf5' holds seed 0"):
        load_demonstrations(tmp_path, BLIND)


def test_images_may_be_left_out_or_shrunk(tmp_path: Path) -> None:
    write(tmp_path, 0, cameras=("top", "angle"))
    assert load_demonstrations(tmp_path, BLIND).spec.cameras == ()
    small = ObservationSpec(cameras=("angle",), image_size=(12, 32))
    assert load_demonstrations(tmp_path, small).spec == replace(small, render_size=(24, 32))


def test_damage_names_the_file(folder: Path) -> None:
    path = folder / "episode_000012.hdf5"
    data = path.read_bytes()
    path.write_bytes(data[: len(data) // 2])
    with pytest.raises(RequestError, match="episode_000012"):
        load_demonstrations(folder, BLIND)
