"""Feeding: bring a cube to the mouth of a person who moves (paper, section IV.C)."""

from robo_manip_baselines.envs.mujoco.tasks.lift import (
    TIME_SINCE_LIFT,
    pose_field,
    start_attribute,
)
from robo_manip_baselines.envs.mujoco.tasks.registry import (
    FACE_ATTRIBUTES,
    FACE_FIELDS,
    FORCE_COLUMNS,
    ResultColumn,
    TaskEntry,
)
from robo_manip_baselines.observation.spec import ObservedNames

_PACKAGE = "robo_manip_baselines.envs.mujoco.tasks.feeding"

APPROACH_LIMIT = 6.0
"""s after the lift within which the gripper should be at the mouth (paper, Algorithm 1, line 10).
``is_success`` has no such limit; tables count the successes within it."""

ENTRY = TaskEntry(
    name="FeedingEnv",
    env=f"{_PACKAGE}.env:FeedingEnv",
    max_episode_steps=600,  # 12 s
    experts={
        "reactive": f"{_PACKAGE}.expert:reactive",
        "anticipatory": f"{_PACKAGE}.expert:anticipatory",
        "servo": f"{_PACKAGE}.expert:servo",
    },
    choices={"utensil": ("gripper", "spoon")},
    metrics=f"{_PACKAGE}.metrics:FeedingMetrics",
    failures={
        "never_grasped": "the cube was never lifted by 0.10 m",
        "dropped": "the cube was lifted, and lost or let go before it was at the mouth; or there "
        "no more than one finger held it",
        "missed_high": "the gripper brought the cube to the face, within 0.06 m of the mouth along "
        "x, and above the mouth",
        "missed_low": "likewise, below the mouth",
        "missed_left": "likewise, to the person's left (world +y)",
        "missed_right": "likewise, to the person's right (world -y)",
        "too_late": "the episode ended with the cube in the gripper and not yet at the mouth",
    },
    names=ObservedNames("mouth", ("cube",)),
    object_fields=("object_pose",),
    fields=(
        *FACE_FIELDS,
        pose_field("The cube: x, y, z, then quaternion w, x, y, z"),
    ),
    attributes=(
        *FACE_ATTRIBUTES,
        start_attribute("cube"),
    ),
    columns=(
        TIME_SINCE_LIFT,
        ResultColumn(
            "closest_distance",
            "float",
            "m, smallest distance gripper-mouth while the lifted cube was held; null without a "
            "lift",
            is_optional=True,
        ),
        ResultColumn(
            "closest_offset",
            "vector",
            "m, x, y, z of gripper minus mouth at the closest approach with the cube, nearest in "
            "units of the tolerances; null without a lift",
            is_optional=True,
            in_report=True,
            unit="m",
        ),
        ResultColumn(
            "cube_offset",
            "vector",
            "m, cube minus mouth in the face's axes (out, across to the person's left, up) where "
            "the lifted cube was held and its centre nearest to the mouth; null without a lift",
            is_optional=True,
        ),
        *FORCE_COLUMNS,
        ResultColumn(
            "dwell",
            "float",
            "s, time in which the gripper, the cube held, was within the tolerance of success",
            is_optional=True,
            unit="s",
            in_tables=True,
            may_be_absent=True,
        ),
    ),
    instruction="Bring the red cube to the mouth of the person and let go of it.",
    success="the gripper brought the cube within 0.03, 0.01 and 0.01 m of the mouth",
    strict_success="the cube let go inside the mouth, the face never touched",
    completion_time="from the lift to success",
    success_time_limit=APPROACH_LIMIT,
    study=f"{_PACKAGE}.paper:STUDY",
    goal_env=f"{_PACKAGE}.goal_env:FeedingGoalEnv",
    schema_version=1,
)
