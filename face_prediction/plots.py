"""One picture of a clip's motion: what was measured, and what of it was cut."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import numpy as np

from face_prediction.errors import RequestError
from face_prediction.motion import ClipMotion
from face_prediction.rotations import matrix_from_quaternion

#: The three axes, in colours that colour-blind readers can tell apart (Okabe and Ito).
AXIS_COLOURS = ("#D55E00", "#009E73", "#0072B2")
CUT_COLOURS = {
    "no face": "#999999",
    "turned away": "#CC79A7",
    "stretch too short": "#F0E442",
    "out of reach": "#E69F00",
}


def plot_clip(path: Path, name: str, motion: ClipMotion) -> None:
    """Draw ``motion`` to the PNG at ``path``.

    Raises:
        RequestError: matplotlib is not installed.
    """
    try:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
        from PIL import Image
    except ImportError as error:
        raise RequestError(
            f"plots need matplotlib ({error}); pip install 'robo_manip_baselines[face_prediction]'"
        ) from None
    figure = Figure(figsize=(10.0, 7.2), dpi=80, layout="constrained")
    canvas = FigureCanvasAgg(figure)
    grid = figure.add_gridspec(3, 2, width_ratios=(3.2, 1), height_ratios=(1.3, 1, 0.8))
    position = figure.add_subplot(grid[0, 0])
    rotation = figure.add_subplot(grid[1, 0], sharex=position)
    jaw = figure.add_subplot(grid[2, 0], sharex=position)
    seconds = motion.timestamps - motion.timestamps[0]

    _draw_position(position, seconds, motion)
    for angles, label, colour in zip(
        euler_angles(motion.orientation).T, ("pitch", "yaw", "roll"), AXIS_COLOURS, strict=True
    ):
        rotation.plot(seconds, angles, lw=1, color=colour, label=label)
    rotation.set_ylabel("head, degrees")
    rotation.legend(loc="upper right", ncols=3, fontsize="small")
    jaw.plot(seconds, 1000 * motion.jaw, lw=1, color="black")
    jaw.set_ylabel("jaw opening, mm")
    jaw.set_xlabel("time, s")
    for axes in (position, rotation, jaw):
        _shade_cuts(axes, seconds, motion)
        axes.set_xlim(0, seconds[-1])
        axes.grid(alpha=0.3)
    handles, labels = jaw.get_legend_handles_labels()
    if handles:
        figure.legend(handles, labels, loc="outside lower center", ncols=6, fontsize="small")
    _draw_speeds(figure.add_subplot(grid[0, 1]), motion)
    _write_facts(figure.add_subplot(grid[1:, 1]), motion)
    kept = sum(stop - start - 1 for start, stop in motion.runs) / motion.fps
    figure.suptitle(f"{name}: {kept:.1f} s kept in {len(motion.runs)} run(s)")

    canvas.draw()
    # 64 colours are plenty for lines and halve the file
    image = Image.fromarray(np.asarray(canvas.buffer_rgba())[..., :3]).quantize(64)
    stream = io.BytesIO()
    image.save(stream, "png", optimize=True)
    path.write_bytes(stream.getvalue())


def euler_angles(orientation: np.ndarray) -> np.ndarray:
    """Pitch, yaw and roll (T, 3) in degrees of quaternions (T, 4): R = Ry(yaw) Rx(pitch) Rz(roll).

    Pitch is about the image's x axis (positive: chin down), yaw about y (positive: toward the
    right of the image), roll about z (positive: counter-clockwise in the image).
    """
    r = matrix_from_quaternion(orientation)
    pitch = -np.arcsin(np.clip(r[:, 1, 2], -1, 1))
    yaw = np.arctan2(r[:, 0, 2], r[:, 2, 2])
    roll = np.arctan2(r[:, 1, 0], r[:, 1, 1])
    return np.degrees(np.stack([pitch, yaw, roll], axis=-1))


def _draw_position(axes: Any, seconds: np.ndarray, motion: ClipMotion) -> None:
    first = motion.runs[0][0] if motion.runs else int(np.argmax(motion.quality.found))
    origin = motion.mouth[first]
    if motion.depth_smoothed:
        raw = 1000 * (motion.raw_depth - origin[2])
        axes.plot(seconds, raw, lw=0.6, color="#9FC5E8", label="z as measured")
    for axis, (label, colour) in enumerate(zip("xyz", AXIS_COLOURS, strict=True)):
        values = 1000 * (motion.mouth[:, axis] - origin[axis])
        axes.plot(seconds, values, lw=1, color=colour, label=label)
    for start, stop in motion.runs:
        for edge in (start, stop - 1):
            axes.axvline(seconds[edge], color="black", lw=0.8, ls=":")
    for step in np.flatnonzero(motion.quality.jump):
        axes.axvline(seconds[step], color="red", lw=0.8, ymin=0.95)
    # wild values in what was cut must not flatten the rest
    shown = 1000 * (motion.mouth[motion.quality.found] - origin)
    low, high = np.percentile(shown, 2), np.percentile(shown, 98)
    for start, stop in motion.runs:
        kept = 1000 * (motion.mouth[start:stop] - origin)
        low, high = min(low, kept.min()), max(high, kept.max())
    margin = 0.08 * (high - low) + 1
    axes.set_ylim(low - margin, high + margin)
    axes.set_ylabel("mouth from first kept, mm")
    axes.legend(loc="upper right", ncols=4, fontsize="small")


def _shade_cuts(axes: Any, seconds: np.ndarray, motion: ClipMotion) -> None:
    quality = motion.quality
    kept = np.zeros(len(seconds), dtype=bool)
    for start, stop in motion.runs:
        kept[start:stop] = True
    short = np.zeros_like(kept)
    for start, stop in quality.facing_segments():
        short[start:stop] = stop - start < motion.window
    lost = ~quality.found | quality.spike
    turned = quality.turned_away & ~lost
    masks = {
        "no face": lost,
        "turned away": turned,
        "stretch too short": short,
        "out of reach": ~kept & ~lost & ~turned & ~short,
    }
    step = 1 / motion.fps
    for label, mask in masks.items():
        edges = np.flatnonzero(np.diff(np.concatenate([[False], mask, [False]]).astype(int)))
        for number, (start, stop) in enumerate(edges.reshape(-1, 2)):
            axes.axvspan(
                seconds[start] - step / 2,
                seconds[stop - 1] + step / 2,
                color=CUT_COLOURS[label],
                alpha=0.45,
                lw=0,
                label=label if number == 0 else None,
            )


def _draw_speeds(axes: Any, motion: ClipMotion) -> None:
    axes.set_title("speed of the mouth, kept", fontsize="small")
    axes.set_xlabel("cm/s", fontsize="small")
    if not motion.runs:
        axes.text(0.5, 0.5, "nothing kept", ha="center", transform=axes.transAxes)
        return
    steps = np.concatenate([np.diff(motion.mouth[a:b], axis=0) for a, b in motion.runs])
    speed = 100 * np.linalg.norm(steps, axis=1) * motion.fps
    axes.hist(speed, bins=np.linspace(0, max(1.0, float(speed.max())), 40), color="#555555")
    axes.set_yscale("log")
    axes.set_ylabel("frames", fontsize="small")


def _write_facts(axes: Any, motion: ClipMotion) -> None:
    axes.axis("off")
    counts = motion.counts
    lines = [f"{key.replace('_', ' ')}: {value}" for key, value in counts.items()]
    lines.append(f"depth low-pass: {'yes' if motion.depth_smoothed else 'no'}")
    axes.text(0.05, 0.95, "\n".join(lines), va="top", fontsize="small", transform=axes.transAxes)
