"""Settings: Table III by default, and one clear line for a value that cannot be."""

from __future__ import annotations

import dataclasses
import json
import subprocess
import sys
from typing import Any

import pytest

from robo_manip_baselines.policy.act.config import ActConfig
from robo_manip_baselines.runs.errors import RequestError


def test_the_defaults_are_those_of_table_three_and_of_the_public_code():
    config = ActConfig()
    assert (config.kl_weight, config.chunk_size) == (10.0, 100)
    assert (config.hidden_size, config.feedforward_size) == (512, 3200)
    assert (config.encoder_layers, config.decoder_layers, config.cvae_layers) == (4, 7, 4)
    assert (config.num_heads, config.latent_size, config.dropout) == (8, 32, 0.1)
    assert config.backbone_learning_rate_factor == 1.0
    assert not config.pre_norm


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"chunk_size": 0}, "chunk_size 0: must be 1 to 10000"),
        ({"decoder_layers": 0}, "decoder_layers 0: must be 1 to 256"),
        ({"num_heads": -1}, "num_heads -1: must be 1 to 1024"),
        ({"hidden_size": 510, "num_heads": 2}, "hidden_size 510: must be a multiple of 4"),
        ({"num_heads": 7}, "hidden_size 512: must be a multiple of num_heads 7"),
        ({"actions_per_query": 0}, "actions_per_query 0: must be 1 to 10000"),
        ({"backbone_width": 12}, "backbone_width 12: must be a multiple of 8"),
        ({"camera_features": 0}, "camera_features 0: must be 1 to 65536"),
        ({"dropout": 1.0}, "dropout 1.0: must be 0 or more, less than 1"),
        ({"dropout": -0.1}, "dropout -0.1: must be 0 or more, less than 1"),
        ({"kl_weight": -1.0}, "kl_weight -1.0: must be 0 or more, and finite"),
        ({"kl_weight": float("nan")}, "kl_weight nan: must be 0 or more, and finite"),
        (
            {"backbone_learning_rate_factor": float("inf")},
            "backbone_learning_rate_factor inf: must be 0 or more, and finite",
        ),
    ],
)
def test_a_wrong_value_is_refused_in_one_line(settings: dict[str, Any], message: str):
    with pytest.raises(RequestError) as error:
        ActConfig(**settings)
    assert str(error.value) == message


@pytest.mark.parametrize(
    "settings",
    [
        {"chunk_size": 1},
        {"actions_per_query": 101},
        {"hidden_size": 4, "num_heads": 4},
        {"dropout": 0.0},
        {"kl_weight": 0.0},
    ],
)
def test_the_edges_are_valid(settings: dict[str, Any]):
    ActConfig(**settings)


def test_it_survives_json():
    config = ActConfig(paper_compat=True, backbone_weights="resnet18.safetensors")
    assert ActConfig(**json.loads(json.dumps(dataclasses.asdict(config)))) == config


@pytest.mark.long
def test_reading_the_settings_imports_no_pytorch():
    code = "import sys, robo_manip_baselines.policy.act.config; assert 'torch' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True, timeout=60)
