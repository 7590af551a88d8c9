"""Importing the packages needs no GPU, OpenGL, MediaPipe or display, and loads none of them."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

HEAVY = {"torch", "mediapipe", "matplotlib", "tensorflow", "jax", "sounddevice"}
GRAPHICS = {"OpenGL", "glfw"}

IMPORT = """
import importlib, sys
importlib.import_module({package!r})
print(*{{name.partition(".")[0] for name in sys.modules}})
"""

# Networks and their training are made of torch; everything else must do without it.
OF_TORCH = (
    "face_prediction.models",
    "face_prediction.training",
    "robo_manip_baselines.policy.act",
    "robo_manip_baselines.policy.cuda_graph",
    "robo_manip_baselines.policy.denoising",
    "robo_manip_baselines.policy.diffusion",
    "robo_manip_baselines.policy.execution",
    "robo_manip_baselines.policy.flow",
    "robo_manip_baselines.policy.interface",
    "robo_manip_baselines.policy.mlp",
    "robo_manip_baselines.policy.sarnn",
    "robo_manip_baselines.training",
)

# On gymnasium-robotics, of the extra ``rl``.
OF_ROBOTICS = ("robo_manip_baselines.envs.mujoco.tasks.feeding.goal_env",)

IMPORT_ALL = """
import importlib, pkgutil, sys
package = importlib.import_module({package!r})
for module in pkgutil.walk_packages(package.__path__, package.__name__ + "."):
    if not module.name.startswith({left_out!r}):
        importlib.import_module(module.name)
print(*{{name.partition(".")[0] for name in sys.modules}})
"""

# The state-only variant, for clusters whose nodes have no OpenGL.
ACT_BLIND = """
import sys
import gymnasium
import robo_manip_baselines
env = gymnasium.make("robo_manip_baselines/FeedingEnv-v0", cameras=(), object_pose=True)
env.reset(seed=0)
for _ in range(3):
    env.step(env.action_space.sample())
env.close()
print(*{name.partition(".")[0] for name in sys.modules})
"""


def modules_after(program: str) -> set[str]:
    """Return the top-level modules that are loaded when ``program`` has run, warnings as errors."""
    environment = {k: v for k, v in os.environ.items() if k not in ("DISPLAY", "PYTHONPATH")}
    environment["MUJOCO_GL"] = "disabled"  # importing mujoco opens the backend's libraries else
    result = subprocess.run(
        [sys.executable, "-W", "error", "-c", program],
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert result.returncode == 0, result.stderr
    return set(result.stdout.split())


@pytest.mark.parametrize("package", ["robo_manip_baselines", "face_prediction"])
def test_importing_a_package_loads_nothing_heavy(package: str) -> None:
    loaded = modules_after(IMPORT.format(package=package))
    assert package in loaded
    assert loaded & (HEAVY | GRAPHICS | {"mujoco"}) == set()


@pytest.mark.parametrize("package", ["robo_manip_baselines", "face_prediction"])
def test_every_other_module_imports_without_opengl_torch_and_mediapipe(package: str) -> None:
    loaded = modules_after(IMPORT_ALL.format(package=package, left_out=OF_TORCH + OF_ROBOTICS))
    assert loaded & (HEAVY | GRAPHICS) == set()


def test_the_state_only_environment_needs_no_opengl() -> None:
    loaded = modules_after(ACT_BLIND)
    assert "mujoco" in loaded
    assert loaded & (HEAVY | GRAPHICS) == set()
