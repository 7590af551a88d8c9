"""Bimanual feeding: the left hand fetches the cube, and the right one brings it to the mouth."""

from robo_manip_baselines.envs.mujoco.tasks.feeding import ENTRY as FEEDING
from robo_manip_baselines.envs.mujoco.tasks.registry import ResultColumn, TaskEntry

_PACKAGE = "robo_manip_baselines.envs.mujoco.tasks.bimanual_feeding"

ENTRY = TaskEntry(
    name="BimanualFeedingEnv",
    env=f"{_PACKAGE}.env:BimanualFeedingEnv",
    max_episode_steps=600,  # 12 s, the length of a segment of recorded motion
    arms=("both",),
    experts={
        "reactive": f"{_PACKAGE}.expert:reactive",
        "servo": f"{_PACKAGE}.expert:servo",
    },
    metrics=f"{_PACKAGE}.metrics:BimanualFeedingMetrics",
    failures={
        **FEEDING.failures,
        "not_handed_over": "the cube was lifted, and the episode ended before the right gripper "
        "alone held it",
    },
    names=FEEDING.names,
    object_fields=FEEDING.object_fields,
    fields=FEEDING.fields,
    attributes=FEEDING.attributes,
    columns=(
        *FEEDING.columns,
        ResultColumn(
            "handover_time",
            "float",
            "s from the lift until the right gripper alone held the cube; null without a hand-over",
            is_optional=True,
            unit="s",
            in_report=True,
            in_tables=True,
        ),
    ),
    instruction="Pick up the red cube with the left gripper, hand it to the right one, bring it to "
    "the mouth of the person and let go of it.",
    success="handed over in the air, the cube was brought by the right gripper within 0.03, 0.01 "
    "and 0.01 m of the mouth",
    strict_success="the cube let go inside the mouth, never before, and the face never touched by "
    "either arm",
    completion_time="from the lift to success",
)
