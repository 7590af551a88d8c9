"""Draw ``data_flow.svg``: the files and programs between a video and the tables of results.

Run: ``python docs/images/draw_data_flow.py``.
"""

from __future__ import annotations

from pathlib import Path

import matplotlib.pyplot as plt
from matplotlib.axes import Axes
from matplotlib.patches import FancyArrowPatch, FancyBboxPatch

FACE, ROBOT, FILE = "#d9efe9", "#dfe7f5", "#ffffff"

BOXES = {
    # name: (text, centre x, centre y, width, colour)
    "video": ("video", 0.8, 5.0, 1.1, FILE),
    "track": ("face track\n.npz", 2.9, 5.0, 1.5, FILE),
    "predictor": ("predictor", 5.3, 5.0, 1.5, FACE),
    "tables12": ("Tables I, II", 7.9, 5.5, 1.7, FILE),
    "stats": ("error statistics\n.json", 7.9, 4.6, 1.7, FILE),
    "motion": ("recorded motion\nmouth, head, jaw, forecasts  .npz", 3.9, 3.4, 3.4, FILE),
    "scene": ("MuJoCo scene\ntwo VX300s, face", 1.5, 2.0, 2.0, ROBOT),
    "expert": ("scripted expert", 4.3, 2.0, 1.8, ROBOT),
    "corruption": ("observation corruption\npredict, error, delay, dropout", 7.4, 3.4, 2.7, ROBOT),
    "episodes": ("episodes\n.hdf5, the truth", 7.4, 2.0, 1.9, FILE),
    "policy": ("policy\ncheckpoint", 7.4, 0.6, 1.7, ROBOT),
    "results": ("results.jsonl", 4.3, 0.6, 1.6, FILE),
    "report": ("Tables IV, V\nreport.html", 1.5, 0.6, 1.7, FILE),
}

ARROWS = (
    # from, to, text
    ("video", "track", "extract"),
    ("track", "predictor", "train"),
    ("predictor", "tables12", "evaluate"),
    ("predictor", "stats", "export-stats"),
    ("track", "motion", "export-motion"),
    ("predictor", "motion", "predict"),
    ("motion", "scene", "replay"),
    ("stats", "corruption", ""),
    ("motion", "corruption", ""),
    ("scene", "expert", ""),
    ("expert", "episodes", "Rollout.py"),
    ("corruption", "episodes", "on reading"),
    ("episodes", "policy", "Train.py"),
    ("policy", "results", "Rollout.py"),
    ("results", "report", "statistics"),
)


def draw(axes: Axes) -> None:
    """Draw boxes and arrows."""
    patches = {}
    for name, (text, x, y, width, colour) in BOXES.items():
        lower_left = (x - width / 2, y - 0.32)
        box = FancyBboxPatch(
            lower_left,
            width,
            0.64,
            boxstyle="round,pad=0.02,rounding_size=0.1",
            facecolor=colour,
            edgecolor="#42526b",
            linewidth=1.0,
        )
        patches[name] = axes.add_patch(box)
        axes.text(x, y, text, ha="center", va="center", fontsize=8.5, color="#1d2733")
    for start, end, text in ARROWS:
        (_, x0, y0, *_), (_, x1, y1, *_) = BOXES[start], BOXES[end]
        axes.add_patch(
            FancyArrowPatch(
                (x0, y0),
                (x1, y1),
                patchA=patches[start],
                patchB=patches[end],
                arrowstyle="-|>",
                mutation_scale=11,
                shrinkA=1,
                shrinkB=1,
                color="#42526b",
                linewidth=1.0,
            )
        )
        if text:
            style = {"facecolor": "white", "edgecolor": "none", "pad": 0.8}
            above = 0.14 if y0 == y1 else 0.0
            middle = (x0 + x1) / 2, (y0 + y1) / 2 + above
            axes.text(*middle, text, ha="center", va="center", fontsize=7, style="italic",
                      color="#42526b", bbox=style)  # fmt: skip
    axes.set(xlim=(0, 9.0), ylim=(0.1, 6.0), aspect="equal")
    axes.axis("off")


def main() -> None:
    """Write the picture beside this file."""
    plt.rcParams.update(
        {"svg.fonttype": "none", "svg.hashsalt": "data flow", "font.family": "sans-serif"}
    )
    figure, axes = plt.subplots(figsize=(9.0, 5.9))
    draw(axes)
    figure.subplots_adjust(0, 0, 1, 1)
    out = Path(__file__).with_name("data_flow.svg")
    figure.savefig(out, metadata={"Date": None}, facecolor="white")


if __name__ == "__main__":
    main()
