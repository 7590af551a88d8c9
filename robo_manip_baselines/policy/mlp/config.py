"""Settings of the perceptron."""

from __future__ import annotations

from dataclasses import dataclass, replace

from robo_manip_baselines.policy.presets import (
    STATE_ONLY_TRAINING,
    ActionExecution,
    Chunk,
    Layers,
    PolicyDims,
    PolicyPreset,
    Width,
)
from robo_manip_baselines.runs.ranges import Fraction, require_ranges


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

    chunk_size: Chunk = 30
    hidden_size: Width = 512
    hidden_layers: Layers = 3
    dropout: Fraction = 0.0

    def __post_init__(self) -> None:
        require_ranges(self)

    def num_parameters(self, dims: PolicyDims) -> int:
        """Return about how many weights the network has."""
        width = self.hidden_size
        outputs = self.chunk_size * dims.action
        return width * (dims.state + (self.hidden_layers - 1) * width + outputs)


PRESETS = {
    "cpu": PolicyPreset(
        config=MlpConfig(),
        training=replace(STATE_ONLY_TRAINING, batch_size=256),
        execution=ActionExecution(temporal_ensemble=False, n_action_steps=10),
        cameras=(),
        object_pose=True,
    )
}
