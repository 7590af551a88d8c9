"""Images of steps: the same pixels however they are kept, and damage never goes unseen."""

from __future__ import annotations

import threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import h5py
import numpy as np
import pytest

from robo_manip_baselines.data import EpisodeReader, episode_path, write_episode
from robo_manip_baselines.data.demonstrations import Demonstrations, load_demonstrations
from robo_manip_baselines.data.example import make_arrays, make_attributes, make_images
from robo_manip_baselines.observation import ObservationSpec
from robo_manip_baselines.observation.images import fit_image
from robo_manip_baselines.runs.errors import RequestError
from robo_manip_baselines.runs.memory import free_memory
from robo_manip_baselines.training import images as images_module
from robo_manip_baselines.training.images import ImageStore

# Not the order in which files keep them.
CAMERAS = ("top", "angle", "front_close")
LENGTHS = (5, 3, 8)


def load(
    folder: Path, codec: str = "jpeg", size: tuple[int, int] = (24, 32)
) -> tuple[Demonstrations, np.ndarray]:
    """Make three episodes; return them, and all their images, read one by one."""
    spec = ObservationSpec(cameras=CAMERAS, image_size=size)
    for seed, steps in enumerate(LENGTHS):
        write_episode(
            episode_path(folder, seed, success=True),
            make_arrays(steps, seed),
            # Rotated, so that no two episodes show the same at the same step.
            {c: v[seed:] + v[:seed] for c, v in make_images(steps, codec, CAMERAS).items()},
            make_attributes(seed, codec=codec),
        )
    loaded = load_demonstrations(folder, spec)
    images = []
    for path in loaded.paths:
        with EpisodeReader(path) as episode:
            steps = range(len(episode))
            images += [[fit_image(episode.frame(c, t), size) for c in CAMERAS] for t in steps]
    return loaded, np.array(images)


@pytest.mark.parametrize("codec", ["jpeg", "png", "raw"])
@pytest.mark.parametrize("is_held", [True, False])
@pytest.mark.parametrize("size", [(24, 32), (8, 16)])
def test_images_are_those_of_the_files(
    tmp_path: Path, codec: str, is_held: bool, size: tuple[int, int]
) -> None:
    loaded, images = load(tmp_path, codec, size)
    budget = images.nbytes if is_held else images.nbytes - 1
    with ImageStore(loaded, memory_budget=budget, threads=3) as source:
        assert (source.held is not None) == is_held
        assert source.shape == (3, *size, 3)
        rows = np.array([15, 0, 5, 4, 7, 7, 8])
        np.testing.assert_array_equal(source.images(rows), images[rows], strict=True)
        out = np.zeros((2, *source.shape), np.uint8)
        assert source.images(np.array([6, 1]), out=out) is out
        np.testing.assert_array_equal(out, images[[6, 1]])
        for wrong in (-1, 16):
            with pytest.raises(IndexError, match="rows 0 to 15, not"):
                source.images(np.array([0, wrong]))


@pytest.mark.parametrize("is_held", [True, False])
def test_damage_is_an_error_that_names_the_frame(tmp_path: Path, is_held: bool) -> None:
    loaded, _ = load(tmp_path)
    with h5py.File(loaded.paths[1], "r+") as file:
        data = file["images/angle/data"]
        offset = file["images/angle/offset"][2]
        data[offset + 40] ^= 1
    message = "episode_000001.hdf5': frame 2 of 'angle' .*checksum is wrong"
    if is_held:
        with pytest.raises(RequestError, match=message):
            ImageStore(loaded)
    else:
        with ImageStore(loaded, memory_budget=0) as source:
            source.images(np.array([6]))
            with pytest.raises(RequestError, match=message):
                source.images(np.array([6, 7]))


def test_an_image_that_is_none_names_the_frame(tmp_path: Path) -> None:
    images = make_images(4, cameras=CAMERAS)
    images["top"][2] = np.arange(50, dtype=np.uint8)
    path = episode_path(tmp_path, 0, success=True)
    write_episode(path, make_arrays(4), images, make_attributes(0))
    loaded = load_demonstrations(tmp_path, ObservationSpec(cameras=("top",), image_size=(24, 32)))
    with (
        ImageStore(loaded, memory_budget=0) as source,
        pytest.raises(RequestError, match=r"frame 2 of 'top' .*: no image"),
    ):
        source.images(np.arange(4))


def test_few_files_may_be_open(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(images_module, "MAX_OPEN_FILES", 2)
    opened: list[Path] = []

    class Counted(EpisodeReader):
        def __init__(self, path: Path) -> None:
            super().__init__(path)
            opened.append(path)

    monkeypatch.setattr(images_module, "EpisodeReader", Counted)
    loaded, images = load(tmp_path)
    with ImageStore(loaded, memory_budget=0) as source:
        for rows in ([0, 6, 1], [7, 2], [9], [8, 3, 6]):
            np.testing.assert_array_equal(source.images(np.array(rows)), images[rows])
    # Episode 2 takes the place of 1, unused for longer than 0; 1 is opened anew, 0 is not.
    assert [loaded.paths.index(path) for path in opened] == [0, 1, 2, 1]


def test_many_threads_may_ask(tmp_path: Path) -> None:
    loaded, images = load(tmp_path)
    rng = np.random.default_rng(0)
    asked = [rng.integers(0, sum(LENGTHS), 4) for _ in range(60)]
    with ImageStore(loaded, memory_budget=0, threads=2) as source, ThreadPoolExecutor(6) as pool:
        for rows, got in zip(asked, pool.map(source.images, asked), strict=True):
            np.testing.assert_array_equal(got, images[rows])


def test_nothing_is_left_running(tmp_path: Path) -> None:
    loaded, _ = load(tmp_path)
    before = threading.active_count()
    for budget in (0, None):
        source = ImageStore(loaded, memory_budget=budget)
        source.images(np.arange(9))
        source.close()
        source.close()
        assert threading.active_count() == before


def test_without_cameras_there_is_no_source(tmp_path: Path) -> None:
    load(tmp_path)
    with pytest.raises(RequestError, match="no images without a camera"):
        ImageStore(load_demonstrations(tmp_path, ObservationSpec(cameras=())))


def test_free_memory_is_known_and_sensible() -> None:
    assert 2**20 < free_memory() < 2**50
