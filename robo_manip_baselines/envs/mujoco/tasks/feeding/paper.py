"""What the paper reports of the feeding task: Tables IV and V.

*Improving Robotic Imitation Learning with Predicted Facial Motion Using Transformers*. Each
configuration was evaluated in 50 independent trials (section IV.C). The paper gives rates in per
cent, all of them whole counts of 50, and mean times to a tenth of a second, without a spread.
"""

from __future__ import annotations

from dataclasses import dataclass

from robo_manip_baselines.benchmark.statistics.conditions import PAPER_ERROR, PAPER_HORIZONS

TRIALS = 50
"""for each configuration (section IV.C)."""

TIME_ROUNDING = 0.05
"""s, half of the last digit of the times in Table V."""


@dataclass(frozen=True)
class PaperResult:
    """A row of Tables IV and V.

    Attributes:
        successes: of ``TRIALS`` (Table IV).
        completion_time: s, mean (Table V).
    """

    successes: int
    completion_time: float

    @property
    def rate(self) -> float:
        """Share of successes."""
        return self.successes / TRIALS


_WITHOUT_ERROR = (
    PaperResult(33, 4.6),  # 66 %
    PaperResult(37, 4.3),  # 74 %
    PaperResult(36, 4.4),  # 72 %
    PaperResult(34, 4.4),  # 68 %
    PaperResult(30, 4.5),  # 60 %
)
_WITH_ERROR = (
    PaperResult(29, 4.7),  # 58 %
    PaperResult(36, 4.3),  # 72 %
    PaperResult(34, 4.5),  # 68 %
    PaperResult(31, 4.5),  # 62 %
    PaperResult(27, 4.6),  # 54 %
)

PAPER: dict[str, PaperResult] = {
    "baseline": PaperResult(21, 4.9),  # 42 %
    "current": PaperResult(30, 4.6),  # 60 %
    **{f"current_pred_h{h}": r for h, r in zip(PAPER_HORIZONS, _WITHOUT_ERROR, strict=True)},
    **{
        f"current_pred_h{h}_{PAPER_ERROR}": r
        for h, r in zip(PAPER_HORIZONS, _WITH_ERROR, strict=True)
    },
}
"""Name of the arm -> what the paper reports of it."""
