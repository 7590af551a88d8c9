"""Where vectors and images lie, and how a batch of them comes to the device.

Legend: R steps of the episodes that are loaded, b examples, S elements of the state, A elements
of an action, K actions of a chunk, N cameras, H and W image height and width, Z numbers of noise.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Generator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, fields

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from robo_manip_baselines.data.demonstrations import Demonstrations
from robo_manip_baselines.data.normalization import Normalization
from robo_manip_baselines.policy.interface import Batch
from robo_manip_baselines.runs.errors import RequestError
from robo_manip_baselines.training.images import FrameSource
from robo_manip_baselines.training.sampling import Schedule, StateNoise, chunk_rows, noise_of

Vectors = NDArray[np.float32]

UPLOAD = 64
"""Steps whose images are copied at a time to where they are kept: 177 MB with three of 480x640."""


@dataclass(frozen=True)
class Examples:
    """What a batch shall hold.

    Attributes:
        rows: (b, K) int64, places among the R steps of the actions; the first of each is that of
            state and images.
        is_pad: (b, K) bool, whether each is padding.
        noise: (b, Z) float32.
        state_noise: (b, S) float32 to add to the normalised state; None for nothing.
        num_valid, num_examples: as in `Batch`.
    """

    rows: NDArray[np.int64]
    is_pad: NDArray[np.bool_]
    noise: Tensor
    state_noise: Tensor | None
    num_valid: float
    num_examples: float


@dataclass(frozen=True)
class Gathered:
    """A batch, and the event after which it may be read; None if at once."""

    batch: Batch
    ready: torch.cuda.Event | None = None


class CpuTables:
    """Gathers in main memory.

    NumPy gathers, not torch: for so little data torch's threads take longer to meet than to work,
    much longer on a busy machine.

    Args:
        state: (R, S), normalised.
        action: (R, A), normalised.
        rows: (R,), the rows of ``frames`` that these are.
        frames: where images come from, if any.
    """

    def __init__(
        self, state: Vectors, action: Vectors, rows: NDArray[np.int64], frames: FrameSource | None
    ) -> None:
        self._state = state
        self._action = action
        self._rows = rows
        self._frames = frames

    def gather(self, examples: Examples) -> Gathered:
        """Return the batch."""
        first = examples.rows[:, 0]
        state = torch.from_numpy(self._state[first])
        if examples.state_noise is not None:
            state += examples.state_noise
        images: Tensor | None = None
        if self._frames is not None:
            images = torch.from_numpy(self._frames.images(self._rows[first]))
        return Gathered(
            Batch(
                state=state,
                images=images,
                action=torch.from_numpy(self._action[examples.rows]),
                is_pad=torch.from_numpy(examples.is_pad),
                noise=examples.noise,
                num_valid=torch.tensor(examples.num_valid),
                num_examples=torch.tensor(examples.num_examples),
            )
        )


class CudaTables:
    """Gathers on a CUDA device, on a stream of its own, without waiting for the device.

    The vectors are kept there. So are the images, if `FrameSource` holds them and they take at
    most half of the device's free memory; others are copied, batch by batch, from page-locked
    memory.

    Args:
        device: where.
        state: (R, S), normalised.
        action: (R, A), normalised.
        rows: (R,), the rows of ``frames`` that these are.
        frames: where images come from, if any.
    """

    def __init__(
        self,
        device: torch.device,
        state: Vectors,
        action: Vectors,
        rows: NDArray[np.int64],
        frames: FrameSource | None,
    ) -> None:
        self._stream = torch.cuda.Stream(device)
        self._rows = rows
        self._frames = frames
        self._images: Tensor | None = None
        with torch.cuda.stream(self._stream):
            self._state = torch.from_numpy(state).to(device)
            self._action = torch.from_numpy(action).to(device)
            if frames is not None and frames.held is not None:
                self._images = self._on_device(frames, device)

    def gather(self, examples: Examples) -> Gathered:
        """Return the batch, which is ready when its event has come to pass."""
        host_images: Tensor | None = None
        if self._frames is not None and self._images is None:
            shape = (len(examples.rows), *self._frames.shape)
            host_images = torch.empty(shape, dtype=torch.uint8, pin_memory=True)
            self._frames.images(self._rows[examples.rows[:, 0]], out=host_images.numpy())
        with torch.cuda.stream(self._stream):
            rows = self._copied(torch.from_numpy(examples.rows))
            images = None if self._images is None else self._images[rows[:, 0]]
            if host_images is not None:
                images = host_images.to(self._state.device, non_blocking=True)
            state = self._state[rows[:, 0]]
            if examples.state_noise is not None:
                state += self._copied(examples.state_noise)
            batch = Batch(
                state=state,
                images=images,
                action=self._action[rows],
                is_pad=self._copied(torch.from_numpy(examples.is_pad)),
                noise=self._copied(examples.noise),
                num_valid=self._copied(torch.tensor(examples.num_valid)),
                num_examples=self._copied(torch.tensor(examples.num_examples)),
            )
            ready = torch.cuda.Event()
            ready.record(self._stream)
        return Gathered(batch, ready)

    def _on_device(self, frames: FrameSource, device: torch.device) -> Tensor | None:
        """Return the images (R, N, H, W, 3) of all rows; None if they are too many."""
        shape = (len(self._rows), *frames.shape)
        if math.prod(shape) > torch.cuda.mem_get_info(device)[0] // 2:
            return None
        images = torch.empty(shape, dtype=torch.uint8, device=device)
        for first in range(0, len(self._rows), UPLOAD):
            part = self._rows[first : first + UPLOAD]
            images[first : first + len(part)] = torch.from_numpy(frames.images(part))
        return images

    def _copied(self, tensor: Tensor) -> Tensor:
        return tensor.pin_memory().to(self._state.device, non_blocking=True)


def received(gathered: Gathered) -> Batch:
    """Make the current stream, of the thread that uses the batch, wait until the batch is there."""
    if gathered.ready is not None:
        stream = torch.cuda.current_stream(gathered.batch.state.device)
        stream.wait_event(gathered.ready)
        for field in fields(gathered.batch):
            tensor = getattr(gathered.batch, field.name)
            if tensor is not None:
                # Its memory was got for another stream; it must not be used anew before this
                # stream is done with it.
                tensor.record_stream(stream)
    return gathered.batch


WORKERS = 2
"""Batches made at a time: while the last images of one are decoded, the next has begun."""


def part_of(count: int, rank: int, world_size: int) -> slice:
    """Return which of ``count`` examples are a process's: contiguous, as equal as can be."""
    return slice(count * rank // world_size, count * (rank + 1) // world_size)


class BatchLoader:
    """Makes the batches of a schedule, each a function of the seed and of the step.

    Threads make batches while earlier steps are computed. On CUDA the vectors, and the images if
    they fit, are on the device and gathered there; otherwise images are copied from page-locked
    memory. Both happen on a stream of their own. Because the threads use the device, a CUDA graph
    that is captured meanwhile needs ``capture_error_mode="thread_local"``.

    Each process takes a contiguous part of every batch, as equal as can be.

    Args:
        demonstrations: all episodes.
        normalization: how to scale vectors, measured on the training episodes.
        episodes: indices into ``demonstrations`` of the episodes that ``schedule`` speaks of.
        schedule: which examples each step sees.
        chunk_size: K.
        noise_size: Z.
        seed: of the noise.
        device: where batches go.
        rank: number of this process, from 0 on.
        world_size: processes that share each batch.
        state_noise: what is added to states; nothing if None.
        frames: where images come from; None without cameras. Not closed by the loader.
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
        schedule: Schedule,
        *,
        chunk_size: int,
        noise_size: int,
        seed: int,
        device: torch.device | str,
        rank: int = 0,
        world_size: int = 1,
        state_noise: StateNoise | None = None,
        frames: FrameSource | None = None,
        depth: int = 4,
    ) -> None:
        if not np.array_equal(demonstrations.lengths[list(episodes)], schedule.lengths):
            raise ValueError("the schedule is of other episodes than the loader's")
        if bool(demonstrations.spec.cameras) != (frames is not None):
            raise ValueError("frames must be given if, and only if, there are cameras")
        if not 0 <= rank < world_size:
            raise ValueError(f"rank {rank} of {world_size} processes")
        if world_size > schedule.batch_size:
            raise RequestError(
                f"batch_size {schedule.batch_size}: must be at least the {world_size} processes"
            )
        if depth < 0:
            raise ValueError(f"depth {depth}: must be 0 or more")
        self._schedule = schedule
        self._offsets = np.concatenate([np.zeros(1, np.int64), np.cumsum(schedule.lengths)])
        self._chunk_size = chunk_size
        self._noise_size = noise_size
        self._seed = seed
        self._state_noise = state_noise or StateNoise(demonstrations.spec)
        self._rank, self._world_size = rank, world_size
        self._depth = depth
        rows = demonstrations.rows(episodes)
        state = normalization.normalized_state(demonstrations.state[rows])
        action = normalization.normalized_action(demonstrations.action[rows])
        device = torch.device(device)
        self._tables = (
            CudaTables(device, state, action, rows, frames)
            if device.type == "cuda"
            else CpuTables(state, action, rows, frames)
        )

    def batch(self, step: int) -> Batch:
        """Return this process's part of the batch of one step."""
        return received(self._make(step))

    def batches(self, first_step: int, last_step: int) -> Generator[Batch, None, None]:
        """Yield this process's part of each batch, from ``first_step`` to before ``last_step``.

        The threads end when the iterator is exhausted or closed. An exception in one of them is
        raised when its batch is due.
        """
        if not self._depth:
            yield from map(self.batch, range(first_step, last_step))
            return
        pool = ThreadPoolExecutor(WORKERS, thread_name_prefix="batches")
        ahead: deque[Future[Gathered]] = deque()
        try:
            for step in range(first_step, last_step):
                ahead.append(pool.submit(self._make, step))
                if len(ahead) > self._depth:
                    yield received(ahead.popleft().result())
            while ahead:
                yield received(ahead.popleft().result())
        finally:
            pool.shutdown(cancel_futures=True)

    def _make(self, step: int) -> Gathered:
        examples = self._schedule.batch(step)
        count = len(examples)
        episodes, starts = examples.T
        rows, is_pad = chunk_rows(self._offsets, episodes, starts, self._chunk_size)
        noise = noise_of(self._seed, "noise", step, count, self._noise_size)
        state_noise = self._state_noise.draw(self._seed, step, count)
        part = part_of(count, self._rank, self._world_size)
        num_valid = float((~is_pad).sum()) / self._world_size
        return self._tables.gather(
            Examples(
                rows=rows[part],
                is_pad=is_pad[part],
                noise=noise[part],
                state_noise=None if state_noise is None else state_noise[part],
                num_valid=num_valid,
                num_examples=count / self._world_size,
            )
        )
