"""MuJoCo's passive viewer in a window that is gone once it is closed."""

from __future__ import annotations

import threading
from typing import Any

import mujoco

PATIENCE = 10.0
"""s to wait for the window to close; one that is drawn without a GPU takes one or two."""


class ViewerWindow:
    """A window of MuJoCo's passive viewer.

    The viewer draws in a thread of its own, which ends some time after it is closed. A program that
    ends before hangs, or ends with an error: both tear down the same window.

    Args:
        model, data: shown.
        options: of ``mujoco.viewer.launch_passive``.

    Attributes:
        viewer: handle that ``launch_passive`` returned.
    """

    def __init__(self, model: mujoco.MjModel, data: mujoco.MjData, **options: Any) -> None:
        from mujoco import viewer  # opens a display's libraries

        others = set(threading.enumerate())
        self.viewer = viewer.launch_passive(model, data, **options)
        self._threads = set(threading.enumerate()) - others

    def close(self) -> None:
        """Close the window, and wait until it is gone."""
        self.viewer.close()
        for thread in self._threads:
            thread.join(PATIENCE)
