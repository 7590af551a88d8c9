"""Actions that a person chose weigh more, and nothing changes where none do."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from robo_manip_baselines.commands import train
from robo_manip_baselines.data import episode_path, write_episode
from robo_manip_baselines.data.demonstrations import Demonstrations, load_demonstrations
from robo_manip_baselines.data.example import make_arrays, make_attributes
from robo_manip_baselines.data.normalization import mean_std
from robo_manip_baselines.observation import ObservationSpec
from robo_manip_baselines.policy.interface import Batch, PolicyModel, masked_mean
from robo_manip_baselines.runs.errors import RequestError
from robo_manip_baselines.training.batching import BatchLoader, ExampleSampler
from robo_manip_baselines.training.config import TrainConfig

LENGTHS, CHUNK = (6, 9, 4), 4
SPEC = ObservationSpec(obs="current", cameras=())


def is_intervention(seed: int, steps: int) -> np.ndarray:
    return np.arange(steps) % (seed + 2) == 1


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two episodes with the column, and one without."""
    folder = tmp_path_factory.mktemp("demonstrations")
    for seed, steps in enumerate(LENGTHS):
        arrays = make_arrays(steps, seed)
        if seed < 2:
            arrays["intervention"] = is_intervention(seed, steps)
        write_episode(episode_path(folder, seed, True), arrays, {}, make_attributes(seed))
    return folder


@pytest.fixture(scope="module")
def loaded(folder: Path) -> Demonstrations:
    return load_demonstrations(folder, SPEC)


def make_loader(
    loaded: Demonstrations, episodes: Sequence[int] = (1, 2, 0), **options: Any
) -> BatchLoader:
    rows = loaded.rows(episodes)
    model = PolicyModel()
    model.chunk_size = CHUNK
    sampler = ExampleSampler(loaded.lengths[list(episodes)], "frame", 5, 7)
    scale = mean_std(loaded.state[rows], loaded.action[rows])
    given: dict[str, Any] = {"seed": 7, "device": "cpu", **options}
    return BatchLoader(loaded, scale, episodes, sampler, model, **given)


def test_marks_are_read(loaded: Demonstrations, folder: Path) -> None:
    marks = [is_intervention(0, 6), is_intervention(1, 9), np.zeros(4, bool)]
    assert loaded.intervention is not None
    np.testing.assert_array_equal(loaded.intervention, np.concatenate(marks))


def test_a_weight_of_1_changes_nothing(loaded: Demonstrations) -> None:
    plain, weighted = make_loader(loaded), make_loader(loaded, intervention_weight=1.0)
    for step in range(4):
        one, other = plain.batch(step), weighted.batch(step)
        assert other.weight is None
        for field in fields(Batch):
            a, b = getattr(one, field.name), getattr(other, field.name)
            assert a is b is None or torch.equal(a, b)


def test_the_loss_is_the_weighted_mean_of_valid_steps(loaded: Demonstrations) -> None:
    """A slow oracle: every valid step of every example by itself."""
    episodes = (1, 2, 0)
    loader = make_loader(loaded, episodes, intervention_weight=3.0)
    sampler = ExampleSampler(loaded.lengths[list(episodes)], "frame", 5, 7)
    rng = np.random.default_rng(0)
    for step in range(6):
        batch = loader.batch(step)
        error = torch.from_numpy(rng.random(batch.action.shape).astype(np.float32))
        total = weights = 0.0
        for i, (place, start) in enumerate(sampler.batch(step)):
            episode = episodes[place]
            marks = is_intervention(episode, LENGTHS[episode]) & (episode < 2)
            for k in range(CHUNK):
                if start + k < LENGTHS[episode]:
                    weight = 3.0 if marks[start + k] else 1.0
                    total += weight * error[i, k].mean().item()
                    weights += weight
        found = masked_mean(batch.weighted(error), batch.is_pad, batch.num_valid)
        assert found.item() == pytest.approx(total / weights, rel=1e-5)


def test_processes_share_the_weights_of_a_batch(loaded: Demonstrations) -> None:
    whole = make_loader(loaded, intervention_weight=3.0).batch(2).weight
    parts = [
        make_loader(loaded, intervention_weight=3.0, rank=rank, world_size=2).batch(2).weight
        for rank in range(2)
    ]
    assert whole is not None
    assert torch.equal(torch.cat([part for part in parts if part is not None]), whole)


def test_a_weight_without_interventions_is_refused(episodes: Path, tmp_path: Path) -> None:
    out = tmp_path / "run"
    options = [
        "--dataset",
        str(episodes),
        "--cameras",
        "none",
        "--no_object_pose",
        "--out",
        str(out),
    ]
    with pytest.raises(RequestError, match=r"intervention_weight 2: no episode of .*Teleop"):
        train.main(["Mlp", *options, "--intervention_weight", "2"])
    assert not out.exists()


def test_the_option_is_kept_in_the_config() -> None:
    config = TrainConfig.from_preset("Act", "cpu")
    assert config.training.intervention_weight == 1.0
    changed = TrainConfig.from_json({**config.to_json(), "intervention_weight": 2.5})
    assert changed.training.intervention_weight == 2.5
    old = {k: v for k, v in config.to_json().items() if k != "intervention_weight"}
    assert TrainConfig.from_json(old) == config
    with pytest.raises(RequestError, match="intervention_weight 0"):
        replace(config.training, intervention_weight=0.0)
