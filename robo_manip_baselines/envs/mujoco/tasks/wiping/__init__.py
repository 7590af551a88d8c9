"""Wiping: wipe residue off the cheek of a person who moves, with a soft pad and little force."""

from robo_manip_baselines.envs.mujoco.tasks.registry import (
    FACE_ATTRIBUTES,
    FACE_FIELDS,
    FORCE_COLUMNS,
    Field,
    ResultColumn,
    TaskEntry,
)
from robo_manip_baselines.observation import ObservedNames

_PACKAGE = "robo_manip_baselines.envs.mujoco.tasks.wiping"

ENTRY = TaskEntry(
    name="FaceWipingEnv",
    env=f"{_PACKAGE}.env:FaceWipingEnv",
    max_episode_steps=600,  # 12 s
    experts={
        "reactive": f"{_PACKAGE}.expert:reactive",
        "servo": f"{_PACKAGE}.expert:servo",
    },
    metrics=f"{_PACKAGE}.metrics:WipingMetrics",
    failures={
        "no_contact": "the pad never touched the face",
        "too_hard": "less than 80 % was wiped off, and of the time in contact with a force out of "
        "the range, most was above 3 N",
        "too_light": "likewise, most was below 1 N",
        "missed": "less than 80 % was wiped off, though most of the contact was within 1 to 3 N: "
        "the pad was beside the residue",
    },
    names=ObservedNames("mouth"),
    fields=(
        *FACE_FIELDS,
        Field("pad_force", ("T",), "Normal force between pad and face", "N", rule="not negative"),
        Field(
            "residue",
            ("T", 36),
            "Spots of residue: 1 where it is still on the cheek, 0 where it is wiped off",
            "1",
            dtype="int8",
            rule="not negative",
        ),
    ),
    attributes=FACE_ATTRIBUTES,
    columns=(
        ResultColumn(
            "wiped_share", "float", "share of the residue that was wiped off", in_report=True
        ),
        ResultColumn(
            "pad_force_mean",
            "float",
            "N, mean normal force between pad and face while they touched; null without contact",
            is_optional=True,
            in_report=True,
            unit="N",
            in_tables=True,
        ),
        ResultColumn("contact_time", "float", "s, time with the pad on the face", unit="s"),
        ResultColumn(
            "range_share",
            "float",
            "share of that time with 1 to 3 N; null without contact",
            is_optional=True,
            in_report=True,
        ),
        *FORCE_COLUMNS,
    ),
    instruction="Wipe the residue off the cheek of the person.",
    success="80 % of the residue was wiped off with 1 to 3 N",
    strict_success="and 1 to 3 N in at least 70 % of the contact, never more than 10 N, and no eye "
    "touched, until the end",
)
