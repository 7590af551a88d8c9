"""A second task, so that files of two tasks can meet."""

from __future__ import annotations

import sys
from dataclasses import replace
from types import ModuleType

import pytest

from robo_manip_baselines.envs.mujoco.tasks.registry import TASKS, task_entry


@pytest.fixture
def other_task(monkeypatch: pytest.MonkeyPatch) -> None:
    """Register ``OtherEnv``, which is feeding under another name."""
    module = ModuleType("other_task")
    module.ENTRY = replace(task_entry("FeedingEnv"), name="OtherEnv")  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "other_task", module)
    monkeypatch.setitem(TASKS, "OtherEnv", "other_task:ENTRY")
