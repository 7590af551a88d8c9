"""Size and reading speed of a dataset made by ``face-prediction build-dataset``.

Run: ``python benchmarks/face_dataset.py face_dataset``. Prints two Markdown tables: where the bytes
are, and how long it takes to read sequences in random order, each read being a different one
(files are in the system's cache after the first table).

With ``--tracks face_tracks`` it prints a third one instead: what the place of the crop tells about
frames that are still to come. Along every axis on which the crop does not touch the border of the
video's picture: how often the middle of the face's range in the history is more than 1.5 pixels of
256 from the middle of the crop, how often the mouth then moves toward the other side, and the mean
absolute error at the last frame of a linear predictor that is given the mouth's last two steps,
without and with that distance (people of a fold predicted by those of the others).
"""

from __future__ import annotations

import argparse
import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import h5py
import numpy as np

from face_prediction.dataset.manifest import CLIP_FOLDER
from face_prediction.dataset.reader import FaceDataset
from face_prediction.dataset.sequences import CropFrom, clip_frames, find_sequences
from face_prediction.tracking.geometry import LIPS
from face_prediction.tracking.tracks import load_track
from robo_manip_baselines.runs.command import run_command
from robo_manip_baselines.runs.errors import RequestError
from robo_manip_baselines.runs.markdown import markdown_table


def sizes(dataset: FaceDataset) -> tuple[Counter[str], int, int]:
    """Bytes by part; pictures stored; and how many decoded frames they show."""
    total: Counter[str] = Counter()
    stored = shown = 0
    for clip in dataset.manifest.clips:
        path = dataset.folder / CLIP_FOLDER / f"{clip.clip}.h5"
        total["all"] += path.stat().st_size
        with h5py.File(path, "r") as file:

            def add(name: str, item: object) -> None:
                if isinstance(item, h5py.Dataset):
                    part = {"pictures/data": "pictures", "frames/landmarks": "landmarks"}
                    total[part.get(name, "other arrays")] += item.id.get_storage_size()

            file.visititems(add)
            if clip.sequences:
                start = np.asarray(file["sequences/start"])
                source = np.asarray(file["frames/source_frame"])
                length = dataset.manifest.settings.length
                shown += len(np.unique(source[start[:, None] + np.arange(length)]))
                stored += len(np.asarray(file["pictures/checksum"]))
    return total, stored, shown


def time_reads(read: Callable[[int], object], indices: Sequence[int]) -> tuple[float, float]:
    """Median and 95th percentile in milliseconds."""
    taken = []
    for index in indices:
        begin = time.perf_counter()
        read(index)
        taken.append(1000 * (time.perf_counter() - begin))
    return float(np.median(taken)), float(np.percentile(taken, 95))


def places(
    dataset: FaceDataset, tracks: Path, crop_from: CropFrom
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Per free axis: middle of the history in the crop, future and last motion, and the fold."""
    settings = replace(dataset.manifest.settings, crop_from=crop_from)
    now = settings.history - 1
    rows: list[tuple[float, float, float, int]] = []
    for clip in dataset.manifest.clips:
        if not clip.sequences or clip.fold is None:
            continue
        frames = clip_frames(load_track(tracks / f"{clip.clip}.npz"), settings)
        sequences = find_sequences(frames, settings)
        for start, crop in zip(sequences.start.tolist(), sequences.crops, strict=True):
            part = frames.landmarks[start : start + settings.length]
            points = crop.normalise(part, frames.image_size)[..., :2]
            history = points[: settings.history]
            middle = (history.min(axis=(0, 1)) + history.max(axis=(0, 1))) / 2 - 0.5
            mouth = points[:, list(LIPS)].mean(axis=1)
            for axis, corner in enumerate((crop.left, crop.top)):
                if 0 < corner < frames.image_size[axis] - crop.side:
                    future = mouth[-1, axis] - mouth[now, axis]
                    last = mouth[now, axis] - mouth[now - 2, axis]
                    rows.append((middle[axis], future, last, clip.fold))
    middle, future, last, fold = np.array(rows).T
    return middle, future, last, fold


def held_out_error(inputs: np.ndarray, wanted: np.ndarray, fold: np.ndarray) -> np.ndarray:
    """(N,) absolute errors of a least-squares fit to the other folds."""
    error = np.zeros(len(wanted))
    for test in np.unique(fold):
        train = fold != test
        weights = np.linalg.lstsq(inputs[train], wanted[train], rcond=None)[0]
        error[~train] = np.abs(wanted - inputs @ weights)[~train]
    return error


def crop_table(dataset: FaceDataset, tracks: Path) -> str:
    """Markdown table of the information leaked by crops around history and whole sequence."""
    head = ["crop around", "axes", "off the middle", "... then moves to the other side"]
    head += ["error from last steps", "... and place", "both where off the middle"]
    rows = []
    for crop_from in ("history", "sequence"):
        middle, future, last, fold = places(dataset, tracks, crop_from)
        off = np.abs(middle) > 1.5 / 256
        place = np.stack([last, middle, np.where(off, middle, 0.0)], axis=1)
        motion = held_out_error(last[:, None], future, fold)
        both = held_out_error(place, future, fold)
        moved = where_off = "–"
        if off.any():
            share = np.mean(np.sign(future[off]) == -np.sign(middle[off]))
            moved = f"{100 * share:.1f} %"
            where_off = f"{motion[off].mean():.4f} {both[off].mean():.4f}"
        cells = [crop_from, len(middle), f"{100 * off.mean():.1f} %", moved]
        rows.append([*cells, f"{motion.mean():.5f}", f"{both.mean():.5f}", where_off])
    return markdown_table(head, rows)


def main() -> None:
    """Measure one dataset."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("dataset", type=Path)
    parser.add_argument("--reads", type=int, default=200, help="sequences read for each row")
    parser.add_argument("--tracks", type=Path, help="tracks of its clips: what crops give away")
    options = parser.parse_args()
    cv2.setNumThreads(1)
    with FaceDataset(options.dataset) as dataset:
        if not len(dataset):
            raise RequestError(f"'{options.dataset}': holds no sequence")
        if options.tracks:
            print(crop_table(dataset, options.tracks))
            return
        total, stored, shown = sizes(dataset)
        count = len(dataset)
        print("| part | MB | kB a sequence |\n|---|---|---|")
        for part in ("pictures", "landmarks", "other arrays", "all"):
            print(f"| {part} | {total[part] / 1e6:.1f} | {total[part] / 1e3 / count:.0f} |")
        print(
            f"\n{count} sequences, {total['all'] / 1e9 / count * 1000:.2f} GB for 1000; "
            f"{stored} pictures of {shown} decoded frames, "
            f"{total['pictures'] / stored / 1e3:.1f} kB each\n"
        )
        rng = np.random.default_rng(0)
        indices = rng.permutation(count)[: options.reads].tolist()
        future = slice(dataset.manifest.settings.history, None)
        side = dataset.manifest.settings.crop_size
        rows: list[tuple[str, Callable[[int], object]]] = [
            (f"whole sequence, {side}×{side}", dataset.read),
            (f"whole sequence, {side // 2}×{side // 2}", lambda i: dataset.read(i, reduce=2)),
            (f"whole sequence, {side // 4}×{side // 4}", lambda i: dataset.read(i, reduce=4)),
            ("the frames to predict", lambda i: dataset.images(i, future)),
            ("landmarks only", dataset.landmarks),
        ]
        print("| what is read | median ms | 95 % ms |\n|---|---|---|")
        for name, read in rows:
            time_reads(read, indices[:10])
            median, high = time_reads(read, indices)
            print(f"| {name} | {median:.1f} | {high:.1f} |")


if __name__ == "__main__":
    run_command(main)
