"""Execution of a trained policy in many environments at once: from observations to actions.

Legend: n environments, b of them that act now, m of those that need a prediction, O observation
steps, K actions of a chunk, S elements of the state, A elements of an action, Z elements of noise.

Every environment is at a step of its own; its actions depend on its own episode alone.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from robo_manip_baselines.data.actions import ActionEncoding
from robo_manip_baselines.data.normalization import Normalization
from robo_manip_baselines.observation import ObservationSpec
from robo_manip_baselines.policy.cuda_graph import Replay
from robo_manip_baselines.policy.interface import PolicyModel
from robo_manip_baselines.policy.presets import STRATEGIES, ActionExecution
from robo_manip_baselines.runs.errors import RequestError, require_choice
from robo_manip_baselines.runs.seeds import derive_seed

EnvIds = NDArray[np.intp]
"""(b,) numbers of environments, all different."""

WARM_UP = 3
"""Predictions before those that are timed."""


class TemporalEnsemble:
    """Average, at every step, of all predictions that were made for that step.

    The i-th prediction for a step, the oldest being i = 0, has the weight exp(-decay i); weights
    are divided by their sum (public ACT: decay 0.01). Predictions are counted, so a prediction of
    zero is one like any other. Only sums for the K steps ahead are kept, and no chunk. A decay of
    more than 0 trusts old predictions more, less than 0 new ones.

    With a ``delay`` a chunk counts from its action of that number on, the first that can still be
    executed when it is there.

    Raises:
        RequestError: the delay is not less than K.
    """

    def __init__(
        self,
        num_envs: int,
        chunk_size: int,
        action_size: int,
        *,
        decay: float = 0.01,
        delay: int = 0,
    ) -> None:
        if delay >= chunk_size:
            raise RequestError(
                f"inference_delay {delay}: must be less than {chunk_size}, the chunk size"
            )
        self._weight = np.exp(-decay * np.arange(chunk_size))
        self._total = np.cumsum(self._weight)
        self._delay = delay
        # Column j is about the step j steps ahead: sums of weighted predictions, and their number.
        self._sum = np.zeros((num_envs, chunk_size, action_size))
        self._count = np.zeros((num_envs, chunk_size), dtype=np.intp)

    def reset(self, env_ids: EnvIds) -> None:
        """Forget the predictions for these environments."""
        self._sum[env_ids], self._count[env_ids] = 0.0, 0

    def steps_to_prediction(self, env_ids: EnvIds) -> NDArray[np.intp]:
        """Return zeros: a prediction is needed at every step."""
        return np.zeros(len(env_ids), dtype=np.intp)

    def act(
        self,
        env_ids: EnvIds,
        chunks: NDArray[np.float32],
        held: NDArray[np.float32] | None = None,
    ) -> NDArray[np.float32]:
        """Add chunks (b, K, A) and return the averages (b, A) for the present step.

        ``held`` (b, A) are the actions before there is any prediction; needed with a delay.
        """
        sums, count, in_time = self._sum[env_ids], self._count[env_ids], slice(self._delay, None)
        sums[:, in_time] += self._weight[count[:, in_time]][..., None] * chunks[:, in_time]
        count[:, in_time] += 1
        action = sums[:, 0] / self._total[count[:, 0] - 1][:, None]
        if held is not None:
            action = np.where(count[:, :1] > 0, action, held)
        # One step on: what was ahead by j is now ahead by j - 1, and the last step is new.
        self._sum[env_ids, :-1], self._sum[env_ids, -1] = sums[:, 1:], 0.0
        self._count[env_ids, :-1], self._count[env_ids, -1] = count[:, 1:], 0
        return action.astype(np.float32)


class ActionQueue:
    """The first ``n_action_steps`` of each chunk, executed before the next one is.

    With a ``delay`` of D steps there are two ways, here with 3 action steps and D = 2. ``|`` is the
    observation of a chunk, ``.`` a step in which the robot holds its last target, and 0, 1, ... are
    the actions of a chunk:

        waits           |. . 0 1 2|. . 0 1 2|. . 0 1
        does not wait   |. . 0|1 2 0|1 2 0|1 2 0       first action 0
                        |. . 0|1 2 2|3 4 2|3 4 2       first action 2

    Args:
        num_envs, chunk_size, action_size: n, K, A.
        n_action_steps: of a chunk.
        delay: D, steps between an observation and the first action of its chunk.
        waits: the next observation is made when the last action has been executed, not D steps
            before.
        first: number of the first action of each chunk that is executed, but for the first chunk
            of an episode, for which nothing went on meanwhile.

    Raises:
        RequestError: the numbers do not fit one another.
    """

    def __init__(
        self,
        num_envs: int,
        chunk_size: int,
        action_size: int,
        *,
        n_action_steps: int,
        delay: int = 0,
        waits: bool = True,
        first: int = 0,
    ) -> None:
        if not 1 <= n_action_steps <= chunk_size - first:
            late = f" less the {first} that come too late" if first else ""
            raise RequestError(
                f"n_action_steps {n_action_steps}: must be 1 to {chunk_size - first}, the chunk "
                f"size{late}"
            )
        if not waits and delay > n_action_steps:
            raise RequestError(
                f"inference_delay {delay}: must be at most n_action_steps {n_action_steps}, so "
                "that one chunk is computed at a time; give more --n_action_steps, or --strategy "
                "synchronous"
            )
        self._delay, self._waits, self._first = delay, waits, first
        self._period = n_action_steps + (delay if waits else 0)
        self._chunk = np.zeros((num_envs, chunk_size, action_size), dtype=np.float32)
        self._coming = self._chunk.copy()
        self._age = np.full(num_envs, self._period)  # steps since the last observation of a chunk
        self._place = np.zeros(num_envs, dtype=np.intp)  # of the next action of the chunk
        self._has_chunk = np.zeros(num_envs, dtype=bool)
        self._is_coming = np.zeros(num_envs, dtype=bool)

    def reset(self, env_ids: EnvIds) -> None:
        """Empty the queues of these environments."""
        self._age[env_ids] = self._period
        self._has_chunk[env_ids] = self._is_coming[env_ids] = False

    def steps_to_prediction(self, env_ids: EnvIds) -> NDArray[np.intp]:
        """Return (b,) the steps until the next chunk is to be predicted."""
        return self._period - self._age[env_ids]

    def under_way(self, env_ids: EnvIds) -> tuple[NDArray[np.float32], NDArray[np.intp]]:
        """Return the actions (b, K, A) from the next one on that a chunk still has, and how many.

        Past their number (b,), which is 0 where there is no chunk, the last one is repeated.
        """
        self._receive(env_ids)
        size = self._chunk.shape[1]
        left = np.where(self._has_chunk[env_ids], size - self._place[env_ids], 0)
        places = np.minimum(self._place[env_ids, None] + np.arange(size), size - 1)
        return self._chunk[env_ids[:, None], places], left

    def act(
        self,
        env_ids: EnvIds,
        chunks: NDArray[np.float32],
        held: NDArray[np.float32] | None = None,
    ) -> NDArray[np.float32]:
        """Take chunks (m, K, A), where they are due, and return the next actions (b, A).

        ``held`` (b, A) are the actions where there is none; needed with a delay.
        """
        self._receive(env_ids)
        due = env_ids[self.steps_to_prediction(env_ids) == 0]
        self._coming[due], self._age[due], self._is_coming[due] = chunks, 0, True
        self._receive(env_ids)  # at once, without a delay
        moves = self._has_chunk[env_ids]
        if self._waits:
            moves &= self._age[env_ids] >= self._delay
        # Where the robot waits, the place may be past the end.
        places = np.minimum(self._place[env_ids], self._chunk.shape[1] - 1)
        action = self._chunk[env_ids, places]
        self._place[env_ids] += moves
        self._age[env_ids] += 1
        return action if held is None else np.where(moves[:, None], action, held)

    def _receive(self, env_ids: EnvIds) -> None:
        """Go on with the chunks that are there by now."""
        there = env_ids[self._is_coming[env_ids] & (self._age[env_ids] == self._delay)]
        self._chunk[there] = self._coming[there]
        self._place[there] = np.where(self._has_chunk[there], self._first, 0)
        self._has_chunk[there], self._is_coming[there] = True, False


ActionBuffer = TemporalEnsemble | ActionQueue


def make_action_buffer(
    execution: ActionExecution, num_envs: int, chunk_size: int, action_size: int
) -> ActionBuffer:
    """Build the buffer of predicted chunks that the settings ask for.

    Its ``reset`` starts episodes, ``steps_to_prediction`` counts the steps before an environment
    needs a prediction, and ``act`` takes chunks for those that need one.

    Raises:
        RequestError: more actions would be executed than a chunk has, or the delay does not fit.
    """
    shape, delay = (num_envs, chunk_size, action_size), execution.inference_delay
    if execution.temporal_ensemble:
        return TemporalEnsemble(*shape, decay=execution.ensemble_decay, delay=delay)
    # What is shown to roll_forward is the state in which its chunk begins.
    is_aligned = execution.strategy in ("synchronous", "roll_forward")
    return ActionQueue(
        *shape,
        n_action_steps=execution.n_action_steps,
        delay=delay,
        waits=execution.strategy == "synchronous",
        first=0 if is_aligned else delay,
    )


def soft_weights(chunk_size: int, delay: int, left: NDArray[np.intp]) -> NDArray[np.float32]:
    """Return the weights (b, K) of the actions under way in real-time chunking.

    1 for the ``delay`` actions that are executed before the new chunk is there, 0 for those that no
    chunk under way has, and falling in between: c (e^c - 1) / (e - 1) with c linear (Black et al.
    2025, arXiv 2506.07339, eq. 5, whose H - s is ``left``, (b,), the actions that are left).
    """
    step = np.arange(chunk_size)
    linear = (left[:, None] - step) / np.maximum(left[:, None] - delay + 1, 1)
    soft = linear * np.expm1(linear) / np.expm1(1.0)
    weights = np.where(step < delay, 1.0, soft)
    return np.where(step < left[:, None], weights, 0.0).astype(np.float32)


def interpolated(chunks: NDArray[np.float32], skip: int) -> NDArray[np.float32]:
    """Return chunks (m, K skip, A) for every control step, of those (m, K, A) for every skip-th.

    Targets are interpolated linearly; the last one is held.
    """
    if skip == 1:
        return chunks
    after = np.concatenate([chunks[:, 1:], chunks[:, -1:]], axis=1)
    share = (np.arange(skip, dtype=np.float32) / skip)[:, None]
    between = chunks[:, :, None] + share * (after - chunks)[:, :, None]
    return between.reshape(len(chunks), -1, chunks.shape[-1]).astype(np.float32, copy=False)


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
        encoding: of the actions that it predicts; None for targets of the joints.
        skip: control steps between two actions of its chunks, and two observations of its window.
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
        encoding: ActionEncoding | None = None,
        skip: int = 1,
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
        # Encoded actions are decoded when they are predicted: what they are relative to changes.
        self._encoding, self._skip = encoding or None, skip
        self._chunk_shape = model.chunk_size * skip, len(normalization.action_mean)
        self._buffer = make_action_buffer(execution, num_envs, *self._chunk_shape)
        self._execution = execution
        _require_strategy(model, execution, skip)
        # Places in the state of what actions are targets of, and the last targets, in the units of
        # the buffer: those of the environment where actions are encoded, normalised otherwise.
        self._posture = spec.posture_places
        self._targets = np.zeros((num_envs, self._chunk_shape[1]), np.float32)
        steps, state_size = model.n_obs_steps, len(normalization.state_mean)
        image_shape = (steps, len(spec.cameras), *spec.image_size, 3)
        # The last observations, of which O are shown, the seed and the control step of every
        # environment.
        kept = (steps - 1) * skip + 1
        self._states = np.zeros((num_envs, kept, state_size), np.float32)
        self._images = np.zeros((num_envs, kept, *image_shape[1:]), np.uint8)
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
        # Of the chunk that goes on while the next one is predicted: actions, weights.
        self._chunk_tiles = (
            torch.zeros(rows, model.chunk_size, self._chunk_shape[1], pin_memory=pinned),
            torch.zeros(rows, model.chunk_size, pin_memory=pinned),
        )
        self._chunk_inputs = tuple(tile.to(self._device) for tile in self._chunk_tiles)
        # On a CPU the inputs are the tiles themselves.
        self._compute = Replay(self._forward, self._device) if pinned else self._forward

    def reset(self, env_ids: EnvIds, seeds: Sequence[int]) -> None:
        """Start episodes of these seeds, (b,), in these environments."""
        self._buffer.reset(env_ids)
        self._seeds[env_ids], self._steps[env_ids] = seeds, 0

    def prediction_time(self, repeats: int = 20) -> float:
        """Return the s on the clock that a prediction takes, the median of several.

        What was kept of the first environment's episode is forgotten.
        """
        env, vectors = np.array([0]), np.zeros((1, self._states.shape[2]), np.float32)
        images = np.zeros((1, *self._images.shape[2:]), np.uint8) if self._has_images else None
        self.reset(env, [0])
        times: list[float] = []
        while len(times) < repeats + WARM_UP:
            is_due = self._buffer.steps_to_prediction(env)[0] == 0
            begun = time.perf_counter()
            self.act(vectors, images, env)  # ends with actions in memory, also of a GPU
            if is_due:
                times.append(time.perf_counter() - begun)
        self.reset(env, [0])
        return float(np.median(times[WARM_UP:]))

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
        held = None
        if self._execution.inference_delay:
            self._hold_posture(env_ids, vectors)
            held = self._targets[env_ids]
        self._steps[env_ids] += 1
        actions = self._buffer.act(env_ids, predicted, held)
        self._targets[env_ids] = actions
        return actions if self._encoding else self._normalization.unnormalize_action(actions)

    def _hold_posture(self, env_ids: EnvIds, vectors: NDArray[np.float32]) -> None:
        """Make the observed posture the target where an episode begins."""
        is_first = self._steps[env_ids] == 0
        posture = vectors[is_first][:, self._posture]
        if not self._encoding:
            posture = self._normalization.normalize_action(posture)
        self._targets[env_ids[is_first]] = posture

    def _states_to_show(self, env_ids: EnvIds) -> NDArray[np.float32]:
        """Return the windows of states (b, O, S) that a prediction is made from.

        With roll_forward the joints are where they will be when the chunk is there: as much further
        as their targets will have moved, since an arm follows its targets with an even lag.
        """
        states, delay = self._states[env_ids, :: self._skip], self._execution.inference_delay
        if self._execution.name != "roll_forward" or not delay:
            return states
        assert isinstance(self._buffer, ActionQueue)
        actions, left = self._buffer.under_way(env_ids)
        change = np.where(left[:, None] > 0, actions[:, delay - 1] - self._targets[env_ids], 0.0)
        scale = 1.0 / self._normalization.state_std[self._posture]
        if not self._encoding:
            scale = self._normalization.action_std * scale
        states[:, :, self._posture] += (change * scale)[:, None].astype(np.float32)
        return states

    def _shown_vectors(self, states: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the packed observations (b, S) that windows (b, O, S) end with."""
        return states[:, -1] * self._normalization.state_std + self._normalization.state_mean

    def _to_execute(
        self, chunks: NDArray[np.float32], states: NDArray[np.float32]
    ) -> NDArray[np.float32]:
        """Return predicted chunks (b, K, A) as the buffer takes them, for every control step."""
        if self._encoding:
            encoded = self._normalization.unnormalize_action(chunks)
            decoded = self._encoding.decode(encoded, self._shown_vectors(states))
            chunks = decoded.astype(np.float32)
        return interpolated(chunks, self._skip)

    def _as_predicted(
        self, actions: NDArray[np.float32], states: NDArray[np.float32]
    ) -> NDArray[np.float32]:
        """Undo `_to_execute`."""
        actions = actions[:, :: self._skip]
        if not self._encoding:
            return actions
        encoded = self._encoding.encode(actions, self._shown_vectors(states)).astype(np.float32)
        return self._normalization.normalize_action(encoded)

    def _fill_chunk_tiles(self, env_ids: EnvIds, states: NDArray[np.float32]) -> None:
        """Write what goes on while a chunk is predicted: the actions and their weights."""
        assert isinstance(self._buffer, ActionQueue)
        delay, size = self._execution.inference_delay, self._chunk_shape[0]
        actions, left = self._buffer.under_way(env_ids)
        weights = soft_weights(size, delay, left)
        if self._execution.name == "rtc_trained":
            weights = (np.arange(size) < np.minimum(delay, left)[:, None]).astype(np.float32)
        actions, weights = self._as_predicted(actions, states), weights[:, :: self._skip]
        for tile, values in zip(self._chunk_tiles, (actions, weights), strict=True):
            tile[len(env_ids) :].zero_()
            tile.numpy()[: len(env_ids)] = values

    def _push(self, window: NDArray[Any], env_ids: EnvIds, newest: NDArray[Any]) -> None:
        """Append an observation to windows (n, O, ...); the first of an episode fills them."""
        window[env_ids, :-1] = window[env_ids, 1:]
        window[env_ids, -1] = newest
        is_first = self._steps[env_ids] == 0
        window[env_ids[is_first]] = newest[is_first, None]

    @torch.no_grad()
    def _predict(self, env_ids: EnvIds) -> NDArray[np.float32]:
        """Return the chunks for the buffer, (b, K, A), for at most one tile's worth of rows."""
        count, states = len(env_ids), self._states_to_show(env_ids)
        self._state_tile[count:].zero_()
        self._state_tile.numpy()[:count] = states
        if self._has_images:
            self._image_tile[count:].zero_()
            self._image_tile.numpy()[:count] = self._images[env_ids, :: self._skip]
        if self._model.sample_noise_size:
            self._noise_tile[count:].zero_()
            for row, env in enumerate(env_ids):
                seed = derive_seed(int(self._seeds[env]), "policy", int(self._steps[env]))
                generator = torch.Generator().manual_seed(seed)
                self._noise_tile[row].normal_(generator=generator)
        if self._continues:
            self._fill_chunk_tiles(env_ids, states)
        tiles = self._state_tile, self._image_tile, self._noise_tile, *self._chunk_tiles
        for tile, there in zip(tiles, (*self._inputs, *self._chunk_inputs), strict=True):
            if there is not None and there is not tile:
                there.copy_(tile, non_blocking=True)
        chunks = self._compute()
        # Waits for the GPU, so that the pinned memory is free for the next tile.
        return self._to_execute(chunks[:count].float().cpu().numpy(), states)

    @property
    def _continues(self) -> bool:
        """True if a chunk is predicted from the one that goes on."""
        return self._execution.name in ("rtc", "rtc_trained")

    def _forward(self) -> Tensor:
        with torch.autocast(self._device.type, torch.bfloat16, enabled=self._is_autocast):
            if not self._continues:
                with torch.inference_mode():
                    return self._model.predict(*self._inputs)
            is_guided = self._execution.name == "rtc"
            predict = self._model.inpaint if is_guided else self._model.extend
            return predict(*self._inputs, *self._chunk_inputs)


def _require_strategy(model: PolicyModel, execution: ActionExecution, skip: int) -> None:
    """Raise RequestError unless the network can act with the strategy and the delay."""
    kind, name, delay = type(model).__name__, execution.name, execution.inference_delay
    needs_model = ("rtc", "rtc_trained")
    if name in needs_model and name not in model.strategies:
        valid = [s for s in STRATEGIES if s not in needs_model or s in model.strategies]
        how = "; rtc_trained is learnt with --max_prefix" if name in needs_model[1:] else ""
        raise RequestError(f"strategy '{name}': not with {kind}; valid: {', '.join(valid)}{how}")
    if name == "rtc_trained" and delay > model.max_delay * skip:
        each = f" actions of {skip} control steps" if skip > 1 else ""
        raise RequestError(
            f"inference_delay {delay}: must be at most the max_prefix {model.max_delay}{each} that "
            "the policy was trained with"
        )
