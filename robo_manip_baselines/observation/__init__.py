"""What a policy is shown: which components, in which order, and how they are built from truth."""

from robo_manip_baselines.observation.corruption import ERRORS, Corruption
from robo_manip_baselines.observation.spec import CAMERAS, MAX_HORIZON, PRESETS, ObservationSpec
from robo_manip_baselines.observation.state import FRAME_PERIOD, Report, Truth, observe

__all__ = [
    "CAMERAS",
    "ERRORS",
    "FRAME_PERIOD",
    "MAX_HORIZON",
    "PRESETS",
    "Corruption",
    "ObservationSpec",
    "Report",
    "Truth",
    "observe",
]
