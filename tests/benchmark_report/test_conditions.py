"""Descriptions of conditions from their observation specs, and the order of the paper's table."""

from __future__ import annotations

import random

import pytest

from robo_manip_baselines.benchmark.statistics.conditions import (
    BASELINE,
    CURRENT,
    FURTHER,
    PREDICTION,
    ConditionDescription,
    describe_condition,
    sort_conditions,
)
from robo_manip_baselines.envs.mujoco.tasks.feeding.paper import STUDY
from robo_manip_baselines.observation import Corruption, ObservationSpec


@pytest.mark.parametrize(
    ("name", "group", "horizon", "error", "delay", "label"),
    [
        ("baseline", BASELINE, None, "none", 0, "Baseline"),
        ("current", CURRENT, 0, "none", 0, "Current only"),
        ("current_pred_h1", PREDICTION, 1, "none", 0, "Prediction, 1 frame"),
        (
            "current_pred_h2_uniform",
            PREDICTION,
            2,
            "uniform",
            0,
            "Prediction, 2 frames, with error",
        ),
        ("current_pred_h2_model", FURTHER, 2, "model", 0, "Prediction, 2 frames, model error"),
        ("current_pred_h3_delay1", FURTHER, 3, "none", 1, "Prediction, 3 frames, 1 frame late"),
        ("current_delay4", FURTHER, 0, "none", 4, "Current only, 4 frames late"),
        (
            "current_pred_h5_uniform_delay2",
            FURTHER,
            5,
            "uniform",
            2,
            "Prediction, 5 frames, with error, 2 frames late",
        ),
        ("current_h2", FURTHER, None, "none", 0, "current_h2"),
        ("current_pred", FURTHER, None, "none", 0, "current_pred"),
        ("oracle", FURTHER, None, "none", 0, "oracle"),
    ],
)
def test_names(
    name: str, group: str, horizon: int | None, error: str, delay: int, label: str
) -> None:
    found = describe_condition(name)
    assert found == ConditionDescription(name, label, group, horizon, error, delay)


def test_a_spec_describes_its_condition() -> None:
    """Rows of version 2 hold the spec; those of version 1 look the name up."""
    late = ObservationSpec("current_pred", 3, (), corruption=Corruption("uniform", delay=40))
    found = describe_condition(late.name, late)
    assert (found.horizon, found.error, found.delay) == (3, "uniform", 40)
    assert found.label == "Prediction, 3 frames, with error, 40 frames late"
    for name in ("baseline", "current", "current_delay4", "current_pred_h5_model_delay1"):
        looked_up = describe_condition(name)
        obs = name.partition("_h")[0].partition("_delay")[0]
        corruption = Corruption(looked_up.error, delay=looked_up.delay)
        spec = ObservationSpec(obs, looked_up.horizon or 1, (), corruption=corruption)
        assert spec.name == name
        assert describe_condition(name, spec) == looked_up


def test_history_has_no_horizon() -> None:
    """It is no point of the axis on which forecasts lie."""
    spec = ObservationSpec("history", cameras=(), corruption=Corruption(delay=4))
    label = "Current and 5 past frames, 4 frames late"
    wanted = ConditionDescription("history_delay4", label, FURTHER, None, "none", 4)
    assert describe_condition("history_delay4", spec) == wanted


def test_a_condition_that_differs_in_more_than_its_spec_says() -> None:
    spec = ObservationSpec("current_pred", 2, corruption=Corruption("model"))
    assert describe_condition("current_pred_h2_shuffled", spec) == ConditionDescription(
        "current_pred_h2_shuffled", "current_pred_h2_shuffled", FURTHER
    )
    lost = ObservationSpec("current", corruption=Corruption(face_dropout=0.1))
    assert describe_condition(lost.name, lost, "Lost").label == "Lost"
    assert describe_condition(lost.name, lost).horizon is None


def test_order_is_that_of_the_papers_table() -> None:
    names = [
        "baseline",
        "current",
        "current_pred_h1",
        "current_pred_h1_uniform",
        "current_pred_h2",
        "current_pred_h5",
        "zebra",  # declared: goes before the further conditions that are not
        "ant",
        "current_delay2",
        "current_pred_h2_empirical",
        "current_pred_h2_model",
        "unknown_a",
        "unknown_b",
    ]
    shuffled = list(names)
    random.Random(0).shuffle(shuffled)
    found = sort_conditions(map(describe_condition, shuffled), given=["zebra", "absent", "ant"])
    assert [condition.name for condition in found] == names


def test_a_group_that_is_not_there_is_refused() -> None:
    with pytest.raises(ValueError, match="must be one of Baseline"):
        ConditionDescription("a", "A", "Other")


def test_the_papers_twelve_rows() -> None:
    names = [c.name for c in sort_conditions(map(describe_condition, STUDY.published))]
    assert FURTHER not in {describe_condition(name).group for name in names}
    results = [STUDY.published[name] for name in names]
    # Table IV, read row by row: without, then with error.
    assert [round(100 * result.successes / STUDY.trials) for result in results] == [
        *(42, 60),
        *(66, 58, 74, 72, 72, 68, 68, 62, 60, 54),
    ]
    # Table V.
    assert [result.completion_time for result in results] == [
        *(4.9, 4.6),
        *(4.6, 4.7, 4.3, 4.3, 4.4, 4.5, 4.4, 4.5, 4.5, 4.6),
    ]
