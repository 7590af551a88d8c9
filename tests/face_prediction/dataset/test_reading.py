"""Datasets that break a promise are refused when they are read."""

from __future__ import annotations

import json

import h5py
import numpy as np
import pytest

from face_prediction.dataset.clip_file import content_digest, read_record
from face_prediction.dataset.reader import FaceDataset
from robo_manip_baselines.runs.errors import RequestError

pytestmark = pytest.mark.long


def damage_manifest(folder, change) -> None:
    path = folder.root / "dataset" / "dataset.json"
    data = json.loads(path.read_text())
    change(data)
    path.write_text(json.dumps(data))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda d: d.update(version=2), "version 2, this release reads 'face_dataset' 1"),
        (lambda d: d.update(schema="episode"), "schema 'episode'"),
        (lambda d: d["settings"].pop("margin"), "settings: margin: is missing"),
        (lambda d: d["clips"][0].pop("fold"), r"clips\[0\]\.fold: is missing"),
        (lambda d: d["clips"][0].update(fold=7), "is in fold 7, there are 3"),
        (lambda d: d["clips"][1].update(fold=(d["clips"][3]["fold"] + 1) % 3), "in two folds"),
        (lambda d: d["clips"][1].update(clip="two"), "a clip is there twice"),
        (lambda d: d["clips"][1].update(clip="../one"), "is no name of a clip"),
        (lambda d: d.update(folds="many"), "folds: must be a whole number"),
    ],
)
def test_a_dataset_that_breaks_a_promise_is_refused(folder, change, message) -> None:
    assert folder.run() == 0
    damage_manifest(folder, change)
    with pytest.raises(RequestError, match=message):
        FaceDataset(folder.root / "dataset")


def test_clip_files_of_another_making_are_refused(folder) -> None:
    assert folder.run() == 0
    assert folder.run("--margin", 0.3, out="wider") == 0
    folder.clip("one").write_bytes(folder.clip("one", "wider").read_bytes())
    first = 6  # after grid_a's six
    with (
        FaceDataset(folder.root / "dataset") as dataset,
        pytest.raises(RequestError, match=r"one\.h5: its settings are not those of the dataset"),
    ):
        dataset.read(first)
    with h5py.File(folder.clip("one"), "a") as file:
        file.attrs["version"] = 9
    with (
        FaceDataset(folder.root / "dataset") as dataset,
        pytest.raises(RequestError, match=r"one\.h5: schema 'face_dataset_clip' version 9"),
    ):
        dataset.read(first)
    folder.clip("one").unlink()
    with (
        FaceDataset(folder.root / "dataset") as dataset,
        pytest.raises(RequestError, match=r"one\.h5: no such file"),
    ):
        dataset.read(first)


def test_no_changed_byte_of_a_picture_goes_unseen(folder) -> None:
    assert folder.run() == 0
    path = folder.clip("one")
    with FaceDataset(folder.root / "dataset") as dataset:
        first = 6
        whole = dataset.read(first)
    content = path.read_bytes()
    with h5py.File(path, "r") as file:
        encoded = file["pictures/data"][:4000].tobytes()  # type: ignore[index]
    place = content.index(encoded[100:200])
    rng = np.random.default_rng(0)
    for offset in rng.integers(0, 100, 5):
        damaged = bytearray(content)
        damaged[place + int(offset)] ^= 0x10
        path.write_bytes(damaged)
        with (
            FaceDataset(folder.root / "dataset") as dataset,
            pytest.raises(RequestError, match=r"one\.h5: .*damaged"),
        ):
            dataset.read(first)
    path.write_bytes(content[: len(content) // 2])
    with (
        FaceDataset(folder.root / "dataset") as dataset,
        pytest.raises(RequestError, match=r"one\.h5: damaged"),
    ):
        dataset.read(first)
    path.write_bytes(content)
    with FaceDataset(folder.root / "dataset") as dataset:
        np.testing.assert_array_equal(dataset.read(first).images, whole.images)


def test_pictures_have_checksums_of_their_own(folder) -> None:
    """Bytes changed through HDF5, whose own checksums then agree."""
    assert folder.run() == 0
    with h5py.File(folder.clip("one"), "a") as file:
        data = file["pictures/data"]
        assert isinstance(data, h5py.Dataset)
        data[300] ^= 1
    with (
        FaceDataset(folder.root / "dataset") as dataset,
        pytest.raises(RequestError, match=r"one\.h5: image 0: damaged \(its checksum is wrong"),
    ):
        dataset.images(6)


def _external(file: h5py.File) -> None:
    del file["frames/mouth"]
    file["frames/mouth"] = h5py.ExternalLink("other.h5", "/mouth")


def _huge(file: h5py.File) -> None:
    del file["frames/mouth"]
    file.create_dataset("frames/mouth", (10**9, 3), "f8", chunks=(1000, 3))


def test_clip_files_that_were_changed_are_refused(folder) -> None:
    """Through HDF5, whose own checksums then agree."""
    assert folder.run() == 0
    path = folder.clip("one")
    content = path.read_bytes()
    for change, message in (
        (lambda file: file["frames/mouth"].__setitem__((3, 1), 0.5), "was changed after it was"),
        (lambda file: file["sequences/start"].__setitem__(0, 10**6), "was changed after it was"),
        (lambda file: file["pictures/checksum"].__setitem__(0, 1), "was changed after it was"),
        (_external, "'frames/mouth' is a link to another place or file"),
        (_huge, "declares 24000000000 bytes"),
        (lambda file: file.attrs.__setitem__("record", "[" * 100_000), "damaged"),
    ):
        with h5py.File(path, "a") as file:
            change(file)
        with (
            FaceDataset(folder.root / "dataset") as dataset,
            pytest.raises(RequestError, match=message) as caught,
        ):
            dataset.read(6)
        assert str(caught.value).startswith(f"{path}: ")
        assert "\n" not in str(caught.value)
        path.write_bytes(content)
    # A whole file of another content, in its place: the manifest knows.
    with h5py.File(path, "a") as file:
        file["frames/mouth"][3, 1] = 0.5  # type: ignore[index]
        record = {**read_record(path, file), "content_sha256": content_digest(path, file)}
        kept = {name: record[name] for name in json.loads(str(file.attrs["record"]))}
        file.attrs["record"] = json.dumps(kept, sort_keys=True)
    with (
        FaceDataset(folder.root / "dataset") as dataset,
        pytest.raises(RequestError, match=r"its frames are not those of the dataset"),
    ):
        dataset.read(6)
