"""Where vectors and images lie, and how a batch of them comes to the device.

Legend: R steps of the episodes that are loaded, b examples, S elements of the state, A elements
of an action, K actions of a chunk, N cameras, H and W image height and width, Z numbers of noise.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from robo_manip_baselines.policy.interface import Batch
from robo_manip_baselines.training.frames import FrameSource

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
