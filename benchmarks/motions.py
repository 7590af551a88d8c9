"""Face motions by name: size, speed and rotation of each, and a plot.

Example: python benchmarks/motions.py --plots docs/images
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from robo_manip_baselines.envs.mujoco.cell.scene import CONTROL_PERIOD
from robo_manip_baselines.envs.mujoco.face.motion import (
    SEGMENT_DURATION,
    MotionLibrary,
    MotionSegment,
)
from robo_manip_baselines.envs.mujoco.face.motions import MOTIONS, parse_motion
from robo_manip_baselines.runs.command import parse, run_command
from robo_manip_baselines.runs.errors import RequestError
from robo_manip_baselines.runs.files import atomic_file, prepare_folder

TIMES = np.arange(0.0, SEGMENT_DURATION, CONTROL_PERIOD)
PERCENTILES = (50, 95, 99, 100)
SHOWN = 3
"""Episodes in a plot."""


@dataclass(frozen=True)
class Options:
    """Draw episodes of every motion, and print the percentiles of their speed.

    Attributes:
        motions: As the option --motion of Rollout.py takes them.
        num_episodes: Episodes of each motion, one for each seed from 0 on.
        plots: Folder for a plot of each motion; none if not given.
    """

    motions: tuple[str, ...] = (*MOTIONS, "recorded:speed=3", "tremor:rating=4")
    num_episodes: int = 200
    plots: Path | None = None

    def __post_init__(self) -> None:
        if self.num_episodes < 1:
            raise RequestError(f"num_episodes {self.num_episodes}: must be 1 or more")
        for motion in self.motions:
            parse_motion(motion)


def row(motion: str, segments: list[MotionSegment]) -> str:
    """Return a row of the table, over all episodes."""
    moved, speeds, rates = [], [], []
    for segment in segments:
        displacement, orientation, _ = segment.at(TIMES)
        turn = Rotation.from_quat(orientation, scalar_first=True)
        moved.append(displacement - displacement.mean(axis=0))
        speeds.append(np.linalg.norm(np.diff(displacement, axis=0), axis=1) / CONTROL_PERIOD)
        rates.append(np.degrees((turn[:-1].inv() * turn[1:]).magnitude()) / CONTROL_PERIOD)
    distance = np.linalg.norm(moved, axis=-1)
    speed = ", ".join(f"{100 * v:.1f}" for v in np.percentile(speeds, PERCENTILES))
    largest = max(np.abs(segment.displacement).max() for segment in segments)
    jaw = max(np.ptp(segment.jaw) for segment in segments)
    cells = [f"`{motion}`", f"{1e3 * np.sqrt((distance**2).mean()):.1f}", f"{1e3 * largest:.0f}"]
    cells += [speed, f"{np.percentile(rates, 95):.0f}", f"{1e3 * jaw:.0f}"]
    return f"| {' | '.join(cells)} |"


def plot(path: Path, motion: str, segments: list[MotionSegment]) -> None:
    """Draw displacement, rotation and jaw of the first episodes."""
    import matplotlib as mpl

    mpl.use("Agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(3, SHOWN, figsize=(9, 4.5), sharex=True, sharey="row")
    for column, segment in enumerate(segments[:SHOWN]):
        displacement, orientation, jaw = segment.at(TIMES)
        turn = Rotation.from_quat(orientation, scalar_first=True).as_rotvec(degrees=True)
        drawn = (
            (1e3 * displacement, ("x, out of the face", "y, to its left", "z, up"), "mouth (mm)"),
            (turn, ("nod", "turn", "tilt"), "head (deg)"),
            (1e3 * jaw[:, None], ("jaw",), "jaw (mm)"),
        )
        for axis, (values, labels, title) in zip(axes[:, column], drawn, strict=True):
            for value, label in zip(values.T, labels, strict=True):
                axis.plot(TIMES, value, linewidth=0.9, label=label)
            if column == 0:
                axis.set_ylabel(title)
                axis.legend(fontsize=7, loc="upper left")
        axes[0, column].set_title(f"{motion}, seed {column}", fontsize=9)
        axes[2, column].set_xlabel("time (s)")
    figure.tight_layout()
    with atomic_file(path) as temporary:
        figure.savefig(temporary, format="png", dpi=64)
    pyplot.close(figure)


def main() -> None:
    """Draw and print."""
    options: Options = parse(Options, "python benchmarks/motions.py --plots docs/images")
    if options.plots:
        prepare_folder(options.plots)
    library = MotionLibrary.load()
    shown = ", ".join(str(p) for p in PERCENTILES)
    print("| motion | rms (mm) | largest, one axis (mm) "
          f"| speed: {shown} % (cm/s) | turning: 95 % (deg/s) | jaw: range (mm) |")  # fmt: skip
    print("|---|---|---|---|---|---|")
    for name in options.motions:
        motion = parse_motion(name)
        segments = [
            motion.draw(np.random.default_rng(seed), library, seed=seed)
            for seed in range(options.num_episodes)
        ]
        print(row(name, segments))
        if options.plots:
            file = name.replace(":", "_").replace("=", "_")
            plot(options.plots / f"face_motion_{file}.png", name, segments)


if __name__ == "__main__":
    run_command(main)
