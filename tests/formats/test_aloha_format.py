"""ALOHA's episodes: the 14 numbers, the gripper's units, images; there and back; its own."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import h5py
import numpy as np
import pytest

from robo_manip_baselines.commands.dataset import main
from robo_manip_baselines.data import EpisodeReader, list_episodes, write_episode
from robo_manip_baselines.data.demonstrations import load_demonstrations
from robo_manip_baselines.data.example import make_frames
from robo_manip_baselines.data.formats import aloha, imported
from robo_manip_baselines.data.formats.aloha import export_aloha, import_aloha
from robo_manip_baselines.data.verify import verify_dataset
from robo_manip_baselines.envs.mujoco.tasks.registry import make_env
from robo_manip_baselines.observation import ObservationSpec
from robo_manip_baselines.runs.errors import RequestError, WriteError

STEPS = 20


@pytest.mark.parametrize("arms", [1, 2])
def test_variables_and_shapes(arms: int, one_arm: Path, two_arms: Path, tmp_path: Path) -> None:
    folder = one_arm if arms == 1 else two_arms
    export_aloha(folder, tmp_path)
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        f"episode_{number}.hdf5" for number in range(3)
    ]
    # As ACT's utils.py reads it.
    with h5py.File(tmp_path / "episode_1.hdf5") as root:
        assert root.attrs["sim"]
        assert root["/action"].shape == (15, 14)
        qpos, qvel = root["/observations/qpos"][3], root["/observations/qvel"][()]
        assert (qpos.shape, qvel.shape) == ((14,), (15, 14))
        image = root["/observations/images/top"]
        assert (image.shape, image.dtype) == ((15, 24, 32, 3), np.uint8)
        with EpisodeReader(list_episodes(folder)[1]) as own:
            np.testing.assert_array_equal(image[4], own.frame("top", 4))
            joints = own.array("joint_position").reshape(15, arms, 6)
            np.testing.assert_allclose(qpos[7:13], joints[3, -1], rtol=1e-6)
            finger = own.array("gripper_position")[3, -1]
            # Closed at 0.01844 m and open at 0.058 m: PUPPET_GRIPPER_POSITION_* of ACT.
            np.testing.assert_allclose(qpos[13], (finger - 0.01844) / 0.03956, rtol=1e-5)
            if arms == 1:
                assert np.ptp(root["/action"][:, :7], axis=0).max() == 0.0
                assert not qvel[:, :7].any()
            else:
                np.testing.assert_allclose(qpos[:6], joints[3, 0], rtol=1e-6)


@pytest.mark.parametrize("arms", [1, 2])
def test_there_and_back_loses_nothing(
    arms: int, one_arm: Path, two_arms: Path, tmp_path: Path
) -> None:
    folder = one_arm if arms == 1 else two_arms
    export_aloha(folder, tmp_path / "aloha")
    import_aloha(tmp_path / "aloha", tmp_path / "back")
    assert verify_dataset(tmp_path / "back") == []
    for path in list_episodes(folder):
        with EpisodeReader(path) as old, EpisodeReader(tmp_path / "back" / path.name) as new:
            assert old.arrays.keys() == new.arrays.keys()
            for name, values in old.arrays.items():
                np.testing.assert_array_equal(new.array(name), values)
            changed = {"image_codec", "content_sha256"}
            for name, value in old.attributes.items():
                assert name in changed or np.array_equal(new.attributes[name], value), name
            for camera in old.cameras:
                np.testing.assert_array_equal(new.frame(camera, 5), old.frame(camera, 5))


def native(path: Path, *, compressed: bool = False, width: int = 14) -> Path:
    """Write an episode as ACT's record_sim_episodes.py does; compressed as ALOHA 2's code does."""
    rng = np.random.default_rng(2)
    qpos = rng.uniform(-0.5, 0.5, (STEPS, width)).astype(np.float32)
    frames = make_frames(STEPS)
    path.parent.mkdir(parents=True, exist_ok=True)
    with h5py.File(path, "w") as root:
        root.attrs["sim"] = not compressed
        root["observations/qpos"] = qpos
        root["observations/qvel"] = qpos
        root["action"] = qpos + 0.1
        if not compressed:
            root["observations/images/top"] = frames
            root["observations/images/vis"] = frames
            return path
        root.attrs["compress"] = True
        # The camera's images go to imencode as they are, and come back from imdecode as they were.
        parts = [cv2.imencode(".jpg", f, [cv2.IMWRITE_JPEG_QUALITY, 95])[1] for f in frames]
        padded = np.zeros((STEPS, max(map(len, parts))), np.uint8)
        for row, part in zip(padded, parts, strict=True):
            row[: len(part)] = part.reshape(-1)
        root["observations/images/cam_high"] = padded
    return path


def test_its_own_episodes_become_demonstrations(tmp_path: Path) -> None:
    for number in (0, 2, 10):
        native(tmp_path / "source" / f"episode_{number}.hdf5")
    out = tmp_path / "out"
    import_aloha(tmp_path / "source", out, cameras=["top", "angle=vis"])
    assert verify_dataset(out) == []
    paths = list_episodes(out)
    assert [path.name for path in paths] == [f"episode_{n:06d}.hdf5" for n in range(3)]
    with EpisodeReader(paths[2]) as episode:
        assert episode.attributes["source_name"] == "episode_10.hdf5"
        assert episode.attributes["joint_names"][6] == "right/waist"
        with h5py.File(tmp_path / "source" / "episode_10.hdf5") as root:
            qpos, action = root["observations/qpos"][:], root["action"][:]
        by_arm = qpos.reshape(STEPS, 2, 7)
        joints = episode.array("joint_position").reshape(STEPS, 2, 6)
        np.testing.assert_array_equal(joints, by_arm[..., :6])
        np.testing.assert_allclose(
            episode.array("gripper_position"), by_arm[..., 6] * 0.03956 + 0.01844, rtol=1e-6
        )
        np.testing.assert_allclose(
            episode.array("action")[:, 13], action[:, 13] * 0.03956 + 0.01844, rtol=1e-6
        )
        np.testing.assert_array_equal(episode.array("qpos"), qpos)
        np.testing.assert_array_equal(episode.frame("angle", 3), make_frames(STEPS)[3])
    spec = ObservationSpec(cameras=("top",), image_size=(24, 32), arms="both")
    assert load_demonstrations(out, spec).state.shape == (3 * STEPS, 28)


def test_commands_take_them(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for number in range(3):
        native(tmp_path / "source" / f"episode_{number}.hdf5")
    out, first = tmp_path / "out", tmp_path / "out" / "episode_000000.hdf5"
    import_aloha(tmp_path / "source", out, cameras=["top"])
    for line in (
        ["info", out],
        ["verify", out],
        ["plot", first, "--out", tmp_path / "curves.png"],
        ["compare", first, first],
        ["split", out, "--out", tmp_path / "parts"],
        ["verify", tmp_path / "parts" / "train"],
        ["export", out, tmp_path / "rmb", "--format", "rmb"],
    ):
        assert main([str(part) for part in line]) == 0, line
    assert "0, in 0 clips" in capsys.readouterr().out
    with pytest.raises(RequestError, match="without an environment to run"):
        make_env("ImportedEnv")


def test_compressed_images_are_read(tmp_path: Path) -> None:
    native(tmp_path / "source" / "episode_0.hdf5", compressed=True)
    import_aloha(tmp_path / "source", tmp_path / "out", cameras=["top=cam_high"])
    with EpisodeReader(list_episodes(tmp_path / "out")[0]) as episode:
        error = np.abs(episode.frame("top", 9).astype(int) - make_frames(STEPS)[9])
    # JPEG of quality 95: red stays red. With channels exchanged, the mean would be about 40.
    assert error.mean() < 5.0


@pytest.mark.parametrize(
    ("width", "message"), [(7, r"qpos \(20, 7\)"), (16, "episodes of two arms")]
)
def test_other_robots_are_refused(width: int, message: str, tmp_path: Path) -> None:
    native(tmp_path / "source" / "episode_0.hdf5", width=width)
    with pytest.raises(RequestError, match=message):
        import_aloha(tmp_path / "source", tmp_path / "out", cameras=["top"])


def test_a_disk_without_room_is_refused_before_writing(
    one_arm: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    usage = type("Usage", (), {"free": 1000})
    monkeypatch.setattr(aloha.shutil, "disk_usage", lambda path: usage)
    with pytest.raises(WriteError, match="the disk has 1000"):
        export_aloha(one_arm, tmp_path / "out")
    assert not list((tmp_path / "out").glob("*"))


def test_others_in_the_way_are_named(one_arm: Path, two_arms: Path, tmp_path: Path) -> None:
    export_aloha(one_arm, tmp_path)
    assert export_aloha(one_arm, tmp_path)["episodes"] == "3, of which 0 new"
    with pytest.raises(RequestError, match="was not exported from"):
        export_aloha(two_arms, tmp_path)


def test_an_interrupted_import_goes_on_to_the_same_bytes(
    tmp_path: Path, tree: Callable[[Path], dict[str, bytes]], monkeypatch: pytest.MonkeyPatch
) -> None:
    for number in range(3):
        native(tmp_path / "source" / f"episode_{number}.hdf5")
    whole, part = tmp_path / "whole", tmp_path / "part"
    import_aloha(tmp_path / "source", whole, cameras=["top"])
    written: list[Path] = []

    def stop(path: Path, *args: Any) -> Path:
        written.append(path)
        if len(written) == 2:
            raise KeyboardInterrupt
        return write_episode(path, *args)

    monkeypatch.setattr(imported, "write_episode", stop)
    with pytest.raises(KeyboardInterrupt):
        import_aloha(tmp_path / "source", part, cameras=["top"])
    assert len(tree(part)) == 1
    import_aloha(tmp_path / "source", part, cameras=["top"])
    assert [path.name for path in written[2:]] == ["episode_000001.hdf5", "episode_000002.hdf5"]
    assert tree(part) == tree(whole)


def test_a_folder_of_other_episodes_is_refused(one_arm: Path, tmp_path: Path) -> None:
    native(tmp_path / "source" / "episode_0.hdf5")
    import_aloha(tmp_path / "source", tmp_path / "out", cameras=["top"])
    export_aloha(one_arm, tmp_path / "other")
    with pytest.raises(RequestError, match="is not that of"):
        import_aloha(tmp_path / "other", tmp_path / "out")
