"""Curves of a run as a picture."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from robo_manip_baselines.data.files import atomic_file


def write_curves(path: Path, lines: Sequence[dict[str, Any]], title: str) -> bool:
    """Draw the losses of ``metrics.jsonl`` over the steps, on a logarithmic scale.

    Args:
        path: of the PNG.
        lines: as `read_metrics` gives them.
        title: above the picture.

    Returns:
        Whether it was drawn: matplotlib may not be installed, and there may be nothing to draw.
    """
    try:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
    except ImportError:
        return False
    logging.getLogger("matplotlib").setLevel(logging.WARNING)  # it tells of its font cache
    by_kind = {kind: [x for x in lines if x["kind"] == kind] for kind in ("train", "validation")}
    train, validation = by_kind["train"], by_kind["validation"]
    if not train:
        return False
    other = ("kind", "step", "epoch", "learning_rate", "grad_norm", "seconds")
    # A policy whose loss has one part calls it twice.
    parts = [n for n in train[-1] if n not in other and not n.startswith("seconds_")]
    if len(parts) == 2 and all(line[parts[0]] == line.get(parts[1]) for line in train):
        parts.pop()
    figure = Figure(figsize=(4.5 * len(parts), 4.0), layout="constrained")
    FigureCanvasAgg(figure)
    for place, name in enumerate(parts):
        axes = figure.add_subplot(1, len(parts), place + 1)
        for kind, marker in (("train", ""), ("validation", "o")):
            points = [(x["step"], x[name]) for x in by_kind[kind] if x.get(name, 0.0) > 0.0]
            if points:
                label = "training" if kind == "train" else "held out"
                axes.plot(*zip(*points, strict=True), marker=marker, markersize=3, label=label)
        axes.set_yscale("log")
        axes.set_xlabel("step")
        axes.set_ylabel(name)
        axes.grid(True, which="both", alpha=0.3)
        if place == 0 and validation:
            axes.legend()
    figure.suptitle(title)
    with atomic_file(path) as temporary:
        figure.savefig(temporary, format="png", dpi=120)
    return True
