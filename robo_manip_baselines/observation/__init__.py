"""Observations: what a policy is shown, packed from the simulator's state after corruption."""

from robo_manip_baselines.observation.corruption import (
    ERRORS,
    FORECASTERS,
    PREDICTIONS,
    Corruption,
    CorruptionPipeline,
)
from robo_manip_baselines.observation.spec import (
    ARM_JOINTS,
    CAMERAS,
    PRESETS,
    ObservationSpec,
    ObservedNames,
)
from robo_manip_baselines.observation.state import (
    FRAME_PERIOD,
    FRAME_RATE,
    MAX_HORIZON,
    State,
    TargetObservation,
)

__all__ = [
    "ARM_JOINTS",
    "CAMERAS",
    "ERRORS",
    "FORECASTERS",
    "FRAME_PERIOD",
    "FRAME_RATE",
    "MAX_HORIZON",
    "PREDICTIONS",
    "PRESETS",
    "Corruption",
    "CorruptionPipeline",
    "ObservationSpec",
    "ObservedNames",
    "State",
    "TargetObservation",
]
