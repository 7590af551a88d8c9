"""Every kind of damage is found, and said with the file's name and the reason."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from robo_manip_baselines.data import EpisodeReader, episode_path, write_episode
from robo_manip_baselines.data.episode import image_checksum
from robo_manip_baselines.data.example import make_arrays, make_attributes, make_frames, make_images
from robo_manip_baselines.data.schema import EpisodeSchema, content_digest, loaded_attribute
from robo_manip_baselines.data.verify import damage_summary, verify_dataset, verify_file
from robo_manip_baselines.envs.mujoco.tasks.registry import task_entry
from robo_manip_baselines.runs.errors import RequestError
from robo_manip_baselines.runs.images import encode_image

SCHEMA = EpisodeSchema.of(task_entry("FeedingEnv"))

pytestmark = pytest.mark.long


def write(
    folder: Path, seed: int = 3, *, success: bool = True, codec: str = "jpeg", **changes: Any
) -> Path:
    attributes = make_attributes(seed, codec=codec) | {"is_success": success} | changes
    path = episode_path(folder, seed, success)
    return write_episode(path, make_arrays(seed=seed), make_images(codec=codec), attributes)


def seal(file: h5py.File) -> None:
    """Make the digest right again, so that only the damage itself can be found."""
    arrays = {name: file[name][()] for name in SCHEMA.fields_of(int(file.attrs["schema_version"]))}
    checksums = {name: group["checksum"][()] for name, group in file["images"].items()}
    known = SCHEMA.attributes_of(int(file.attrs["schema_version"]), file.attrs)
    attributes = {i.name: loaded_attribute(i, file.attrs[i.name]) for i in known}
    file.attrs["content_sha256"] = content_digest(SCHEMA, arrays, checksums, attributes)


def put_frame(file: h5py.File, camera: str, step: int, data: np.ndarray) -> None:
    """Replace a frame, its checksum and the digest: what a faulty writer would have written."""
    group = file[f"images/{camera}"]
    offset = group["offset"][()]
    old = group["data"][()]
    new = np.concatenate([old[: offset[step]], data, old[offset[step + 1] :]])
    offset[step + 1 :] += len(data) - (offset[step + 1] - offset[step])
    del group["data"]
    group["data"], group["offset"][...] = new, offset
    group["checksum"][step] = image_checksum(data)
    seal(file)


def swap_frame(file: h5py.File) -> None:
    """Change a byte of a picture, leaving its checksum as it was."""
    group = file["images/top"]
    group["data"][group["offset"][4] + 300] ^= 1


def _remove(name: str) -> Callable[[h5py.File], None]:
    def damage(file: h5py.File) -> None:
        del file[name]

    return damage


def _replace(name: str, change: Callable[[np.ndarray], np.ndarray]) -> Callable[[h5py.File], None]:
    def damage(file: h5py.File) -> None:
        values, attributes = file[name][()], dict(file[name].attrs)
        del file[name]
        file[name] = change(values)
        file[name].attrs.update(attributes)

    return damage


def _assign(name: str, index: Any, value: float) -> Callable[[h5py.File], None]:
    def damage(file: h5py.File) -> None:
        file[name][index] = value
        seal(file)

    return damage


def _attribute(name: str, value: Any) -> Callable[[h5py.File], None]:
    return lambda file: file.attrs.__setitem__(name, value)


def _frame(data: np.ndarray) -> Callable[[h5py.File], None]:
    return lambda file: put_frame(file, "top", 4, data)


DAMAGE: list[tuple[Callable[[h5py.File], Any], str]] = [
    (_remove("action"), "'action' is missing"),
    (_remove("images"), "no dataset 'images/front_close/"),
    (_remove("images/top"), "no dataset 'images/top/"),
    (_remove("images/top/offset"), "no dataset 'images/top/offset'"),
    (_remove("images/top/checksum"), "no dataset 'images/top/checksum'"),
    (lambda file: file.attrs.__delitem__("seed"), "attribute 'seed' is missing"),
    (_replace("action", lambda x: x[:, :6]), "'action' has A=6, not 7 or 14"),
    (_replace("action", lambda x: x[:-1]), "'action' has T=11 where 'time' has T=12"),
    (_replace("mouth_position", lambda x: x[:, :5]), "'mouth_position' has K=5, not 6 or 25"),
    (_replace("mouth_position", lambda x: x[:, 0]), "(12, 3), not (T, K, 3)"),
    (_replace("qpos", lambda x: x[:, 0]), "'qpos' has shape (12,), not (T, Q)"),
    (_replace("qpos", lambda x: x.astype(np.float32)), "'qpos' is float32, not float64"),
    (
        _replace("images/top/offset", lambda x: x[:-1]),
        "'images/top' cannot be read: 11 frames inst",
    ),
    (lambda file: file["qpos"].attrs.__setitem__("unit", "cm"), "'qpos' is in 'cm', not in 'm, "),
    (_assign("qvel", (5, 1), np.nan), "'qvel' is NaN or infinite, first at step 5"),
    (_assign("action", (7, 0), -np.inf), "'action' is NaN or infinite, first at step 7"),
    (_assign("head_orientation", 6, 0.7), "'head_orientation' is no unit quaternion at step 6"),
    (_assign("object_pose", (2, 3), 5), "'object_pose' is no unit quaternion at step 2"),
    (_assign("time", 4, 0.0), "'time' does not increase at step 4"),
    (_assign("jaw_opening", 4, -0.01), "'jaw_opening' is negative at step 4"),
    (_assign("phase", 8, 3), "'phase' is 3 at step 8, of 3 phases"),
    (_attribute("schema", "lerobot"), "no episode: schema 'lerobot'"),
    (_attribute("schema_version", np.int64(9)), "schema version 9; this release reads 1, 2"),
    (_attribute("seed", "x"), "attribute 'seed' is no int"),
    (_attribute("versions", "{"), "attribute 'versions' cannot be read"),
    (_attribute("num_steps", np.int64(13)), "attribute 'num_steps' says 13, but 'time' has 12"),
    (_attribute("expert", "another"), "do not fit 'content_sha256'"),
    (lambda file: file["qpos"].__setitem__((0, 0), 0.5), "do not fit 'content_sha256'"),
    (swap_frame, "frame 4 of 'top' cannot be read: its checksum is wrong"),
    (_frame(np.frombuffer(b"no image", np.uint8)), "frame 4 of 'top' cannot be decoded"),
    (_frame(make_images()["top"][4][:0]), "frame 4 of 'top' cannot be decoded"),
    (_frame(encode_image(make_frames(size=(24, 30))[0])), "frame 4 of 'top' is (24, 30, 3)"),
]


@pytest.mark.parametrize(("damage", "message"), DAMAGE)
def test_damage_is_found_and_named(
    tmp_path: Path, damage: Callable[[h5py.File], Any], message: str
) -> None:
    write(tmp_path, 2)
    path = write(tmp_path, 3)
    with h5py.File(path, "a") as file:
        damage(file)
    problems = [problem for problem in verify_file(path) if not problem.is_warning]
    assert any(message in str(problem) for problem in problems), problems
    for problem in problems:
        assert str(problem).startswith(f"{path}: ")
        assert "\n" not in str(problem)
        assert problem in verify_dataset(tmp_path)
    assert {problem.path for problem in verify_dataset(tmp_path)} == {path}


@pytest.mark.parametrize("codec", ["jpeg", "png", "raw"])
def test_whole_files_pass(tmp_path: Path, codec: str) -> None:
    for seed in range(3):
        write(tmp_path, seed, success=seed != 1, codec=codec)
    assert verify_dataset(tmp_path) == []
    assert damage_summary(tmp_path, []).endswith("2 demonstrations and 1 failures, all whole")


@pytest.mark.parametrize("contents", [b"", b"text", b"\x89HDF\r\n\x1a\n"])
def test_what_is_no_hdf5_file(tmp_path: Path, contents: bytes) -> None:
    path = tmp_path / "episode_000003.hdf5"
    path.write_bytes(contents)
    (problem,) = verify_file(path)
    assert "no HDF5 file" in str(problem)


def test_missing_file(tmp_path: Path) -> None:
    (problem,) = verify_file(tmp_path / "episode_000003.hdf5")
    assert problem.message == "no file"


def test_without_images_frames_are_not_read(tmp_path: Path) -> None:
    path = write(tmp_path)
    with h5py.File(path, "a") as file:
        swap_frame(file)
    assert verify_file(path, images=False) == []
    assert len(verify_file(path)) == 1


def test_unknown_keys_are_warnings(tmp_path: Path) -> None:
    path = write(tmp_path)
    with h5py.File(path, "a") as file:
        file["reward"] = np.zeros(12)
        file["images/wrist"] = np.zeros(12)
        file.attrs["comment"] = "mine"
    problems = verify_file(path)
    assert all(problem.is_warning for problem in problems)
    assert [str(problem).split(": ", 1)[1] for problem in problems] == [
        "warning: unknown key 'reward'",
        "warning: unknown attribute 'comment'",
        "warning: unknown key 'images/wrist'",
    ]


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("env_id", "robo_manip_baselines/OtherEnv-v0"),
        ("env_kwargs", {"arms": "both"}),
        ("xml_hash", "1" * 64),
        ("control_period", 0.04),
        ("action_names", list("abcdefg")),
    ],
)
@pytest.mark.usefixtures("other_task")
def test_mixed_folder(tmp_path: Path, name: str, value: object) -> None:
    for seed in range(3):
        write(tmp_path, seed)
    odd = write(tmp_path, 7, **{name: value})
    (problem,) = verify_dataset(tmp_path)
    assert problem.path == odd
    assert problem.message.startswith(f"{name} is ")
    assert "in 3 other files" in problem.message


def test_mixed_cameras(tmp_path: Path) -> None:
    for seed in range(2):
        write(tmp_path, seed)
    odd = write_episode(episode_path(tmp_path, 2, True), make_arrays(), {}, make_attributes(2))
    assert {problem.path for problem in verify_dataset(tmp_path)} == {odd}


def test_misplaced_files(tmp_path: Path) -> None:
    for seed in range(3):
        write(tmp_path, seed)
    copy = tmp_path / "episode_000009.hdf5"
    shutil.copy(tmp_path / "episode_000001.hdf5", copy)
    failure = write(tmp_path, 5, success=False).rename(tmp_path / "episode_000005.hdf5")
    found = {(problem.path, problem.message) for problem in verify_dataset(tmp_path)}
    assert found == {
        (copy, "holds seed 1, which its name does not say"),
        (copy, f"seed 1 is also in {tmp_path / 'episode_000001.hdf5'}"),
        (failure, "is a failure; it belongs in failed/"),
    }
    again = write(tmp_path, 2, success=False)
    assert any(problem.path == again for problem in verify_dataset(tmp_path))


def test_leftovers_are_warnings(tmp_path: Path) -> None:
    write(tmp_path)
    (tmp_path / ".episode_000004.hdf5.77.partial").touch()
    (problem,) = verify_dataset(tmp_path)
    assert problem.is_warning
    assert damage_summary(tmp_path, [problem]).endswith("1 demonstrations, all whole, 1 warnings")


def test_folder_without_episodes_is_a_wrong_request(tmp_path: Path) -> None:
    with pytest.raises(RequestError, match="holds no episode_"):
        verify_dataset(tmp_path)
    with pytest.raises(RequestError, match="is no folder"):
        verify_dataset(tmp_path / "x")


@pytest.fixture(scope="module", params=["jpeg", "raw"])
def whole(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Any:
    path = write(tmp_path_factory.mktemp("whole"), codec=request.param)
    return path.read_bytes(), list(contents(path)), path.parent / "damaged.hdf5"


def contents(path: Path) -> Iterator[tuple[str, str]]:
    """All that a reader can get out of a file."""
    with EpisodeReader(path) as episode:
        yield from ((name, repr(value)) for name, value in episode.attributes.items())
        for name, array in episode.arrays.items():
            yield name, f"{array.dtype}{array.shape}{array.tobytes().hex()}"
        for camera in episode.cameras:
            for step in range(len(episode)):
                yield f"{camera} {step}", episode.encoded_frame(camera, step).tobytes().hex()


FUZZ = settings(
    max_examples=int(os.environ.get("FUZZ_EXAMPLES", "80")),
    deadline=None,
    derandomize=True,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)


@FUZZ
@given(fraction=st.floats(0, 1, exclude_max=True))
def test_truncation_is_found(whole: Any, fraction: float) -> None:
    data, _, path = whole
    path.write_bytes(data[: int(len(data) * fraction)])
    assert verify_file(path)


@FUZZ
@given(position=st.floats(0, 1, exclude_max=True), flip=st.integers(1, 255))
def test_changed_byte_is_found_or_without_effect(whole: Any, position: float, flip: int) -> None:
    data, truth, path = whole
    damaged = bytearray(data)
    damaged[int(len(data) * position)] ^= flip
    path.write_bytes(bytes(damaged))
    if not any(not problem.is_warning for problem in verify_file(path)):
        assert list(contents(path)) == truth


@FUZZ
@given(start=st.floats(0, 1, exclude_max=True), length=st.integers(1, 4096), fill=st.binary())
def test_overwritten_block_is_found_or_without_effect(
    whole: Any, start: float, length: int, fill: bytes
) -> None:
    data, truth, path = whole
    first = int(len(data) * start)
    last = min(first + length, len(data))
    block = (fill or b"\0") * (length // max(len(fill), 1) + 1)
    path.write_bytes(data[:first] + block[: last - first] + data[last:])
    if not any(not problem.is_warning for problem in verify_file(path)):
        assert list(contents(path)) == truth
