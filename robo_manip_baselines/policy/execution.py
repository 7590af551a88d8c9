"""Execution of a trained policy in many environments at once: from observations to actions.

Legend: n environments, b of them that act now, m of those that need a prediction, O observation
steps, K actions of a chunk, S elements of the state, A elements of an action, Z elements of noise.

Every environment is at a step of its own; its actions depend on its own episode alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from robo_manip_baselines.data.normalization import Normalization
from robo_manip_baselines.observation import ObservationSpec
from robo_manip_baselines.policy.cuda_graph import Replay
from robo_manip_baselines.policy.interface import PolicyModel
from robo_manip_baselines.policy.presets import ActionExecution
from robo_manip_baselines.runs.errors import RequestError, require_choice
from robo_manip_baselines.runs.seeds import derive_seed

EnvIds = NDArray[np.intp]
"""(b,) numbers of environments, all different."""


class TemporalEnsemble:
    """Average, at every step, of all predictions that were made for that step.

    The i-th prediction for a step, the oldest being i = 0, has the weight exp(-decay i); weights
    are divided by their sum (public ACT: decay 0.01). Predictions are counted, so a prediction of
    zero is one like any other. Only sums for the K steps ahead are kept, and no chunk. A decay of
    more than 0 trusts old predictions more, less than 0 new ones.
    """

    def __init__(
        self, num_envs: int, chunk_size: int, action_size: int, *, decay: float = 0.01
    ) -> None:
        self._weight = np.exp(-decay * np.arange(chunk_size))
        self._total = np.cumsum(self._weight)
        # Column j is about the step j steps ahead: sums of weighted predictions, and their number.
        self._sum = np.zeros((num_envs, chunk_size, action_size))
        self._count = np.zeros((num_envs, chunk_size), dtype=np.intp)

    def reset(self, env_ids: EnvIds) -> None:
        """Forget the predictions for these environments."""
        self._sum[env_ids], self._count[env_ids] = 0.0, 0

    def steps_to_prediction(self, env_ids: EnvIds) -> NDArray[np.intp]:
        """Return zeros: a prediction is needed at every step."""
        return np.zeros(len(env_ids), dtype=np.intp)

    def act(self, env_ids: EnvIds, chunks: NDArray[np.float32]) -> NDArray[np.float32]:
        """Add chunks (b, K, A) and return the averages (b, A) for the present step."""
        count = self._count[env_ids]
        sums = self._sum[env_ids] + self._weight[count][..., None] * chunks
        action = sums[:, 0] / self._total[count[:, 0]][:, None]
        # One step on: what was ahead by j is now ahead by j - 1, and the last step is new.
        self._sum[env_ids, :-1], self._sum[env_ids, -1] = sums[:, 1:], 0.0
        self._count[env_ids, :-1], self._count[env_ids, -1] = count[:, 1:] + 1, 0
        return action.astype(np.float32)


class ActionQueue:
    """The first ``n_action_steps`` of each chunk, executed before the next chunk is predicted.

    Raises:
        RequestError: ``n_action_steps`` is not 1 to K.
    """

    def __init__(
        self, num_envs: int, chunk_size: int, action_size: int, *, n_action_steps: int
    ) -> None:
        if not 1 <= n_action_steps <= chunk_size:
            raise RequestError(
                f"n_action_steps {n_action_steps}: must be 1 to {chunk_size}, the chunk size"
            )
        self._queue = np.zeros((num_envs, n_action_steps, action_size), dtype=np.float32)
        self._used = np.full(num_envs, n_action_steps)

    def reset(self, env_ids: EnvIds) -> None:
        """Empty the queues of these environments."""
        self._used[env_ids] = self._queue.shape[1]

    def steps_to_prediction(self, env_ids: EnvIds) -> NDArray[np.intp]:
        """Return (b,) the lengths of the queues."""
        return self._queue.shape[1] - self._used[env_ids]

    def act(self, env_ids: EnvIds, chunks: NDArray[np.float32]) -> NDArray[np.float32]:
        """Fill empty queues from chunks (m, K, A) and return the next actions (b, A)."""
        empty = env_ids[self.steps_to_prediction(env_ids) == 0]
        self._queue[empty] = chunks[:, : self._queue.shape[1]]
        self._used[empty] = 0
        action = self._queue[env_ids, self._used[env_ids]]
        self._used[env_ids] += 1
        return action


ActionBuffer = TemporalEnsemble | ActionQueue


def make_action_buffer(
    execution: ActionExecution, num_envs: int, chunk_size: int, action_size: int
) -> ActionBuffer:
    """Build the buffer of predicted chunks that the settings ask for.

    Its ``reset`` starts episodes, ``steps_to_prediction`` counts the steps before an environment
    needs a prediction, and ``act`` takes chunks for those that need one.

    Raises:
        RequestError: more actions would be executed than a chunk has.
    """
    shape = num_envs, chunk_size, action_size
    if execution.temporal_ensemble:
        return TemporalEnsemble(*shape, decay=execution.ensemble_decay)
    return ActionQueue(*shape, n_action_steps=execution.n_action_steps)


INFERENCE_PRECISIONS = ("fp32", "bf16")

TILE = 8
"""Rows of a tile where eight cost little more than one: on a GPU, and without images on a CPU."""


class PolicyRunner:
    """A trained network that acts in many environments; the policy of ``rollout.rollout``.

    The network always runs on tiles of the same number of rows, the last one filled up with zeros:
    matrix products of other shapes are rounded otherwise, and an episode would come out differently
    for the number of environments beside it. With images on a CPU a tile is one row, which costs
    nothing there.

    Args:
        model: the network; it is moved to the device and put into evaluation mode.
        spec: of the observations.
        normalization: of the demonstrations that it was trained on.
        execution: of its chunks.
        num_envs: n.
        device: of the network.
        precision: ``fp32``, or ``bf16`` for the products inside the network.
        tile: rows of a tile; ``TILE`` if None, and 1 with images on a CPU.

    Raises:
        RequestError: a value that is not valid.
    """

    def __init__(
        self,
        model: PolicyModel,
        spec: ObservationSpec,
        normalization: Normalization,
        execution: ActionExecution,
        *,
        num_envs: int,
        device: torch.device | str = "cpu",
        precision: str = "fp32",
        tile: int | None = None,
    ) -> None:
        self._device = torch.device(device)
        is_bf16 = require_choice("precision", precision, INFERENCE_PRECISIONS) == "bf16"
        fast = model.eval().for_inference(torch.bfloat16 if is_bf16 else torch.float32)
        self._is_autocast = is_bf16 and fast is model
        self._model = fast.to(self._device)
        if spec.cameras:
            self._model = self._model.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        self._has_images, self._normalization = bool(spec.cameras), normalization
        self._chunk_shape = model.chunk_size, len(normalization.action_mean)
        self._buffer = make_action_buffer(execution, num_envs, *self._chunk_shape)
        steps, state_size = model.n_obs_steps, len(normalization.state_mean)
        image_shape = (steps, len(spec.cameras), *spec.image_size, 3)
        # The last O observations, the seed and the control step of every environment.
        self._states = np.zeros((num_envs, steps, state_size), np.float32)
        self._images = np.zeros((num_envs, *image_shape), np.uint8)
        self._seeds = np.zeros(num_envs, np.int64)
        self._steps = np.zeros(num_envs, np.int64)
        rows = tile or (1 if self._device.type == "cpu" and spec.cameras else TILE)
        # The same memory for every tile: pinned, so that a GPU can fetch it by itself.
        pinned = self._device.type == "cuda"
        self._state_tile = torch.zeros(rows, steps, state_size, pin_memory=pinned)
        self._image_tile = torch.zeros(
            (rows, *image_shape), dtype=torch.uint8, pin_memory=pinned and bool(spec.cameras)
        )
        self._noise_tile = torch.zeros(rows, model.sample_noise_size, pin_memory=pinned)
        self._inputs: tuple[Tensor, Tensor | None, Tensor | None] = (
            self._state_tile.to(self._device),
            self._image_tile.to(self._device) if self._has_images else None,
            self._noise_tile.to(self._device) if model.sample_noise_size else None,
        )
        # On a CPU the inputs are the tiles themselves.
        self._compute = Replay(self._forward, self._device) if pinned else self._forward

    def reset(self, env_ids: EnvIds, seeds: Sequence[int]) -> None:
        """Start episodes of these seeds, (b,), in these environments."""
        self._buffer.reset(env_ids)
        self._seeds[env_ids], self._steps[env_ids] = seeds, 0

    def needs_images(self, env_ids: EnvIds) -> NDArray[np.bool_]:
        """Return (b,) whether the next observation's images enter a prediction."""
        # Those of a step enter the next prediction if its window of O steps reaches back to them.
        return self._buffer.steps_to_prediction(env_ids) < self._states.shape[1]

    def act(
        self, vectors: NDArray[np.float32], images: NDArray[np.uint8] | None, env_ids: EnvIds
    ) -> NDArray[np.float32]:
        """Return the next actions (b, A) in the units of the environment.

        ``vectors`` are (b, S) packed observations, ``images`` (b, N, H, W, 3).

        Raises:
            RequestError: the network gives numbers that are not finite.
        """
        self._push(self._states, env_ids, self._normalization.normalize_state(vectors))
        if images is not None:
            needed = self.needs_images(env_ids)
            self._push(self._images, env_ids[needed], images[needed])
        due = env_ids[self._buffer.steps_to_prediction(env_ids) == 0]
        size = len(self._state_tile)
        chunks = [self._predict(due[start : start + size]) for start in range(0, len(due), size)]
        predicted = np.concatenate([np.empty((0, *self._chunk_shape), np.float32), *chunks])
        if not np.isfinite(predicted).all():
            raise RequestError("the network gives actions that are not finite; train it again")
        self._steps[env_ids] += 1
        return self._normalization.unnormalize_action(self._buffer.act(env_ids, predicted))

    def _push(self, window: NDArray[Any], env_ids: EnvIds, newest: NDArray[Any]) -> None:
        """Append an observation to windows (n, O, ...); the first of an episode fills them."""
        window[env_ids, :-1] = window[env_ids, 1:]
        window[env_ids, -1] = newest
        is_first = self._steps[env_ids] == 0
        window[env_ids[is_first]] = newest[is_first, None]

    @torch.inference_mode()
    def _predict(self, env_ids: EnvIds) -> NDArray[np.float32]:
        """Return the chunks, normalised, (b, K, A), for at most one tile's worth of rows."""
        count = len(env_ids)
        self._state_tile[count:].zero_()
        self._state_tile.numpy()[:count] = self._states[env_ids]
        if self._has_images:
            self._image_tile[count:].zero_()
            self._image_tile.numpy()[:count] = self._images[env_ids]
        if self._model.sample_noise_size:
            self._noise_tile[count:].zero_()
            for row, env in enumerate(env_ids):
                seed = derive_seed(int(self._seeds[env]), "policy", int(self._steps[env]))
                generator = torch.Generator().manual_seed(seed)
                self._noise_tile[row].normal_(generator=generator)
        tiles = self._state_tile, self._image_tile, self._noise_tile
        for tile, there in zip(tiles, self._inputs, strict=True):
            if there is not None and there is not tile:
                there.copy_(tile, non_blocking=True)
        chunks = self._compute()
        # Waits for the GPU, so that the pinned memory is free for the next tile.
        return chunks[:count].float().cpu().numpy()

    def _forward(self) -> Tensor:
        with torch.autocast(self._device.type, torch.bfloat16, enabled=self._is_autocast):
            return self._model.predict(*self._inputs)
