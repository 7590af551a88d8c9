"""Images of the demonstrations, held in memory or decoded when they are needed.

Legend: R steps of all demonstrations together, b steps asked for, N cameras, H and W image height
and width.
"""

from __future__ import annotations

import hashlib
import math
import threading
from collections import OrderedDict
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from robo_manip_baselines.data.demonstrations import Demonstrations
from robo_manip_baselines.data.episode import EpisodeFileError, EpisodeReader
from robo_manip_baselines.observation.images import fit_image
from robo_manip_baselines.runs.errors import RequestError
from robo_manip_baselines.runs.images import decode_image
from robo_manip_baselines.runs.memory import free_memory
from robo_manip_baselines.runs.progress import track
from robo_manip_baselines.runs.shared_arrays import SharedArray, shared_array
from robo_manip_baselines.runs.threads import processors
from robo_manip_baselines.runs.versions import source_digest

Images = NDArray[np.uint8]

MAX_OPEN_FILES = 256
"""Episode files open at a time; the usual limit of a process is 1024 files of all kinds."""


class ImageStore(AbstractContextManager["ImageStore"]):
    """Images of steps, in the order of ``spec.cameras``, as the environment shows them.

    Recorded images of the size ``spec.drawn_size`` become ones of ``spec.image_size`` by
    `fit_image`, which the environment applies to what it draws.

    Images that fit into ``memory_budget``, or that another process on this machine holds already,
    are decoded once and held by all of them together. Otherwise each is read from its file, which
    stays open, and decoded when it is needed. A pool of threads does the decoding.
    The pixels are the same either way, and each image is checked against its checksum when it is
    read.

    May be used from several threads. Use as a context manager, or call `close`.

    Args:
        demonstrations: with at least one camera in their ``spec``.
        memory_budget: bytes that images may take; half of what is free if None, 0 to hold none.
        threads: that decode; one for each processor if None.

    Attributes:
        shape: (N, H, W, 3).
        held: (R, N, H, W, 3) uint8 if all images are held, otherwise None.

    Raises:
        RequestError: there is no camera.
        EpisodeFileError: an image that is to be held is damaged.
    """

    def __init__(
        self,
        demonstrations: Demonstrations,
        *,
        memory_budget: int | None = None,
        threads: int | None = None,
    ) -> None:
        spec = demonstrations.spec
        if not spec.cameras:
            raise RequestError("no images without a camera; choose --cameras")
        self.shape = (len(spec.cameras), *spec.image_size, 3)
        self.held: Images | None = None
        self._cameras = spec.cameras
        self._paths = demonstrations.paths
        self._offsets = demonstrations.offsets
        self._open: OrderedDict[int, EpisodeReader] = OrderedDict()
        self._reading = threading.Lock()
        self._pool = ThreadPoolExecutor(threads or processors(), thread_name_prefix="images")
        shape = (int(self._offsets[-1]), *self.shape)
        budget = free_memory() // 2 if memory_budget is None else memory_budget
        self._shared: SharedArray | None = None
        if budget:
            try:
                self._shared = shared_array(_key(demonstrations), shape, self._decode_all, budget)
                if self._shared is not None:
                    self.held = self._shared.array
                elif math.prod(shape) <= budget:
                    self.held = self._decode_all(np.empty(shape, np.uint8))
            except BaseException:
                self.close()
                raise

    def __exit__(self, *error: object) -> None:
        self.close()

    def images(self, rows: NDArray[np.int64], out: Images | None = None) -> Images:
        """Return the images (b, N, H, W, 3) of (b,) rows among the R steps, written to ``out``.

        Raises:
            IndexError: there is no such step.
            EpisodeFileError: an image is damaged; names file, camera and step.
        """
        if len(rows) and not 0 <= rows.min() <= rows.max() < self._offsets[-1]:
            raise IndexError(f"rows 0 to {self._offsets[-1] - 1}, not {rows.min()} to {rows.max()}")
        images: Images = np.empty((len(rows), *self.shape), np.uint8) if out is None else out
        if self.held is not None:
            # Unlike indexing, and unlike the mode "raise", this lets other threads run meanwhile.
            np.take(self.held, rows, axis=0, out=images, mode="clip")
            return images
        episodes = np.searchsorted(self._offsets, rows, side="right") - 1
        decoded = []
        for row, episode, views in zip(rows, episodes, images, strict=True):
            step = int(row - self._offsets[episode])
            for camera, view in zip(self._cameras, views, strict=True):
                with self._reading:  # HDF5 itself reads one thing at a time
                    data = self._reader(int(episode)).encoded_frame(camera, step)
                arguments = data, view, self._paths[episode], camera, step
                decoded.append(self._pool.submit(_decode, *arguments))
        for future in decoded:
            future.result()
        return images

    def close(self) -> None:
        """Close the files and end the threads; may be called again."""
        self._pool.shutdown(cancel_futures=True)
        with self._reading:
            while self._open:
                self._open.popitem()[1].close()
            if self._shared:
                self._shared.close()

    def _reader(self, episode: int) -> EpisodeReader:
        """Return the open file of an episode; the one unused for longest is closed if need be."""
        if episode not in self._open:
            if len(self._open) >= MAX_OPEN_FILES:
                self._open.popitem(last=False)[1].close()
            self._open[episode] = EpisodeReader(self._paths[episode])
        self._open.move_to_end(episode)
        return self._open[episode]

    def _decode_all(self, held: Images) -> Images:
        """Fill ``held`` with every image, an episode to each thread."""

        def decode_episode(index: int) -> None:
            with EpisodeReader(self._paths[index]) as episode:
                for number, camera in enumerate(self._cameras):
                    for step, data in enumerate(episode.encoded_frames(camera)):
                        image = held[self._offsets[index] + step, number]
                        _decode(data, image, episode.path, camera, step)

        numbers = range(len(self._paths))
        done = self._pool.map(decode_episode, numbers)
        for _ in track(done, len(numbers), "episode", "decoding images"):
            pass
        return held


def _key(demonstrations: Demonstrations) -> str:
    """Name of the images: what decides their pixels."""
    spec = demonstrations.spec
    size = spec.image_size, spec.drawn_size
    parts = demonstrations.content_hash, spec.cameras, size, source_digest()
    return hashlib.sha256(repr(parts).encode()).hexdigest()


def _decode(data: Images, out: Images, path: Path, camera: str, step: int) -> None:
    """Write the decoded image to ``out``, (H, W, 3)."""
    try:
        out[:] = fit_image(decode_image(data), (out.shape[0], out.shape[1]))
    except ValueError as error:
        raise EpisodeFileError(f"'{path}': frame {step} of '{camera}': {error}") from error
