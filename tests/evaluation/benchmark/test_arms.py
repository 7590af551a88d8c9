"""What an arm's name says, and the order of the paper's table."""

from __future__ import annotations

import random

import pytest

from robo_manip_baselines.benchmark.statistics.conditions import (
    BASELINE,
    CURRENT,
    FURTHER,
    PREDICTION,
    Arm,
    arm_of,
    in_order,
)
from robo_manip_baselines.envs.mujoco.tasks.feeding.paper import PAPER, TRIALS


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
        ("current_uniform", FURTHER, 0, "uniform", 0, "Current only, with error"),
    ],
)
def test_names(
    name: str, group: str, horizon: int | None, error: str, delay: int, label: str
) -> None:
    assert arm_of(name) == Arm(name, label, group, horizon, error, delay)


def test_order_is_that_of_the_papers_table() -> None:
    names = [
        "baseline",
        "current",
        "current_pred_h1",
        "current_pred_h1_uniform",
        "current_pred_h2",
        "current_pred_h10",
        "zebra",  # described: goes before the arms that are not
        "ant",
        "current_delay2",
        "current_pred_h2_empirical",
        "current_pred_h2_model",
        "unknown_a",
        "unknown_b",
    ]
    described = {"zebra": Arm("zebra", "Z", FURTHER), "ant": Arm("ant", "A", FURTHER)}
    shuffled = names * 2
    random.Random(0).shuffle(shuffled)
    assert [arm.name for arm in in_order(shuffled, described)] == names
    assert in_order(["zebra", "current"], described)[1].label == "Z"


def test_a_group_that_is_not_there_is_refused() -> None:
    with pytest.raises(ValueError, match="must be one of Baseline"):
        Arm("a", "A", "Other")


def test_the_papers_twelve_rows() -> None:
    ours = [arm for arm in in_order(PAPER) if arm.group != FURTHER]
    assert len(ours) == len(PAPER) == 12
    # Table IV, read row by row: without, then with error.
    assert [round(100 * PAPER[arm.name].successes / TRIALS) for arm in ours] == [
        *(42, 60),
        *(66, 58, 74, 72, 72, 68, 68, 62, 60, 54),
    ]
    # Table V.
    assert [PAPER[arm.name].completion_time for arm in ours] == [
        *(4.9, 4.6),
        *(4.6, 4.7, 4.3, 4.3, 4.4, 4.5, 4.4, 4.5, 4.5, 4.6),
    ]
