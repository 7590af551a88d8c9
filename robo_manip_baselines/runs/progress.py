"""Progress of a run: a bar on a terminal, a few log lines elsewhere, and closing tables."""

from __future__ import annotations

import logging
import math
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import TypeVar

from tqdm import tqdm

LINES = 10
"""Log lines over a whole task where there is no terminal for a bar: one for each tenth of it."""

FIRST_LINE = 10.0
"""s until the first of them. Where tenths take longer, a line follows whenever the time that has
passed has doubled, so that a long task is not silent and a short one says nothing."""

Item = TypeVar("Item")
Bar = TypeVar("Bar", bound="ProgressBar")

logger = logging.getLogger(__name__)


class ProgressBar:
    """Progress over units of work: a bar on a terminal, at most a few log lines elsewhere.

    Use as a context manager.

    Args:
        total: units of the whole work; None where it is not known, which gives no lines.
        unit: noun of a unit, such as ``episode``; empty for a share of the work, whose time left
            is part of the note.
        label: in front.
        done: units done before.
        shown: whether to show anything at all.
        keep: whether a full bar stays on the terminal.
        form: of the bar, see tqdm's ``bar_format``.
        clock: current time, s.

    Attributes:
        total: units of the whole work.
        note: behind the bar, such as the loss.
    """

    def __init__(
        self,
        total: float | None,
        unit: str,
        label: str = "",
        *,
        done: float = 0,
        shown: bool = True,
        keep: bool = True,
        form: str | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.note = ""
        self.total, self._done, self._start = total, done, done
        self._unit, self._label, self._clock = unit, label, clock
        self._begin = self._last = clock()
        self._tenth = -1
        is_terminal = shown and is_on_terminal()
        self._logs = shown and not is_terminal and total is not None
        self._bar = tqdm(
            total=total,
            initial=done,
            unit=unit,
            desc=label or None,
            leave=keep,
            dynamic_ncols=True,
            disable=not is_terminal,
            bar_format=form,
        )

    def advance(self, count: float = 1) -> None:
        """Count units as done."""
        self.move_to(self._done + count)

    def move_to(self, done: float) -> None:
        """Set the units that are done."""
        count, self._done = done - self._done, done
        if not self._bar.disable:
            self._bar.set_postfix_str(self.note, refresh=False)
            self._bar.update(count)
        elif self._logs and self._is_line_due():
            logger.info("%s", self._line())

    def refresh(self) -> None:
        """Draw the bar again, where nothing was done but time has passed."""
        if not self._bar.disable:
            self._bar.refresh()

    def close(self) -> None:
        """Leave the bar as it is."""
        self._bar.close()

    def __enter__(self: Bar) -> Bar:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _is_line_due(self) -> bool:
        now = self._clock()
        tenth = math.floor(LINES * self._done / self.total) if self.total else LINES
        passed, before = now - self._begin, self._last - self._begin
        if passed < FIRST_LINE or (tenth <= self._tenth and passed < 2.0 * before):
            return False
        self._tenth, self._last = max(tenth, self._tenth), now
        return True

    def _line(self) -> str:
        assert self.total is not None
        passed = self._last - self._begin
        made, remaining = self._done - self._start, self.total - self._done
        amount = f" of {self.total:g} {self._unit}s" if self._unit else ""
        percent = f"{100.0 * self._done / (self.total or 1.0):.0f} %"
        parts = [percent + amount, duration(passed)]
        if self._unit and remaining > 0.0 and made > 0.0:
            parts.append(f"about {duration(passed / made * remaining)} left")
        label = f"{self._label}: " if self._label else ""
        return label + ", ".join([*parts, *filter(None, [self.note])])


def is_on_terminal() -> bool:
    """Return whether a bar can be drawn: stderr is a terminal."""
    return sys.stderr is not None and sys.stderr.isatty()


def track(
    items: Iterable[Item],
    total: float | None,
    unit: str,
    label: str = "",
    *,
    shown: bool = True,
    keep: bool = True,
) -> Iterator[Item]:
    """Yield the items under a `ProgressBar`, each counted when the next one is asked for."""
    with ProgressBar(total, unit, label, shown=shown, keep=keep) as bar:
        for item in items:
            yield item
            bar.advance()


class EpisodeProgress(ProgressBar):
    """Progress over episodes that run at once, by the steps of those that have not ended.

    A step counts as its part of an episode of the mean length of those that have ended, or of the
    longest episode before any has.

    Args:
        total: episodes.
        longest: steps of an episode that runs into its time limit.
        label: in front.
    """

    def __init__(self, total: int, longest: int, label: str) -> None:
        form = "{l_bar}{bar}| {n:.1f}/{total_fmt} {unit}s [{elapsed}<{remaining}{postfix}]"
        super().__init__(total, "episode", label, form=form)
        self._limit = max(total - 0.1, 0.0)
        self._longest = longest
        self._steps = self._ended_steps = self._ended = 0
        self._shown = 0.0

    def step(self, count: int) -> None:
        """Count steps of all episodes together."""
        self._steps += count
        self._show()

    def end(self, steps: int) -> None:
        """Count an episode, of so many steps that have been counted, as ended."""
        self._ended += 1
        self._ended_steps += steps
        self._show()

    def _show(self) -> None:
        mean = self._ended_steps / self._ended if self._ended else self._longest
        running = max(self._steps - self._ended_steps, 0) / max(mean, 1.0)
        # Never back, when the mean has grown; nor full before the last episode has ended.
        self._shown = max(self._shown, self._ended, min(self._ended + 0.9 * running, self._limit))
        self.move_to(self._shown)


class StepProgress:
    """Progress over the steps of a training. Use as a context manager.

    Args:
        total: steps of the whole budget.
        done: steps done by earlier processes.
        seconds: seconds that those took.
        shown: whether to show anything at all.

    Attributes:
        step: steps done.
    """

    def __init__(self, total: int, done: int, seconds: float, *, shown: bool) -> None:
        self.total, self.step = total, done
        self._before, self._start = seconds, time.perf_counter()
        self._bar = ProgressBar(total, "step", done=done, shown=shown)

    @property
    def seconds(self) -> float:
        """Seconds spent so far, by all processes in turn."""
        return self._before + time.perf_counter() - self._start

    def advance(self) -> None:
        """Count one step."""
        self.step += 1
        self._bar.advance()

    def is_due(self, interval: int) -> bool:
        """Return whether something that happens every ``interval`` steps is due, or the end is."""
        return self.step % interval == 0 or self.step == self.total

    def report(self, loss: float) -> None:
        """Show the loss with the progress."""
        self._bar.note = f"loss {loss:.4g}"

    def __enter__(self) -> StepProgress:
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.close()


def closing_table(rows: Mapping[str, str]) -> str:
    """Lay out the table that a command prints at its end: a name and a value in each row."""
    width = max(map(len, rows))
    return "\n".join(f"{name:<{width}}  {value}" for name, value in rows.items())


def duration(seconds: float) -> str:
    """Format a duration: ``45 s``, ``12 min``, ``1 h 05 min``."""
    if seconds < 90.0:
        return f"{seconds:.0f} s"
    minutes = round(seconds / 60.0)
    return f"{minutes} min" if minutes < 90 else f"{minutes // 60} h {minutes % 60:02d} min"
