"""Training batches: sampled, and made ahead by threads in main memory or on a CUDA device.

Examples, noise and changes to images are functions of the seed and of the step, nothing else.

Legend: E training episodes, R steps of them, b examples of a step, O observation steps, S elements
of the state, A elements of an action, K actions of a chunk, N cameras, H and W image height and
width.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Generator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Annotated

import numpy as np
import torch
from annotated_types import Interval
from numpy.typing import NDArray
from torch import Tensor

from robo_manip_baselines.data.actions import ActionEncoding
from robo_manip_baselines.data.demonstrations import Demonstrations
from robo_manip_baselines.data.normalization import Normalization
from robo_manip_baselines.observation import ObservationSpec, ObservedNames
from robo_manip_baselines.policy.interface import Batch, PolicyModel
from robo_manip_baselines.policy.presets import SAMPLERS, TrainSettings
from robo_manip_baselines.runs.errors import RequestError, require_choice
from robo_manip_baselines.runs.ranges import Count, NonNegativeInt, require_range
from robo_manip_baselines.runs.seeds import derive_seed
from robo_manip_baselines.training.augmentation import (
    ImageAugmentation,
    ImageChanges,
    change_images,
)
from robo_manip_baselines.training.images import ImageStore

UPLOAD = 64
"""Steps whose images are copied to a GPU at a time: 177 MB with three of 480x640."""

WORKERS = 2
"""Batches made at a time: while the last images of one are decoded, the next has begun."""


Indices = NDArray[np.int64]


class ExampleSampler:
    """Sampler without state, so that training can be resumed at any step.

    With the sampler ``episode`` (the paper's) an epoch draws one start from each episode, uniform
    over its steps; with ``frame`` an epoch visits every step of every episode once. Either way
    the order is random and another in each epoch. Epochs follow one another without a seam: every
    batch is full, and one may hold the end of an epoch and the beginning of the next. So 2000
    epochs of 50 episodes in batches of 8 (paper, Table III) are 12 500 steps.

    Attributes:
        lengths: (E,) int64, steps of each training episode.
        sampler, batch_size, seed: as given.
        frames_per_epoch: examples of an epoch.

    Raises:
        RequestError: unknown sampler, batch size below 1, a negative seed, or no episodes.
    """

    def __init__(
        self, lengths: Sequence[int] | Indices, sampler: str, batch_size: int, seed: int
    ) -> None:
        self.lengths = np.asarray(lengths, dtype=np.int64)
        self.sampler = require_choice("sampler", sampler, SAMPLERS)
        self.batch_size = batch_size
        self.seed = seed
        require_range("batch_size", batch_size, Count)
        require_range("seed", seed, Annotated[int, Interval(ge=0, le=2**63 - 1)])  # perhaps derived
        if self.lengths.ndim != 1 or not self.lengths.size or self.lengths.min() < 1:
            raise RequestError("training needs at least one episode, each of at least one step")
        by_episode = sampler == "episode"
        self.frames_per_epoch = len(self.lengths) if by_episode else int(self.lengths.sum())
        self._epochs: dict[int, Indices] = {}

    def epochs(self, steps: int) -> float:
        """Return the number of epochs in so many steps."""
        return steps * self.batch_size / self.frames_per_epoch

    def total_steps(self, settings: TrainSettings) -> int:
        """Return the budget in optimiser steps; the last batch is full."""
        if settings.steps is not None:
            return settings.steps
        assert settings.epochs is not None  # TrainSettings takes exactly one of the two
        return -(-settings.epochs * self.frames_per_epoch // self.batch_size)

    def batch(self, step: int) -> Indices:
        """Return the examples of a step, (b, 2): index of the training episode, first step in it.

        Raises:
            ValueError: a negative step.
        """
        if step < 0:
            raise ValueError(f"step {step}: must be 0 or more")
        numbers = np.arange(step * self.batch_size, (step + 1) * self.batch_size)
        epochs, places = np.divmod(numbers, self.frames_per_epoch)
        parts = [self._epoch(int(e))[places[epochs == e]] for e in np.unique(epochs)]
        return np.concatenate(parts)

    def _epoch(self, epoch: int) -> Indices:
        """Return all examples of an epoch in their order; two epochs are cached."""
        if (cached := self._epochs.get(epoch)) is not None:
            return cached
        rng = np.random.default_rng(derive_seed(self.seed, "schedule", epoch))
        if self.sampler == "episode":
            episodes = rng.permutation(len(self.lengths))
            starts = rng.integers(0, self.lengths[episodes])
        else:
            first = np.concatenate([[0], np.cumsum(self.lengths)])
            frames = rng.permutation(self.frames_per_epoch)
            episodes = np.searchsorted(first, frames, side="right") - 1
            starts = frames - first[episodes]
        examples = np.stack([episodes, starts], axis=1).astype(np.int64, copy=False)
        # Replaced, not changed: another thread may be reading it. Two, for batches on a seam.
        self._epochs = {number: self._epochs[number] for number in list(self._epochs)[-1:]}
        self._epochs[epoch] = examples
        return examples


def chunk_rows(
    offsets: Indices, episodes: Indices, starts: Indices, chunk_size: int, skip: int = 1
) -> tuple[Indices, NDArray[np.bool_]]:
    """Return the rows of chunks of actions; past the end of an episode its last row is repeated.

    Args:
        offsets: (E + 1,) row at which each episode begins, and the number of rows.
        episodes: (b,) index of each example's episode.
        starts: (b,) step of each example within its episode.
        chunk_size: K.
        skip: steps between two actions.

    Returns:
        (b, K) rows, and (b, K) whether each is padding.
    """
    rows = (offsets[episodes] + starts)[:, None] + skip * np.arange(chunk_size)
    end = offsets[episodes + 1][:, None]
    return np.minimum(rows, end - 1), rows >= end


def window_rows(
    offsets: Indices, episodes: Indices, starts: Indices, n_obs_steps: int, skip: int = 1
) -> Indices:
    """Return the rows (b, O) of windows of observations that end with each example's step.

    Before the start of an episode its first row is repeated. Arguments as in `chunk_rows`.
    """
    first = offsets[episodes][:, None]
    rows = first + starts[:, None] + skip * np.arange(1 - n_obs_steps, 1)
    return np.maximum(rows, first)


def step_noise(seed: int, stream: str, step: int, count: int, size: int) -> Tensor:
    """Return (count, size) standard normal numbers, a function of seed, stream and step."""
    generator = torch.Generator().manual_seed(derive_seed(seed, stream, step))
    return torch.randn(count, size, generator=generator)


class StateNoise:
    """Gaussian noise on normalised states: on proprioception and on the clock.

    The gripper's position from the target is proprioception, too, with the same noise in each of
    its frames. Target and objects are left as they are. ``robot`` is ``TrainSettings.state_noise``,
    ``clock`` ``TrainSettings.clock_noise``.
    """

    def __init__(
        self, spec: ObservationSpec, names: ObservedNames, robot: float = 0.0, clock: float = 0.0
    ) -> None:
        elements = spec.vector_names(names)
        self._size = len(elements)
        self._robot_size = len(spec.components(names)["state"])  # they come first
        self._times = [i for i, name in enumerate(elements) if name.startswith("t_")]
        start = f"gripper from {names.target} "
        self._gripper = [i for i, name in enumerate(elements) if name.startswith(start)]
        self._robot, self._clock = robot, clock

    def draw(self, seed: int, step: int, count: int) -> Tensor | None:
        """Return (count, S) for a step; None where there is no noise."""
        if not self._robot and not (self._clock and self._times):
            return None
        drawn = step_noise(seed, "state", step, count, self._robot_size + 1)
        noise = torch.zeros(count, self._size)
        noise[:, : self._robot_size] = self._robot * drawn[:, : self._robot_size]
        # One clock: all times of an observation are off by the same.
        noise[:, self._times] = self._clock * drawn[:, self._robot_size :]
        if self._gripper:
            place = self._robot * step_noise(seed, "gripper", step, count, 3)
            noise[:, self._gripper] = place.repeat(1, len(self._gripper) // 3)
        return noise


class ObjectNoise:
    """Gaussian noise on the positions of objects that are carried, in normalised states.

    Args:
        demonstrations: all episodes.
        names: of the task's objects.
        normalization: of the states.
        std: standard deviation along each axis, m (``TrainSettings.object_noise``).
    """

    def __init__(
        self,
        demonstrations: Demonstrations,
        names: ObservedNames,
        normalization: Normalization,
        std: float,
    ) -> None:
        carried = demonstrations.carried(names) if std else np.zeros((0, 0), bool)
        self._carried = torch.from_numpy(carried.repeat(3, axis=-1))  # (sum T, 3 O)
        self._part = demonstrations.spec.slices(names).get("object_position", slice(0, 0))
        self._scale = torch.from_numpy(std / normalization.state_std[self._part])
        self._size = len(normalization.state_std)

    def __bool__(self) -> bool:
        return bool(self._carried.any())

    def draw(self, seed: int, step: int, rows: NDArray[np.int64]) -> Tensor:
        """Return (..., S) for a step, whose observations are the rows (...) of demonstrations."""
        carried = self._carried[torch.from_numpy(rows)]
        drawn = step_noise(seed, "object", step, rows.size, carried.shape[-1])
        noise = torch.zeros(*rows.shape, self._size)
        noise[..., self._part] = self._scale * drawn.view(carried.shape) * carried
        return noise


def part_of(count: int, rank: int, world_size: int) -> slice:
    """Return a process's part of ``count`` examples: contiguous, as equal as can be."""
    return slice(count * rank // world_size, count * (rank + 1) // world_size)


class BatchLoader:
    """Batches of a sampler, each a function of the seed and of the step.

    Threads make batches while earlier steps are computed. On CUDA the vectors, and the images if
    `ImageStore` holds them and they take at most half of the device's free memory, are on the
    device and gathered there; other images are copied from page-locked memory. Both happen on a
    stream of their own. Because the threads use the device, a CUDA graph that is captured
    meanwhile needs ``capture_error_mode="thread_local"``.

    Each process takes a contiguous part of every batch, as equal as can be.

    Args:
        demonstrations: all episodes.
        normalization: of states and actions.
        episodes: indices into ``demonstrations`` of the episodes of ``sampler``.
        sampler: of the examples of each step.
        model: only its chunk size, observation steps and noise size are read.
        seed: of the noise.
        device: of the batches.
        rank: number of this process, from 0 on.
        world_size: processes that share each batch.
        encoding: of the actions; None for targets of the joints.
        skip: control steps between two actions of a chunk, and between observations of a window.
        state_noise: added to states; None for no noise.
        object_noise: added to states as well; None for no noise.
        action_noise: standard deviation of the noise that is added to normalised actions.
        intervention_weight: of the error of actions that a person chose instead of the policy.
        images: None without cameras. Not closed by the loader.
        augment: random changes to the images; None for none.
        depth: batches made ahead; 0 makes each when it is asked for, without threads.

    Raises:
        RequestError: more processes than examples in a batch.
        ValueError: arguments that do not fit one another.
    """

    def __init__(
        self,
        demonstrations: Demonstrations,
        normalization: Normalization,
        episodes: Sequence[int],
        sampler: ExampleSampler,
        model: PolicyModel,
        *,
        seed: int,
        device: torch.device | str,
        rank: int = 0,
        world_size: int = 1,
        encoding: ActionEncoding | None = None,
        skip: int = 1,
        state_noise: StateNoise | None = None,
        object_noise: ObjectNoise | None = None,
        action_noise: float = 0.0,
        intervention_weight: float = 1.0,
        images: ImageStore | None = None,
        augment: ImageAugmentation | None = None,
        depth: int = 4,
    ) -> None:
        if not np.array_equal(demonstrations.lengths[list(episodes)], sampler.lengths):
            raise ValueError("the sampler is of other episodes than the loader's")
        if bool(demonstrations.spec.cameras) != (images is not None):
            raise ValueError("images must be given if, and only if, there are cameras")
        if not 0 <= rank < world_size:
            raise ValueError(f"rank {rank} of {world_size} processes")
        if world_size > sampler.batch_size:
            raise RequestError(
                f"batch_size {sampler.batch_size}: must be at least the {world_size} processes"
            )
        require_range("depth", depth, NonNegativeInt)
        self._sampler, self._model, self._seed = sampler, model, seed
        self._state_noise, self._action_noise = state_noise, action_noise
        self._object_noise = object_noise or None
        self._encoding, self._skip = encoding or None, skip
        self._rank, self._world_size, self._depth = rank, world_size, depth
        self._offsets = np.concatenate([np.zeros(1, np.int64), np.cumsum(sampler.lengths)])
        self._rows = demonstrations.rows(episodes)  # of the images, for each of the R steps
        self._normalization, self._observed = normalization, demonstrations.state[self._rows]
        self._state = normalization.normalize_state(self._observed)
        action = demonstrations.action[self._rows]
        if self._encoding:
            action = self._encoding.columns(action).astype(np.float32)
        self._action = normalization.normalize_action(action)
        self._weight: NDArray[np.float32] | None = None
        if intervention_weight != 1.0:
            if demonstrations.intervention is None:
                raise ValueError("a weight of interventions without any")
            marked = demonstrations.intervention[self._rows]
            self._weight = np.where(marked, intervention_weight, 1.0).astype(np.float32)
        self._images = images
        self._augmentation = augment
        self._device = torch.device(device)
        self._stream: torch.cuda.Stream | None = None
        self._device_images: Tensor | None = None
        if self._device.type == "cuda":
            self._stream = torch.cuda.Stream(self._device)
            with torch.cuda.stream(self._stream):
                self._device_state = torch.from_numpy(self._state).to(self._device)
                self._device_action = torch.from_numpy(self._action).to(self._device)
                self._device_images = self._upload_images()

    def batch(self, step: int) -> Batch:
        """Return this process's part of the batch of one step."""
        return _received(*self._make(step))

    def batches(self, first_step: int, last_step: int) -> Generator[Batch, None, None]:
        """Yield this process's part of each batch, from ``first_step`` to before ``last_step``.

        The threads end when the iterator is exhausted or closed. An exception in one of them is
        raised when its batch is due.
        """
        if not self._depth:
            yield from map(self.batch, range(first_step, last_step))
            return
        pool = ThreadPoolExecutor(WORKERS, thread_name_prefix="batches")
        ahead: deque[Future[tuple[Batch, torch.cuda.Event | None]]] = deque()
        try:
            for step in range(first_step, last_step):
                ahead.append(pool.submit(self._make, step))
                if len(ahead) > self._depth:
                    yield _received(*ahead.popleft().result())
            while ahead:
                yield _received(*ahead.popleft().result())
        finally:
            pool.shutdown(cancel_futures=True)

    def _make(self, step: int) -> tuple[Batch, torch.cuda.Event | None]:
        """Return a batch, and the event after which it may be read; None if at once."""
        examples = self._sampler.batch(step)
        count, n_obs_steps = len(examples), self._model.n_obs_steps
        episodes, starts = examples.T
        places = self._offsets, episodes, starts
        chunks, is_pad = chunk_rows(*places, self._model.chunk_size, self._skip)
        windows = window_rows(*places, n_obs_steps, self._skip)
        noise = step_noise(self._seed, "noise", step, count, self._model.noise_size)
        part = part_of(count, self._rank, self._world_size)
        state_noise: Tensor | None = None
        if self._state_noise:
            drawn = self._state_noise.draw(self._seed, step, count * n_obs_steps)
            state_noise = None if drawn is None else drawn.view(count, n_obs_steps, -1)[part]
        if self._object_noise is not None:
            added = self._object_noise.draw(self._seed, step, self._rows[windows])[part]
            state_noise = added if state_noise is None else state_noise + added
        image_changes: ImageChanges | None = None
        if self._augmentation:
            image_changes = self._augmentation.draw(self._seed, step, count).part(part)
        gather = self._gather if self._stream is None else self._gather_on_device
        # All processes divide by the same number, the mean over the processes.
        return gather(
            windows[part],
            chunks[part],
            state_noise,
            self._action_change(step, part, windows[part, -1], state_noise),
            image_changes,
            is_pad=torch.from_numpy(is_pad[part]),
            noise=noise[part],
            num_valid=torch.tensor(float((~is_pad).sum()) / self._world_size),
            num_examples=torch.tensor(count / self._world_size),
            **self._weights(chunks, is_pad, part),
        )

    def _weights(
        self, chunks: NDArray[np.int64], is_pad: NDArray[np.bool_], part: slice
    ) -> dict[str, Tensor]:
        """Return ``weight`` of a process's part of a batch; nothing where all weigh the same."""
        if self._weight is None:
            return {}
        weight = self._weight[chunks]
        return {"weight": torch.from_numpy(weight / weight[~is_pad].mean())[part]}

    def _action_change(
        self, step: int, part: slice, rows: NDArray[np.int64], state_noise: Tensor | None
    ) -> Tensor | None:
        """Return what is added to normalised actions (b, K, A): noise, less their reference.

        The reference is that of the observations with their noise: so a target relative to a
        posture that is disturbed leads to where the demonstration went. None for no change.
        """
        change: Tensor | None = None
        shape = self._model.chunk_size, self._action.shape[1]
        if self._action_noise:
            size = self._sampler.batch_size, math.prod(shape)
            drawn = self._action_noise * step_noise(self._seed, "action", step, *size)
            change = drawn.view(-1, *shape)[part]
        if self._encoding:
            scale, vectors = self._normalization, self._observed[rows]
            if state_noise is not None:
                vectors = vectors + state_noise[:, -1].numpy() * scale.state_std
            reference = self._encoding.reference(vectors, shape[0]) / scale.action_std
            taken = torch.from_numpy(reference.astype(np.float32))
            change = -taken if change is None else change - taken
        return change

    def _gather(
        self,
        windows: NDArray[np.int64],
        chunks: NDArray[np.int64],
        state_noise: Tensor | None,
        change: Tensor | None,
        image_changes: ImageChanges | None,
        **others: Tensor,
    ) -> tuple[Batch, None]:
        """Gather rows in main memory.

        With NumPy, not with torch: for so little data torch's threads take longer to meet than to
        work, much longer on a busy machine.
        """
        state = torch.from_numpy(self._state[windows])
        if state_noise is not None:
            state += state_noise
        images = None if self._images is None else torch.from_numpy(self._read_images(windows))
        if images is not None and image_changes is not None:
            images = change_images(images, image_changes)
        action = torch.from_numpy(self._action[chunks])
        if change is not None:
            action += change
        return Batch(state=state, images=images, action=action, **others), None

    def _gather_on_device(
        self,
        windows: NDArray[np.int64],
        chunks: NDArray[np.int64],
        state_noise: Tensor | None,
        change: Tensor | None,
        image_changes: ImageChanges | None,
        **others: Tensor,
    ) -> tuple[Batch, torch.cuda.Event]:
        """Gather rows on the device, without waiting for it."""
        host_images: Tensor | None = None
        if self._images is not None and self._device_images is None:
            shape = (*windows.shape, *self._images.shape)
            host_images = torch.empty(shape, dtype=torch.uint8, pin_memory=True)
            self._read_images(windows, out=host_images.numpy())

        def copied(tensor: Tensor) -> Tensor:
            return tensor.pin_memory().to(self._device, non_blocking=True)

        with torch.cuda.stream(self._stream):
            rows = copied(torch.from_numpy(windows))
            images = None if self._device_images is None else self._device_images[rows]
            if host_images is not None:
                images = host_images.to(self._device, non_blocking=True)
            if images is not None and image_changes is not None:
                images = change_images(images, image_changes.to(self._device))
            state = self._device_state[rows]
            if state_noise is not None:
                state += copied(state_noise)
            action = self._device_action[copied(torch.from_numpy(chunks))]
            if change is not None:
                action += copied(change)
            others = {name: copied(tensor) for name, tensor in others.items()}
            ready = torch.cuda.Event()
            ready.record(self._stream)
        return Batch(state=state, images=images, action=action, **others), ready

    def _read_images(
        self, windows: NDArray[np.int64], out: NDArray[np.uint8] | None = None
    ) -> NDArray[np.uint8]:
        """Return (b, O, N, H, W, 3)."""
        assert self._images is not None
        shape = self._images.shape
        out = None if out is None else out.reshape(-1, *shape)
        images = self._images.images(self._rows[windows.ravel()], out)
        return images.reshape(*windows.shape, *shape)

    def _upload_images(self) -> Tensor | None:
        """Return the images (R, N, H, W, 3) of all rows; None if they are not held, or too many."""
        if self._images is None or self._images.held is None:
            return None
        shape = (len(self._rows), *self._images.shape)
        if math.prod(shape) > torch.cuda.mem_get_info(self._device)[0] // 2:
            return None
        images = torch.empty(shape, dtype=torch.uint8, device=self._device)
        for first in range(0, len(self._rows), UPLOAD):
            part = self._rows[first : first + UPLOAD]
            source = self._images.held[part[0] : part[-1] + 1]  # rows in their order: no copy
            if not np.array_equal(part, np.arange(part[0], part[-1] + 1)):
                source = self._images.images(part)
            images[first : first + len(part)] = torch.from_numpy(source)
        return images


def _received(batch: Batch, ready: torch.cuda.Event | None) -> Batch:
    """Make the current stream, of the thread that uses the batch, wait until the batch is there."""
    if ready is not None:
        stream = torch.cuda.current_stream(batch.state.device)
        stream.wait_event(ready)
        for tensor in vars(batch).values():
            if tensor is not None:
                # Allocated on another stream: it must not be reused before this one is done.
                tensor.record_stream(stream)
    return batch
