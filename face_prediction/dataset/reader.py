"""Reading a dataset back, one sequence at a time.

Legend: F frames of a sequence, H history, L = 468 landmarks, S side of the images.
"""

from __future__ import annotations

import os
import zlib
from collections import OrderedDict
from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from face_prediction.dataset.clip_file import (
    clip_array,
    damage,
    open_clip,
    read_record,
    read_rows,
)
from face_prediction.dataset.manifest import (
    CLIP_FOLDER,
    ClipEntry,
    SequenceRow,
    read_manifest,
)
from face_prediction.dataset.sequences import STATISTICS, SequenceSettings
from face_prediction.tracking.geometry import Crop
from robo_manip_baselines.runs.errors import RequestError
from robo_manip_baselines.runs.images import REDUCTIONS, decode_image, encoded_size

MAX_OPEN = 64
"""Clip files kept open at once; a process may open some thousand."""


@dataclass(frozen=True)
class FaceSequence:
    """One sequence, as a camera that stands still around the face records it.

    Attributes:
        images: (F, S, S, 3) uint8 RGB.
        landmarks: (F, 468, 3) float32: u right and v down, 0...1 across the image, and MediaPipe's
            relative depth in the same unit.
        timestamps: (F,) float64 s on the video's clock.
        interpolated: (F,) bool: landmarks made from two decoded frames.
        image_lag: (F,) float64 s: time of the image less that of the frame (images are not mixed).
        mouth: (F, 3) float64 m, mouth centre in the camera frame.
    """

    images: np.ndarray
    landmarks: np.ndarray
    timestamps: np.ndarray
    interpolated: np.ndarray
    image_lag: np.ndarray
    mouth: np.ndarray


class FaceDataset:
    """A dataset made by ``face-prediction build-dataset``, open for reading.

    Sequences are counted from 0 through all clips, in the order of ``manifest.clips``. Nothing but
    the list of clips is read until a sequence is asked for. May be pickled and forked: every
    process opens files of its own.

    Attributes:
        folder: where it is.
        manifest: clips, settings and folds.

    Raises:
        RequestError: there is no dataset, or one of another schema.
    """

    def __init__(self, folder: str | Path) -> None:
        self.folder = Path(folder)
        self.manifest = read_manifest(self.folder)
        counts = [clip.sequences for clip in self.manifest.clips]
        self._ends = np.cumsum(counts, dtype=np.int64)
        self._files: OrderedDict[int, _ClipReader] = OrderedDict()
        self._verified: set[int] = set()
        self._process = os.getpid()

    def __len__(self) -> int:
        return int(self._ends[-1]) if len(self._ends) else 0

    def __enter__(self) -> FaceDataset:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_files": OrderedDict()}

    def close(self) -> None:
        """Close all files; they are opened again when needed."""
        for reader in self._files.values():
            reader.file.close()
        self._files.clear()

    def entry(self, index: int) -> ClipEntry:
        """The clip that sequence ``index`` is from."""
        return self.manifest.clips[self._place(index)[0]]

    def indices(
        self, folds: Collection[int] | None = None, kinds: Collection[str] | None = None
    ) -> np.ndarray:
        """(N,) int: the sequences of these folds and kinds of footage; None: of all."""
        clips = self.manifest.clips
        keep = [
            (folds is None or clip.fold in folds) and (kinds is None or clip.kind in kinds)
            for clip in clips
        ]
        return np.flatnonzero(np.repeat(keep, [clip.sequences for clip in clips]))

    def starts(self) -> np.ndarray:
        """(N,) int: the first frame of every sequence, in its clip at the dataset's rate."""
        clips = enumerate(self.manifest.clips)
        found = [self._open(place).start for place, clip in clips if clip.sequences]
        return np.concatenate([np.empty(0, dtype=np.int64), *found]).astype(np.int64)

    def landmarks(self, index: int) -> np.ndarray:
        """(F, 468, 3) float32 in the coordinates of the images, without reading these."""
        reader, number = self._reader(index)
        return reader.landmarks(number)

    def images(self, index: int, frames: slice | None = None, reduce: int = 1) -> np.ndarray:
        """Images (F, S / reduce, S / reduce, 3) uint8 RGB; only those of ``frames`` are decoded.

        Raises:
            RequestError: the bytes are damaged.
            ValueError: ``reduce`` is not 1, 2, 4 or 8.
        """
        reader, number = self._reader(index)
        return reader.images(number, frames or slice(None), reduce)

    def read(self, index: int, reduce: int = 1) -> FaceSequence:
        """One whole sequence. Raises as `images` does."""
        reader, number = self._reader(index)
        rows = reader.rows(number)
        return FaceSequence(
            images=reader.images(number, slice(None), reduce),
            landmarks=reader.landmarks(number),
            timestamps=reader.array("frames/timestamps", rows),
            interpolated=reader.array("frames/interpolated", rows),
            image_lag=reader.array("frames/image_lag", rows),
            mouth=reader.array("frames/mouth", rows),
        )

    def rows(self) -> list[SequenceRow]:
        """The table of all sequences, read from the clips' files."""
        result: list[SequenceRow] = []
        for place, clip in enumerate(self.manifest.clips):
            if not clip.sequences or clip.fold is None:
                continue
            reader = self._open(place)
            columns = {name: reader.array(f"sequences/{name}").tolist() for name in STATISTICS}
            for number, start in enumerate(reader.start.tolist()):
                values = {name: column[number] for name, column in columns.items()}
                place = (clip.clip, number, clip.subject, clip.kind, clip.fold, start)
                result.append(SequenceRow(*place, values))
        return result

    def _place(self, index: int) -> tuple[int, int]:
        """Clip that sequence ``index`` is from, and its number in the clip."""
        if not 0 <= index < len(self):
            raise IndexError(f"sequence {index}: {self.folder} has {len(self)}")
        place = int(np.searchsorted(self._ends, index, side="right"))
        return place, int(index - self._ends[place] + self.manifest.clips[place].sequences)

    def _reader(self, index: int) -> tuple[_ClipReader, int]:
        """The reader of the clip that sequence ``index`` is from, and its number in the clip."""
        place, number = self._place(index)
        return self._open(place), number

    def _open(self, place: int) -> _ClipReader:
        if self._process != os.getpid():  # forked: these handles are the parent's
            self._files = OrderedDict()
            self._process = os.getpid()
        if place in self._files:
            self._files.move_to_end(place)
            return self._files[place]
        clip = self.manifest.clips[place]
        path = self.folder / CLIP_FOLDER / f"{clip.clip}.h5"
        verify = place not in self._verified  # once is enough: files may be reopened often
        reader = self._files[place] = _ClipReader(path, clip, self.manifest.settings, verify)
        self._verified.add(place)
        if len(self._files) > MAX_OPEN:
            _, oldest = self._files.popitem(last=False)
            oldest.file.close()
        return reader


class _ClipReader:
    """The open file of one clip.

    Raises:
        RequestError: it was made from something else, or with other settings.
    """

    def __init__(
        self, path: Path, clip: ClipEntry, settings: SequenceSettings, verify: bool
    ) -> None:
        self.path = path
        self.file = open_clip(path, verify=verify)
        self._arrays: dict[str, h5py.Dataset] = {}
        try:
            record = read_record(path, self.file)
            self.start = self.array("sequences/start")
            self._crops = self.array("sequences/crop")
            self._index = self.array("pictures/index")
            self._offset = self.array("pictures/offset")
            self._checksum = self.array("pictures/checksum")
            wanted = {
                "clip": clip.clip,
                "track_sha256": clip.track_sha256,
                "video_sha256": clip.video_sha256,
                "settings": settings.to_json(),
            }
            wrong = [key for key, value in wanted.items() if record.get(key) != value]
            if not wrong and clip.content_sha256 not in ("", record.get("content_sha256")):
                wrong.append("frames")
            shape = (clip.sequences, settings.length)
            if len(self.start) != clip.sequences or self._index.shape != shape:
                wrong.append("sequences")
            elif not self._is_consistent(settings):
                raise RequestError(f"{path}: its sequences lie outside its frames or images")
            if wrong:
                problem = f"its {', '.join(wrong)} are not those of the dataset"
                raise RequestError(f"{path}: {problem}; make the dataset again")
        except RequestError:
            self.file.close()
            raise
        self._length, self._side = settings.length, settings.crop_size
        width, height = record["image_size"]
        self._image_size = (int(width), int(height))

    def _is_consistent(self, settings: SequenceSettings) -> bool:
        """Return whether starts, crops and images of the sequences point into the arrays."""
        frames = len(clip_array(self.path, self.file, "frames/valid"))
        stored = len(clip_array(self.path, self.file, "pictures/data"))
        images, sizes = len(self._checksum), np.diff(self._offset)
        if len(self._offset) != images + 1 or self._offset[0] or self._offset[-1] != stored:
            return False
        if images and not (
            sizes.min() >= 0 and sizes.max() <= 4 * settings.crop_size**2 * 3 + 2**16
        ):
            return False
        if not len(self.start):
            return True
        return bool(
            len(self._crops) == len(self.start)
            and self.start.min() >= 0
            and self.start.max() <= frames - settings.length
            and self._index.min() >= 0
            and self._index.max() < images
            and self._crops[:, 2].min() > 0
        )

    def array(self, name: str, rows: Any = ()) -> np.ndarray:
        if name not in self._arrays:
            self._arrays[name] = clip_array(self.path, self.file, name)
        return read_rows(self.path, self._arrays[name], name, rows)

    def rows(self, number: int) -> slice:
        start = int(self.start[number])
        return slice(start, start + self._length)

    def landmarks(self, number: int) -> np.ndarray:
        crop = Crop(*map(int, self._crops[number]))
        points = self.array("frames/landmarks", self.rows(number))
        return crop.normalise(points, self._image_size).astype(np.float32)

    def images(self, number: int, frames: slice, reduce: int) -> np.ndarray:
        if reduce not in REDUCTIONS:
            raise ValueError(f"reduce {reduce}: one of {', '.join(map(str, REDUCTIONS))}")
        index = self._index[number][frames]
        if not len(index):
            raise ValueError("no frame asked for")
        wanted, place = np.unique(index, return_inverse=True)
        first = int(self._offset[wanted[0]])
        data = self.array("pictures/data", slice(first, int(self._offset[wanted[-1] + 1])))
        images: list[np.ndarray] = []
        for image in wanted.tolist():
            encoded = data[self._offset[image] - first : self._offset[image + 1] - first]
            try:
                if zlib.crc32(encoded.tobytes()) != int(self._checksum[image]):
                    raise ValueError("its checksum is wrong")
                if encoded_size(encoded) != (self._side, self._side):
                    raise ValueError(f"it is {encoded_size(encoded)}, not of side {self._side}")
                images.append(decode_image(encoded, reduce))
            except ValueError as error:
                raise RequestError(f"{self.path}: image {image}: {damage(error)}") from None
        return np.stack(images)[place]
