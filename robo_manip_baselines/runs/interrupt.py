"""Signals that end a run: Ctrl-C, SIGTERM, and SIGHUP of a terminal that is closed."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any

_NOTICE = b"\nstopping: saving after this step; Ctrl-C again stops at once\n"

ENDING = tuple(
    getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)
)


@contextmanager
def signals_as_interrupt() -> Iterator[None]:
    """Let SIGTERM and SIGHUP raise KeyboardInterrupt, as Ctrl-C does; once, so that cleaning up
    is not interrupted.

    Signals that are ignored, as by ``nohup``, stay so.
    """

    def interrupt(number: int, frame: FrameType | None) -> None:
        for other in before:
            signal.signal(other, signal.SIG_IGN)
        raise KeyboardInterrupt

    before: dict[int, Any] = {}
    if threading.current_thread() is threading.main_thread():
        for number in ENDING:
            if number != signal.SIGINT and signal.getsignal(number) is signal.SIG_DFL:
                before[number] = signal.signal(number, interrupt)
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


class StopRequest:
    """While entered, notes SIGINT, SIGTERM and SIGHUP as a request to stop after a step.

    Args:
        once_more: whether a second Ctrl-C ends the process at once. Not with ``torchrun``, which
            sends every process the signal again that the terminal has sent already.

    Attributes:
        is_made: whether a signal has come.
    """

    def __init__(self, once_more: bool = True) -> None:
        self._once_more = once_more
        self.is_made = False
        self._before: dict[int, Any] = {}

    def __enter__(self) -> StopRequest:
        """Take over the signals; only the main thread can."""
        if threading.current_thread() is threading.main_thread():
            for number in ENDING:
                # ``nohup`` lets a run outlive its terminal
                if number == signal.SIGINT or signal.getsignal(number) is not signal.SIG_IGN:
                    self._before[number] = signal.signal(number, self._note)
        return self

    def __exit__(self, *_: object) -> None:
        """Give the signals back."""
        for number, handler in self._before.items():
            signal.signal(number, handler)
        self._before.clear()

    def _note(self, number: int, frame: FrameType | None) -> None:
        if self.is_made:
            if self._once_more and number == signal.SIGINT:
                raise KeyboardInterrupt
            return
        self.is_made = True
        os.write(2, _NOTICE)  # a handler may interrupt logging: it must not log itself
