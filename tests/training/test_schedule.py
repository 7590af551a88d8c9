"""Examples of a training step: every one in its turn, at random, and the same ones every time."""

from __future__ import annotations

from collections import Counter

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from robo_manip_baselines.policy.presets import TrainSettings
from robo_manip_baselines.runs.errors import RequestError
from robo_manip_baselines.training.batching import ExampleSampler

LENGTHS = st.lists(st.integers(1, 9), min_size=1, max_size=8)


def epoch(examples: ExampleSampler, number: int) -> np.ndarray:
    """(examples of one epoch, 2), cut out of the batches that hold them."""
    size, count = examples.batch_size, examples.frames_per_epoch
    first, last = number * count, (number + 1) * count
    steps = range(first // size, -(-last // size))
    examples = np.concatenate([examples.batch(step) for step in steps])
    skipped = first - steps[0] * size
    return examples[skipped : skipped + count]


@given(LENGTHS, st.integers(1, 12), st.integers(0, 99), st.integers(0, 5))
def test_frame_examplesvisits_every_frame_once(
    lengths: list[int], batch_size: int, seed: int, number: int
) -> None:
    examples = ExampleSampler(lengths, "frame", batch_size, seed)
    every = sorted((episode, t) for episode, steps in enumerate(lengths) for t in range(steps))
    assert sorted(map(tuple, epoch(examples, number).tolist())) == every
    assert examples.frames_per_epoch == len(every)


@given(LENGTHS, st.integers(1, 12), st.integers(0, 99), st.integers(0, 5))
def test_episode_examplesvisits_every_episode_once(
    lengths: list[int], batch_size: int, seed: int, number: int
) -> None:
    examples = ExampleSampler(lengths, "episode", batch_size, seed)
    episodes, starts = epoch(examples, number).T
    assert sorted(episodes) == list(range(len(lengths)))
    assert (starts >= 0).all()
    assert (starts < np.array(lengths)[episodes]).all()
    assert examples.frames_per_epoch == len(lengths)


@given(LENGTHS, st.sampled_from(["episode", "frame"]), st.integers(1, 12), st.data())
def test_a_step_is_the_same_whatever_came_before(
    lengths: list[int], sampler: str, batch_size: int, data: st.DataObject
) -> None:
    used = ExampleSampler(lengths, sampler, batch_size, 7)
    for step in data.draw(st.lists(st.integers(0, 60), min_size=1, max_size=10)):
        fresh = ExampleSampler(lengths, sampler, batch_size, 7)
        np.testing.assert_array_equal(used.batch(step), fresh.batch(step), strict=True)
        assert len(used.batch(step)) == batch_size


@pytest.mark.parametrize("sampler", ["episode", "frame"])
def test_order_differs_between_epochs_and_seeds(sampler: str) -> None:
    orders = {
        epoch(ExampleSampler([30] * 30, sampler, 8, seed), number).tobytes()
        for seed in range(4)
        for number in range(4)
    }
    assert len(orders) == 16


def test_every_start_is_as_likely_as_any_other() -> None:
    examples = ExampleSampler([5], "episode", 8, 0)
    counts = Counter(int(examples.batch(step)[0, 1]) for step in range(2000))
    # 400 each; the standard deviation is 18, so 90 is five of them.
    assert sorted(counts) == [0, 1, 2, 3, 4]
    assert all(abs(count - 400) < 90 for count in counts.values())


def test_table_3() -> None:
    settings = TrainSettings(batch_size=8, epochs=2000)
    lengths = [430] * 50
    everything = ExampleSampler(lengths, "episode", settings.batch_size, 0)
    assert everything.frames_per_epoch == 50
    assert everything.total_steps(settings) == 12_500
    assert everything.epochs(12_500) == 2000.0
    held_out = ExampleSampler(lengths[:40], "episode", settings.batch_size, 0)
    assert held_out.total_steps(settings) == 10_000
    assert ExampleSampler(lengths[:3], "episode", 8, 0).total_steps(TrainSettings(epochs=3)) == 2
    assert everything.total_steps(TrainSettings(steps=123)) == 123


def test_a_schedule_stays_what_it_was() -> None:
    # A run that is resumed with a later release must go on with the same examples.
    assert ExampleSampler([5, 3, 9], "episode", 2, 11).batch(4).tolist() == [[2, 2], [1, 1]]
    assert ExampleSampler([5, 3, 9], "frame", 3, 11).batch(7).tolist() == [[0, 1], [1, 1], [0, 4]]


def test_a_batch_that_is_spoilt_spoils_no_other() -> None:
    examples = ExampleSampler([5, 3, 9], "frame", 3, 0)
    batch = examples.batch(0)
    kept = batch.copy()
    batch[:] = 99
    np.testing.assert_array_equal(examples.batch(0), kept)


@pytest.mark.parametrize(
    ("lengths", "sampler", "batch_size", "seed", "message"),
    [
        ([5], "frames", 8, 0, "unknown sampler 'frames' .*valid: episode, frame"),
        ([5], "frame", 0, 0, "batch_size 0: must be 1 to"),
        ([5], "frame", 8, -1, "seed -1: must be 0 to"),
        ([], "frame", 8, 0, "at least one episode"),
        ([5, 0], "frame", 8, 0, "each of at least one step"),
    ],
)
def test_what_cannot_be_scheduled(
    lengths: list[int], sampler: str, batch_size: int, seed: int, message: str
) -> None:
    with pytest.raises(RequestError, match=message):
        ExampleSampler(lengths, sampler, batch_size, seed)


def test_there_is_no_step_before_the_first() -> None:
    with pytest.raises(ValueError, match="step -1"):
        ExampleSampler([5], "frame", 8, 0).batch(-1)
