"""Metrics of a training run: ``metrics.jsonl``, its curves, TensorBoard and wandb.

A line of ``metrics.jsonl`` is a JSON object with ``kind``: ``train`` (means over the steps since
the last such line) or ``validation``, and ``step``, the number of steps done.
"""

from __future__ import annotations

import io
import json
import logging
import math
import os
import socket
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Literal, Protocol

from robo_manip_baselines.runs.documents import IGNORES_OTHERS, convert, parse_json, read_json_lines
from robo_manip_baselines.runs.errors import RequestError, require_choice
from robo_manip_baselines.runs.extras import pip_install
from robo_manip_baselines.runs.files import AppendFile, atomic_file, disk_errors, write_text
from robo_manip_baselines.runs.ranges import NonNegativeInt

TENSORBOARD = "tensorboard"
"""Folder of a run with files for TensorBoard."""

EVENTS = "events.out.tfevents"
EVENTS_SUFFIX = ".run"
"""Start and end of the names of these files."""

LOGGERS = ("tensorboard", "wandb", "none")


@dataclass(frozen=True)
class MetricsLine:
    """Fields of every line of ``metrics.jsonl``, beside numbers by name."""

    __pydantic_config__: ClassVar = IGNORES_OTHERS

    kind: Literal["train", "validation"]
    step: NonNegativeInt


def read_metrics(path: Path) -> list[dict[str, Any]]:
    """Read ``metrics.jsonl``; a last line that was cut off is left out.

    Raises:
        RequestError: the file cannot be read, or another line is damaged.
    """
    lines: list[dict[str, Any]] = []
    for number, text in read_json_lines(path) if path.exists() else ():
        source = f"'{path}', line {number}"
        values = convert(parse_json(text, source), dict, source)
        head = convert(values, MetricsLine, source)
        rest = {name: value for name, value in values.items() if name not in vars(head)}
        lines.append({**vars(head), **convert(rest, dict[str, float], source)})
    return lines


class Board(Protocol):
    """Display of scalars beside the file: TensorBoard or wandb."""

    def add_scalar(self, tag: str, scalar_value: float, global_step: int) -> None:
        """Show a number."""

    def close(self) -> None:
        """Write out what is left."""


class MetricsLog:
    """Appends lines to ``metrics.jsonl`` and shows their numbers on a board.

    Args:
        path: of the file; lines of steps after ``step`` are dropped.
        step: that training goes on from.
        board: as `open_board` makes it.
    """

    def __init__(self, path: Path, step: int, board: Board | None) -> None:
        # lines after the step would be written twice
        kept = [line for line in read_metrics(path) if line["step"] <= step]
        write_text(path, "".join(f"{_to_line(line)}\n" for line in kept))
        self._file = AppendFile(path)
        self._board = board

    def write(self, kind: str, step: int, values: Mapping[str, float]) -> None:
        """Write a line, at once."""
        # JSON has no NaN: a number that is none is left out.
        finite = {name: value for name, value in values.items() if math.isfinite(value)}
        line = _to_line({"kind": kind, "step": step, **finite})
        self._file.append(f"{line}\n".encode())
        if self._board:
            for name, value in finite.items():
                self._board.add_scalar(f"{kind}/{name}", value, step)

    def __enter__(self) -> MetricsLog:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close file and board."""
        self._file.close()
        if self._board:
            self._board.close()


def open_board(logger: str, folder: Path, step: int, config: Mapping[str, Any]) -> Board | None:
    """Open TensorBoard or wandb, or nothing.

    Args:
        logger: one of ``LOGGERS``.
        folder: of the run.
        step: that training goes on from; what TensorBoard has of later steps is hidden.
        config: of the run, for wandb.

    Raises:
        RequestError: the logger is unknown or not installed.
    """
    require_choice("logger", logger, LOGGERS)
    if logger == "none":
        return None
    try:
        if logger == "tensorboard":
            return _TensorBoard(folder / TENSORBOARD, step)
        return _Wandb(folder, config)
    except ImportError as error:
        remedy = f"say --logger none, or run: {pip_install(logger)}"
        raise RequestError(f"{logger} is not installed; {remedy}") from error


class _TensorBoard:
    """File of events for TensorBoard, made when the first number is added.

    TensorBoard's own writer has a thread, which a full disk ends with a traceback.
    """

    def __init__(self, folder: Path, step: int) -> None:
        import tensorboard.summary.writer.record_writer  # noqa: F401 — not installed: found out now

        self._folder, self._step = folder, step
        self._file: AppendFile | None = None

    def add_scalar(self, tag: str, scalar_value: float, global_step: int) -> None:
        """Add a number."""
        import tensorboard.compat.proto.event_pb2 as made_by_protobuf

        events: Any = made_by_protobuf
        if self._file is None:
            with disk_errors(self._folder):
                self._folder.mkdir(parents=True, exist_ok=True)
            self._file = AppendFile(self._folder / _event_file_name())
            self._append(events.Event(wall_time=time.time(), file_version="brain.Event:2"))
            if self._step:  # hides what an interrupted process has written of later steps
                log = events.SessionLog(status=events.SessionLog.START)
                self._append(
                    events.Event(wall_time=time.time(), step=self._step + 1, session_log=log)
                )
        event = events.Event(wall_time=time.time(), step=global_step)
        event.summary.value.add(tag=tag, simple_value=scalar_value)
        self._append(event)

    def close(self) -> None:
        """Close the file."""
        if self._file is not None:
            self._file.close()

    def _append(self, event: Any) -> None:
        from tensorboard.summary.writer.record_writer import RecordWriter

        assert self._file is not None
        record = io.BytesIO()
        RecordWriter(record).write(event.SerializeToString())
        self._file.append(record.getvalue())


def _event_file_name() -> str:
    parts = f"{time.time():017.6f}", socket.gethostname(), str(os.getpid())
    return f"{EVENTS}.{'.'.join(parts)}{EVENTS_SUFFIX}"


class _Wandb:
    """wandb behind the same two calls; a resumed run goes on under its own name."""

    def __init__(self, folder: Path, config: Mapping[str, Any]) -> None:
        import wandb  # pyright: ignore[reportMissingImports]

        self._run = wandb.init(
            project="robo_manip_baselines",
            id=folder.resolve().name,
            dir=str(folder),
            config=dict(config),
            resume="allow",
        )

    def add_scalar(self, tag: str, scalar_value: float, global_step: int) -> None:
        """Show a number."""
        self._run.log({tag: scalar_value}, step=global_step)

    def close(self) -> None:
        """Write out what is left."""
        self._run.finish()


def _to_line(values: Mapping[str, Any]) -> str:
    rounded = {k: float(f"{v:.7g}") if isinstance(v, float) else v for k, v in values.items()}
    return json.dumps(rounded, allow_nan=False)


def write_curves(
    path: Path,
    lines: Sequence[dict[str, Any]],
    title: str,
    panels: Mapping[str, Sequence[str]] | None = None,
) -> bool:
    """Draw the losses of ``metrics.jsonl`` over the steps, on a logarithmic scale.

    Args:
        path: of the PNG.
        lines: as `read_metrics` gives them.
        title: above the panels.
        panels: label of each panel, and the numbers drawn in it; by default every loss has one.

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
    if panels is None:
        other = ("kind", "step", "epoch", "learning_rate", "grad_norm", "seconds")
        # A part that is 0 throughout is not drawn: the network has none of it.
        parts = [n for n in train[-1] if n not in other and not n.startswith("seconds_")]
        parts = [n for n in parts if n == "loss" or any(line.get(n) for line in train)]
        # A policy whose loss has one part calls it twice.
        if len(parts) == 2 and all(line[parts[0]] == line.get(parts[1]) for line in train):
            parts.pop()
        panels = {name: (name,) for name in parts}
    figure = Figure(figsize=(4.5 * len(panels), 4.0), layout="constrained")
    FigureCanvasAgg(figure)
    for place, (panel, names) in enumerate(panels.items()):
        axes = figure.add_subplot(1, len(panels), place + 1)
        for kind, marker in (("train", ""), ("validation", "o")):
            for name in names:
                points = [(x["step"], x[name]) for x in by_kind[kind] if x.get(name, 0.0) > 0.0]
                if points:
                    people = "training" if kind == "train" else "held out"
                    label = people if len(names) == 1 else f"{people}: {name.replace('_', ' ')}"
                    axes.plot(*zip(*points, strict=True), marker=marker, markersize=3, label=label)
        axes.set_yscale("log")
        axes.set_xlabel("step")
        axes.set_ylabel(panel)
        axes.grid(True, which="both", alpha=0.3)
        if axes.lines and validation and (place == 0 or len(names) > 1):
            axes.legend()
    # It may be the name of a folder: no formula, and bytes that are no UTF-8 cannot be drawn.
    readable = title.encode(errors="replace").decode()
    figure.suptitle(readable, parse_math=False)
    with atomic_file(path) as temporary:
        figure.savefig(temporary, format="png", dpi=120)
    return True
