"""How a network is trained: one frozen record, kept in its checkpoint."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, fields
from typing import Any, Literal

from face_prediction.errors import RequestError

Schedule = Literal["constant", "cosine"]
Precision = Literal["auto", "fp32", "bf16"]


@dataclass(frozen=True)
class TrainSettings:
    """Everything that the weights depend on, beside network, data and seed.

    Raises:
        RequestError: a value is out of its range; the message names the option.
    """

    steps: int
    batch_size: int
    #: Of Adam; 1e-4 in the paper (IV.B).
    learning_rate: float = 1e-4
    #: cosine: down to a hundredth of the learning rate at the last step.
    schedule: Schedule = "constant"
    #: Steps over which the learning rate rises from 0.
    warmup_steps: int = 0
    #: Longest gradient; 0: any.
    clip_norm: float = 1.0
    #: Of the moving average of the weights, which is then validated and kept; 0: none.
    ema_decay: float = 0.0
    #: Turn half of the sequences left to right, and make them lighter or darker.
    augment: bool = False
    #: auto: bf16 on a GPU, fp32 elsewhere.
    precision: Precision = "auto"
    #: Steps between looks at the fold that is held out.
    validate_every: int = 500
    #: Sequences of it that are looked at, evenly spread; 0: all.
    validation_sequences: int = 96

    def __post_init__(self) -> None:
        for name, low, high in (
            ("steps", 1, 1_000_000_000),
            ("batch_size", 1, 65536),
            ("learning_rate", 0.0, 10.0),
            ("warmup_steps", 0, 1_000_000_000),
            ("clip_norm", 0.0, 1e9),
            ("ema_decay", 0.0, 0.999999),
            ("validate_every", 1, 1_000_000_000),
            ("validation_sequences", 0, 1_000_000_000),
        ):
            value = getattr(self, name)
            if not low <= value <= high:
                raise RequestError(f"--{name} {value}: between {low} and {high:g}")
        for name, choices in (
            ("schedule", ("constant", "cosine")),
            ("precision", ("auto", "fp32", "bf16")),
        ):
            if getattr(self, name) not in choices:
                raise RequestError(f"--{name} {getattr(self, name)}: one of {', '.join(choices)}")

    def learning_rate_at(self, step: int) -> float:
        """The learning rate of the step after ``step`` steps."""
        rate = self.learning_rate * min((step + 1) / (self.warmup_steps + 1), 1.0)
        if self.schedule == "cosine":
            done = max(step - self.warmup_steps, 0) / max(self.steps - self.warmup_steps, 1)
            rate *= 0.01 + 0.99 * 0.5 * (1 + math.cos(math.pi * min(done, 1.0)))
        return rate

    def to_json(self) -> dict[str, Any]:
        """Plain values, what `from_json` takes."""
        return asdict(self)

    @classmethod
    def from_json(cls, data: Any) -> TrainSettings:
        """Undo `to_json`.

        Raises:
            RequestError: other keys, or values that are none of settings.
        """
        names = {item.name for item in fields(cls)}
        if not isinstance(data, dict) or set(data) != names:
            raise RequestError(f"training settings need the keys {', '.join(sorted(names))}")
        try:
            return cls(**data)
        except TypeError as error:
            raise RequestError(f"training settings are not as expected ({error})") from None
