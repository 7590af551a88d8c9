"""One picture of a clip's motion: what was measured, and what of it was cut."""

from __future__ import annotations

import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from face_prediction.motion.library import MotionLibrary
from face_prediction.motion.motion import ClipMotion, step_tremor
from face_prediction.tracking.geometry import matrix_from_quaternion, rotation_angle
from robo_manip_baselines.runs.errors import RequestError

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


BEGIN = "<!-- begin generated by: face-prediction export-motion --report -->"
END = "<!-- end generated -->"


def clip_row(motion: ClipMotion, subject: str) -> dict[str, Any]:
    """What became of one clip: counts, tremor in mm, speeds in cm/s of what is kept."""
    row: dict[str, Any] = {"subject": subject, **motion.counts}
    row["seconds"] = round(sum(b - a - 1 for a, b in motion.runs) / motion.fps, 2)
    row["depth_smoothed"] = motion.depth_smoothed
    row["distance_m"] = round(float(-np.nanmedian(motion.raw_depth)), 3)
    row["raw_depth_tremor_mm"] = round(1000 * step_tremor(motion.raw_depth), 2)
    if motion.runs:
        kept = [motion.mouth[a:b] for a, b in motion.runs]
        steps = np.concatenate([np.diff(part, axis=0) for part in kept])
        speed = np.linalg.norm(steps, axis=1) * motion.fps * 100
        row["speed_median_cm_s"] = round(float(np.median(speed)), 1)
        row["speed_p95_cm_s"] = round(float(np.percentile(speed, 95)), 1)
        row["tremor_mm"] = [
            round(1000 * max(step_tremor(part[:, axis]) for part in kept), 2) for axis in range(3)
        ]
    return row


def tables(library: MotionLibrary) -> str:
    """Markdown of a library: its total, a row per clip, what was cut, and the attribution.

    Clips too short to give a run are pooled in one row of the second table.
    """
    clips: dict[str, dict[str, Any]] = library.metadata["clips"]
    used = {name: row for name, row in clips.items() if row["runs"]}
    long_enough = library.metadata["settings"]["min_run"] * library.fps
    listed = {name: row for name, row in clips.items() if row["frames"] > long_enough}
    pooled = [row for name, row in clips.items() if name not in listed]
    subjects = sorted({row["subject"] for row in used.values()})
    lines = [
        f"{library.seconds:.1f} s of continuous motion in {len(library.run_start)} runs, "
        f"of {len(subjects)} people, at {library.fps:g} frames a second. {extremes(library)}",
        "",
        "| clip | subject | kept s | runs | distance m | depth tremor as measured mm "
        "| depth low-pass | tremor x, y, z as kept mm | speed median, 95 % cm/s |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for name, row in used.items():
        tremor = " ".join(f"{value:.2f}" for value in row["tremor_mm"])
        lines.append(
            f"| {name} | {row['subject']} | {row['seconds']:.1f} | {row['runs']} "
            f"| {row['distance_m']:.2f} | {row['raw_depth_tremor_mm']:.2f} "
            f"| {'yes' if row['depth_smoothed'] else 'no'} | {tremor} "
            f"| {row['speed_median_cm_s']:.1f}, {row['speed_p95_cm_s']:.1f} |"
        )
    lines += [
        "",
        "Frames of each clip, by what became of them:",
        "",
        "| clip | frames | kept | no face | spike | turned away | stretch too short "
        "| out of reach | jumps (steps) |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    keys = ("frames", "kept", "no_face", "spike", "turned_away", "too_short", "out_of_reach")
    for name, row in listed.items():
        counts = " | ".join(str(row[key]) for key in keys)
        lines.append(f"| {name} | {counts} | {row['jumps']} |")
    if pooled:
        counts = " | ".join(str(sum(row[key] for row in pooled)) for key in keys)
        jumps = sum(row["jumps"] for row in pooled)
        lines.append(f"| {len(pooled)} clips shorter than a run | {counts} | {jumps} |")
    lines += ["", "| clip | licence | source |", "|---|---|---|"]
    for name, row in library.metadata["attribution"].items():
        lines.append(f"| {name} | {row['licence']} | {row['source']} |")
    return "\n".join(lines)


def page(library: MotionLibrary, plots: Sequence[str]) -> str:
    """The generated part of the page: the tables, then the plots (paths beside the page)."""
    pictures = [f"![Motion of {Path(plot).stem.removeprefix('motion_')}]({plot})" for plot in plots]
    return "\n\n".join([BEGIN, tables(library), *pictures, END])


def extremes(library: MotionLibrary) -> str:
    """A sentence on the most that a mouth, head and jaw do in what is kept."""
    most = np.zeros(5)
    for index in range(len(library.run_start)):
        part = library.run(index)
        velocity = np.diff(library.mouth[part, :2].astype(float), axis=0) * library.fps
        acceleration = np.diff(velocity, axis=0) * library.fps
        orientation = library.orientation[part].astype(float)
        turn = np.degrees(rotation_angle(orientation[1:], orientation[:-1])) * library.fps
        here = (
            np.linalg.norm(velocity, axis=1).max(),
            np.linalg.norm(acceleration, axis=1).max(),
            turn.max(),
            np.abs(np.diff(library.jaw[part].astype(float))).max() * library.fps,
            np.degrees(rotation_angle(orientation, np.array([1.0, 0.0, 0.0, 0.0]))).max(),
        )
        most = np.maximum(most, here)
    return (
        f"The most that is kept: mouth across the view {most[0]:.2f} m/s and {most[1]:.1f} m/s², "
        f"head {most[2]:.0f}°/s, jaw {most[3]:.2f} m/s, head turned {most[4]:.0f}° away."
    )


def read_page(path: Path) -> str:
    """The text of the page at ``path``, or of an empty one.

    Raises:
        RequestError: the page exists without the two marks, or cannot be read.
    """
    if not path.exists():
        return f"{BEGIN}\n{END}\n"
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise RequestError(f"--report {path}: cannot be read ({error})") from None
    if text.count(BEGIN) != 1 or text.count(END) != 1 or text.index(BEGIN) > text.index(END):
        raise RequestError(f"--report {path}: lacks the lines '{BEGIN}' and '{END}'")
    return text


def write_report(
    path: Path, library: MotionLibrary, clips: Sequence[tuple[str, ClipMotion]]
) -> None:
    """Put tables and plots into the Markdown page at ``path``, between its two marks.

    Plots go to ``images/`` beside it, one for every clip of the length of a run. A page that does
    not exist is made; text around the marks is kept.

    Raises:
        RequestError: matplotlib is missing, or the page exists without the marks.
    """
    text = read_page(path)
    from face_prediction.motion.report import plot_clip

    shortest = library.metadata["settings"]["min_run"]
    plots: list[str] = []
    for name, motion in clips:
        if len(motion.timestamps) <= shortest * motion.fps:
            continue
        relative = f"images/motion_{name}.png"
        (path.parent / "images").mkdir(parents=True, exist_ok=True)
        plot_clip(path.parent / relative, name, motion)
        plots.append(relative)
    before, rest = text.split(BEGIN)
    after = rest.split(END)[1]
    path.write_text(before + page(library, plots) + after, encoding="utf-8")
