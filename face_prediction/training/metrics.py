"""What training says of itself: ``metrics.jsonl`` and its picture ``curves.png``.

A line of ``metrics.jsonl`` is a JSON object with ``kind``: ``train`` (means over the steps since
the last such line) or ``validation``, and ``step``, the number of steps done.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from robo_manip_baselines.runs.files import atomic_file

METRICS_FILE = "metrics.jsonl"
CURVES_FILE = "curves.png"


class RunningMean:
    """Means of numbers that stay on the device until they are asked for.

    Args:
        names: of the numbers.
        rows: of earlier steps, as `rows` gave them.
    """

    def __init__(self, names: Sequence[str] = (), rows: Sequence[Sequence[float]] = ()) -> None:
        self.names = tuple(names)
        self._rows = [list(row) for row in rows]
        self._pending: list[Tensor] = []

    def add(self, numbers: Mapping[str, Tensor]) -> None:
        """Take in the numbers of a step."""
        self.names = tuple(numbers)
        self._pending.append(torch.stack([value.detach().double() for value in numbers.values()]))

    def rows(self) -> list[list[float]]:
        """The numbers of every step so far."""
        if self._pending:
            self._rows += torch.stack(self._pending).tolist()
            self._pending.clear()
        return self._rows

    def take(self) -> dict[str, float]:
        """Means by name; the next ones start anew."""
        columns = list(zip(*self.rows(), strict=True))
        self._rows = []
        return {
            name: math.fsum(column) / len(column)
            for name, column in zip(self.names, columns, strict=True)
        }


def read_metrics(path: Path) -> list[dict[str, Any]]:
    """The lines of ``metrics.jsonl``; a last line that was cut off is left out."""
    lines: list[dict[str, Any]] = []
    if path.is_file():
        for text in path.read_text(encoding="utf-8", errors="replace").splitlines():
            try:
                lines.append(json.loads(text))
            except ValueError:
                break
    return lines


class MetricsLog:
    """Appends lines to ``metrics.jsonl`` in ``folder``.

    Args:
        folder: of the run.
        step: that training goes on from; lines of later steps are dropped, to be written again.
    """

    def __init__(self, folder: Path, step: int) -> None:
        self._path = folder / METRICS_FILE
        kept = [line for line in read_metrics(self._path) if line["step"] <= step]
        with atomic_file(self._path) as temporary:
            temporary.write_text("".join(map(_line, kept)), encoding="utf-8")

    def write(self, kind: str, step: int, numbers: Mapping[str, float]) -> None:
        """Write a line, at once; JSON has no NaN: a number that is none is left out."""
        finite = {k: v for k, v in numbers.items() if math.isfinite(v)}
        with self._path.open("a", encoding="utf-8") as stream:
            stream.write(_line({"kind": kind, "step": step, **finite}))


def draw_curves(folder: Path) -> None:
    """Draw ``metrics.jsonl`` to ``curves.png``; nothing where matplotlib is not installed."""
    lines = read_metrics(folder / METRICS_FILE)
    try:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
    except ImportError:
        return
    figure = Figure(figsize=(9.0, 3.6), dpi=100, layout="constrained")
    FigureCanvasAgg(figure)
    loss, mouth = figure.subplots(1, 2)
    for axes, kind, name, style in (
        (loss, "train", "loss", "-"),
        (loss, "validation", "loss", "o-"),
        (mouth, "validation", "mouth_error", "o-"),
        (mouth, "validation", "persistence_mouth_error", "--"),
    ):
        rows = [line for line in lines if line["kind"] == kind and name in line]
        label = f"{kind} {name}".replace("_", " ")
        if rows:
            steps = [line["step"] for line in rows]
            axes.plot(steps, [line[name] for line in rows], style, ms=3, lw=1, label=label)
    for axes, title in ((loss, "loss"), (mouth, "error of the mouth centre, crops")):
        axes.set_title(title, fontsize="medium")
        axes.set_xlabel("step")
        axes.grid(alpha=0.3)
        if axes.lines:
            axes.set_yscale("log")
            axes.legend(fontsize="small")
    with atomic_file(folder / CURVES_FILE) as temporary:
        figure.savefig(temporary, format="png")


def _line(numbers: Mapping[str, Any]) -> str:
    rounded = {k: float(f"{v:.7g}") if isinstance(v, float) else v for k, v in numbers.items()}
    return json.dumps(rounded, allow_nan=False) + "\n"
