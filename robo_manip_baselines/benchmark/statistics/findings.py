"""The paper's findings, and what the further arms ask, each as a contrast with an interval."""

from __future__ import annotations

import zlib
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from robo_manip_baselines.benchmark.statistics.comparison import not_seen
from robo_manip_baselines.benchmark.statistics.conditions import PAPER_ERROR, PAPER_HORIZONS
from robo_manip_baselines.benchmark.statistics.intervals import Estimate, mean_estimate
from robo_manip_baselines.benchmark.statistics.outcomes import on_common_seeds
from robo_manip_baselines.benchmark.statistics.study import Study
from robo_manip_baselines.envs.mujoco.tasks.feeding.paper import PAPER

LITTLE = 0.10
"""Rate that errors may cost and still be said to cost little. The paper's own cost 0.05."""

_LITTLE = f"(less than {100 * LITTLE:.0f} points)"


@dataclass(frozen=True)
class Claim:
    """Something that may hold or not, as a number that should be above a limit.

    Attributes:
        text: what is claimed.
        weights: name of the arm -> its weight in the contrast.
        measure: what is weighted: ``success`` (rate) or ``time`` (s).
        limit: what the contrast should be above.
    """

    text: str
    weights: Mapping[str, float]
    measure: str = "success"
    limit: float = 0.0

    @property
    def paper(self) -> float | None:
        """The contrast in the paper's own tables; None where the paper has not all of the arms."""
        if not set(self.weights) <= set(PAPER):
            return None
        values = {
            name: PAPER[name].rate if self.measure == "success" else PAPER[name].completion_time
            for name in self.weights
        }
        return sum(weight * values[name] for name, weight in self.weights.items())


@dataclass(frozen=True)
class Finding:
    """What became of a claim.

    Attributes:
        claim: which one.
        contrast: ours.
    """

    claim: Claim
    contrast: Estimate

    @property
    def verdict(self) -> str:
        """``holds`` or ``does not hold`` where the interval lies on one side of the limit."""
        low, high, limit = self.contrast.low, self.contrast.high, self.claim.limit
        if low is None or high is None:
            return "no answer"
        return "holds" if low > limit else "does not hold" if high < limit else "undecided"


def _h(horizon: int, error: str = "") -> str:
    return f"current_pred_h{horizon}{error}"


_OTHERS = tuple(h for h in PAPER_HORIZONS if h not in (2, 3))

PAPER_CLAIMS = (
    Claim("The present mouth position raises success", {"current": 1.0, "baseline": -1.0}),
    Claim("A forecast of 2 frames raises it further", {_h(2): 1.0, "current": -1.0}),
    Claim(
        "2–3 frames are better than 1, 4 and 5",
        {**{_h(h): 1 / 2 for h in (2, 3)}, **{_h(h): -1 / 3 for h in _OTHERS}},
    ),
    Claim(
        f"Errors cost little {_LITTLE}",
        {
            **{_h(h, f"_{PAPER_ERROR}"): 1 / 5 for h in PAPER_HORIZONS},
            **{_h(h): -1 / 5 for h in PAPER_HORIZONS},
        },
        limit=-LITTLE,
    ),
    Claim(
        "2 frames are faster than the present position alone",
        {"current": 1.0, _h(2): -1.0},
        measure="time",
    ),
)
"""What the paper says (section V)."""

FURTHER_CLAIMS = (
    Claim(
        "A forecast of 2 frames is worth more than a frozen one",
        {_h(2): 1.0, _h(2, "_persistence"): -1.0},
    ),
    Claim(
        "A forecast of 2 frames is worth more than the motion of another time",
        {_h(2): 1.0, _h(2, "_shuffled"): -1.0},
    ),
    Claim(
        f"A trained predictor in place of the true future costs little {_LITTLE}",
        {_h(2, "_model"): 1.0, _h(2): -1.0},
        limit=-LITTLE,
    ),
    Claim(
        "An expert who anticipates teaches more (4 frames)",
        {_h(4, "_anticipatory"): 1.0, _h(4): -1.0},
    ),
)
"""What the arms of `arms/feeding.yaml` ask that the paper does not have."""

CLAIMS = PAPER_CLAIMS + FURTHER_CLAIMS


def findings(study: Study) -> tuple[Finding, ...]:
    """Work out what became of the claims whose arms were all run.

    Contrasts are taken episode by episode, over training and evaluation seeds that all arms of a
    claim have; times, over episodes that all of them managed. Intervals are 95 % each.
    """
    outcomes = {figures.arm.name: figures.outcomes for figures in study.arms}
    found = []
    for claim in CLAIMS:
        if set(claim.weights) <= set(outcomes):
            rng = np.random.default_rng([study.seed, zlib.crc32(claim.text.encode())])
            grids = on_common_seeds([outcomes[name] for name in claim.weights], claim.measure)
            contrast = np.tensordot(list(claim.weights.values()), grids, axes=1)
            estimate = mean_estimate(contrast, rng, study.resamples)
            if claim.measure == "success" and estimate.n and not np.nan_to_num(contrast).any():
                estimate = not_seen(estimate)
            found.append(Finding(claim, estimate))
    return tuple(found)
