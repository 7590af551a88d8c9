"""From chunks of actions to actions, for many environments ("slots") at once.

Legend: n slots that there are, b slots that act now, m of them that need a chunk, K actions of a
chunk, A elements of an action.

A step of the slots that act now is: ask ``needs_chunk``, get chunks for those that do, and hand
them to ``act``. Every slot is at a step of its own; what happens in one changes nothing in another.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np
import torch
from numpy.typing import NDArray

from robo_manip_baselines.data.normalization import Normalization
from robo_manip_baselines.observation import ObservationSpec
from robo_manip_baselines.policy.interface import PolicyModel
from robo_manip_baselines.policy.presets import Acting
from robo_manip_baselines.runs.errors import RequestError, require_choice

Slots = NDArray[np.intp]
"""(b,) numbers of slots, none of them twice."""


class Chunking(Protocol):
    """How chunks become actions."""

    def reset(self, slots: Slots) -> None:
        """Forget everything about these slots: episodes start in them."""
        ...

    def needs_chunk(self, slots: Slots) -> NDArray[np.bool_]:
        """Say, (b,), which slots cannot act without a new chunk."""
        ...

    def act(self, slots: Slots, chunks: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return actions (b, A), given chunks (m, K, A) for the slots that need one, in order."""
        ...


class TemporalEnsemble:
    """Ask for a chunk at every step; average all predictions that were made for that step.

    The i-th prediction for a step, the oldest being i = 0, has the weight exp(-decay i); weights
    are divided by their sum (public ACT: decay 0.01). Predictions are counted, so a prediction of
    zero is one like any other. A slot holds the sums for the K steps ahead, and no chunk.

    Args:
        slots: n.
        chunk_size: K.
        action_size: A.
        decay: of the weights; more than 0 trusts old predictions more, less than 0 new ones.
    """

    def __init__(
        self, slots: int, chunk_size: int, action_size: int, *, decay: float = 0.01
    ) -> None:
        self._weight = np.exp(-decay * np.arange(chunk_size))
        self._total = np.cumsum(self._weight)
        # Column j is about the step j steps ahead: sums of weighted predictions, and their number.
        self._sum = np.zeros((slots, chunk_size, action_size))
        self._count = np.zeros((slots, chunk_size), dtype=np.intp)

    def reset(self, slots: Slots) -> None:
        """Forget the predictions for these slots."""
        self._sum[slots] = 0.0
        self._count[slots] = 0

    def needs_chunk(self, slots: Slots) -> NDArray[np.bool_]:
        """Every slot needs one at every step."""
        return np.ones(len(slots), dtype=np.bool_)

    def act(self, slots: Slots, chunks: NDArray[np.float32]) -> NDArray[np.float32]:
        """Add chunks (b, K, A) and return the averages (b, A) for the present step."""
        count = self._count[slots]
        sums = self._sum[slots] + self._weight[count][..., None] * chunks
        action = sums[:, 0] / self._total[count[:, 0]][:, None]
        # One step on: what was ahead by j is now ahead by j - 1, and the last step is new.
        self._sum[slots, :-1], self._sum[slots, -1] = sums[:, 1:], 0.0
        self._count[slots, :-1], self._count[slots, -1] = count[:, 1:] + 1, 0
        return action.astype(np.float32)


class ExecuteFirst:
    """Carry out the first actions of a chunk, then ask for the next.

    Args:
        slots: n.
        chunk_size: K.
        action_size: A.
        execute: how many actions of a chunk are carried out, 1 to K.

    Raises:
        RequestError: ``execute`` is not 1 to K.
    """

    def __init__(self, slots: int, chunk_size: int, action_size: int, *, execute: int) -> None:
        if not 1 <= execute <= chunk_size:
            raise RequestError(f"execute {execute}: must be 1 to {chunk_size}, the chunk size")
        self._planned = np.zeros((slots, execute, action_size), dtype=np.float32)
        self._used = np.full(slots, execute)

    def reset(self, slots: Slots) -> None:
        """Forget what was planned for these slots."""
        self._used[slots] = self._planned.shape[1]

    def needs_chunk(self, slots: Slots) -> NDArray[np.bool_]:
        """A slot needs one when it has carried out the last."""
        return self._used[slots] == self._planned.shape[1]

    def act(self, slots: Slots, chunks: NDArray[np.float32]) -> NDArray[np.float32]:
        """Plan with chunks (m, K, A) and return the next actions (b, A)."""
        new = slots[self.needs_chunk(slots)]
        self._planned[new] = chunks[:, : self._planned.shape[1]]
        self._used[new] = 0
        action = self._planned[slots, self._used[slots]]
        self._used[slots] += 1
        return action


def make_chunking(acting: Acting, slots: int, chunk_size: int, action_size: int) -> Chunking:
    """Build what the settings ask for.

    Raises:
        RequestError: more actions would be carried out than a chunk has.
    """
    if acting.temporal_ensemble:
        return TemporalEnsemble(slots, chunk_size, action_size, decay=acting.decay)
    return ExecuteFirst(slots, chunk_size, action_size, execute=acting.execute)


PRECISIONS = ("fp32", "bf16")

CUDA_TILE = 8
"""Rows of a tile on a GPU, where eight cost little more than one."""


class ChunkPolicy:
    """What ``evaluation.rollout`` asks for actions.

    The network always runs on tiles of the same number of rows, the last one filled up with zeros:
    matrix products of other shapes are rounded otherwise, and an episode would come out differently
    for the number of environments beside it. On a CPU a tile is one row, which costs nothing there.

    Args:
        model: the network; it is moved to the device and put into evaluation mode.
        spec: what the policy is shown.
        normalization: of the demonstrations that it was trained on.
        acting: how chunks become actions.
        slots: n.
        device: where the network runs.
        precision: ``fp32``, or ``bf16`` for the products inside the network.
        tile: R; 1 on a CPU and ``CUDA_TILE`` elsewhere if None.

    Raises:
        RequestError: a value that is not valid.
    """

    def __init__(
        self,
        model: PolicyModel,
        spec: ObservationSpec,
        normalization: Normalization,
        acting: Acting,
        *,
        slots: int,
        device: torch.device | str = "cpu",
        precision: str = "fp32",
        tile: int | None = None,
    ) -> None:
        self._device = torch.device(device)
        is_bf16 = require_choice("precision", precision, PRECISIONS) == "bf16"
        fast = model.eval().for_inference(torch.bfloat16 if is_bf16 else torch.float32)
        self._is_autocast = is_bf16 and fast is model
        self._model = fast.to(self._device)
        if spec.cameras:
            self._model = self._model.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        self._spec, self._normalization = spec, normalization
        self._chunking = make_chunking(
            acting, slots, model.chunk_size, len(normalization.action_mean)
        )
        rows = tile or (1 if self._device.type == "cpu" else CUDA_TILE)
        # The same memory for every tile: pinned, so that a GPU can fetch it by itself.
        pinned = self._device.type == "cuda"
        self._state = torch.zeros(rows, len(normalization.state_mean), pin_memory=pinned)
        shape = (rows, len(spec.cameras), *spec.image_size, 3)
        self._images = torch.zeros(shape, dtype=torch.uint8, pin_memory=pinned)

    def reset(self, slots: Slots, seeds: Sequence[int]) -> None:
        """Start the episodes of these seeds in these environments."""
        self._chunking.reset(slots)

    def needs_images(self, slots: Slots) -> NDArray[np.bool_]:
        """Return, (b,), whether the policy reads the images when it acts next."""
        return self._chunking.needs_chunk(slots)

    def act(
        self, vectors: NDArray[np.float32], images: NDArray[np.uint8] | None, slots: Slots
    ) -> NDArray[np.float32]:
        """Return the next actions (b, A) in the units of the environment.

        Args:
            vectors: (b, S) packed observations.
            images: (b, N, H, W, 3); rows that need none may hold anything.
            slots: (b,) the environments that they come from.

        Raises:
            RequestError: the network gives numbers that are not finite.
        """
        rows = np.flatnonzero(self._chunking.needs_chunk(slots))
        state = self._normalization.normalized_state(vectors)
        size = len(self._state)
        chunks = [
            self._predict(state, images, rows[start : start + size])
            for start in range(0, len(rows), size)
        ]
        shape = (0, self._model.chunk_size, len(self._normalization.action_mean))
        planned = np.concatenate(chunks) if chunks else np.empty(shape, np.float32)
        if not np.isfinite(planned).all():
            raise RequestError("the network gives actions that are not finite; train it again")
        return self._normalization.action(self._chunking.act(slots, planned))

    @torch.inference_mode()
    def _predict(
        self, state: NDArray[np.float32], views: NDArray[np.uint8] | None, rows: NDArray[np.intp]
    ) -> NDArray[np.float32]:
        """Return the chunks, normalised, (r, K, A), of at most one tile's worth of rows."""
        count = len(rows)
        self._state.zero_()
        self._state.numpy()[:count] = state[rows]
        images = None
        if views is not None:
            self._images[count:].zero_()
            self._images.numpy()[:count] = views[rows]
            images = self._images.to(self._device, non_blocking=True)
        inputs = self._state.to(self._device, non_blocking=True)
        with torch.autocast(self._device.type, torch.bfloat16, enabled=self._is_autocast):
            chunks = self._model.predict(inputs, images)
        # Waits for the GPU, so that the pinned memory is free for the next tile.
        return chunks[:count].float().cpu().numpy()
