"""Dropout that takes its random numbers four at a time on a processor.

PyTorch draws a number of 64 bits for each element there: a tenth of a whole training step.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

_LEVELS = 1 << 16
"""Values of 16 bits: the probability is met to 1 in 65,536."""


class Dropout(nn.Module):
    """Sets elements to 0 in training and scales the others so that the mean stays.

    Randomness comes from PyTorch's default generator of the device.

    Attributes:
        probability: of an element to be dropped.
    """

    def __init__(self, probability: float) -> None:
        super().__init__()
        self.probability = probability

    def forward(self, x: Tensor) -> Tensor:
        """Return a tensor of the same shape and type."""
        if not self.training or self.probability == 0.0:
            return x
        if x.device.type != "cpu" or torch.compiler.is_compiling():
            return nn.functional.dropout(x, self.probability)
        dropped = round(self.probability * _LEVELS)
        # From the smallest number of 64 bits without an end: all 64 bits are random.
        words = torch.empty(-(-x.numel() // 4), dtype=torch.int64).random_(-(2**63), None)
        draws = words.view(torch.int16)[: x.numel()].view(x.shape)  # from -32,768 on
        kept = (draws >= dropped - _LEVELS // 2).to(x.dtype)
        return x * kept.mul_(_LEVELS / (_LEVELS - dropped))

    def extra_repr(self) -> str:
        """Return what `print` shows of it."""
        return f"{self.probability}"
