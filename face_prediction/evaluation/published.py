"""Tables I and II of the paper, as printed: measured on its authors' own recordings.

"Improving Robotic Imitation Learning with Predicted Facial Motion Using Transformers", section
IV.B: 100 sequences, five forecast frames of each. What is printed as variances cannot be variances
of errors in these units: a quantity between 0 and 1 with mean 0.017 has none above 0.0167.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class PublishedRow:
    """One column of the paper's Table I; None where it prints a dash."""

    name: str
    mean: tuple[float | None, float | None]
    variance: tuple[float | None, float | None]
    ssim: float


TABLE_1 = (
    PublishedRow("approach 1, images only", (None, None), (None, None), 0.662),
    PublishedRow("approach 2, simple fusion", (0.032, 0.036), (0.061, 0.130), 0.818),
    PublishedRow("approach 3, cross-attention", (0.015, 0.017), (0.013, 0.025), 0.928),
)

#: Approach 3 by frame: rows of Table II by the names that the tables here use.
TABLE_2: dict[str, tuple[float, ...]] = {
    "mean dU": (0.010, 0.019, 0.013, 0.020, 0.014),
    "var dU": (0.010, 0.014, 0.014, 0.013, 0.014),
    "mean dV": (0.013, 0.021, 0.015, 0.017, 0.017),
    "var dV": (0.021, 0.027, 0.026, 0.025, 0.027),
    "SSIM": (0.926, 0.927, 0.928, 0.928, 0.929),
}
