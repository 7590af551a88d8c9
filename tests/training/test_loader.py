"""Batches: their contents, functions of the seed and of the step alone."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from robo_manip_baselines.data import episode_path, write_episode
from robo_manip_baselines.data.demonstrations import Demonstrations, load_demonstrations
from robo_manip_baselines.data.example import make_arrays, make_attributes, make_images
from robo_manip_baselines.data.normalization import Normalization, mean_std
from robo_manip_baselines.observation import ObservationSpec, ObservedNames
from robo_manip_baselines.policy.interface import Batch, PolicyModel
from robo_manip_baselines.runs.errors import RequestError
from robo_manip_baselines.training.augmentation import ImageAugmentation, change_images
from robo_manip_baselines.training.batching import (
    BatchLoader,
    ExampleSampler,
    ObjectNoise,
    StateNoise,
    part_of,
)
from robo_manip_baselines.training.images import ImageStore

LENGTHS = (6, 9, 4, 7, 5)
TRAIN = (3, 0, 4)  # not in order: the schedule's episodes are places in this list
CHUNK = 4
NOISE = 3


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("demonstrations")
    for seed, steps in enumerate(LENGTHS):
        images = make_images(steps, cameras=("top", "angle"))
        path = episode_path(folder, seed, success=True)
        write_episode(path, make_arrays(steps, seed), images, make_attributes(seed))
    return folder


@pytest.fixture(scope="module")
def blind(folder: Path) -> Demonstrations:
    return load_demonstrations(folder, ObservationSpec(obs="current", cameras=()))


@pytest.fixture(scope="module")
def shown(folder: Path) -> Demonstrations:
    return load_demonstrations(folder, ObservationSpec(cameras=("top",), image_size=(24, 32)))


def statistics(loaded: Demonstrations) -> Normalization:
    rows = loaded.rows(TRAIN)
    return mean_std(loaded.state[rows], loaded.action[rows])


def make_loader(loaded: Demonstrations, sampler: str = "frame", **changes: Any) -> BatchLoader:
    examples = ExampleSampler(loaded.lengths[list(TRAIN)], sampler, changes.pop("batch_size", 4), 5)
    sizes = {name: changes.pop(name) for name in ("noise_size", "n_obs_steps") if name in changes}
    options = {"seed": 5, "device": "cpu", **changes}
    return BatchLoader(loaded, statistics(loaded), TRAIN, examples, model(**sizes), **options)


def model(noise_size: int = NOISE, n_obs_steps: int = 1) -> PolicyModel:
    """A network of which only the sizes are read."""
    made = PolicyModel()
    made.chunk_size, made.noise_size, made.n_obs_steps = CHUNK, noise_size, n_obs_steps
    return made


def assert_equal(one: Batch, other: Batch) -> None:
    for field in fields(Batch):
        a, b = getattr(one, field.name), getattr(other, field.name)
        assert (a is None) == (b is None)
        if a is not None:
            assert a.dtype == b.dtype, field.name
            assert torch.equal(a.cpu(), b.cpu()), field.name


def test_a_batch_holds_the_examples_of_the_sampler(blind: Demonstrations) -> None:
    loader, scale = make_loader(blind), statistics(blind)
    sampler = ExampleSampler(blind.lengths[list(TRAIN)], "frame", 4, 5)
    seen_padding = False
    for step in range(2 * sampler.frames_per_epoch // 4 + 1):
        batch = loader.batch(step)
        examples = sampler.batch(step)
        assert batch.images is None
        assert batch.noise.shape == (len(examples), NOISE)
        valid = 0
        for i, (episode, start) in enumerate(examples):
            rows = blind.rows([TRAIN[episode]])
            states, actions = blind.state[rows], blind.action[rows]
            state = (states[start] - scale.state_mean) / scale.state_std
            np.testing.assert_array_equal(batch.state[i].numpy(), state[None], strict=True)
            for k in range(CHUNK):
                is_past = start + k >= len(rows)
                assert bool(batch.is_pad[i, k]) == is_past
                valid += not is_past
                if not is_past:
                    action = (actions[start + k] - scale.action_mean) / scale.action_std
                    np.testing.assert_array_equal(batch.action[i, k].numpy(), action, strict=True)
        assert batch.num_valid.dtype == torch.float32
        assert batch.num_valid.shape == ()
        assert batch.num_valid.item() == valid
        seen_padding |= bool(batch.is_pad.any())
    assert seen_padding


@settings(max_examples=20)
@given(first=st.integers(0, 15), count=st.integers(0, 12), depth=st.integers(0, 6))
def test_a_step_is_the_same_wherever_one_starts_and_however_far_ahead(
    blind: Demonstrations, first: int, count: int, depth: int
) -> None:
    whole = make_loader(blind, depth=0)
    batches = list(make_loader(blind, depth=depth).batches(first, first + count))
    assert len(batches) == count
    for step, batch in enumerate(batches, first):
        assert_equal(batch, whole.batch(step))


def test_noise_is_normal_and_new_at_every_step(blind: Demonstrations) -> None:
    loader = make_loader(blind, noise_size=500, batch_size=16)
    noise = torch.stack([loader.batch(step).noise for step in (0, 2, 4)])
    # 24 000 numbers: the mean strays by 0.0065, the deviation by 0.0046; five times that.
    assert abs(noise.mean().item()) < 0.033
    assert abs(noise.std().item() - 1.0) < 0.023
    assert len(torch.unique(noise)) > 0.99 * noise.numel()
    other = make_loader(blind, noise_size=500, batch_size=16, seed=6)
    assert not torch.equal(other.batch(0).noise, loader.batch(0).noise)


@pytest.mark.parametrize("world_size", [1, 2, 3, 4])
def test_processes_share_a_batch_out(blind: Demonstrations, world_size: int) -> None:
    noise = {"state_noise": StateNoise(blind.spec, ObservedNames(), robot=0.3)}
    whole = make_loader(blind, **noise)
    parts = [
        make_loader(blind, rank=rank, world_size=world_size, **noise) for rank in range(world_size)
    ]
    for step in range(6):
        expected = whole.batch(step)
        got = [loader.batch(step) for loader in parts]
        for name in ("state", "action", "is_pad", "noise"):
            joined = torch.cat([getattr(batch, name) for batch in got])
            assert torch.equal(joined, getattr(expected, name)), name
        for batch in got:
            # One division in float32 at the most.
            torch.testing.assert_close(batch.num_valid * world_size, expected.num_valid)
            torch.testing.assert_close(batch.num_examples * world_size, torch.tensor(4.0))
        sizes = [len(batch.state) for batch in got]
        assert max(sizes) - min(sizes) <= 1


def test_more_processes_than_examples_are_refused(blind: Demonstrations) -> None:
    with pytest.raises(RequestError, match="batch_size 4: must be at least the 5 processes"):
        make_loader(blind, rank=4, world_size=5)


def test_parts_are_contiguous() -> None:
    assert [part_of(10, rank, 4) for rank in range(4)] == [
        slice(0, 2),
        slice(2, 5),
        slice(5, 7),
        slice(7, 10),
    ]


@pytest.mark.parametrize("budget", [0, None])
def test_images_are_those_of_the_first_step(shown: Demonstrations, budget: int | None) -> None:
    sampler = ExampleSampler(shown.lengths[list(TRAIN)], "episode", 2, 5)
    with ImageStore(shown, memory_budget=budget) as images:
        loader = make_loader(shown, "episode", batch_size=2, images=images)
        for step, batch in enumerate(loader.batches(0, 6)):
            rows = [shown.offsets[TRAIN[e]] + t for e, t in sampler.batch(step)]
            assert batch.images is not None
            expected = images.images(np.array(rows))[:, None]
            np.testing.assert_array_equal(batch.images.numpy(), expected, strict=True)
            channels_first = batch.images[:, 0, 0].permute(0, 3, 1, 2)
            assert channels_first.is_contiguous(memory_format=torch.channels_last)


@pytest.mark.parametrize("budget", [0, None])
def test_windows_end_with_the_example_and_begin_in_its_episode(
    shown: Demonstrations, budget: int | None
) -> None:
    """Rows before the start of the episode repeat its first; noise is on every row."""
    sampler = ExampleSampler(shown.lengths[list(TRAIN)], "frame", 4, 5)
    with ImageStore(shown, memory_budget=budget) as images:
        loader = make_loader(shown, images=images, n_obs_steps=3)
        noise = StateNoise(shown.spec, ObservedNames(), robot=0.3)
        noisy = make_loader(shown, images=images, n_obs_steps=3, state_noise=noise)
        for step in range(6):
            batch = loader.batch(step)
            assert batch.images is not None
            assert batch.action.shape[1] == CHUNK
            for i, (episode, start) in enumerate(sampler.batch(step)):
                first = shown.offsets[TRAIN[episode]]
                rows = np.array([first + max(start - past, 0) for past in (2, 1, 0)])
                state = statistics(shown).normalize_state(shown.state[rows])
                np.testing.assert_array_equal(batch.state[i].numpy(), state, strict=True)
                np.testing.assert_array_equal(batch.images[i].numpy(), images.images(rows))
            drawn = noisy.batch(step).state - batch.state
            assert len(torch.unique(drawn[..., :14])) > 0.9 * drawn[..., :14].numel()


def test_images_are_changed_for_training_only_where_asked(shown: Demonstrations) -> None:
    with ImageStore(shown) as images:
        augment = ImageAugmentation("shift+colour", images.shape, 0.1)
        plain = make_loader(shown, images=images)
        changed = make_loader(shown, images=images, augment=augment)
        parts = [
            make_loader(shown, images=images, augment=augment, rank=rank, world_size=2)
            for rank in range(2)
        ]
        for step in range(3):
            before = plain.batch(step)
            assert before.images is not None
            expected = change_images(before.images, augment.draw(5, step, 4))
            assert not torch.equal(expected, before.images)
            assert_equal(changed.batch(step), replace(before, images=expected))
            joined = [part.batch(step).images for part in parts]
            assert torch.equal(torch.cat([x for x in joined if x is not None]), expected)


def loading_threads() -> list[str]:
    return [thread.name for thread in threading.enumerate() if thread.name.startswith("batches")]


@pytest.mark.parametrize("is_exhausted", [True, False])
def test_threads_end(blind: Demonstrations, is_exhausted: bool) -> None:
    batches = make_loader(blind).batches(0, 20)
    assert not loading_threads()
    next(batches)
    assert loading_threads()
    if is_exhausted:
        assert sum(1 for _ in batches) == 19
    else:
        batches.close()
    assert not loading_threads()


def test_threads_end_when_the_consumer_fails(blind: Demonstrations) -> None:
    def consume(batches: Iterator[Batch]) -> None:
        for _ in batches:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        consume(make_loader(blind).batches(0, 1000))
    assert not loading_threads()


def test_a_failure_ahead_comes_when_its_batch_is_due(
    blind: Demonstrations, monkeypatch: pytest.MonkeyPatch
) -> None:
    loader = make_loader(blind, depth=6)
    sampler_batch = ExampleSampler.batch

    def batch(self: ExampleSampler, step: int) -> np.ndarray:
        if step == 3:
            raise OSError("the disk is gone")
        return sampler_batch(self, step)

    monkeypatch.setattr(ExampleSampler, "batch", batch)
    batches = loader.batches(0, 9)
    for _ in range(3):
        next(batches)
    with pytest.raises(OSError, match="the disk is gone"):
        next(batches)
    assert not loading_threads()


def test_no_more_than_depth_batches_are_made_ahead(
    blind: Demonstrations, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[int] = []
    sampler_batch = ExampleSampler.batch

    def batch(self: ExampleSampler, step: int) -> np.ndarray:
        asked.append(step)
        return sampler_batch(self, step)

    monkeypatch.setattr(ExampleSampler, "batch", batch)
    batches = make_loader(blind, depth=2).batches(0, 50)
    for _ in range(5):
        next(batches)
    assert max(asked, default=0) <= 4 + 2
    batches.close()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"rank": 2, "world_size": 2}, "rank 2 of 2 processes"),
        ({"rank": -1}, "rank -1 of 1"),
        ({"depth": -1}, "depth -1: must be 0 to"),
    ],
)
def test_wrong_arguments(blind: Demonstrations, changes: dict[str, int], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make_loader(blind, **changes)


def test_sampler_and_images_must_fit(blind: Demonstrations, shown: Demonstrations) -> None:
    sampler = ExampleSampler([6, 7, 5], "frame", 4, 5)
    with pytest.raises(ValueError, match="sampler is of other episodes"):
        BatchLoader(blind, statistics(blind), TRAIN, sampler, model(), seed=5, device="cpu")
    with pytest.raises(ValueError, match="if, and only if, there are cameras"):
        make_loader(shown)
    with (
        ImageStore(shown) as images,
        pytest.raises(ValueError, match="if, and only if, there are cameras"),
    ):
        make_loader(blind, images=images)


def copies(loader: BatchLoader, steps: int) -> list[Batch]:
    """Copies of batches, made on the GPU; late, when their memory might be in use again."""
    kept = []
    for step, batch in enumerate(loader.batches(0, steps)):
        if step % 2:
            torch.cuda._sleep(5_000_000)  # some milliseconds, on the stream that reads the batch
        values = {field.name: getattr(batch, field.name) for field in fields(Batch)}
        kept.append(Batch(**{k: v if v is None else v.clone() for k, v in values.items()}))
    return kept


@pytest.mark.cuda
@pytest.mark.parametrize("budget", [0, None])
def test_a_gpu_gets_the_same_images(shown: Demonstrations, budget: int | None) -> None:
    with ImageStore(shown, memory_budget=budget) as images:
        here = make_loader(shown, images=images, depth=0)
        there = make_loader(shown, images=images, device="cuda")
        for step, batch in enumerate(copies(there, 60)):
            assert batch.images is not None
            assert batch.images.device.type == batch.num_valid.device.type == "cuda"
            assert_equal(batch, here.batch(step))


@pytest.mark.cuda
@pytest.mark.parametrize("depth", [0, 4])
@pytest.mark.parametrize("noise_size", [0, NOISE])
def test_a_gpu_gets_the_same_vectors(blind: Demonstrations, depth: int, noise_size: int) -> None:
    here = make_loader(blind, depth=0, noise_size=noise_size)
    there = make_loader(blind, depth=depth, device="cuda:0", noise_size=noise_size)
    for step, batch in enumerate(copies(there, 60)):
        assert_equal(batch, here.batch(step))


CUBE = ObservedNames(objects=("cube",))


@pytest.fixture(scope="module")
def carrying(tmp_path_factory: pytest.TempPathFactory) -> Demonstrations:
    """Episodes whose cube rises by 4 mm a step, after it has lain for two."""
    folder = tmp_path_factory.mktemp("carrying")
    for seed, steps in enumerate(LENGTHS):
        arrays = make_arrays(steps, seed)
        arrays["object_pose"][:, :3] = arrays["object_pose"][0, :3]
        arrays["object_pose"][:, 2] += 0.004 * np.maximum(np.arange(steps) - 2, 0)
        write_episode(episode_path(folder, seed, success=True), arrays, {}, make_attributes(seed))
    return load_demonstrations(folder, ObservationSpec("current", cameras=(), object_pose=True))


def test_an_object_is_carried_from_a_centimetre_on(carrying: Demonstrations) -> None:
    expected = [step >= 5 for steps in LENGTHS for step in range(steps)]  # 12 mm
    assert carrying.carried(CUBE)[:, 0].tolist() == expected
    hidden = replace(carrying, spec=replace(carrying.spec, object_pose=False))
    assert hidden.carried(CUBE).shape == (sum(LENGTHS), 0)


def test_only_carried_objects_have_noise(carrying: Demonstrations) -> None:
    scale = statistics(carrying)
    noise = ObjectNoise(carrying, CUBE, scale, 0.02)
    rows = np.arange(sum(LENGTHS))[:, None].repeat(2000, axis=1)
    metres = noise.draw(3, 7, rows).numpy() * scale.state_std
    assert (metres[..., :-3] == 0.0).all()
    carried = carrying.carried(CUBE)[:, 0]
    assert (metres[~carried] == 0.0).all()
    # 22 000 numbers an axis; five times their standard error.
    assert np.abs(metres[carried][..., -3:].std(axis=(0, 1)) - 0.02).max() < 0.0005
    assert torch.equal(noise.draw(3, 7, rows), noise.draw(3, 7, rows))
    assert not torch.equal(noise.draw(3, 8, rows), noise.draw(3, 7, rows))
    assert not ObjectNoise(carrying, CUBE, scale, 0.0)


@pytest.mark.parametrize("world_size", [1, 3])
def test_noise_of_objects_is_shared_out(carrying: Demonstrations, world_size: int) -> None:
    scale = statistics(carrying)
    given = {
        "object_noise": ObjectNoise(carrying, CUBE, scale, 0.02),
        "state_noise": StateNoise(carrying.spec, CUBE, robot=0.3),
        "n_obs_steps": 2,
    }
    whole, plain = make_loader(carrying, **given), make_loader(carrying, n_obs_steps=2)
    parts = [
        make_loader(carrying, rank=rank, world_size=world_size, **given)
        for rank in range(world_size)
    ]
    changed = 0
    for step in range(6):
        expected = whole.batch(step)
        joined = torch.cat([loader.batch(step).state for loader in parts])
        assert torch.equal(joined, expected.state)
        difference = (expected.state - plain.batch(step).state)[..., -3:]
        changed += int((difference != 0).any(-1).sum())
        assert torch.equal(expected.action, plain.batch(step).action)
    assert 0 < changed < 6 * 4 * 2
