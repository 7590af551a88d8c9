"""Batches for training, made ahead of the step that needs them.

Legend: B examples of a step, all processes together; b those of this process; S elements of the
state, N cameras, H and W image height and width, K actions of a chunk, A elements of an action,
Z numbers of noise.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Generator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor

import numpy as np
import torch

from robo_manip_baselines.data.demonstrations import Demonstrations
from robo_manip_baselines.data.normalization import Normalization
from robo_manip_baselines.errors import RequestError
from robo_manip_baselines.policy.interface import Batch
from robo_manip_baselines.training.chunks import chunk_rows
from robo_manip_baselines.training.frames import FrameSource
from robo_manip_baselines.training.gather import (
    CpuTables,
    CudaTables,
    Examples,
    Gathered,
    received,
)
from robo_manip_baselines.training.schedule import Schedule
from robo_manip_baselines.training.state_noise import StateNoise, noise_of

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
