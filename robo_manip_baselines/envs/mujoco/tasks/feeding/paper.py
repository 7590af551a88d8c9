"""The paper's results of the feeding task (Tables IV and V), its claims, and figures of reports.

*Improving Robotic Imitation Learning with Predicted Facial Motion Using Transformers*. Each
configuration was evaluated in 50 independent trials (section IV.C). The paper gives rates in per
cent, all of them whole counts of 50, and mean times to a tenth of a second, without a spread.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from robo_manip_baselines.envs.mujoco.tasks.feeding.metrics import REACH
from robo_manip_baselines.envs.mujoco.tasks.feeding.success import MOUTH_TOLERANCE
from robo_manip_baselines.envs.mujoco.tasks.registry import (
    Claim,
    EpisodeFigure,
    PublishedResult,
    TaskStudy,
)

PAPER_ERROR = "uniform"
"""Error that is the paper's "with error": uniform within the bounds of its equations 6 and 7."""

PAPER_HORIZONS = range(1, 6)
"""Frames of 1/30 s, Tables IV and V."""

LITTLE = 0.10
"""Largest cost of errors, as a rate, that counts as little. The paper's own cost 0.05."""

_LITTLE = f"(less than {100 * LITTLE:.0f} points)"

# (successes of 50, mean time in s) at 1 ... 5 frames: 66, 74, 72, 68, 60 and 58, 72, 68, 62, 54 %.
_WITHOUT_ERROR = ((33, 4.6), (37, 4.3), (36, 4.4), (34, 4.4), (30, 4.5))
_WITH_ERROR = ((29, 4.7), (36, 4.3), (34, 4.5), (31, 4.5), (27, 4.6))


def _h(horizon: int, error: str = "") -> str:
    return f"current_pred_h{horizon}{error}"


_ERROR = f"_{PAPER_ERROR}"

PAPER_CLAIMS = (
    Claim("The present mouth position raises success", {"current": 1.0, "baseline": -1.0}),
    Claim("A forecast of 2 frames raises it further", {_h(2): 1.0, "current": -1.0}),
    Claim(
        "2–3 frames are better than 1, 4 and 5",
        {_h(h): 1 / 2 if h in (2, 3) else -1 / 3 for h in (2, 3, 1, 4, 5)},
    ),
    Claim(
        f"Errors cost little {_LITTLE}",
        {
            **{_h(h, _ERROR): 1 / 5 for h in PAPER_HORIZONS},
            **{_h(h): -1 / 5 for h in PAPER_HORIZONS},
        },
        limit=-LITTLE,
    ),
    Claim(
        "2 frames are faster than the present position alone",
        {"current": 1.0, _h(2): -1.0},
        measure="time",
    ),
)
"""Claims of the paper (section V)."""

FURTHER_CLAIMS = (
    Claim(
        "A forecast of 2 frames is worth more than a frozen one",
        {_h(2): 1.0, _h(2, "_persistence"): -1.0},
    ),
    Claim(
        "A forecast of 2 frames is worth more than the motion of another time",
        {_h(2): 1.0, _h(2, "_shuffled"): -1.0},
    ),
    Claim(
        f"A trained predictor in place of the true future costs little {_LITTLE}",
        {_h(2, "_model"): 1.0, _h(2): -1.0},
        limit=-LITTLE,
    ),
    Claim(
        "An expert who anticipates teaches more (4 frames)",
        {_h(4, "_anticipatory"): 1.0, _h(4): -1.0},
    ),
)
"""Claims about conditions of ``conditions/feeding.yaml`` that the paper does not have."""


FACE_VIEW = 0.06
"""m to every side of the mouth in the figure of arrivals."""

_GREEN, _RED, _INK = "#009e73", "#d55e00", "#1f2328"


def draw_arrivals(axes: Any, results: Sequence[Mapping[str, Any]], many: bool) -> None:
    """Draw where on the mouth's plane the cube came nearest, seen from in front of the face.

    Args:
        axes: of Matplotlib, in mm; the person's left is on the right.
        results: columns of the result rows of one condition, with ``is_success``.
        many: whether the points are many, and drawn as pixels.
    """
    across, up = 1000.0 * MOUTH_TOLERANCE[1:]
    view = 1000.0 * FACE_VIEW
    at_face = [
        (1000.0 * offset[1], 1000.0 * offset[2], result["is_success"])
        for result in results
        if (offset := result["cube_offset"]) is not None and abs(offset[0]) < REACH
    ]
    seen = [p for p in at_face if max(abs(p[0]), abs(p[1])) <= view]
    for is_success, color, marker in ((False, _RED, "x"), (True, _GREEN, ".")):
        points = np.array([p[:2] for p in seen if p[2] == is_success]).reshape(-1, 2)
        axes.plot(*points.T, marker, color=color, ms=3.5, mew=0.7, alpha=0.7, rasterized=many)
    box = [-across, across, across, -across, -across], [-up, -up, up, up, -up]
    axes.plot(*box, color=_INK, lw=1.2)
    missing = f"{len(results) - len(at_face)} not at the face"
    if outside := len(at_face) - len(seen):
        missing += f", {outside} outside"
    axes.text(0.02, 0.02, missing, transform=axes.transAxes, fontsize=7)
    axes.set(xlim=(-view, view), ylim=(-view, view), aspect="equal")


ARRIVALS = EpisodeFigure(
    name="arrivals",
    title="Where on the face the cube arrived",
    caption="The centre of the cube on the mouth's plane where, held, it was nearest to the mouth, "
    f"if that was within {1000 * REACH:.0f} mm along the face's normal. Green dots: successes; red "
    f"crosses: failures; the box: ±{1000 * MOUTH_TOLERANCE[1]:.0f} mm, the tolerance that "
    "Algorithm 1 gives to the gripper behind it.",
    summary="One scatter plot for each condition; the numbers are in the table of how episodes "
    "ended.",
    xlabel="across the face, mm (right: the person's left)",
    ylabel="up, mm",
    draw=draw_arrivals,
)

STUDY = TaskStudy(
    published={
        "baseline": PublishedResult(21, 4.9),  # 42 %
        "current": PublishedResult(30, 4.6),  # 60 %
        **{_h(h): PublishedResult(*_WITHOUT_ERROR[h - 1]) for h in PAPER_HORIZONS},
        **{_h(h, _ERROR): PublishedResult(*_WITH_ERROR[h - 1]) for h in PAPER_HORIZONS},
    },
    trials=50,
    time_rounding=0.05,
    success_table="Table IV",
    time_table="Table V",
    claims=PAPER_CLAIMS + FURTHER_CLAIMS,
    figures=(ARRIVALS,),
)
"""Counts of Table IV (of 50) and mean times of Table V, by the name of the condition."""
