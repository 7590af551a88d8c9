"""Images: what a policy is trained on is, pixel by pixel, what an environment shows it."""

from __future__ import annotations

import contextlib
import json
from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np
import pytest

from robo_manip_baselines.data import EpisodeReader, episode_path, write_episode
from robo_manip_baselines.data.demonstrations import Demonstrations, load_demonstrations
from robo_manip_baselines.data.example import make_arrays, make_attributes, make_images
from robo_manip_baselines.envs.mujoco.tasks.registry import make_env, task_entry, task_names
from robo_manip_baselines.observation import ObservationSpec
from robo_manip_baselines.observation.images import fit_image
from robo_manip_baselines.rollout.demonstrate import demonstrate
from robo_manip_baselines.rollout.workers import EnvConfig, StepRequest, open_envs
from robo_manip_baselines.runs.errors import RequestError
from robo_manip_baselines.training.images import ImageStore

CAMERAS = ("top", "front_close")
"""Not the order in which files keep them."""

RECORDED = (480, 640)
SHOWN = ((240, 320), (224, 224), (120, 120), (60, 80), (96, 128), (60, 200), RECORDED)


def test_an_image_of_the_size_is_returned_as_it_is() -> None:
    image = np.zeros((8, 12, 3), np.uint8)
    assert fit_image(image, (8, 12)) is image


def test_pixels_are_means_of_the_area_they_stand_for() -> None:
    image = np.random.default_rng(0).integers(0, 256, (8, 12, 3), dtype=np.uint8)
    square = image[:, 2:10].reshape(4, 2, 4, 2, 3).mean(axis=(1, 3))
    # Rounding, in OpenCV of halves to even.
    assert np.abs(fit_image(image, (4, 4)) - square).max() <= 0.5


@pytest.mark.parametrize("size", [(4, 4), (2, 6), (8, 2), (1, 12), (5, 5), (7, 11), (1, 1)])
def test_nothing_is_squashed(size: tuple[int, int]) -> None:
    """Rows and columns keep their scale: ramps keep their slope, about the same centre."""
    rows, columns = np.mgrid[:240, :360].astype(np.float64)
    image = np.stack([rows, columns * 240 / 360, rows], axis=-1).round().astype(np.uint8)
    shown = fit_image(image, size).astype(np.float64)
    assert shown.shape == (*size, 3)
    assert shown[..., 0].mean() == pytest.approx(119.5, abs=1)
    assert shown[..., 1].mean() == pytest.approx(119.5, abs=1.5)
    if min(size) > 1:
        down, right = np.diff(shown[:, 0, 0]).mean(), np.diff(shown[0, :, 1]).mean()
        assert right * 360 / 240 == pytest.approx(down, rel=0.05)


@pytest.mark.parametrize("size", [(9, 12), (8, 13), (9, 3)])
def test_nothing_is_enlarged(size: tuple[int, int]) -> None:
    with pytest.raises(ValueError, match="8x12 cannot be shown at"):
        fit_image(np.zeros((8, 12, 3), np.uint8), size)


def record(folder: Path, name: str, seed: int = 0, **env_kwargs: object) -> None:
    """Record the first three steps of an episode, which are taken for a success."""
    env_kwargs = {"cameras": CAMERAS, "image_size": RECORDED, **env_kwargs}
    with contextlib.closing(make_env(name, max_episode_steps=3, **env_kwargs)) as env:
        expert = next(iter(task_entry(name).experts))
        made = demonstrate(env, expert, seed, codec="png", quality=90)
    attributes = {**made.attributes, "is_success": True}
    write_episode(episode_path(folder, seed, success=True), made.arrays, made.images, attributes)


@pytest.fixture(scope="module", params=sorted(task_names()))
def recorded(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of one episode of a task; its name is the task's."""
    folder = tmp_path_factory.mktemp("images") / str(request.param)
    record(folder, request.param)
    return folder


def trained_on(loaded: Demonstrations) -> np.ndarray:
    """Return the images (T, N, H, W, 3) that a policy is trained on."""
    with ImageStore(loaded) as store:
        return store.images(np.arange(loaded.offsets[-1]))


def shown(loaded: Demonstrations) -> np.ndarray:
    """Return the images (T, N, H, W, 3) that the recorded actions make an environment show."""
    config = EnvConfig(loaded.env_id.split("/")[1][:-3], loaded.spec, dict(loaded.env_kwargs))
    keys = loaded.spec.image_keys()
    with contextlib.closing(config.make()) as env:
        observation, _ = env.reset(seed=loaded.seeds[0])
        observations = [observation]
        with EpisodeReader(loaded.paths[0]) as episode:
            for action in episode.array("action")[:-1]:
                observations.append(env.step(action)[0])
        assert env.observation_space.contains(observation)
        return np.array([[observation[key] for key in keys] for observation in observations])


@pytest.mark.gl
@pytest.mark.parametrize("size", SHOWN)
def test_what_is_trained_on_is_what_is_shown(recorded: Path, size: tuple[int, int]) -> None:
    arms = task_entry(recorded.name).arms[0]
    spec = ObservationSpec(cameras=CAMERAS, image_size=size, arms=arms)
    loaded = load_demonstrations(recorded, spec)
    assert loaded.spec.drawn_size == RECORDED
    images = trained_on(loaded)
    assert images.shape == (3, 2, *size, 3)
    assert images.std() > 10
    np.testing.assert_array_equal(images, shown(loaded))
    # A checkpoint keeps the spec as JSON, and rollouts share images between processes.
    assert ObservationSpec.from_json(json.loads(json.dumps(loaded.spec.to_json()))) == loaded.spec
    config = EnvConfig(recorded.name, loaded.spec, dict(loaded.env_kwargs))
    with open_envs(config, num_envs=1, workers=0) as envs:
        envs.submit([StepRequest(0, seed=0, needs_images=True)])
        envs.wait()
        np.testing.assert_array_equal(envs.arrays["images"][0], images[0])


@pytest.mark.gl
def test_images_that_were_recorded_shrunk_are_shown_so(tmp_path: Path) -> None:
    sizes = {"image_size": (40, 40), "render_size": (96, 128)}
    record(tmp_path, "FeedingEnv", **sizes)
    loaded = load_demonstrations(tmp_path, ObservationSpec(cameras=CAMERAS, image_size=(40, 40)))
    assert loaded.spec.render_size == (96, 128)
    np.testing.assert_array_equal(trained_on(loaded), shown(loaded))
    twice = ObservationSpec(cameras=CAMERAS, image_size=(20, 20))
    with pytest.raises(RequestError, match="drawn at 96x128 and shrunk to 40x40; choose --image"):
        load_demonstrations(tmp_path, twice)


@pytest.mark.gl
@pytest.mark.parametrize(
    "sizes",
    [
        {"image_size": (48, 64)},
        {"image_size": (24, 32), "render_size": (96, 128)},
    ],
)
def test_images_of_two_sizes_do_not_mix(tmp_path: Path, sizes: dict[str, tuple[int, int]]) -> None:
    record(tmp_path, "FeedingEnv", 0, image_size=(24, 32))
    record(tmp_path, "FeedingEnv", 1, **sizes)
    spec = ObservationSpec(cameras=CAMERAS, image_size=(12, 16))
    with pytest.raises(RequestError, match=r"000001.hdf5' holds images .* not 24x32; keep"):
        load_demonstrations(tmp_path, spec)
    load_demonstrations(tmp_path, replace(spec, cameras=()))


def test_the_same_size_is_no_size_of_its_own() -> None:
    spec = ObservationSpec(image_size=(24, 32), render_size=(24, 32))
    assert spec == ObservationSpec(image_size=(24, 32))
    assert "render_size" not in spec.to_json()  # as in files of older releases
    for given, other in product([(24, 32), (48, 64)], [(25, 32), (24, 33)]):
        if other[0] > given[0] or other[1] > given[1]:
            with pytest.raises(RequestError, match="must be no larger than the render size"):
                ObservationSpec(image_size=other, render_size=given)


def test_a_run_on_squashed_images_is_not_resumed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Runs of earlier releases have no render size, and saw other images than this release's."""
    from robo_manip_baselines.training import setup as module
    from robo_manip_baselines.training.config import TrainConfig

    images = make_images(10, cameras=("top",))
    for seed in (0, 1):
        path = episode_path(tmp_path, seed, success=True)
        write_episode(path, make_arrays(10, seed), images, make_attributes(seed))
    config = TrainConfig.from_preset("Act", "cpu", dataset=tmp_path, out=tmp_path / "run")
    spec = ObservationSpec(cameras=("top",), image_size=(16, 16))
    setup = module.TrainSetup.load(replace(config, spec=spec))
    before = replace(setup.checkpoint(0), spec=spec)
    monkeypatch.setattr(module, "list_checkpoints", lambda _: [0])
    monkeypatch.setattr(module, "require_same_config", lambda *_: None)
    monkeypatch.setattr(module, "read_checkpoint", lambda _: before)
    with pytest.raises(RequestError, match=r"16x16 drawn at 16x16, .* at 24x32; choose another"):
        setup.find_start(resume=True)
