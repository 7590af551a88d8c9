"""Ctrl-C and SIGTERM as a request to stop after the step at hand."""

from __future__ import annotations

import os
import signal
import threading
from types import FrameType
from typing import Any

_NOTICE = b"\nstopping: saving after this step; Ctrl-C again stops at once\n"


class StopRequest:
    """While entered, notes SIGINT and SIGTERM.

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
            for number in (signal.SIGINT, signal.SIGTERM):
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
