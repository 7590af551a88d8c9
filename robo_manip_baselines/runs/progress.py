"""Progress of a run: a bar on a terminal, a few log lines elsewhere, and closing tables."""

from __future__ import annotations

import logging
import sys
import time
from collections.abc import Mapping

from tqdm import tqdm

LINES = 10
"""Log lines over a whole run where there is no terminal for a bar."""

logger = logging.getLogger(__name__)


class StepProgress:
    """Progress over the steps of a training. Use as a context manager.

    Args:
        total: steps of the whole budget.
        done: steps done by earlier processes.
        seconds: seconds that those took.
        shown: whether to show anything at all.
        log_every: steps between calls of `report`.

    Attributes:
        step: steps done.
    """

    def __init__(
        self, total: int, done: int, seconds: float, *, shown: bool, log_every: int
    ) -> None:
        self.total, self.step = total, done
        self._before, self._start = seconds, time.perf_counter()
        self._shown, self._log_every = shown, log_every
        disable = None if shown else True  # None: only where there is no terminal
        self._bar = tqdm(
            total=total, initial=done, unit="step", dynamic_ncols=True, disable=disable
        )

    @property
    def seconds(self) -> float:
        """Seconds spent so far, by all processes in turn."""
        return self._before + time.perf_counter() - self._start

    def advance(self) -> None:
        """Count one step."""
        self.step += 1
        self._bar.update()

    def is_due(self, interval: int) -> bool:
        """Return whether something that happens every ``interval`` steps is due, or the end is."""
        return self.step % interval == 0 or self.step == self.total

    def report(self, loss: float) -> None:
        """Show the loss on the bar, or now and then in a log line."""
        self._bar.set_postfix(loss=f"{loss:.4g}", refresh=False)
        between = max(self.total // LINES, 1)
        if self._bar.disable and self._shown and self.step % between < self._log_every:
            seconds = self.seconds
            left = seconds / self.step * (self.total - self.step)
            numbers = (self.step, self.total, loss, seconds, left)
            logger.info("step %d of %d, loss %.4g, %.0f s, %.0f s left", *numbers)
            sys.stderr.flush()

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
