"""The parts of the trainer, each on its own: order, pictures, people, schedule, numbers."""

from __future__ import annotations

import itertools
import json
import os
import signal
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from face_prediction.models.settings import PredictorTrainSettings
from face_prediction.training.options import FaceTrainOptions
from face_prediction.training.trainer import CURVES, StepMeans, choose_people, torch_seed
from face_prediction.training.windows import SequenceImages, WindowSampler
from robo_manip_baselines.runs.errors import RequestError
from robo_manip_baselines.runs.interrupt import StopRequest
from robo_manip_baselines.runs.metrics import write_curves
from robo_manip_baselines.runs.seeds import stream_generator


class TestSampler:
    @given(st.integers(1, 12), st.integers(1, 9), st.integers(0, 2**32))
    def test_every_epoch_goes_through_all_once(self, count: int, batch: int, seed: int) -> None:
        sampler = WindowSampler(count, 10, 10, batch, seed)
        rows = np.concatenate([sampler.batch(step)[0] for step in range(3 * count)])
        for epoch in range(3):
            assert sorted(rows[epoch * count : (epoch + 1) * count]) == list(range(count))

    def test_a_batch_is_a_function_of_seed_and_step(self) -> None:
        one, other = WindowSampler(50, 75, 25, 4, 7), WindowSampler(50, 75, 25, 4, 7)
        for step in (90, 3, 91, 0, 12):  # in another order, from another object
            for a, b in zip(one.batch(step), other.batch(step), strict=True):
                np.testing.assert_array_equal(a, b)
        different = WindowSampler(50, 75, 25, 4, 8)
        assert any(not np.array_equal(one.batch(s)[0], different.batch(s)[0]) for s in range(3))

    def test_epochs_have_orders_of_their_own(self) -> None:
        sampler = WindowSampler(20, 10, 10, 20, 0)
        assert not np.array_equal(sampler.batch(0)[0], sampler.batch(1)[0])

    def test_windows_lie_anywhere_in_the_sequence(self) -> None:
        sampler = WindowSampler(5, 75, 25, 50, 0)
        starts = np.concatenate([sampler.batch(step)[1] for step in range(40)])
        assert set(starts) == set(range(51))
        whole = WindowSampler(5, 75, 75, 50, 0)
        assert set(whole.batch(3)[1]) == {0}


class TestSettings:
    def test_cosine_goes_from_the_rate_to_a_hundredth_after_warming_up(self) -> None:
        settings = PredictorTrainSettings(
            steps=110, batch_size=1, learning_rate=1.0, schedule="cosine", warmup_steps=10
        )
        rates = [settings.learning_rate_at(step) for step in range(111)]
        np.testing.assert_allclose(rates[:10], np.arange(1, 11) / 11)
        assert rates[10] == 1.0
        assert rates[60] == pytest.approx(0.505)
        assert rates[110] == pytest.approx(0.01)
        assert np.all(np.diff(rates[10:]) < 0)

    def test_constant_is_constant(self) -> None:
        settings = PredictorTrainSettings(steps=9, batch_size=1, learning_rate=1e-4)
        assert {settings.learning_rate_at(step) for step in range(9)} == {1e-4}

    @pytest.mark.parametrize(
        ("name", "value"),
        [
            ("steps", 0),
            ("batch_size", 0),
            ("learning_rate", -1.0),
            ("learning_rate", float("nan")),
            ("ema_decay", 1.0),
            ("schedule", "linear"),
            ("precision", "fp16"),
            ("validate_every", 0),
        ],
    )
    def test_values_out_of_range_name_the_option(self, name: str, value) -> None:
        with pytest.raises(RequestError, match=f"--{name} '?{value}"):
            PredictorTrainSettings(**{"steps": 1, "batch_size": 1, name: value})


def test_seeds_differ_by_name_and_place() -> None:
    seeds = {torch_seed(0, name, place) for name in ("a", "b") for place in range(5)}
    assert len(seeds | {torch_seed(1, "a", 0)}) == 11
    assert torch_seed(3, "x", 4) == stream_generator(3, "x", 4).integers(2**63)


class FakeDataset:
    """Pictures that say which frame of which sequence they are; counts what is decoded."""

    def __init__(self, length: int = 10, crop: int = 64) -> None:
        settings = SimpleNamespace(length=length, crop_size=crop)
        self.manifest = SimpleNamespace(settings=settings)
        self.folder = Path("fake")
        self.decoded: list[tuple[int, int, int]] = []

    def images(self, index: int, frames: slice, reduce: int) -> np.ndarray:
        self.decoded.append((index, frames.start, frames.stop))
        values = 20 * index + np.arange(frames.start, frames.stop)
        side = 64 // reduce
        return np.broadcast_to(values[:, None, None, None], (len(values), side, side, 3))


class TestPictures:
    def test_only_what_is_needed_is_decoded_and_only_once(self) -> None:
        dataset = FakeDataset()
        store = SequenceImages(dataset, 32, 1e9)  # pyright: ignore[reportArgumentType]
        for start, stop in ((3, 6), (4, 6), (2, 5), (0, 10), (0, 10)):
            got = store.read(2, start, stop)
            assert got.shape == (stop - start, 32, 32, 3)
            assert got[:, 0, 0, 0].tolist() == list(range(40 + start, 40 + stop))
        assert dataset.decoded == [(2, 3, 6), (2, 2, 3), (2, 0, 10)]

    def test_beyond_the_memory_it_is_decoded_every_time(self) -> None:
        dataset = FakeDataset()
        store = SequenceImages(dataset, 32, 2.5 * 10 * 32 * 32 * 3)  # pyright: ignore[reportArgumentType]
        for _ in range(2):
            for index in range(4):
                assert store.read(index, 0, 10)[9, 0, 0, 0] == 20 * index + 9
        assert [index for index, _, _ in dataset.decoded] == [0, 1, 2, 3, 2, 3]

    @pytest.mark.parametrize("size", [128, 4, 48])
    def test_a_size_that_jpeg_does_not_give_is_refused(self, size: int) -> None:
        with pytest.raises(RequestError, match=f"64 pixels, but this network needs {size}"):
            SequenceImages(FakeDataset(), size, 1e9)  # pyright: ignore[reportArgumentType]


class FakePeople:
    """Seven people in four folds, two sequences each."""

    def __init__(self, folds: int = 4) -> None:
        self.folder = Path("fake")
        self.owner = [f"p{n % 7}" for n in range(14)]
        clips = [SimpleNamespace(clip=f"c{n}", fold=n % 7 % folds, sequences=1) for n in range(14)]
        settings = SimpleNamespace(length=75)
        self.manifest = SimpleNamespace(folds=folds, clips=clips, settings=settings, seed=0)

    def entry(self, index: int):
        return SimpleNamespace(subject=self.owner[index])


class TestPeople:
    def choose(self, folds: int = 4, **options):
        given = FaceTrainOptions(model="image_only", **{"test_fold": 1, **options})
        return choose_people(FakePeople(folds), given)  # pyright: ignore[reportArgumentType]

    def test_the_next_fold_validates(self) -> None:
        people = self.choose()
        assert people.folds == {"train": [0, 3], "validation": [2], "test": [1]}
        assert people.train.tolist() == [0, 3, 4, 7, 10, 11]
        assert people.validation.tolist() == [2, 6, 9, 13]
        assert people.train_subjects == ["p0", "p3", "p4"]

    def test_none_trains_on_all_but_the_test_fold(self) -> None:
        people = self.choose(hold_out="none")
        assert people.folds == {"train": [0, 2, 3], "validation": [], "test": [1]}
        assert people.train_subjects == ["p0", "p2", "p3", "p4", "p6"]
        assert len(people.validation) == 0

    def test_no_test_fold_trains_on_everybody(self) -> None:
        people = self.choose(test_fold=None, hold_out="none")
        assert len(people.train) == 14
        assert people.folds == {"train": [0, 1, 2, 3], "validation": [], "test": []}

    def test_fewer_subjects_are_the_first_of_one_order(self) -> None:
        chosen = [set(self.choose(hold_out="none", subjects=n).train_subjects) for n in range(1, 6)]
        assert [len(names) for names in chosen] == [1, 2, 3, 4, 5]
        assert all(a < b for a, b in itertools.pairwise(chosen))
        few = self.choose(hold_out="none", subjects=2)
        assert {FakePeople().owner[row] for row in few.train} == set(few.train_subjects)
        assert len(few.train) == 4
        others = {
            tuple(self.choose(hold_out="none", subjects=2, seed=s).train_subjects) for s in range(9)
        }
        assert len(others) > 1

    @pytest.mark.parametrize(
        ("options", "words"),
        [
            ({"test_fold": 4}, "fold 4: this dataset has folds 0 to 3"),
            ({"test_fold": None}, "--hold_out none"),
            ({"subjects": 4}, "--subjects 4: the folds to train on have 3"),
            ({"subjects": 0}, "--subjects 0"),
            ({"folds": 2}, "--hold_out none"),
            ({"folds": 1, "test_fold": 0, "hold_out": "none"}, "nobody to train on"),
        ],
    )
    def test_what_cannot_be_is_refused(self, options, words: str) -> None:
        with pytest.raises(RequestError, match=words):
            self.choose(**options)


class TestMetrics:
    def test_means(self) -> None:
        mean = StepMeans()
        for value in (1.0, 2.0, 6.0):
            mean.add({"a": torch.tensor(value), "b": torch.tensor(-value)})
        carried_on = StepMeans(mean.names, json.loads(json.dumps(mean.rows())))
        for one in (mean, carried_on):
            one.add({"a": torch.tensor(7.0), "b": torch.tensor(1.0)})
            assert one.take() == {"a": 4.0, "b": -2.0}
            one.add({"a": torch.tensor(5.0), "b": torch.tensor(0.0)})
            assert one.take() == {"a": 5.0, "b": 0.0}

    @pytest.mark.parametrize("is_held_out", [True, False])
    def test_curves_are_drawn_of_what_there_is(self, tmp_path: Path, is_held_out: bool) -> None:
        pytest.importorskip("matplotlib", reason="matplotlib is not installed")
        path = tmp_path / "curves.png"
        assert not write_curves(path, [], "run", CURVES)
        lines: list[dict[str, Any]] = [{"kind": "train", "step": 10, "loss": -0.5}]
        if is_held_out:
            lines.append({"kind": "validation", "step": 10, "loss": -0.5, "mouth_error": 0.1})
        assert write_curves(path, lines, "run", CURVES)
        assert path.read_bytes().startswith(b"\x89PNG")


def test_a_first_signal_is_noted_and_a_second_ends() -> None:
    before = signal.getsignal(signal.SIGINT)
    with StopRequest() as stop:
        assert not stop.is_made
        os.kill(os.getpid(), signal.SIGTERM)
        assert stop.is_made
        with pytest.raises(KeyboardInterrupt):
            os.kill(os.getpid(), signal.SIGINT)
    assert signal.getsignal(signal.SIGINT) is before
