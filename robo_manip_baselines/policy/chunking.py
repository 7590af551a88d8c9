"""From chunks of actions to actions, for many environments ("slots") at once.

Legend: n slots that there are, b slots that act now, m of them that need a chunk, K actions of a
chunk, A elements of an action.

A step of the slots that act now is: ask ``needs_chunk``, get chunks for those that do, and hand
them to ``act``. Every slot is at a step of its own; what happens in one changes nothing in another.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from robo_manip_baselines.errors import RequestError
from robo_manip_baselines.policy.presets import Acting

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
