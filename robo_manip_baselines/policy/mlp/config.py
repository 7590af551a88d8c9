"""Settings of the perceptron."""

from __future__ import annotations

from dataclasses import dataclass, replace

from robo_manip_baselines.policy.presets import STATE_ONLY_TRAINING, ActionExecution, PolicyPreset
from robo_manip_baselines.runs.errors import RequestError


@dataclass(frozen=True)
class MlpConfig:
    """Architecture of the perceptron.

    Attributes:
        chunk_size: K, actions predicted at once.
        hidden_size: width of each hidden layer.
        hidden_layers: number of hidden layers.
        dropout: before the last layer.

    Raises:
        RequestError: a value that is not valid.
    """

    chunk_size: int = 30
    hidden_size: int = 512
    hidden_layers: int = 3
    dropout: float = 0.0

    def __post_init__(self) -> None:
        for name in ("chunk_size", "hidden_size", "hidden_layers"):
            if getattr(self, name) < 1:
                raise RequestError(f"{name} {getattr(self, name)}: must be 1 or more")
        if not 0.0 <= self.dropout < 1.0:
            raise RequestError(f"dropout {self.dropout}: must be 0 or more, less than 1")


PRESETS = {
    "cpu": PolicyPreset(
        config=MlpConfig(),
        training=replace(STATE_ONLY_TRAINING, batch_size=256),
        execution=ActionExecution(temporal_ensemble=False, n_action_steps=10),
        cameras=(),
        object_pose=True,
    )
}
