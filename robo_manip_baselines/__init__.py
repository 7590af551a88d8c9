"""Robot learning for feeding people who move. Importing it registers the environments."""

from robo_manip_baselines.envs.mujoco.tasks.registry import register_envs

__version__ = "0.1.0"

register_envs()
