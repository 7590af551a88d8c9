"""``bin/Dataset.py``: inspect, verify and plot episodes."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import mean, stdev
from typing import Annotated, Any

import tyro

from robo_manip_baselines.runs.command import parse
from robo_manip_baselines.runs.errors import RequestError, require_choice
from robo_manip_baselines.runs.progress import closing_table

EpisodeFolder = Annotated[
    Path,
    tyro.conf.arg(metavar="DIR", help="Folder of episode_*.hdf5 files, as Rollout.py writes it."),
    tyro.conf.Positional,
]


IMAGE_TYPES = {".png": "agg", ".svg": "svg"}
"""Suffix of an image -> Matplotlib's backend for it."""


@dataclass(frozen=True)
class Verify:
    """Find damaged, mixed-up and misplaced episode files. Ends with 1 if there are any."""

    folder: EpisodeFolder
    images: bool = True
    """Decode every image, too; --no_images checks the rest only, which is much faster."""

    def run(self) -> tuple[str, int]:
        """Return the text to print and the exit code."""
        from robo_manip_baselines.data.verify import damage_summary, verify_dataset

        problems = verify_dataset(self.folder, images=self.images)
        lines = [*map(str, problems), damage_summary(self.folder, problems)]
        return "\n".join(lines), int(any(not problem.is_warning for problem in problems))


@dataclass(frozen=True)
class Info:
    """List what a folder of episodes holds."""

    folder: EpisodeFolder

    def run(self) -> tuple[str, int]:
        """Return the text to print and the exit code."""
        return closing_table(dataset_info(self.folder)), 0


@dataclass(frozen=True)
class Plot:
    """Draw the curves of an episode: joints and commands, gripper, target, phases."""

    episode: Annotated[
        Path, tyro.conf.arg(metavar="FILE", help="An episode_*.hdf5 file."), tyro.conf.Positional
    ]
    out: Path | None = None
    """Image to write, .png or .svg; the episode's name with .png, in this folder, if not given."""

    def run(self) -> tuple[str, int]:
        """Return the text to print and the exit code."""
        from robo_manip_baselines.benchmark.report.figures import styled_figure
        from robo_manip_baselines.data.curves import draw_episode
        from robo_manip_baselines.data.episode import EpisodeReader
        from robo_manip_baselines.runs.files import atomic_file

        out = self.out or Path(self.episode.with_suffix(".png").name)
        kind = require_choice("--out: image of type", out.suffix, IMAGE_TYPES)
        if out.exists():
            raise RequestError(f"'{out}': is there already; choose another file with --out")
        with (
            EpisodeReader(self.episode) as episode,
            styled_figure(IMAGE_TYPES[kind], "white") as figure,
        ):
            draw_episode(figure, episode)
            with atomic_file(out) as path:
                figure.savefig(path, format=kind[1:], dpi=120)
        return f"written to '{out}'", 0


def dataset_info(folder: Path) -> dict[str, str]:
    """Return the contents of a folder of episodes as rows of a table: name -> text.

    Raises:
        RequestError: there is no such folder, no episode in it, or a file is damaged.
    """
    # Imported here: --help needs no HDF5.
    from robo_manip_baselines.data import list_episodes, read_metadata
    from robo_manip_baselines.data.files import FAILED_FOLDER

    paths, failed_folder = list_episodes(folder), folder / FAILED_FOLDER
    failed = list_episodes(failed_folder) if failed_folder.is_dir() else []
    if not (tried := paths + failed):
        raise RequestError(f"'{folder}' holds no episode_*.hdf5 file")
    metadata = [read_metadata(path) for path in tried]
    size = sum(path.stat().st_size for path in tried)
    successes = sum(item["is_success"] for item in metadata)
    strict = sum(item["is_success_strict"] for item in metadata)
    durations = [item["num_steps"] * item["control_period"] for item in metadata]
    times = [item["completion_time"] for item in metadata if item["is_success"]]
    mixture = _mixture(metadata)
    # Episodes that were imported have no face.
    subjects = {item["motion_subject"] for item in metadata if "motion_subject" in item}
    clips = {item["motion_clip"] for item in metadata if "motion_clip" in item}
    return {
        "folder": str(folder),
        "demonstrations": str(len(paths)),
        "kept apart": f"{len(failed)} in {FAILED_FOLDER}/",
        "environment": _counted(item["env_id"] for item in metadata),
        "schema version": _counted(item["schema_version"] for item in metadata),
        "expert": _counted(item["expert"] for item in metadata),
        "success": f"{successes} of {len(metadata)} tried, {strict} by the strict condition",
        "duration": f"{mixture or _spread(durations)}; {sum(durations):.1f} s in all",
        "completion time": (mixture or _spread(times)) if times else "–",
        "people": f"{len(subjects)}, in {len(clips)} clips",
        "cameras": _counted(_image_text(item) for item in metadata),
        "size": f"{size / 1e6:.1f} MB, {size / len(metadata) / 1e6:.2f} MB an episode",
    }


def _image_text(metadata: dict[str, Any]) -> str:
    if not metadata["cameras"]:
        return "none"
    height, width = metadata["image_size"]
    codec = metadata["image_codec"]
    quality = f" {metadata['image_quality']}" if codec == "jpeg" else ""
    return f"{', '.join(metadata['cameras'])} ({height}x{width} {codec}{quality})"


def _counted(values: Any) -> str:
    counts = Counter(values).most_common()
    if len(counts) == 1:
        return str(counts[0][0])
    return "; ".join(f"{value} ({number})" for value, number in counts)


def _mixture(metadata: list[dict[str, Any]]) -> str:
    """Return why episodes have no mean in common; empty if they do."""
    for name in ("env_id", "expert", "control_period", "xml_hash"):
        values = sorted({str(item[name]) for item in metadata})
        if len(values) > 1:
            return f"– (episodes differ in {name}: {', '.join(v[:40] for v in values)})"
    return ""


def _spread(values: list[float]) -> str:
    """Format mean, sample standard deviation and range of times in s."""
    if len(values) == 1:
        return f"{values[0]:.2f} s (one episode)"
    deviation, n = stdev(values), len(values)
    ends = f"{min(values):.2f} … {max(values):.2f}"
    return f"{mean(values):.2f} ± {deviation:.2f} s (mean ± sd of {n}; {ends})"


def main(args: Sequence[str]) -> int:
    """Run ``bin/Dataset.py``."""
    example = "python bin/Dataset.py verify dataset/FeedingEnv"
    description = "Inspect, verify and plot episodes."
    text, code = parse(Verify | Info | Plot, example, description=description, args=args).run()
    print(text)  # noqa: T201
    return code
