"""The presets are what the docs say they are."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from robo_manip_baselines.observation import CAMERAS
from robo_manip_baselines.policy.act.config import PRESETS
from robo_manip_baselines.policy.act.model import ActModel
from robo_manip_baselines.policy.interface import PolicyDims
from robo_manip_baselines.training.batching import ExampleSampler


def test_paper_is_table_3() -> None:
    preset = PRESETS["paper"]
    config, training = preset.config, preset.training
    assert config.kl_weight == 10.0
    assert config.chunk_size == 100
    assert config.hidden_size == 512
    assert config.feedforward_size == 3200
    assert training.batch_size == 8
    assert training.learning_rate == 1e-5
    assert training.epochs == 2000
    assert training.sampler == "episode"
    assert (preset.cameras, preset.image_size, preset.object_pose) == (CAMERAS, (480, 640), False)
    sampler = ExampleSampler([430] * 50, training.sampler, training.batch_size, 0)
    assert sampler.total_steps(training) == 12_500


def test_cpu_sees_no_images() -> None:
    preset = PRESETS["cpu"]
    assert (preset.config.num_queries, preset.config.use_cvae) == (6, False)
    assert preset.training.steps == 3000
    assert preset.cameras == ()
    assert preset.object_pose


def test_cpu_images_sees_three_cameras_through_small_encoders() -> None:
    preset = PRESETS["cpu_images"]
    assert (preset.cameras, preset.image_size, preset.object_pose) == (CAMERAS, (96, 128), False)
    assert preset.config == replace(PRESETS["cpu"].config, vision="small")
    assert (preset.training.augment, preset.training.augment_shift) == ("shift", 0.02)
    with torch.device("meta"):
        dims = PolicyDims(29, 7, len(preset.cameras), preset.image_size)
        model = ActModel(preset.config, dims)
    count = sum(parameter.numel() for parameter in model.parameters())
    assert count == 1_134_811  # of which docs/act.md speaks
    assert preset.config.num_parameters(dims) == pytest.approx(count, rel=0.05)
