"""Settings of the corruption: what is valid, how it is named, typed and stored."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from robo_manip_baselines.observation import Corruption, ObservationSpec
from robo_manip_baselines.observation.corruption import ERRORS, MEASURED_ERRORS
from robo_manip_baselines.observation.error_models import DRAWN_ERRORS
from robo_manip_baselines.observation.error_stats import load_error_stats
from robo_manip_baselines.runs.errors import RequestError


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"error": "unifrom"}, "unknown error model 'unifrom' .*did you mean 'uniform'"),
        ({"error_stats": "x.json"}, "error_stats 'x.json' goes with the errors uniform, gaussian"),
        ({"error": "model", "error_stats": "x.json"}, "not with 'model'"),
        ({"delay": -1}, "delay -1: must be 0 to 900 frames"),
        ({"face_dropout": -0.1}, "face_dropout -0.1: must be 0 or more"),
        ({"face_dropout": 0.94}, "face_dropout 0.94: must be 0 to 0.938.*losses of 15 frames"),
        ({"face_dropout": 0.6, "face_dropout_length": 1.0}, "must be 0 to 0.5"),
        ({"face_dropout": float("nan")}, "face_dropout nan"),
        ({"face_dropout_length": 0.5}, "face_dropout_length 0.5: must be 1 to 1000000"),
        ({"face_dropout_length": float("inf")}, "face_dropout_length inf"),
        ({"detector_rate": 0.0}, "detector_rate 0.0: must be more than 0, 30 or less"),
        ({"detector_rate": 31.0}, "detector_rate 31"),
        ({"detector_rate": float("nan")}, "detector_rate nan"),
        ({"seed": -1}, "corruption_seed -1: must be 0 to 9007199254740991"),
    ],
)
def test_invalid_settings_get_one_line(values: dict[str, Any], message: str) -> None:
    with pytest.raises(RequestError, match=message) as caught:
        Corruption(**values)
    assert "\n" not in str(caught.value)


def test_unknown_settings_are_named() -> None:
    with pytest.raises(RequestError, match=r"unknown name 'dealy' .*did you mean 'delay'"):
        Corruption.from_json({"dealy": 3})
    assert Corruption.from_json({"delay": 3}) == Corruption(delay=3)


def test_every_measured_error_can_be_drawn() -> None:
    assert set(DRAWN_ERRORS) == set(MEASURED_ERRORS)
    assert set(ERRORS) == {"none", "model", *DRAWN_ERRORS}


@pytest.mark.parametrize(
    ("corruption", "label"),
    [
        (Corruption("uniform"), "uniform"),
        (Corruption("gaussian", "a/mine.json"), "gaussian_mine"),
        (Corruption(delay=3), "delay3"),
        (Corruption(prediction="kalman"), "kalman"),
        (Corruption(prediction="persistence", delay=3), "persistence_delay3"),
        (Corruption("model", delay=2, detector_rate=10.0), "model_delay2_rate10"),
        (Corruption(face_dropout=0.1), "dropout0.1"),
        (Corruption(face_dropout=0.1, face_dropout_length=30), "dropout0.1x30"),
        (Corruption("uniform", seed=4), "uniform_draw4"),
    ],
)
def test_labels_tell_conditions_apart(corruption: Corruption, label: str) -> None:
    assert corruption.label == label
    assert corruption


def test_one_switch_turns_everything_off() -> None:
    for off in (Corruption(), Corruption(seed=3, face_dropout_length=4.0)):
        plain = ObservationSpec(obs="current_pred")
        assert replace(plain, corruption=off) == plain
        assert ObservationSpec(obs="baseline", corruption=off).corruption == Corruption()


@pytest.mark.parametrize(
    ("obs", "corruption", "message"),
    [
        ("baseline", Corruption("uniform"), "'uniform' corrupts the mouth, of which .*'baseline'"),
        ("baseline", Corruption(delay=3), "'delay3' corrupts the mouth"),
        ("current", Corruption("model"), "error 'model' is one of forecasts.*'current' shows none"),
        ("current", Corruption("uniform", delay=1), "error 'uniform' is one of forecasts"),
        ("current", Corruption(delay=1, face_dropout=0.1, detector_rate=5.0), None),
        ("current_pred", Corruption("empirical", delay=1), None),
    ],
)
def test_there_must_be_something_to_corrupt(
    obs: str, corruption: Corruption, message: str | None
) -> None:
    if message is None:
        assert ObservationSpec(obs=obs, corruption=corruption).corruption == corruption
        return
    with pytest.raises(RequestError, match=message):
        ObservationSpec(obs=obs, corruption=corruption)


@pytest.mark.parametrize(
    "values",
    [{}, {"error": "uniform", "delay": 2}, {"detector_rate": 10.0}, {"prediction": "kalman"}],
)
def test_a_spec_goes_through_json(values: dict[str, Any]) -> None:
    corruption = Corruption(**values)
    spec = ObservationSpec(obs="current_pred", cameras=("top",), corruption=corruption)
    stored = json.loads(json.dumps(spec.to_json()))
    assert ObservationSpec.from_json(stored) == spec
    assert ("corruption" in stored) == bool(corruption)


def test_a_spec_without_corruption_is_stored_as_ever() -> None:
    """JSON of a spec without corruption, as in early versions; hashes are made of it."""
    stored = (
        '{"obs": "current", "horizon": 2, "cameras": [], "image_size": [480, 640], '
        '"object_pose": true, "error": "none", "arms": "right"}'
    )
    spec = ObservationSpec(obs="current", cameras=(), object_pose=True)
    assert json.dumps(spec.to_json()) == stored
    assert ObservationSpec.from_json(json.loads(stored)) == spec


def test_statistics_are_pinned_to_their_file(stats_file: Path) -> None:
    shipped = Corruption("uniform").pinned()
    assert shipped.stats_sha256 == load_error_stats().sha256
    own = Corruption("gaussian", str(stats_file)).pinned()
    assert own.stats_sha256 == load_error_stats(stats_file).sha256 != shipped.stats_sha256
    for same in (shipped, own, Corruption(delay=3), Corruption("model")):
        assert same.pinned() == same
    with pytest.raises(RequestError, match="not those that were used before"):
        Corruption("gaussian", stats_sha256=own.stats_sha256).pinned()
