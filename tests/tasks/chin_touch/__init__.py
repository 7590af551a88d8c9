"""Chin touch: touch the chin of a person who moves with the closed gripper."""

from robo_manip_baselines.envs.mujoco.tasks.registry import (
    FACE_ATTRIBUTES,
    FACE_FIELDS,
    Field,
    ResultColumn,
    TaskEntry,
)
from robo_manip_baselines.observation import ObservedNames

ENTRY = TaskEntry(
    name="ChinTouchEnv",
    env="chin_touch.env:ChinTouchEnv",
    max_episode_steps=400,  # 8 s
    experts={"reactive": "chin_touch.expert:ChinTouchExpert"},
    metrics="chin_touch.metrics:ChinTouchMetrics",
    failures={
        "too_far": "the finger tips were never within 0.03 m of the chin",
        "missed": "they were, but never within 0.01 m with the gripper closed",
    },
    names=ObservedNames(target="chin"),
    target_field="chin_position",
    predicted_field="",  # predictors forecast the mouth
    fields=(
        *FACE_FIELDS,
        Field(
            "chin_position",
            ("T", "K", 3),
            "True chin now (k = 0) and k = 1…K-1 frames of `prediction_period` ahead: x, y, z",
            "m",
            "world",
        ),
    ),
    attributes=FACE_ATTRIBUTES,
    columns=(
        ResultColumn(
            "chin_distance", "float", "m, smallest distance of the finger tips from the chin"
        ),
        ResultColumn(
            "face_force", "float", "N, largest normal force between robot and face", in_report=True
        ),
    ),
    success="the tips of the closed fingers came within 0.01 m of the chin",
    strict_success="and the robot never pressed the face with more than 5 N",
)
