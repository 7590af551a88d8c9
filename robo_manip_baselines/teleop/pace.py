"""Real time: a loop of 50 Hz that counts the deadlines it misses."""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable

TOLERANCE = 0.5
"""Share of a period by which a step may end late before it counts as missed: less than half a
period late is not seen, and the next step makes up for it."""


class Pace:
    """Waits for the end of every period.

    A step that ends late does not shift the ones after it, unless it is late by more than a
    period: time that is lost is not made up by hurrying, which would move an arm faster than the
    person meant.

    Args:
        period: s; None keeps no time.
        clock: returns s; ``sleep`` waits for s. Others in tests.

    Attributes:
        missed: steps that ended late since the last `restart`.
    """

    def __init__(
        self,
        period: float | None,
        clock: Callable[[], float] = time.perf_counter,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        self._period, self._clock, self._sleep = period, clock, sleep
        self._ends: deque[float] = deque()
        self.restart()

    def restart(self) -> None:
        """Begin the first period now; nothing has been missed yet."""
        self.missed, self._steps = 0, 0
        self._begin = self._due = self._clock()

    def wait(self) -> None:
        """Wait for the end of the present period, and begin the next one."""
        self._steps += 1
        if self._period is None:
            return
        self._due += self._period
        left = self._due - self._clock()
        if left > 0.0:
            self._sleep(left)
        elif -left > TOLERANCE * self._period:
            self.missed += 1
            if -left > self._period:
                self._due = self._clock()
        now = self._clock()
        self._ends.append(now)
        while self._ends[0] < now - 1.0:
            self._ends.popleft()

    @property
    def rate(self) -> float:
        """Steps a second, over the last second, in Hz; NaN where there is none, or no period."""
        if len(self._ends) < 2:
            return math.nan
        return (len(self._ends) - 1) / (self._ends[-1] - self._ends[0])

    @property
    def mean_rate(self) -> float:
        """Steps a second since the last `restart`, in Hz; NaN likewise."""
        elapsed = self._clock() - self._begin
        return math.nan if self._period is None or not self._steps else self._steps / elapsed
