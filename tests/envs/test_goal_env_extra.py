"""Without the extra ``rl`` the package works, and FeedingGoalEnv says what it needs."""

from __future__ import annotations

import subprocess
import sys

import pytest

PROGRAM = """
import sys
sys.modules["gymnasium_robotics"] = None  # as if it were not installed
import gymnasium
import robo_manip_baselines
gymnasium.make("robo_manip_baselines/FeedingEnv-v0", cameras=()).close()
try:
    gymnasium.make("robo_manip_baselines/FeedingGoalEnv-v0")
except ValueError as error:
    print(type(error).__name__, error)
"""


@pytest.mark.long
def test_without_gymnasium_robotics() -> None:
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", PROGRAM], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    line = done.stdout.strip()
    assert "\n" not in line
    assert line.startswith("RequestError FeedingGoalEnv needs gymnasium-robotics (")
    assert "pip install" in line
    assert line.rstrip("'\"").endswith("[rl]")
