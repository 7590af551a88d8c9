"""Episodes from elsewhere: links, sizes, attributes and edits are refused before data are used."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from robo_manip_baselines.data import EpisodeFileError, EpisodeReader, episode_path, write_episode
from robo_manip_baselines.data.demonstrations import load_demonstrations
from robo_manip_baselines.data.example import make_arrays, make_attributes, make_images
from robo_manip_baselines.data.schema import (
    EpisodeSchema,
    content_digest,
    loaded_attribute,
    stored_text,
)
from robo_manip_baselines.data.verify import verify_dataset, verify_file
from robo_manip_baselines.envs.mujoco.face.motion import MotionLibrary
from robo_manip_baselines.envs.mujoco.tasks.registry import ENV_ARGUMENTS, task_entry
from robo_manip_baselines.observation import ObservationSpec
from robo_manip_baselines.runs.errors import RequestError

SPEC = ObservationSpec(obs="current", cameras=())
SCHEMA = EpisodeSchema.of(task_entry("FeedingEnv"))


def write(folder: Path, seed: int = 3, *, cameras: tuple[str, ...] = ("top",)) -> Path:
    images = make_images(cameras=cameras)
    path = episode_path(folder, seed, success=True)
    return write_episode(path, make_arrays(seed=seed), images, make_attributes(seed))


def seal(path: Path) -> None:
    """Make the digest right again, as somebody who knows the format would."""
    with h5py.File(path, "a") as file:
        names = SCHEMA.fields_of(int(file.attrs["schema_version"]))
        arrays = {name: file[name][()] for name in names}
        checksums = {name: group["checksum"][()] for name, group in file["images"].items()}
        known = SCHEMA.attributes_of(int(file.attrs["schema_version"]), file.attrs)
        attributes = {i.name: loaded_attribute(i, file.attrs[i.name]) for i in known}
        digest = content_digest(SCHEMA, arrays, checksums, attributes)
        file.attrs["content_sha256"] = stored_text(digest)


def soft_link(file: h5py.File) -> None:
    file.move("action", "hidden")
    file["action"] = h5py.SoftLink("/hidden")


def external_link(file: h5py.File) -> None:
    other = Path(file.filename).with_name("other.h5")
    with h5py.File(other, "w") as store:
        store["action"] = file["action"][()]
    del file["action"]
    file["action"] = h5py.ExternalLink(str(other), "action")


def virtual(file: h5py.File) -> None:
    other = Path(file.filename).with_name("other.h5")
    with h5py.File(other, "w") as store:
        store["action"] = file["action"][()]
    layout = h5py.VirtualLayout(file["action"].shape, file["action"].dtype)
    layout[:] = h5py.VirtualSource(str(other), "action", file["action"].shape)
    del file["action"]
    file.create_virtual_dataset("action", layout)


def external_storage(file: h5py.File) -> None:
    values = file["action"][()]
    other = Path(file.filename).with_name("other.bin")
    other.write_bytes(values.tobytes())
    del file["action"]
    place = [(str(other), 0, values.nbytes)]
    file.create_dataset("action", values.shape, values.dtype, external=place)


def replaced(**options: Any) -> Callable[[h5py.File], None]:
    """Replace ``action`` by a dataset made with these options."""

    def change(file: h5py.File) -> None:
        del file["action"]
        file.create_dataset("action", **options)

    return change


def linked_cameras(file: h5py.File) -> None:
    file["images/wrist"] = h5py.ExternalLink("other.h5", "/")


def attribute(name: str, value: Any) -> Callable[[h5py.File], None]:
    return lambda file: file.attrs.__setitem__(name, value)


HUGE = 40_000_000
PLACES: list[tuple[Callable[[h5py.File], Any], str]] = [
    (soft_link, "'action' is a link to another place or file"),
    (external_link, "'action' is a link to another place or file"),
    (lambda f: f.__setitem__("extra", h5py.ExternalLink("x.h5", "/")), "'extra' is a link"),
    (virtual, "'action' has its data in another file"),
    (external_storage, "'action' has its data in another file"),
    (replaced(data=[b"text"] * 12), "'action' holds no plain numbers"),
    (replaced(data=["text"] * 12), "'action' holds no plain numbers"),
    (replaced(shape=(12,), dtype=h5py.vlen_dtype("f8")), "'action' holds no plain numbers"),
    (replaced(shape=(12,), dtype=h5py.ref_dtype), "'action' holds no plain numbers"),
    (replaced(shape=(12, 7), dtype=[("x", "f8")]), "'action' holds no plain numbers"),
    (replaced(shape=(12, 7), dtype="c16"), "'action' holds no plain numbers"),
    (replaced(data=h5py.Empty("f8")), "'action' holds no plain numbers"),
    (replaced(shape=(HUGE, 7), dtype="f8", chunks=(1024, 7)), "declares 2240000000 bytes"),
    (replaced(shape=(HUGE, 7), dtype="f8"), "declares 2240000000 bytes"),
    (replaced(data=np.zeros((12, 7)), chunks=(4, 7), compression="lzf"), "other than gzip"),
    (
        replaced(data=np.zeros((12, 7)), chunks=(2**15, 7), maxshape=(None, 7)),
        "'action' has chunks of 1835008 bytes",
    ),
    (replaced(data=np.zeros((0, 7))), "'action' has T=0 where 'time' has T=12"),
    (replaced(data=np.zeros((12, 7), "f4")), "'action' is float32, not float64"),
    (attribute("seed", np.zeros(2**14, "i8")), "attribute 'seed' is no int"),
    (attribute("seed", ["a", "b"]), "attribute 'seed' is neither a number nor text"),
    (attribute("seed", h5py.Empty("i8")), "attribute 'seed' "),
    (attribute("expert", np.bytes_(b"\xff\xfe")), "utf-8"),
]


def problem_of(path: Path) -> str:
    """Return the message with which training refuses a file; `verify` must find it, too."""
    with pytest.raises(EpisodeFileError) as caught:
        load_demonstrations(path.parent, SPEC)
    message = str(caught.value)
    assert str(path) in message
    assert "\n" not in message
    assert any(not problem.is_warning for problem in verify_file(path))
    return message


@pytest.mark.parametrize(("change", "message"), PLACES)
def test_only_plain_arrays_of_the_file_itself_are_read(
    tmp_path: Path, change: Callable[[h5py.File], Any], message: str
) -> None:
    path = write(tmp_path)
    with h5py.File(path, "a") as file:
        change(file)
    assert message in problem_of(path)
    assert any(message in str(problem) for problem in verify_file(path))


def test_cameras_that_lie_elsewhere_are_found(tmp_path: Path) -> None:
    path = write(tmp_path)
    with h5py.File(path, "a") as file:
        linked_cameras(file)
    (problem,) = verify_file(path)
    assert "'wrist' is a link to another place or file" in str(problem)


def test_sizes_are_bounded_before_anything_is_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Every array agrees on a number of rows that no episode has."""
    path = write(tmp_path, cameras=())
    with h5py.File(path, "a") as file:
        for name in [name for name in file if name != "images"]:
            shape, dtype, given = file[name].shape[1:], file[name].dtype, dict(file[name].attrs)
            del file[name]
            rows = np.zeros((200_000, *shape), dtype)
            file.create_dataset(name, data=rows, compression="gzip", chunks=(10_000, *shape))
            file[name].attrs.update(given)
        file.attrs["num_steps"] = np.int64(180_000)

    def forbidden(*_: object) -> None:
        raise AssertionError("data were read")

    monkeypatch.setattr("robo_manip_baselines.data.episode.read_whole", forbidden)
    monkeypatch.setattr("robo_manip_baselines.data.verify.read_whole", forbidden)
    assert "'time' has T=200000, more than 180000" in problem_of(path)


TEXT = 'attribute "{}"'
ATTRIBUTES: list[tuple[str, Any, str]] = [
    ("num_steps", -1, "must be 1 to 180000"),
    ("num_steps", 0, "must be 1 to 180000"),
    ("num_steps", 2**62, "must be 1 to 180000"),
    ("num_steps", 11, "says 11, but 'time' has 12"),
    ("seed", -1, "must be 0 or more"),
    ("control_period", 0.0, "must be positive"),
    ("control_period", float("nan"), "must be positive"),
    ("prediction_period", float("inf"), "must be positive"),
    ("completion_time", -1.0, "must be 0 or more"),
    ("env_kwargs", [], "must be an object with names of arguments"),
    ("env_kwargs", "FeedingEnv", "must be an object with names of arguments"),
    ("env_kwargs", {"id": "other"}, "has 'id', which is no argument of the environment"),
    ("env_kwargs", {"max_episode_steps": 3}, "has 'max_episode_steps'"),
    ("env_kwargs", {"self": 1}, "has 'self'"),
    ("env_kwargs", {"cameras": "top"}, "has cameras 'top', not of type list"),
    ("env_kwargs", {"cameras": [1]}, "not a list of type str"),
    ("env_kwargs", {"corruption": "uniform"}, "has corruption 'uniform', not of type dict"),
    ("env_kwargs", {"horizon": True}, "has horizon 'True', not of type int"),
    ("env_kwargs", {"image_size": [3]}, "not height and width"),
    ("env_kwargs", {"image_size": [3.5, 4]}, "not a list of type int"),
    ("env_kwargs", {"render_mode": "human"}, "a render_mode that opens windows"),
    ("cameras", ["nose"], "must be a list of some of top, angle, front_close"),
    ("cameras", "top", "must be a list of some of"),
    ("cameras", ["top", "top"], "must be a list of some of"),
    ("joint_names", [], "must be a list of different names"),
    ("action_names", [1, 2], "must be a list of different names"),
    ("phase_names", {}, "must be a list of different names"),
    ("phase_names", ["x"] * 3, "must be a list of different names"),
    ("image_size", [24], "must be height and width, at most 8192"),
    ("image_size", [24, 10**9], "must be height and width, at most 8192"),
    ("image_size", [-1, 32], "must be height and width, at most 8192"),
    ("image_codec", "gif", "must be one of jpeg, png, raw"),
    ("versions", {"python": 3}, "must be an object of texts"),
    ("xml_hash", "0", "must be 64 hexadecimal digits"),
]


@pytest.mark.parametrize(("name", "value", "message"), ATTRIBUTES)
def test_attributes_are_typed_and_in_range(
    tmp_path: Path, name: str, value: Any, message: str
) -> None:
    path = write(tmp_path)
    kind = SCHEMA.attribute_by_name[name].kind
    number = {"int": np.int64, "float": np.float64}.get(kind)
    stored = (
        number(value) if number else stored_text(value if kind == "text" else json.dumps(value))
    )
    with h5py.File(path, "a") as file:
        file.attrs[name] = stored
    seal(path)
    found = problem_of(path)
    assert message in found
    assert name in found


@pytest.mark.parametrize("text", ["[" * 100_000, "{", '{"a": NaN', "1" * 5000])
def test_attributes_that_are_no_json_are_refused(tmp_path: Path, text: str) -> None:
    path = write(tmp_path)
    with h5py.File(path, "a") as file:
        file.attrs["env_kwargs"] = stored_text(text)
    assert "env_kwargs" in problem_of(path)


def test_known_arguments_are_those_of_the_environment() -> None:
    import inspect

    from robo_manip_baselines.envs.mujoco.tasks.face_env import FaceEnv

    parameters = inspect.signature(FaceEnv).parameters.values()
    named = {item.name for item in parameters if item.kind is not item.VAR_KEYWORD}
    assert set(ENV_ARGUMENTS) - {"error"} == named


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda f: f["action"].__setitem__((3, 6), 0.021), "was changed after it was recorded"),
        (lambda f: f["qvel"].__setitem__((3, 6), 0.5), "was changed after it was recorded"),
        (attribute("motion_subject", stored_text("x")), "was changed after it was recorded"),
        (lambda f: f["images/top/checksum"].__setitem__(0, 1), "was changed after it was recorded"),
        (lambda f: f["joint_velocity"].__setitem__((10, 2), np.nan), "'joint_velocity' is NaN or"),
        (lambda f: f["qpos"].__setitem__((10, 2), np.inf), "'qpos' is NaN or infinite, first at"),
        (lambda f: f["time"].__setitem__(4, 0.0), "'time' does not increase at step 4"),
    ],
)
def test_an_edit_in_place_is_refused_when_demonstrations_are_loaded(
    tmp_path: Path, change: Callable[[h5py.File], Any], message: str
) -> None:
    write(tmp_path, 2)
    path = write(tmp_path, 3)
    before = load_demonstrations(tmp_path, SPEC).content_hash
    with h5py.File(path, "a") as file:
        change(file)
    assert message in problem_of(path)
    write(tmp_path, 3)
    assert load_demonstrations(tmp_path, SPEC).content_hash == before


def test_the_content_hash_is_of_what_was_read(tmp_path: Path) -> None:
    path = write(tmp_path)
    before = load_demonstrations(tmp_path, SPEC)
    with h5py.File(path, "a") as file:
        file["action"][3, 6] = 0.021
    seal(path)
    after = load_demonstrations(tmp_path, SPEC)
    assert after.content_hash != before.content_hash
    assert not np.array_equal(after.action, before.action)


def test_each_array_is_read_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from robo_manip_baselines.data import episode

    path = write(tmp_path, cameras=())
    names: list[str] = []
    read = episode.read_whole
    monkeypatch.setattr(
        episode, "read_whole", lambda item: (names.append(item.name), read(item))[1]
    )
    load_demonstrations(tmp_path, SPEC)
    with EpisodeReader(path) as reader:
        assert sorted(names) == sorted(f"/{name}" for name in reader.fields)


HOLD = "import h5py, sys; f = h5py.File(sys.argv[1], 'r+'); print('open', flush=True); input()"


def test_an_episode_that_another_program_writes_is_in_use(tmp_path: Path) -> None:
    path = write(tmp_path)
    other = subprocess.Popen(
        [sys.executable, "-c", HOLD, str(path)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        env={**os.environ, "OMP_NUM_THREADS": "1"},
    )
    try:
        assert other.stdout is not None
        other.stdout.readline()
        message = problem_of(path)
        (problem,) = verify_dataset(tmp_path)
        assert "in use: another program holds it open for writing" in message
        assert "in use: another program holds it open for writing" in str(problem)
        assert "damaged" not in f"{message} {problem}"
    finally:
        other.communicate(b"\n")
    assert verify_dataset(tmp_path) == []
    assert load_demonstrations(tmp_path, SPEC).seeds == (3,)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda g: g["offset"].__setitem__(3, -5), "a frame of -"),
        (lambda g: g["offset"].__setitem__(12, 2**40), "do not divide its bytes"),
        (lambda g: g["offset"].__setitem__(0, 7), "do not divide its bytes"),
    ],
)
def test_places_of_images_are_checked(
    tmp_path: Path, change: Callable[[h5py.Group], Any], message: str
) -> None:
    path = write(tmp_path)
    with h5py.File(path, "a") as file:
        change(file["images/top"])
    assert message in problem_of(path)
    with pytest.raises(RequestError, match=message), EpisodeReader(path) as episode:
        episode.frame("top", 0)


def test_episodes_of_one_library_belong_together_whatever_its_path(tmp_path: Path) -> None:
    def record(seed: int, **kwargs: Any) -> None:
        given = make_attributes(seed) | {"env_kwargs": kwargs}
        write_episode(episode_path(tmp_path, seed, True), make_arrays(seed=seed), {}, given)

    one, other = "1" * 64, "2" * 64
    record(0, motion_library="/a.npz", motion_sha256=one)
    record(1, motion_library="/b.npz", motion_sha256=one)
    assert load_demonstrations(tmp_path, SPEC).env_kwargs["motion_sha256"] == one
    assert verify_dataset(tmp_path) == []
    record(1, motion_library="/a.npz", motion_sha256=other)
    with pytest.raises(RequestError, match=r'env_kwargs \{"motion_sha256": "222'):
        load_demonstrations(tmp_path, SPEC)
    record(0)
    record(1, motion_library="/a.npz", motion_sha256=MotionLibrary.load().sha256)
    assert load_demonstrations(tmp_path, SPEC).seeds == (0, 1)
