"""Curves of an episode: joints and their commands, the gripper's way to the target, phases."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np

from robo_manip_baselines.data.episode import EpisodeReader

AXES = ("x", "y", "z")
COLORS = ("#0072b2", "#e69f00", "#009e73")
"""Of x, y and z; Okabe and Ito's, which people with any colour vision can tell apart."""

SHADES = ("#00000000", "#0000000d")
"""Of successive phases."""

NARROWEST = 16
"""Part of the episode, 1 / 16, below which a phase has no room for its name."""


def draw_episode(figure: Any, episode: EpisodeReader) -> None:
    """Draw the arrays of an episode against time, a row of panels for each joint of an arm.

    Measured values are solid, commands dashed; positions of the gripper are solid, those of the
    target dashed. Phases are shaded.

    Args:
        figure: an empty Matplotlib figure, with constrained layout.
        episode: an open file.
    """
    arrays, attributes = episode.arrays, episode.attributes
    time = arrays["time"]
    joints, actions = attributes["joint_names"], attributes["action_names"]
    grippers = [name for name in actions if name not in joints]
    rows = -(-(len(joints) + len(grippers)) // 2)
    figure.set_size_inches(9.0, 2.4 + 1.15 * rows + 2.2)
    panels = figure.add_gridspec(rows + 2, 2, height_ratios=[2.0, 1.2, *[1.0] * rows])
    _draw_way(figure.add_subplot(panels[0, :]), episode)
    _draw_distance(figure.add_subplot(panels[1, :]), episode)
    curves = [(name, arrays["joint_position"][:, i], "rad") for i, name in enumerate(joints)]
    curves += [(n, arrays["gripper_position"][:, i], "m") for i, n in enumerate(grippers)]
    for number, (name, measured, unit) in enumerate(curves):
        axes = figure.add_subplot(panels[2 + number // 2, number % 2])
        axes.plot(time, arrays["action"][:, actions.index(name)], "--", color=COLORS[1])
        axes.plot(time, measured, color=COLORS[0])
        axes.set_title(f"{name}, {unit}", fontsize=9, loc="left")
        _finish(axes, episode, is_last=number >= len(curves) - 2)
    task, seed = attributes["env_id"].rpartition("/")[2], attributes["seed"]
    end = "success" if attributes["is_success"] else "no success"
    source = attributes["expert"]
    if episode.task.target_field:
        motion = attributes["env_kwargs"].get("motion", "recorded")
        source += f", motion {motion} ({attributes['motion_clip']})"
    figure.suptitle(f"{task}, seed {seed}: {source}; {end}", fontsize=11)


def _draw_way(axes: Any, episode: EpisodeReader) -> None:
    """Draw the gripper's position and the target's, world frame, and name the phases."""
    arrays, time = episode.arrays, episode.arrays["time"]
    gripper, target = arrays["end_effector_position"], _target(episode)
    for axis, (name, color) in enumerate(zip(AXES, COLORS, strict=True)):
        axes.plot(time, gripper[:, axis], color=color, label=f"gripper {name}")
        if target is None:
            continue
        axes.plot(time, target[:, axis], "--", color=color, label=f"{_target_name(episode)} {name}")
    axes.set_ylabel("m, world")
    axes.legend(ncols=6, fontsize=8, loc="lower left", bbox_to_anchor=(0.0, 1.0))
    axes.margins(y=0.2)
    _finish(axes, episode, is_last=False)
    for start, end, phase in _phases(episode):
        if (end - start) * NARROWEST < len(time):
            continue
        middle = time[(start + end - 1) // 2]
        axes.annotate(phase, (middle, 0.02), xycoords=("data", "axes fraction"),
                      ha="center", fontsize=8, color="#555555")  # fmt: skip


def _draw_distance(axes: Any, episode: EpisodeReader) -> None:
    """Draw the distance between gripper and target."""
    if (target := _target(episode)) is None:
        axes.set_axis_off()
        return
    offset = episode.arrays["end_effector_position"] - target
    axes.plot(episode.arrays["time"], 100.0 * np.linalg.norm(offset, axis=1), color="#333333")
    axes.set_ylabel(f"to {_target_name(episode)}, cm")
    axes.set_ylim(bottom=0.0)
    _finish(axes, episode, is_last=False)


def _finish(axes: Any, episode: EpisodeReader, *, is_last: bool) -> None:
    time = episode.arrays["time"]
    for number, (start, end, _) in enumerate(_phases(episode)):
        last = time[min(end, len(time) - 1)]
        axes.axvspan(time[start], last, color=SHADES[number % 2], linewidth=0)
    axes.set_xlim(time[0], time[-1])
    axes.grid(visible=True)
    if is_last:
        axes.set_xlabel("s")
    else:
        axes.tick_params(labelbottom=False)


def _target(episode: EpisodeReader) -> np.ndarray | None:
    """(T, 3) m, world: the true target at each step; None where the episode has none."""
    if not episode.task.target_field:
        return None
    return episode.arrays[episode.task.target_field][:, 0]


def _target_name(episode: EpisodeReader) -> str:
    return episode.task.names.target


def _phases(episode: EpisodeReader) -> list[tuple[int, int, str]]:
    """Return first step, step after the last, and name of each stretch of one phase."""
    phase, names = episode.arrays["phase"], episode.attributes["phase_names"]
    changes = np.flatnonzero(np.diff(phase)) + 1
    bounds = [0, *changes.tolist(), len(phase)]
    return [(start, end, names[int(phase[start])]) for start, end in pairwise(bounds)]
