"""Ranges of numbers, for options and for files."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, Any, Literal

import pytest
from annotated_types import Interval

from face_prediction.commands.build_dataset import BuildDatasetOptions
from face_prediction.commands.evaluate import EvaluateOptions
from face_prediction.commands.export_stats import ExportStatsOptions
from face_prediction.commands.export_surface import ExportSurfaceOptions
from face_prediction.commands.live import LiveOptions
from face_prediction.dataset.sequences import SequenceSettings
from face_prediction.models.settings import MODELS, PredictorTrainSettings
from face_prediction.motion.motion import MotionSettings, QualityLimits
from face_prediction.tracking.detector import DetectorSettings
from face_prediction.tracking.extract import ExtractSettings
from face_prediction.training.options import FaceTrainOptions
from robo_manip_baselines.benchmark.plan import BenchmarkPreset
from robo_manip_baselines.commands.benchmark import BenchmarkOptions
from robo_manip_baselines.commands.rollout import PolicyOptions, RolloutOptions, ScriptedOptions
from robo_manip_baselines.observation import Corruption, ObservationSpec
from robo_manip_baselines.policy.act.config import ActConfig
from robo_manip_baselines.policy.mlp.config import MlpConfig
from robo_manip_baselines.policy.presets import ActionExecution, PolicyDims, TrainSettings
from robo_manip_baselines.policy.registry import make_model
from robo_manip_baselines.rollout.demonstrate import Collection
from robo_manip_baselines.rollout.evaluation import EvaluationConfig
from robo_manip_baselines.runs.errors import RequestError
from robo_manip_baselines.runs.ranges import (
    Amount,
    Count,
    Fraction,
    number_fields,
    require_range,
    require_ranges,
)
from robo_manip_baselines.training.config import TrainConfig

OPTIONS: tuple[type, ...] = (
    *(ActConfig, ActionExecution, BenchmarkOptions, BenchmarkPreset, BuildDatasetOptions),
    *(Collection, Corruption, DetectorSettings, EvaluateOptions, EvaluationConfig),
    *(ExportStatsOptions, ExportSurfaceOptions, ExtractSettings, FaceTrainOptions, LiveOptions),
    *(MlpConfig, MotionSettings, ObservationSpec, PolicyDims, PolicyOptions),
    *(PredictorTrainSettings, QualityLimits, RolloutOptions, ScriptedOptions, SequenceSettings),
    *(TrainConfig, TrainSettings),
    *(settings for settings, _ in MODELS.values()),
)
"""Dataclasses with options and settings."""


@pytest.mark.parametrize("kind", OPTIONS)
def test_every_number_declares_its_range(kind: type) -> None:
    without = [name for name, _, interval in number_fields(kind) if interval is None]
    free = {"channels", "seconds"}  # lists with rules of their own, and expected durations
    assert set(without) <= free


@dataclass(frozen=True)
class Settings:
    count: Count | None = None
    few: Annotated[int, Interval(ge=1, le=5)] = 1
    share: Fraction = 0.0
    amount: Amount = 0.0
    free: float = 0.0
    whole: int = 0
    many: tuple[Count, ...] = ()
    choice: Literal["a", "b"] = "a"
    is_on: bool = True


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"count": 0}, "count 0: must be 1 to 1000000000"),
        ({"few": 6}, "few 6: must be 1 to 5"),
        ({"few": 10**5000}, "few an integer of 16610 bits: must be 1 to 5"),
        ({"share": 1.0}, "share 1.0: must be 0 or more, less than 1"),
        ({"share": math.nan}, "share nan: must be 0 or more, less than 1"),
        ({"amount": math.inf}, "amount inf: must be 0 or more, and finite"),
        ({"free": math.nan}, "free nan: must be finite"),
        ({"whole": 2**63}, "whole 9223372036854775808: must be of 64 bits"),
        ({"many": (1, 0)}, "many 0: must be 1 to 1000000000"),
        ({"choice": "c"}, "choice 'c': unknown; valid: a, b"),
    ],
)
def test_what_is_out_of_range_is_named(values: dict[str, Any], message: str) -> None:
    require_ranges(Settings())
    with pytest.raises(RequestError) as caught:
        require_ranges(Settings(**values))
    assert str(caught.value) == message


def test_one_number() -> None:
    require_range("steps", 3, Count)
    with pytest.raises(RequestError, match=r"^steps 0: must be 1 to 1000000000$"):
        require_range("steps", 0, Count)


def test_networks_that_no_memory_holds_are_refused() -> None:
    dims = PolicyDims(state=14, action=7, cameras=0, image=(480, 640))
    for name, config in (
        ("Mlp", MlpConfig(hidden_size=60_000, hidden_layers=256)),
        ("Act", ActConfig(hidden_size=60_000)),
        ("Act", ActConfig(feedforward_size=65_536, state_layers=256)),
    ):
        with pytest.raises(RequestError, match=r"a network of [\d,]+ parameters needs [\d.]+ GiB"):
            make_model(name, config, dims)


@pytest.mark.parametrize(
    ("name", "config", "cameras"),
    [
        ("Mlp", MlpConfig(), 0),
        ("Act", ActConfig(hidden_size=256, feedforward_size=512), 3),
        ("Act", ActConfig(hidden_size=128, feedforward_size=512, state_layers=2), 0),
    ],
)
def test_parameters_are_counted(name: str, config: Any, cameras: int) -> None:
    dims = PolicyDims(state=14, action=7, cameras=cameras, image=(48, 64))
    model = make_model(name, config, dims)
    count = sum(parameter.numel() for parameter in model.parameters())
    assert config.num_parameters(dims) == pytest.approx(count, rel=0.05)
