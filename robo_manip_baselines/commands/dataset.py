"""``bin/Dataset.py``: inspect, draw, compare, merge, split, export and import episodes."""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from statistics import mean, stdev
from typing import TYPE_CHECKING, Annotated, Any

import tyro
from annotated_types import Interval

from robo_manip_baselines.commands.rollout import changed_options
from robo_manip_baselines.observation import Corruption
from robo_manip_baselines.runs.browser import PageOptions, require_viser
from robo_manip_baselines.runs.command import parse
from robo_manip_baselines.runs.errors import RequestError, require_choice
from robo_manip_baselines.runs.images import CODECS
from robo_manip_baselines.runs.progress import closing_table
from robo_manip_baselines.runs.ranges import NonNegativeInt, Seed

if TYPE_CHECKING:
    from robo_manip_baselines.data.comparison import ColumnDifference, EpisodeComparison
    from robo_manip_baselines.data.curation import Copied

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

        out = self.out or Path(f"{self.episode.stem or 'episode'}.png")
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


@dataclass(frozen=True)
class View:
    """Show episodes in a browser: 3-D scene, cameras and curves, with one slider.

    Attributes:
        episodes: Episode files, or folders of them.
        page: Address of the page.
    """

    episodes: Annotated[
        tuple[Path, ...],
        tyro.conf.arg(metavar="DIR|FILE [DIR|FILE ...]"),
        tyro.conf.Positional,
    ]
    page: tyro.conf.OmitArgPrefixes[PageOptions] = field(default_factory=PageOptions)

    def run(self) -> tuple[str, int]:
        """Serve the page until the process is interrupted."""
        require_viser("view")
        from robo_manip_baselines.rollout.episode_page import serve_episodes

        serve_episodes(_episode_files(self.episodes), self.page)
        return "", 0


@dataclass(frozen=True)
class Merge:
    """Copy the episodes of several folders into a new one. Mixtures are refused.

    Attributes:
        folders: Folders of episode_*.hdf5 files; they are only read.
        out: Folder to make; provenance.json in it says where each episode comes from.
    """

    folders: Annotated[
        tuple[Path, ...], tyro.conf.arg(metavar="DIR DIR [DIR ...]"), tyro.conf.Positional
    ]
    out: Path

    def run(self) -> tuple[str, int]:
        """Return the text to print and the exit code."""
        from robo_manip_baselines.data.curation import merge_datasets

        return _copied_text(merge_datasets(self.folders, self.out)), 0


@dataclass(frozen=True)
class Split:
    """Copy the demonstrations of a folder into train/ and validation/ of a new one.

    Attributes:
        folder: Folder of episode_*.hdf5 files; it is only read. Failures are left out.
        out: Folder to make; provenance.json in it says where each episode comes from.
        fraction: Share of the episodes to hold out for validation.
        seed: Seed of the random choice.
        by: What stays together: episode, or person, so that nobody is in both parts.
    """

    folder: EpisodeFolder
    out: Path
    fraction: Annotated[float, Interval(gt=0.0, lt=1.0)] = 0.2
    seed: Seed = 0
    by: str = "episode"

    def run(self) -> tuple[str, int]:
        """Return the text to print and the exit code."""
        from robo_manip_baselines.data.curation import SplitRequest, split_dataset

        request = SplitRequest(self.fraction, self.seed, self.by)
        return _copied_text(split_dataset(self.folder, self.out, request)), 0


@dataclass(frozen=True)
class Compare:
    """Compare two episodes, number by number. Ends with 1 if they differ.

    Attributes:
        one: An episode_*.hdf5 file.
        other: Another one.
        columns: Most columns of an array to list, those that differ most; 0 for all.
    """

    one: Annotated[Path, tyro.conf.arg(metavar="FILE"), tyro.conf.Positional]
    other: Annotated[Path, tyro.conf.arg(metavar="FILE"), tyro.conf.Positional]
    columns: NonNegativeInt = 8

    def run(self) -> tuple[str, int]:
        """Return the text to print and the exit code."""
        from robo_manip_baselines.data.comparison import compare_episodes
        from robo_manip_baselines.data.episode import EpisodeReader

        with EpisodeReader(self.one) as one, EpisodeReader(self.other) as other:
            found = compare_episodes(one, other)
        return comparison_text(found, (str(self.one), str(self.other)), self.columns), int(
            not found.is_same
        )


@dataclass(frozen=True)
class Tile:
    """Play the videos of evaluations at once: a row for each condition, a column for each seed.

    Attributes:
        folders: Folders of Rollout.py --policy --video, or a folder above several of them.
        out: Video to write, .mp4.
        view: View of each video: top, angle, front_close, front_close_zoom, or all of them.
        width: Width of a tile in pixels.
        columns: Most seeds to show.
    """

    folders: Annotated[
        tuple[Path, ...], tyro.conf.arg(metavar="DIR [DIR ...]"), tyro.conf.Positional
    ]
    out: Path = Path("tiles.mp4")
    view: str = "angle"
    width: Annotated[int, Interval(ge=64, le=4096)] = 320
    columns: Annotated[int, Interval(ge=1, le=64)] = 4

    def run(self) -> tuple[str, int]:
        """Return the text to print and the exit code."""
        from robo_manip_baselines.rollout.tiling import find_tiles, write_tiles
        from robo_manip_baselines.runs.files import locked_file, require_out_file
        from robo_manip_baselines.runs.videos import VIDEO

        _require_folders(self.folders, "results/...")
        tiling = find_tiles(self.folders, self.columns)
        shown = [path for row in tiling.rows.values() for path, _ in row.values()]
        require_out_file(self.out, VIDEO, shown)
        with locked_file(self.out):
            write_tiles(self.out, tiling, view=self.view, width=self.width)
        size = f"{len(tiling.rows)} conditions, {len(tiling.seeds)} seeds"
        return f"written to '{self.out}': {size}", 0


def _require_folders(folders: Sequence[Path], example: str) -> None:
    if not folders:
        raise RequestError(f"which folder? name one or more, for example {example}")
    for folder in folders:
        if not folder.is_dir():
            raise RequestError(f"'{folder}' is no folder; name a folder")


def _episode_files(given: Sequence[Path]) -> list[Path]:
    """Return the files that are named, and those of the folders that are named, failures last."""
    from robo_manip_baselines.data.files import list_episodes, list_failures

    paths: list[Path] = []
    for path in given:
        paths += list_episodes(path) + list_failures(path) if path.is_dir() else [path]
    if not paths:
        names = ", ".join(f"'{path}'" for path in given)
        what = f"{names} holds no episode_*.hdf5 file" if given else "no episode is named"
        raise RequestError(f"{what}; name files, or a folder that holds some")
    return paths


def _copied_text(copied: Copied) -> str:
    rows = {}
    for folder, number in copied.demonstrations.items():
        failures = copied.failures[folder]
        kept = f" and {failures} failures" if failures else ""
        rows[str(folder)] = f"{number} demonstrations{kept}"
    if copied.duplicates:
        rows["taken once"] = f"{copied.duplicates} that were there twice"
    rows["copied now"] = str(copied.new)
    return closing_table(rows)


def comparison_text(found: EpisodeComparison, names: tuple[str, str], columns: int = 8) -> str:
    """Return what differs between two episodes, for people to read.

    Args:
        found: differences.
        names: of the episodes.
        columns: most lines for one array; 0 for all.
    """
    if found.is_same:
        return f"the same: {found.lengths[0]} steps, every attribute, number and image"
    lines: list[str] = []
    if found.lengths[0] != found.lengths[1]:
        fewer = min(found.lengths)
        lines.append(
            f"steps: {found.lengths[0]} and {found.lengths[1]}; the first {fewer} compared"
        )
    for name, (one, other) in found.attributes.items():
        lines.append(f"attribute {name}: {_short(one)} and {_short(other)}")
    lines += [f"{name}: only in {names[place]}" for name, place in found.only_in.items()]
    lines += [f"{name}: shapes {one} and {other}" for name, (one, other) in found.shapes.items()]
    if found.columns:
        rows = [("array", "column", "first step", "steps", "max", "rms", "unit")]
        for name, group in itertools.groupby(found.columns, key=lambda item: item.field):
            items = list(group)
            cut = columns and len(items) > columns
            listed = sorted(items, key=lambda i: -i.largest)[:columns] if cut else items
            rows += [_column_row(item) for item in listed]
            if len(items) > len(listed):
                rows.append((name, f"… {len(items) - len(listed)} more", *[""] * 5))
        lines += _aligned(rows)
    for image in found.images:
        mean = "" if image.mean is None else f", mean difference {image.mean:.2f} of 255"
        first = f"first at step {image.first_step}"
        lines.append(f"images of {image.camera}: {image.steps} differ, {first}{mean}")
    if found.first_step is not None:
        lines.append(f"first difference at step {found.first_step}")
    return "\n".join(lines)


def _column_row(item: ColumnDifference) -> tuple[str, ...]:
    numbers = str(item.first_step), str(item.steps), f"{item.largest:.3g}", f"{item.rms:.3g}"
    return item.field, item.column, *numbers, item.unit


def _aligned(rows: Sequence[Sequence[str]]) -> list[str]:
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return ["  ".join(map(str.ljust, row, widths)).rstrip() for row in rows]


def _short(value: Any) -> str:
    text = " ".join(str(value).split())
    return text if len(text) <= 60 else f"{text[:60]}…"


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


ForeignFolder = Annotated[
    Path,
    tyro.conf.arg(metavar="DIR", help="Folder of episodes of the other program."),
    tyro.conf.Positional,
]
OutFolder = Annotated[
    Path, tyro.conf.arg(metavar="OUT", help="Folder to write."), tyro.conf.Positional
]

EXPORTS = ("lerobot", "rmb", "aloha")
IMPORTS = ("rmb", "aloha")
LEROBOT_ONLY = ("obs", "horizon", "object_pose", "relative", "corruption", "cameras", "recorded")
"""Options of an export that the other formats have no use for: they hold the recorded state."""


@dataclass(frozen=True)
class Export:
    """Write demonstrations for LeRobot, RoboManipBaselines or ALOHA. Killed, it goes on."""

    folder: EpisodeFolder
    out: OutFolder
    format: str
    """Format: lerobot (LeRobot v3.0), rmb (RoboManipBaselines) or aloha (public ACT)."""
    obs: str = "baseline"
    """Observation preset of `observation.state`: baseline, current, current_pred, history."""
    horizon: int = 2
    """Frames of 1/30 s that current_pred looks ahead."""
    object_pose: bool = False
    """Positions of the objects in `observation.state`, too."""
    relative: bool = False
    """The mouth in other frames relative to the present one."""
    corruption: tyro.conf.OmitArgPrefixes[Corruption] = field(default_factory=Corruption)
    cameras: tuple[str, ...] | None = None
    """Cameras to export, or none; all that were recorded if not given."""
    recorded: bool = True
    """Every field of the episode files, too, as features recorded.<field> of LeRobot."""
    video_codec: str | None = None
    """Codec of the videos: libsvtav1 (lerobot's default), h264 (rmb's), hevc or lossless."""
    crf: int | None = None
    """Quality of the videos, lower is better; 30 for libsvtav1, 23 for h264, 28 for hevc."""
    gop: int | None = None
    """Frames from one key frame to the next; 2 for lerobot, 10 for rmb."""

    def run(self) -> tuple[str, int]:
        """Return the text to print and the exit code."""
        require_choice("format", self.format, EXPORTS)
        if self.format != "lerobot":
            self._require_unused(LEROBOT_ONLY)
        if self.format == "aloha":
            self._require_unused(("video_codec", "crf", "gop"))
        _require_elsewhere(self.folder, self.out)
        return closing_table(self._export()), 0

    def _export(self) -> dict[str, str]:
        from robo_manip_baselines.data.formats.aloha import export_aloha
        from robo_manip_baselines.data.formats.lerobot import LeRobotRequest, export_lerobot
        from robo_manip_baselines.data.formats.rmb import ENCODING, export_rmb
        from robo_manip_baselines.data.formats.video import VIDEO_CODECS, VideoEncoding

        if self.format == "aloha":
            return export_aloha(self.folder, self.out)
        usual = VideoEncoding() if self.format == "lerobot" else ENCODING
        codec = require_choice("video codec", self.video_codec or usual.codec, VIDEO_CODECS)
        crf = VIDEO_CODECS[codec] if self.crf is None else self.crf
        encoding = VideoEncoding(codec, crf, usual.gop if self.gop is None else self.gop)
        if self.format == "rmb":
            return export_rmb(self.folder, self.out, encoding)
        chosen = {name: getattr(self, name) for name in LEROBOT_ONLY}
        return export_lerobot(self.folder, self.out, LeRobotRequest(**chosen, encoding=encoding))

    def _require_unused(self, names: Sequence[str]) -> None:
        """Refuse options that the format has no use for."""
        usual = Export(self.folder, self.out, self.format)
        given = replace(usual, **{name: getattr(self, name) for name in names})
        if changed := changed_options(given, usual):
            raise RequestError(f"--{changed[0]}: not for the format {self.format}; leave it out")


def _require_elsewhere(folder: Path, out: Path) -> None:
    """Refuse to write into the folder that is read, or to a file."""
    if out.exists() and not out.is_dir():
        raise RequestError(f"OUT '{out}': is a file; name a folder")
    if out.resolve() == folder.resolve():
        raise RequestError(f"OUT '{out}': is read; name another folder")


@dataclass(frozen=True)
class Import:
    """Make episode files of episodes of RoboManipBaselines or ALOHA. Killed, it goes on."""

    folder: ForeignFolder
    out: OutFolder
    format: str
    """Format: rmb (RoboManipBaselines) or aloha (public ACT)."""
    cameras: tuple[str, ...] | None = None
    """Names here of the cameras there, such as top=cam_high; those that are not named are left
    out."""
    image_codec: str = "png"
    """Codec of the images: png (lossless), jpeg or raw."""

    def run(self) -> tuple[str, int]:
        """Return the text to print and the exit code."""
        from robo_manip_baselines.data.formats.aloha import import_aloha
        from robo_manip_baselines.data.formats.rmb import import_rmb

        require_choice("format", self.format, IMPORTS)
        require_choice("image codec", self.image_codec, CODECS)
        _require_elsewhere(self.folder, self.out)
        given = None if self.cameras is None else list(self.cameras)
        read = {"rmb": import_rmb, "aloha": import_aloha}[self.format]
        return closing_table(read(self.folder, self.out, cameras=given, codec=self.image_codec)), 0


COMMANDS = Info | Verify | Plot | View | Merge | Split | Compare | Tile | Export | Import
"""Subcommands, in the order of --help."""


def main(args: Sequence[str]) -> int:
    """Run ``bin/Dataset.py``."""
    example = "python bin/Dataset.py verify dataset/FeedingEnv"
    description = "Inspect, verify, draw, compare, merge, split, export and import episodes."
    text, code = parse(COMMANDS, example, description=description, args=args).run()
    if text:
        print(text)  # noqa: T201
    return code
