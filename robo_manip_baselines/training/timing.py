"""Time of each phase of a training step, without making the GPU wait.

On CUDA the phases of a step are marked with events on the stream, and read when the numbers are
asked for; on CPU the clock is read.
"""

from __future__ import annotations

import time

import torch

PHASES = ("data", "forward", "backward", "optimizer")
"""data: waiting for the batch; optimizer: clipping, AdamW and the average of the weights."""


class PhaseClock:
    """Sums the time between marks by phase.

    Each step calls `mark` with the names of ``PHASES`` in order; ``data`` is always measured on
    the host, the others where they run.
    """

    def __init__(self, device: torch.device) -> None:
        self._on_cuda = device.type == "cuda"
        self._sums: dict[str, float] = dict.fromkeys(PHASES, 0.0)
        self._events: list[tuple[str, torch.cuda.Event]] = []
        self._steps = 0
        self._last = time.perf_counter()

    def mark(self, phase: str) -> None:
        """Say that a phase has ended."""
        now = time.perf_counter()
        if phase == "data":
            self._steps += 1
        if phase == "data" or not self._on_cuda:
            self._sums[phase] += now - self._last
        self._last = now
        if self._on_cuda:
            event = torch.cuda.Event(enable_timing=True)
            event.record()
            self._events.append((phase, event))

    def skip(self) -> None:
        """Leave out the time since the last mark: logging, validation, saving."""
        self._last = time.perf_counter()

    def read(self) -> dict[str, float]:
        """Return mean seconds a step by phase since the last call, and start anew.

        On CUDA this waits for the device.
        """
        if self._events:
            torch.cuda.synchronize()
            for (_, start), (phase, end) in zip(self._events, self._events[1:], strict=False):
                if phase != "data":
                    self._sums[phase] += start.elapsed_time(end) / 1e3
        means = {phase: total / max(self._steps, 1) for phase, total in self._sums.items()}
        self._sums = dict.fromkeys(PHASES, 0.0)
        self._events.clear()
        self._steps = 0
        return means
