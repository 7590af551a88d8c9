"""RoboManipBaselines' episodes: keys, units and attributes; there and back; those of its own."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from robo_manip_baselines.data import EpisodeReader, list_episodes
from robo_manip_baselines.data.demonstrations import load_demonstrations
from robo_manip_baselines.data.example import make_frames
from robo_manip_baselines.data.formats import rmb
from robo_manip_baselines.data.formats.rmb import export_rmb, import_rmb, relative_poses
from robo_manip_baselines.data.formats.video import VideoEncoding, VideoReader, VideoWriter
from robo_manip_baselines.data.verify import verify_dataset
from robo_manip_baselines.observation import ObservationSpec
from robo_manip_baselines.runs.errors import RequestError

LOSSLESS = VideoEncoding("lossless", 0, gop=3)
Tree = Callable[[Path], dict[str, bytes]]


@pytest.mark.parametrize("arms", [1, 2])
def test_keys_shapes_and_attributes(
    arms: int, one_arm: Path, two_arms: Path, tmp_path: Path
) -> None:
    folder = one_arm if arms == 1 else two_arms
    export_rmb(folder, tmp_path / "rmb")
    names = sorted(path.name for path in (tmp_path / "rmb").iterdir())
    assert names == [f"episode_{seed:06d}.rmb" for seed in range(3)]
    root = tmp_path / "rmb" / "episode_000001.rmb"
    assert sorted(path.name for path in root.iterdir()) == [
        "front_close_rgb_image.rmb.mp4",
        "main.rmb.hdf5",
        "top_rgb_image.rmb.mp4",
    ]
    with h5py.File(root / "main.rmb.hdf5") as file, EpisodeReader(list_episodes(folder)[1]) as own:
        shapes = {name: item.shape for name, item in file.items()}
        for which in ("measured", "command"):
            expected = {"joint_pos": 7, "joint_pos_rel": 7, "gripper_joint_pos": 1}
            expected |= {"eef_pose": 7, "eef_pose_rel": 6}
            for key, width in expected.items():
                assert shapes[f"{which}_{key}"] == (15, width * arms), key
        assert shapes["measured_joint_vel"] == (15, 7 * arms)
        # Every member is an array with a row a step: RmbData reads all of them with [:].
        assert all(shape[0] == 15 for shape in shapes.values())
        measured = file["measured_joint_pos"][:].reshape(15, arms, 7)
        joints = own.array("joint_position").reshape(15, arms, 6)
        np.testing.assert_array_equal(measured[..., :6], joints)
        np.testing.assert_array_equal(measured[..., 6], own.array("gripper_position"))
        np.testing.assert_array_equal(file["command_joint_pos"], own.array("action"))
        np.testing.assert_array_equal(
            file["command_joint_pos_rel"][1:], np.diff(own.array("action"), axis=0)
        )
        assert not file["command_joint_pos_rel"][0].any()
        pose = file["measured_eef_pose"][:, -7:]
        np.testing.assert_array_equal(pose[:, :3], own.array("end_effector_position"))
        assert file.attrs["format"] == "RmbData-Compact"
        assert file.attrs["env"] == "FeedingEnv"
        assert list(file.attrs["camera_names"]) == ["front_close", "top"]
        assert file.attrs["world_idx"] == 1
    with VideoReader(root / "top_rgb_image.rmb.mp4") as video:
        info = video.info
        assert (info.frames, info.size, info.codec, info.fps) == (15, (24, 32), "h264", 50)
        assert len(list(video)) == 15


def test_relative_poses_lead_from_one_to_the_next() -> None:
    rng = np.random.default_rng(0)
    quaternion = Rotation.random(6, rng=rng).as_quat(scalar_first=True)
    poses = np.concatenate([rng.normal(size=(6, 3)), quaternion], axis=1)[:, None]
    steps = relative_poses(poses)
    assert steps.shape == (6, 6)
    np.testing.assert_allclose(steps[0], 0.0, atol=1e-12)
    turn, place = Rotation.from_quat(quaternion[0], scalar_first=True), poses[0, 0, :3]
    for t in range(1, 6):
        place = place + turn.apply(steps[t, :3])
        turn = turn * Rotation.from_euler("xyz", steps[t, 3:])
        np.testing.assert_allclose(place, poses[t, 0, :3], atol=1e-12)
        expected = Rotation.from_quat(quaternion[t], scalar_first=True)
        assert (turn.inv() * expected).magnitude() < 1e-7


@pytest.mark.parametrize("arms", [1, 2])
def test_there_and_back_loses_nothing(
    arms: int, one_arm: Path, two_arms: Path, tmp_path: Path
) -> None:
    folder = one_arm if arms == 1 else two_arms
    export_rmb(folder, tmp_path / "rmb", LOSSLESS)
    import_rmb(tmp_path / "rmb", tmp_path / "back")
    assert verify_dataset(tmp_path / "back") == []
    for path in list_episodes(folder):
        with EpisodeReader(path) as old, EpisodeReader(tmp_path / "back" / path.name) as new:
            assert old.arrays.keys() == new.arrays.keys()
            for name, values in old.arrays.items():
                np.testing.assert_array_equal(new.array(name), values)
                assert new.array(name).dtype == values.dtype
            # Images are stored as PNG: the pixels are the same, and their bytes are not.
            changed = {"image_codec", "content_sha256"}
            for name, value in old.attributes.items():
                assert name in changed or np.array_equal(new.attributes[name], value), name
            for camera in old.cameras:
                for step in range(len(old)):
                    np.testing.assert_array_equal(new.frame(camera, step), old.frame(camera, step))


def test_an_export_goes_on_where_it_was(one_arm: Path, tmp_path: Path, tree: Tree) -> None:
    whole, part = tmp_path / "whole", tmp_path / "part"
    export_rmb(one_arm, whole)
    with pytest.MonkeyPatch.context() as patch:
        seen: list[int] = []
        add = VideoWriter.add

        def stop(self: VideoWriter, image: np.ndarray) -> None:
            seen.append(1)
            if len(seen) == 30:
                raise KeyboardInterrupt
            add(self, image)

        patch.setattr(rmb.VideoWriter, "add", stop)
        with pytest.raises(KeyboardInterrupt):
            export_rmb(one_arm, part)
    assert [path.name for path in part.iterdir()] == ["episode_000000.rmb"]
    rows = export_rmb(one_arm, part)
    assert rows["episodes"] == "3, of which 2 new"
    videos = {name: data for name, data in tree(whole).items() if name.endswith(".mp4")}
    assert videos == {name: data for name, data in tree(part).items() if name.endswith(".mp4")}


def test_others_in_the_way_are_named(one_arm: Path, two_arms: Path, tmp_path: Path) -> None:
    export_rmb(one_arm, tmp_path)
    with pytest.raises(RequestError, match="was not exported from"):
        export_rmb(two_arms, tmp_path)


def native(
    path: Path, *, single: bool, width: int = 7, steps: int = 20, **changes: np.ndarray
) -> Path:
    """Write an episode as RoboManipBaselines' DataManager does."""
    rng = np.random.default_rng(1)
    arrays = {
        "time": 0.02 * np.arange(steps),
        "measured_joint_pos": rng.normal(size=(steps, width)),
        "command_joint_pos": rng.normal(size=(steps, width)),
        "measured_joint_vel": rng.normal(size=(steps, width)),
        "measured_eef_pose": np.tile([0.1, 0.2, 0.3, 2.0, 0, 0, 0], (steps, width // 7)),
        "measured_eef_wrench": rng.normal(size=(steps, 6)),
        **changes,
    }
    frames = make_frames(steps)
    main = path if single else path / "main.rmb.hdf5"
    main.parent.mkdir(parents=True, exist_ok=True)
    with h5py.File(main, "w") as file:
        for name, values in arrays.items():
            file[name] = values
        file.attrs["env"] = "MujocoUR5eCable"
        file.attrs["task_desc"] = "pass the cable between the poles"
        file.attrs["camera_names"] = ["front", "side"]
        file.attrs["world_idx"] = 3
        if single:
            file["front_rgb_image"] = frames
            file["front_depth_image"] = np.zeros(frames.shape[:3], np.float32)
    if not single:
        for name in ("front_rgb_image", "side_rgb_image"):
            with VideoWriter(path / f"{name}.rmb.mp4", (24, 32), 25, LOSSLESS) as video:
                for frame in frames:
                    video.add(frame)
    return path


@pytest.mark.parametrize("single", [True, False])
@pytest.mark.parametrize("width", [7, 14])
def test_its_own_episodes_become_demonstrations(single: bool, width: int, tmp_path: Path) -> None:
    source = tmp_path / "source"
    name = "cable_000.hdf5" if single else "cable_000.rmb"
    native(source / name, single=single, width=width)
    out = tmp_path / "out"
    rows = import_rmb(source, out, cameras=["top=front"])
    assert rows["episodes"] == "1, of which 1 new"
    assert verify_dataset(out) == []
    (path,) = list_episodes(out)
    with (
        EpisodeReader(path) as episode,
        h5py.File(source / name if single else source / name / "main.rmb.hdf5") as file,
    ):
        assert episode.task.name == "ImportedEnv"
        np.testing.assert_array_equal(episode.array("action"), file["command_joint_pos"])
        by_arm = file["measured_joint_pos"][:].reshape(20, -1, 7)
        np.testing.assert_array_equal(episode.array("gripper_position"), by_arm[..., 6])
        np.testing.assert_array_equal(episode.array("end_effector_orientation")[:, 0], 1.0)
        assert episode.attributes["instruction"] == "pass the cable between the poles"
        assert episode.attributes["source_attributes"]["world_idx"] == 3
        assert episode.cameras == ("top",)
        np.testing.assert_array_equal(episode.frame("top", 7), make_frames(20)[7])
    spec = ObservationSpec(
        cameras=("top",), image_size=(24, 32), arms="right" if width == 7 else "both"
    )
    given = load_demonstrations(out, spec)
    assert given.action.shape == (20, width)
    assert given.state.shape == (20, 2 * width)
    assert np.isfinite(given.state).all()
    with pytest.raises(RequestError, match="holds no face"):
        load_demonstrations(out, ObservationSpec("current", cameras=(), arms=spec.arms))
    again = import_rmb(source, out, cameras=["top=front"])
    assert again["episodes"] == "1, of which 0 new"


def test_old_keys_and_missing_velocities_are_read(tmp_path: Path) -> None:
    source = native(tmp_path / "source" / "old.hdf5", single=True)
    with h5py.File(source, "r+") as file:
        file.move("measured_joint_pos", "joint_pos")
        del file["measured_joint_vel"]
        joints = file["joint_pos"][:]
    import_rmb(source.parent, tmp_path / "out", cameras=[])
    (path,) = list_episodes(tmp_path / "out")
    with EpisodeReader(path) as episode:
        np.testing.assert_array_equal(episode.array("joint_position"), joints[:, :6])
        expected = np.gradient(joints, 0.02 * np.arange(20), axis=0)
        np.testing.assert_allclose(episode.array("joint_velocity"), expected[:, :6])


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"width": 8}, r"measured_joint_pos \(20, 8\).*one or two arms of 6 joints"),
        ({"time": np.zeros(20)}, "does not increase"),
        ({"measured_joint_pos": np.full((20, 7), np.nan)}, "NaN or infinite"),
    ],
)
def test_what_cannot_be_imported_is_one_line(
    changes: dict[str, object], message: str, tmp_path: Path
) -> None:
    source = native(tmp_path / "source" / "a.hdf5", single=True, **changes)  # type: ignore[arg-type]
    with pytest.raises(RequestError, match=message):
        import_rmb(source.parent, tmp_path / "out", cameras=["top=front"])
    assert not list((tmp_path / "out").glob("**/*.hdf5"))


def test_cameras_are_named_by_the_user(tmp_path: Path) -> None:
    source = native(tmp_path / "source" / "a.hdf5", single=True)
    for cameras, message in (
        (None, "'front' has no name here; choose with --cameras, for example top=front"),
        (["top=hand"], "has no camera 'hand'; valid: front"),
        (["front=front"], "unknown camera 'front'"),
    ):
        with pytest.raises(RequestError, match=message):
            import_rmb(source.parent, tmp_path / "out", cameras=cameras)


def test_a_file_of_something_else_is_refused(tmp_path: Path) -> None:
    (tmp_path / "source").mkdir()
    (tmp_path / "source" / "a.hdf5").write_bytes(b"no HDF5")
    with pytest.raises(RequestError, match="is no RMB episode"):
        import_rmb(tmp_path / "source", tmp_path / "out")
    (tmp_path / "empty").mkdir()
    with pytest.raises(RequestError, match=r"holds no \.rmb folder"):
        import_rmb(tmp_path / "empty", tmp_path / "out")
