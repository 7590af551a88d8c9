"""Folder of the episodes of a session, and the images that are drawn into them afterwards.

Three images take longer to draw than a control step has time. A session therefore records states
alone; when an episode is saved it lies in ``unrendered/`` at once, whole but for its images, and a
worker process runs its actions again, draws the images and puts the episode in its place. An
episode whose images were not drawn before the end, or because the session was killed, is completed
by the next session. The images are those that drawing within the loop would have given, bit for
bit.
"""

from __future__ import annotations

import contextlib
import logging
from collections import deque
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robo_manip_baselines.data import (
    EpisodeReader,
    episode_path,
    finished_seeds,
    list_episodes,
    remove_partial_episodes,
    write_episode,
)
from robo_manip_baselines.data.files import UNRENDERED_FOLDER, seed_of
from robo_manip_baselines.envs.mujoco.tasks.face_env import world_of
from robo_manip_baselines.rollout.demonstrate import Demonstration, remake_env, replay
from robo_manip_baselines.runs.errors import RequestError
from robo_manip_baselines.runs.images import encode_image
from robo_manip_baselines.runs.processes import Worker, wait_for

logger = logging.getLogger(__name__)


class EpisodeStore:
    """Folder of episodes; see the module's docstring.

    Args:
        out: the folder, which this process holds.

    Attributes:
        waiting: episodes that were saved and have no images yet.
    """

    def __init__(self, out: Path) -> None:
        self._out, self._unrendered = out, out / UNRENDERED_FOLDER
        remove_partial_episodes(out)
        remove_partial_episodes(self._unrendered)
        self._worker: Worker | None = None
        self._drawing: Path | None = None
        found = list_episodes(self._unrendered) if self._unrendered.is_dir() else []
        self.waiting: deque[Path] = deque(found)

    @property
    def seeds(self) -> set[int]:
        """Seeds of all episodes that are there, with images or without."""
        drawing = [self._drawing] if self._drawing else []
        pending = {seed_of(path) for path in (*self.waiting, *drawing)}
        return finished_seeds(self._out) | {seed for seed in pending if seed is not None}

    def save(self, episode: Demonstration) -> str:
        """Write an episode; return a line for the person.

        Raises:
            RequestError: the folder cannot be written to.
            WriteError: the disk is full, or fails.
        """
        known = episode.attributes
        has_images = bool(known["env_kwargs"]["cameras"])
        path = episode_path(self._out, known["seed"], known["is_success"])
        if has_images:
            path = episode_path(self._unrendered, known["seed"], success=True)
        write_episode(path, episode.arrays, {}, known)
        if has_images:
            self.waiting.append(path)
        result = "a success" if known["is_success"] else "no success"
        return f"saved seed {known['seed']}, {result}"

    def poll(self) -> str:
        """Let the worker draw images, without waiting; return a line for the person, or "".

        Raises:
            RequestError, WriteError, RuntimeError: an episode cannot be completed.
        """
        if self._worker and self._drawing and wait_for([self._worker], 0.0):
            return self._receive()
        if self.waiting and not self._drawing:
            if self._worker is None:
                self._worker = Worker(_Drawer, self._out)
            self._drawing = self.waiting.popleft()
            self._worker.submit(self._drawing)
        return ""

    def finish(self) -> None:
        """Wait until every episode has its images.

        Raises:
            RequestError, WriteError, RuntimeError: an episode cannot be completed.
        """
        count = len(self.waiting) + (self._drawing is not None)
        if count:
            logger.info("drawing the images of %d episodes; Ctrl-C leaves them for later", count)
        while self.waiting or self._drawing:
            self.poll()
            if self._worker and self._drawing:
                wait_for([self._worker])

    def close(self) -> None:
        """End the worker; may be called again."""
        if self._worker is not None:
            self._worker.close(at_once=self._drawing is not None)
            self._worker = None
        with contextlib.suppress(OSError):  # it is not there, or not empty
            self._unrendered.rmdir()

    def _receive(self) -> str:
        """Take in the answer of the worker."""
        assert self._worker is not None
        self._worker.receive()
        seed = seed_of(self._drawing) if self._drawing else None
        self._drawing = None
        return f"seed {seed} has its images"


class _Drawer:
    """Draws the images of one episode after another, in a worker process."""

    def __init__(self, out: Path) -> None:
        self._out = out

    def __call__(self, path: Path) -> None:
        draw_images(path, self._out)


def draw_images(path: Path, out: Path) -> Path:
    """Complete an episode by the images of its cameras, and move it to its place in a folder.

    Args:
        path: episode without images, whose ``env_kwargs`` name the cameras.
        out: folder of the episodes.

    Returns:
        The new file; the old one is removed.

    Raises:
        RequestError: the file is damaged, this release's environment is another one, or the
            actions do not lead through the recorded states.
        WriteError: the disk is full, or fails.
    """
    with EpisodeReader(path) as episode:
        known, arrays = episode.attributes, episode.arrays
        with contextlib.closing(remake_env(episode, disable_env_checker=True)) as env:
            world = world_of(env)
            world.renders_images = False
            cameras = world.observation_spec.image_keys()
            images: dict[str, list[NDArray[np.uint8]]] = {name: [] for name in cameras.values()}
            for step in replay(env, episode):
                if not np.array_equal(world.data.qpos, arrays["qpos"][step]):
                    raise RequestError(
                        f"'{path}': its actions lead elsewhere at step {step}; another version of "
                        "MuJoCo, or another machine, recorded it: draw its images there, or "
                        "remove the file"
                    )
                world.renders_images = True
                observation = world.observe()
                world.renders_images = False
                for key, camera in cameras.items():
                    codec, quality = known["image_codec"], known["image_quality"]
                    images[camera].append(encode_image(observation[key], codec, quality))
        derived = {item.name for item in episode.schema.attributes if item.is_derived}
    given: dict[str, Any] = {name: item for name, item in known.items() if name not in derived}
    target = episode_path(out, known["seed"], known["is_success"])
    write_episode(target, arrays, images, given)
    path.unlink()
    return target
