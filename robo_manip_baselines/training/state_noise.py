"""Noise on what a policy is shown in training, so that it copes with what no demonstration shows.

Legend: b examples, S elements of the state, R of them what the robot feels of itself.
"""

from __future__ import annotations

import torch
from torch import Tensor

from robo_manip_baselines.observation import ObservationSpec
from robo_manip_baselines.observation.vector import vector_names
from robo_manip_baselines.training.seeds import derive_seed
from robo_manip_baselines.training.settings import TrainSettings


def noise_of(seed: int, stream: str, step: int, count: int, size: int) -> Tensor:
    """Return (count, size) standard normal numbers, a function of seed, stream and step."""
    generator = torch.Generator().manual_seed(derive_seed(seed, stream, step))
    return torch.randn(count, size, generator=generator)


class StateNoise:
    """What is added to normalised states; mouth and cube are always shown as they are.

    Args:
        spec: what the elements of the state are.
        robot: ``TrainSettings.state_noise``.
        clock: ``TrainSettings.clock_noise``.
    """

    def __init__(self, spec: ObservationSpec, robot: float = 0.0, clock: float = 0.0) -> None:
        names = vector_names(spec)
        self._size = len(names)
        self._felt = len(spec.components()["state"])  # R; they come first
        self._times = [i for i, name in enumerate(names) if name.startswith("t_")]
        self._robot, self._clock = robot, clock

    @classmethod
    def of(cls, spec: ObservationSpec, settings: TrainSettings) -> StateNoise:
        """Return the noise that the settings ask for."""
        return cls(spec, settings.state_noise, settings.clock_noise)

    def draw(self, seed: int, step: int, count: int) -> Tensor | None:
        """Return (b, S) for a step; None if nothing is to be added."""
        if not self._robot and not (self._clock and self._times):
            return None
        drawn = noise_of(seed, "state", step, count, self._felt + 1)
        noise = torch.zeros(count, self._size)
        noise[:, : self._felt] = self._robot * drawn[:, : self._felt]
        # One clock: all the times that are shown are wrong by the same.
        noise[:, self._times] = self._clock * drawn[:, self._felt :]
        return noise
