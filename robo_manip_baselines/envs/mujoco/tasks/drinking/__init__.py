"""Drinking: bring a cup with a spout to the mouth of a person who moves, and let them drink."""

from robo_manip_baselines.envs.mujoco.tasks.lift import (
    TIME_SINCE_LIFT,
    pose_field,
    start_attribute,
)
from robo_manip_baselines.envs.mujoco.tasks.registry import (
    FACE_ATTRIBUTES,
    FACE_FIELDS,
    FORCE_COLUMNS,
    Field,
    ResultColumn,
    TaskEntry,
)
from robo_manip_baselines.observation.spec import ObservedNames

_PACKAGE = "robo_manip_baselines.envs.mujoco.tasks.drinking"

ENTRY = TaskEntry(
    name="DrinkingEnv",
    env=f"{_PACKAGE}.env:DrinkingEnv",
    max_episode_steps=600,  # 12 s
    experts={"reactive": f"{_PACKAGE}.expert:reactive", "servo": f"{_PACKAGE}.expert:servo"},
    metrics=f"{_PACKAGE}.metrics:DrinkingMetrics",
    failures={
        "never_grasped": "the cup was never lifted by 0.10 m",
        "dropped": "the cup was lifted, and no finger touched it any more before enough was drunk",
        "spilled": "more than a quarter of the liquid was spilled, so that too little was left",
        "missed": "the tip of the spout was never in the mouth",
        "too_late": "it was, and the episode ended before enough was drunk",
    },
    names=ObservedNames("mouth", ("cup",)),
    object_fields=("object_pose",),
    fields=(
        *FACE_FIELDS,
        pose_field(
            "The cup: x, y, z of the middle of its body, then quaternion w, x, y, z; its x axis "
            "points to the spout, its z axis up along the body"
        ),
        Field(
            "liquid",
            ("T", 2),
            "Delivered into the mouth and spilled, as shares of the serving",
            "1",
            rule="not negative",
        ),
    ),
    attributes=(
        *FACE_ATTRIBUTES,
        start_attribute("cup"),
    ),
    columns=(
        TIME_SINCE_LIFT,
        ResultColumn(
            "delivered",
            "float",
            "share of the liquid that went into the mouth, 0 to 1",
            in_report=True,
            in_tables=True,
        ),
        ResultColumn(
            "spilled",
            "float",
            "share of the liquid that went anywhere else, 0 to 1",
            in_report=True,
            in_tables=True,
        ),
        ResultColumn(
            "closest_distance",
            "float",
            "m, smallest distance between the tip of the spout and the mouth while the lifted cup "
            "was held; null without a lift",
            is_optional=True,
        ),
        *FORCE_COLUMNS,
        ResultColumn(
            "dwell",
            "float",
            "s, time in which the tip of the spout was in the mouth opening",
            unit="s",
            in_tables=True,
        ),
    ),
    instruction="Bring the cup to the mouth of the person and pour the drink.",
    success="at least 75 % of the liquid went into the mouth, within 0.03 m of its centre",
    strict_success="at most 5 % was spilled, and the face never pressed with more than 10 N",
    completion_time="from the lift to success",
)
