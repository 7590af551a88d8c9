"""Writing and reading episode files: round trips, refusals, and errors that name the file."""

from __future__ import annotations

import hashlib
import json
import re
from pathlib import Path

import h5py
import numpy as np
import pytest

from robo_manip_baselines.data import EpisodeFileError, EpisodeReader, read_metadata, write_episode
from robo_manip_baselines.data.example import make_arrays, make_attributes, make_frames, make_images
from robo_manip_baselines.data.schema import EpisodeSchema
from robo_manip_baselines.data.verify import verify_file
from robo_manip_baselines.envs.mujoco.tasks.registry import task_entry
from robo_manip_baselines.runs.errors import RequestError

SCHEMA = EpisodeSchema.of(task_entry("FeedingEnv"))


@pytest.mark.parametrize("codec", ["jpeg", "png", "raw"])
@pytest.mark.parametrize("arms", [1, 2])
def test_what_is_written_is_read(tmp_path: Path, codec: str, arms: int) -> None:
    arrays, given = make_arrays(arms=arms), make_attributes(codec=codec, arms=arms)
    path = write_episode(tmp_path / "a.hdf5", arrays, make_images(codec=codec), given)
    with EpisodeReader(path) as episode:
        assert len(episode) == 12
        assert episode.cameras == ("front_close", "top")
        for name, values in arrays.items():
            np.testing.assert_array_equal(episode.arrays[name], values, strict=True)
        for name, value in given.items():
            np.testing.assert_array_equal(episode.attributes[name], value)
        assert episode.attributes["image_size"] == [24, 32]
        for index, camera in enumerate(episode.cameras):
            for step, truth in enumerate(make_frames(seed=index)):
                frame = episode.frame(camera, step)
                assert frame.shape == truth.shape
                error = np.abs(frame.astype(int) - truth)
                # JPEG at 90 smears the square's edge; channels swapped would be off by 30.
                assert error.mean() < (6 if codec == "jpeg" else 1e-9)


def test_predictions_are_there_or_not(tmp_path: Path) -> None:
    old, new = (make_arrays(version=version) for version in (1, 2))
    assert set(new) - set(old) == {"predicted_mouth"}
    for version, arrays in ((1, old), (2, new)):
        path = write_episode(tmp_path / f"{version}.hdf5", arrays, {}, make_attributes())
        assert verify_file(path) == []
        with EpisodeReader(path) as episode:
            assert episode.attributes["schema_version"] == version
            assert set(episode.fields) == set(episode.arrays) == set(arrays)
            np.testing.assert_array_equal(episode.array("qvel"), old["qvel"])
    with EpisodeReader(path) as episode:
        np.testing.assert_array_equal(episode.array("predicted_mouth"), new["predicted_mouth"])
    with h5py.File(path, "a") as file:
        del file["predicted_mouth"]
    assert [problem.message for problem in verify_file(path)] == ["'predicted_mouth' is missing"]


def test_state_only_episode(tmp_path: Path) -> None:
    path = write_episode(tmp_path / "a.hdf5", make_arrays(), {}, make_attributes())
    with EpisodeReader(path) as episode:
        assert episode.cameras == ()
        assert episode.attributes["image_size"] == [0, 0]
        with pytest.raises(RequestError, match="unknown camera 'top'"):
            episode.frame("top", 0)


def test_float32_is_widened_without_loss(tmp_path: Path) -> None:
    arrays = make_arrays()
    arrays["action"] = arrays["action"].astype(np.float32)
    with EpisodeReader(write_episode(tmp_path / "a.hdf5", arrays, {}, make_attributes())) as e:
        np.testing.assert_array_equal(e.array("action").astype(np.float32), arrays["action"])


def test_completion_time_may_be_missing(tmp_path: Path) -> None:
    attributes = make_attributes() | {"completion_time": float("nan"), "is_success": False}
    path = write_episode(tmp_path / "a.hdf5", make_arrays(), {}, attributes)
    assert np.isnan(read_metadata(path)["completion_time"])


def test_same_content_gives_same_bytes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def write(name: str, seed: int = 3) -> str:
        path = tmp_path / name
        write_episode(path, make_arrays(), make_images(), make_attributes(seed))
        return hashlib.sha256(path.read_bytes()).hexdigest()

    assert write("a.hdf5") == write("b.hdf5") != write("c.hdf5", seed=4)


def test_content_hash_covers_everything(tmp_path: Path) -> None:
    def digest(**changes: object) -> str:
        arrays, images = make_arrays(), make_images()
        attributes = make_attributes()
        for name, value in changes.items():
            (arrays if name in arrays and name != "is_success" else attributes)[name] = value
        write_episode(tmp_path / "a.hdf5", arrays, images, attributes)
        return str(read_metadata(tmp_path / "a.hdf5")["content_sha256"])

    usual = digest()
    assert re.fullmatch("[0-9a-f]{64}", usual)
    assert digest() == usual
    shifted = make_arrays()["qpos"]
    shifted[3, 2] = np.nextafter(shifted[3, 2], np.inf)
    others = [digest(qpos=shifted), digest(seed=4), digest(completion_time=3.3)]
    others += [digest(face_offset=[0.0, 0.0, 0.0]), digest(versions={"python": "3.12.0"})]
    assert len({usual, *others}) == 6


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda a, i, t: a.pop("qpos"), "'qpos' is missing"),
        (lambda a, i, t: a.update(extra=np.zeros(12)), "'extra' is no field"),
        (lambda a, i, t: a.update(action=a["action"][:-1]), "'action' has T=11 where 'time' has"),
        (lambda a, i, t: a.update(action=a["action"][:, :5]), "'action' has A=5, not 7 or 14"),
        (lambda a, i, t: a.update(jaw_opening=a["jaw_opening"][:, None]), "not \\(T,\\)"),
        (lambda a, i, t: a.update(time=a["time"] * 0), "'time' does not increase at step 1"),
        (lambda a, i, t: a["qvel"].__setitem__((5, 1), np.nan), "'qvel' is NaN .* step 5"),
        (lambda a, i, t: a["qvel"].__setitem__((5, 1), np.inf), "'qvel' is NaN or infinite"),
        (lambda a, i, t: a["head_orientation"].__imul__(1.1), "no unit quaternion at step 0"),
        (lambda a, i, t: a["object_pose"][4].__imul__(0), "'object_pose' is no unit .* step 4"),
        (lambda a, i, t: a["jaw_opening"].__setitem__(7, -1e-3), "negative at step 7"),
        (lambda a, i, t: a["phase"].__setitem__(2, 3), "'phase' is 3 at step 2, of 3 phases"),
        (lambda a, i, t: a.update(phase=a["phase"] + 0.5), "'phase' is float"),
        (lambda a, i, t: a.update(is_success=a["phase"]), "'is_success' is int8, not bool"),
        (lambda a, i, t: t.pop("seed"), "attribute 'seed' is missing"),
        (lambda a, i, t: t.update(cameras=["top"]), "'cameras' is not for the caller"),
        (lambda a, i, t: t.update(seed="3"), "attribute 'seed' needs int, not '3'"),
        (lambda a, i, t: t.update(seed=True), "attribute 'seed' needs int, not True"),
        (lambda a, i, t: t.update(face_offset=[1, 2]), "'face_offset' needs 3 finite numbers"),
        (lambda a, i, t: t.update(action_names=["x"]), "'action_names' says 1, but .* has 7"),
        (lambda a, i, t: t.update(image_codec="gif"), "unknown image codec 'gif'.*jpeg, png, raw"),
        (lambda a, i, t: i["top"].pop(), "camera 'top' has 11 frames for 12 steps"),
        (lambda a, i, t: t.update(image_codec="raw"), "no raw image"),
        (lambda a, i, t: i.update(top=make_images(12, "raw")["top"]), "no jpeg image"),
    ],
)
def test_wrong_content_is_refused_and_nothing_is_left(
    tmp_path: Path, change: object, message: str
) -> None:
    arrays, images, attributes = make_arrays(), make_images(), make_attributes()
    change(arrays, images, attributes)  # type: ignore[operator]
    with pytest.raises(ValueError, match=message):
        write_episode(tmp_path / "a.hdf5", arrays, images, attributes)
    assert list(tmp_path.iterdir()) == []


def test_failure_while_writing_leaves_what_was_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = write_episode(tmp_path / "a.hdf5", make_arrays(), {}, make_attributes())
    before = path.read_bytes()

    def fail(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("robo_manip_baselines.data.episode._write_frames", fail)
    with pytest.raises(OSError, match="No space left"):
        write_episode(path, make_arrays(), make_images(), make_attributes())
    assert [child.name for child in tmp_path.iterdir()] == ["a.hdf5"]
    assert path.read_bytes() == before


def test_units_stand_beside_the_numbers(tmp_path: Path) -> None:
    path = write_episode(tmp_path / "a.hdf5", make_arrays(), {}, make_attributes())
    with h5py.File(path) as file:
        for field in (field for field in SCHEMA.fields if field.since == 1):
            assert file[field.name].attrs["unit"].decode() == field.unit
            assert file[field.name].attrs["frame"].decode() == field.frame
        assert file["mouth_position"].attrs["unit"] == b"m"
        assert set(file.attrs) == {item.name for item in SCHEMA.attributes if item.since == 1}
        assert json.loads(file.attrs["versions"])["mujoco"] == "3.17.0"


def test_metadata_is_read_without_images(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write_episode(tmp_path / "a.hdf5", make_arrays(), make_images(), make_attributes())

    def forbidden(*_: object) -> None:
        raise AssertionError("data were read")

    monkeypatch.setattr(h5py.Dataset, "__getitem__", forbidden)
    assert read_metadata(path)["seed"] == 3


def _truncated(path: Path) -> None:
    write_episode(path, make_arrays(), make_images(), make_attributes())
    path.write_bytes(path.read_bytes()[:-100])


def _other_hdf5(path: Path) -> None:
    with h5py.File(path, "w") as file:
        file["action"] = np.zeros(3)


def _future(path: Path) -> None:
    write_episode(path, make_arrays(), {}, make_attributes())
    with h5py.File(path, "a") as file:
        file.attrs["schema_version"] = np.int64(6)


@pytest.mark.parametrize(
    ("make", "why"),
    [
        (lambda path: None, "is no file"),
        (lambda path: path.mkdir(), "is no file"),
        (lambda path: path.write_text("not an episode"), "is no HDF5 file"),
        (lambda path: path.write_bytes(b""), "is no HDF5 file"),
        (_truncated, "is no HDF5 file, or a damaged one: .*truncated"),
        (_other_hdf5, "is no episode: schema None"),
        (_future, "schema version 6; this release reads 1, 2, 3, 4, 5"),
    ],
)
def test_errors_name_the_file_and_why(tmp_path: Path, make: object, why: str) -> None:
    path = tmp_path / "episode_000007.hdf5"
    make(path)  # type: ignore[operator]
    with pytest.raises(EpisodeFileError, match=f"'.*episode_000007.hdf5'.*{why}") as caught:
        EpisodeReader(path)
    assert "\n" not in str(caught.value)


def test_reader_refuses_wrong_names_and_steps(tmp_path: Path) -> None:
    path = write_episode(tmp_path / "a.hdf5", make_arrays(), make_images(), make_attributes())
    with EpisodeReader(path) as episode:
        with pytest.raises(RequestError, match=r"unknown camera 'tpo' .*'top'.*front_close, top"):
            episode.frame("tpo", 0)
        with pytest.raises(RequestError, match="steps 0…11, not 12"):
            episode.frame("top", 12)
        with pytest.raises(RequestError, match="steps 0…11, not -1"):
            episode.frame("top", -1)
        with pytest.raises(RequestError, match=r"unknown field 'actions' .*'action'"):
            episode.array("actions")


def test_damaged_frame_is_an_error_when_it_is_read(tmp_path: Path) -> None:
    images = make_images()
    path = write_episode(tmp_path / "a.hdf5", make_arrays(), images, make_attributes())
    data = bytearray(path.read_bytes())
    start = data.rindex(images["top"][5].tobytes())  # another camera has the same picture
    data[start + images["top"][5].size // 2] ^= 4
    path.write_bytes(bytes(data))
    with EpisodeReader(path) as episode:
        episode.frame("front_close", 5)
        with pytest.raises(EpisodeFileError, match=r"frame 5 of 'top' .*: its checksum is wrong"):
            episode.frame("top", 5)
        # One checksum is of several small images together: the first of them is named.
        with pytest.raises(EpisodeFileError, match=r"frame 0 of 'top' .*: its checksum is wrong"):
            list(episode.encoded_frames("top"))


@pytest.mark.parametrize("codec", ["jpeg", "png", "raw"])
def test_all_images_of_a_camera_are_those_read_one_by_one(tmp_path: Path, codec: str) -> None:
    images = make_images(codec=codec)
    path = write_episode(tmp_path / "a.hdf5", make_arrays(), images, make_attributes(codec=codec))
    with EpisodeReader(path) as episode:
        for camera in episode.cameras:
            frames = list(episode.encoded_frames(camera))
            assert len(frames) == len(episode)
            assert all(np.array_equal(x, y) for x, y in zip(frames, images[camera], strict=True))
