"""``bin/Teleop.py``: files, folders, and what is refused."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from robo_manip_baselines.commands import teleop
from robo_manip_baselines.data import EpisodeReader, list_episodes, read_metadata
from robo_manip_baselines.data.demonstrations import load_demonstrations
from robo_manip_baselines.data.files import UNRENDERED_FOLDER
from robo_manip_baselines.data.verify import verify_dataset
from robo_manip_baselines.observation import ObservationSpec
from robo_manip_baselines.rollout.demonstrate import Collection, collect, deviation
from robo_manip_baselines.runs.errors import RequestError
from robo_manip_baselines.teleop import recording, teleoperate

pytestmark = pytest.mark.long

Recorded = Callable[..., Path]


def play_back(recorded: Path, out: Path, *more: str) -> None:
    """Run the command on recorded episodes."""
    options = ["--device", "replay", "--episodes", str(recorded), "--out", str(out)]
    teleop.main(["FeedingEnv", *options, *(more or ("--cameras", "none"))])


def test_episodes_are_like_those_of_experts(
    recorded: Recorded, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    play_back(recorded(), out, "--cameras", "none", "--operator", "Ada")
    assert "1, 1 of them successes" in capsys.readouterr().out
    (path,) = list_episodes(out)
    assert [item.name for item in out.iterdir()] == [path.name]
    assert verify_dataset(out) == []
    found = deviation(path)
    assert (found.qpos, found.qvel) == (0.0, 0.0)
    known, wanted = read_metadata(path), read_metadata(list_episodes(recorded())[0])
    assert (known["expert"], known["source"], known["device"]) == ("Ada", "teleop", "replay")
    assert known["schema_version"] == 5
    for name in ("env_id", "seed", "xml_hash", "versions", "motion_clip", "cameras"):
        assert known[name] == wanted[name]
    # What a policy learns from is read from both kinds of file by the same code.
    spec = ObservationSpec("current_pred", cameras=(), object_pose=True)
    ours, theirs = (load_demonstrations(folder, spec) for folder in (out, recorded()))
    assert ours.state.shape[1] == theirs.state.shape[1]
    assert ours.env_kwargs == theirs.env_kwargs


def test_the_same_motion_gives_the_same_bytes(recorded: Recorded, tmp_path: Path) -> None:
    for name in ("one", "two"):
        play_back(recorded(), tmp_path / name)
    one, two = (list_episodes(tmp_path / name)[0].read_bytes() for name in ("one", "two"))
    assert one == two


@pytest.mark.gl
def test_images_are_those_that_an_expert_records(tmp_path: Path) -> None:
    """Drawn afterwards, by running the actions again: the same bytes."""
    kwargs: dict[str, Any] = {"cameras": ["top"], "image_size": [24, 32], "face_motion": "episode"}
    collect(Collection("FeedingEnv", tmp_path / "expert", "reactive", range(1), kwargs))
    path = list_episodes(tmp_path / "expert")[0]
    out = tmp_path / "out"
    unrendered = out / UNRENDERED_FOLDER / path.name
    with EpisodeReader(path) as episode:
        schema = episode.schema
        derived = {item.name for item in schema.attributes if item.is_derived}
        given = {k: v for k, v in episode.attributes.items() if k not in derived}
        recording.write_episode(unrendered, episode.arrays, {}, given)
    assert recording.draw_images(unrendered, out).read_bytes() == path.read_bytes()
    assert not unrendered.exists()


@pytest.mark.gl
def test_a_session_draws_what_a_killed_one_left(recorded: Recorded, tmp_path: Path) -> None:
    out, size = tmp_path / "out", ("--cameras", "top", "--image_size", "24x32")

    def die(store: recording.EpisodeStore) -> str:
        return ""

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(recording.EpisodeStore, "poll", die)
        patch.setattr(recording.EpisodeStore, "finish", lambda store: None)
        play_back(recorded(), out, *size)
    assert [item.name for item in out.iterdir()] == [UNRENDERED_FOLDER]
    play_back(recorded(), out, *size)
    (path,) = list_episodes(out)
    assert [item.name for item in out.iterdir()] == [path.name]
    with EpisodeReader(path) as episode:
        assert episode.frame("top", 5).shape == (24, 32, 3)
    assert verify_dataset(out) == []
    with pytest.raises(RequestError, match="holds an episode of every seed played back"):
        play_back(recorded(), out, *size)


@pytest.mark.gl
def test_the_same_command_draws_what_is_left_where_every_seed_is_recorded(
    recorded: Recorded, tmp_path: Path
) -> None:
    """Of devices that a person moves: nobody is asked to, and the session ends."""
    out, size = tmp_path / "out", ("--cameras", "top", "--image_size", "24x32")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(recording.EpisodeStore, "poll", lambda store: "")
        patch.setattr(recording.EpisodeStore, "finish", lambda store: None)
        play_back(recorded(), out, *size)
    again = ["FeedingEnv", "--device", "web", "--num_episodes", "1", "--out", str(out), *size]
    device = SimpleNamespace(is_paced=False, close=lambda: None)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(teleoperate, "open_device", lambda *_: device)
        teleop.main(again)
        (path,) = list_episodes(out)
        with EpisodeReader(path) as episode:
            assert episode.cameras == ("top",)
        with pytest.raises(RequestError, match="holds all episodes of the seeds 0 to 0; give"):
            teleop.main(again)


@pytest.mark.gl
def test_actions_that_lead_elsewhere_are_noticed(recorded: Recorded, tmp_path: Path) -> None:
    with EpisodeReader(list_episodes(recorded())[0]) as episode:
        derived = {item.name for item in episode.schema.attributes if item.is_derived}
        known = {k: v for k, v in episode.attributes.items() if k not in derived}
        arrays = dict(episode.arrays)
    arrays["action"] = arrays["action"] + 1e-3
    known["env_kwargs"] = {**known["env_kwargs"], "cameras": ["top"], "image_size": [24, 32]}
    path = recording.write_episode(tmp_path / "u" / "episode_000000.hdf5", arrays, {}, known)
    with pytest.raises(RequestError, match="its actions lead elsewhere at step 1"):
        recording.draw_images(path, tmp_path)
    assert path.exists()
    assert list_episodes(tmp_path) == []


def test_the_spoon_can_be_steered() -> None:
    options = teleop.TeleopOptions("FeedingEnv", device="replay", utensil="spoon")
    assert teleop.to_config(options).env_kwargs == {"utensil": "spoon"}


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--device", "glove"], "unknown device 'glove'.*valid: .*replay"),
        (["--device", "replay"], "no episode to play back; give --episodes"),
        (["--arm", "third"], "unknown arm 'third'.*valid: both, left, right"),
        (["--time_limit", "0"], "--time_limit 0.0: must be 0.02 to 3600"),
        (["--operator", "a\nb"], "operator"),
        (["--image_codec", "gif"], "unknown image codec 'gif'"),
        (["--motion", "flying"], "flying"),
        (["--utensil", "fork"], "unknown utensil 'fork'"),
        (["--episodes", "there", "--arm", "left"], "there"),
        (["--port", "9"], "--port goes with --device web or spacemouse, not with replay"),
        (["--device", "web", "--mice", "/dev/hidraw3"], "--mice goes with --device keyboard or sp"),
    ],
)
def test_what_is_wrong_is_one_line(options: list[str], message: str, tmp_path: Path) -> None:
    out = tmp_path / "out"
    given = options if "--device" in options else ["--device", "replay", *options]
    with pytest.raises(RequestError, match=message) as caught:
        teleop.main(["FeedingEnv", *given, "--cameras", "none", "--out", str(out)])
    assert "\n" not in str(caught.value)
    assert not out.exists()


def test_folders_of_other_settings_are_refused(recorded: Recorded, tmp_path: Path) -> None:
    out = tmp_path / "out"
    play_back(recorded(), out)
    before = {path: path.read_bytes() for path in out.iterdir()}
    with pytest.raises(RequestError, match="holds episodes with env_kwargs"):
        play_back(recorded(), out, "--cameras", "top")
    scripted = tmp_path / "scripted"
    shutil.copytree(recorded(), scripted)
    with pytest.raises(RequestError, match="holds episodes with source scripted, not teleop"):
        play_back(recorded(), scripted)
    kwargs = {"cameras": (), "image_size": (480, 640), "face_motion": "episode"}
    with pytest.raises(RequestError, match="holds episodes with source teleop, not scripted"):
        collect(Collection("FeedingEnv", out, "reactive", range(2), kwargs))
    assert {path: path.read_bytes() for path in out.iterdir()} == before
    (tmp_path / "notes").mkdir()
    (tmp_path / "notes" / "a.txt").touch()
    with pytest.raises(RequestError, match=r"holds a\.txt and no demonstrations"):
        play_back(recorded(), tmp_path / "notes")


def test_the_world_must_be_the_recorded_one(recorded: Recorded, tmp_path: Path) -> None:
    with pytest.raises(RequestError, match='was recorded with motion null, not "still"'):
        play_back(recorded(), tmp_path / "out", "--cameras", "none", "--motion", "still")


def test_what_an_expert_was_shown_is_no_part_of_the_world(
    recorded: Recorded, tmp_path: Path
) -> None:
    """As by a servo that goes by a camera; the command has no such options."""
    with EpisodeReader(list_episodes(recorded())[0]) as episode:
        derived = {item.name for item in episode.schema.attributes if item.is_derived}
        known = {k: v for k, v in episode.attributes.items() if k not in derived}
        arrays = dict(episode.arrays)
    shown = {"mouth_source": "camera", "camera_latency": 2, "render_mode": "rgb_array"}
    known["env_kwargs"] = known["env_kwargs"] | shown
    recording.write_episode(tmp_path / "camera" / "episode_000000.hdf5", arrays, {}, known)
    play_back(tmp_path / "camera", tmp_path / "out")
    assert len(list_episodes(tmp_path / "out")) == 1


def test_the_left_arm_alone(recorded: Recorded, tmp_path: Path) -> None:
    """The task's one arm stays where it is; the files have both."""
    with pytest.raises(RequestError, match="moves the arm right, not left"):
        play_back(recorded(), tmp_path / "out", "--cameras", "none", "--arm", "left")
    assert not list_episodes(tmp_path / "out") if (tmp_path / "out").exists() else True


def test_values_of_new_attributes_are_checked(recorded: Recorded, tmp_path: Path) -> None:
    with EpisodeReader(list_episodes(recorded())[0]) as episode:
        derived = {item.name for item in episode.schema.attributes if item.is_derived}
        known = {k: v for k, v in episode.attributes.items() if k not in derived}
        arrays = dict(episode.arrays)
    arrays["intervention"] = np.arange(len(arrays["time"])) % 2 == 0
    for wrong in ({"source": "dream"}, {"missed_deadlines": -1}, {"policy": {"name": "Act"}}):
        with pytest.raises(ValueError, match=next(iter(wrong))):
            recording.write_episode(tmp_path / "e.hdf5", arrays, {}, known | wrong)
    policy = {"name": "Act", "sha256": "0" * 64}
    facts = {"source": "teleop", "device": "web", "loop_rate": 49.9, "missed_deadlines": 2}
    path = tmp_path / "episode_000000.hdf5"
    recording.write_episode(path, arrays, {}, known | facts | {"policy": policy})
    assert verify_dataset(tmp_path) == []
    with EpisodeReader(path) as episode:
        assert episode.attributes["schema_version"] == 5
        assert episode.attributes["policy"] == policy
        np.testing.assert_array_equal(episode.array("intervention"), arrays["intervention"])
