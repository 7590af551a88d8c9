"""Replay of the same work on a CUDA device, without launching its kernels one by one."""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import Generic, TypeVar, cast

import torch

Result = TypeVar("Result")

WARM_UP = 3
"""Calls that are computed before one is recorded: libraries choose their kernels meanwhile."""

logger = logging.getLogger(__name__)


class Replay(Generic[Result]):
    """Function that is recorded as a CUDA graph and replayed from then on.

    ``compute`` reads its inputs from tensors that stay where they are, and leaves its results in
    tensors, which each replay overwrites. It must not wait for the device. The first calls compute
    as usual, on a stream of their own that the current one waits for, so that no call is lost.
    What cannot be recorded is computed on every call, after one warning.

    Args:
        compute: the work.
        device: CUDA device.

    Attributes:
        is_recorded: true once the work is recorded and calls replay it.
    """

    def __init__(self, compute: Callable[[], Result], device: torch.device) -> None:
        self._compute = compute
        self._stream = torch.cuda.Stream(device)
        self._graph: torch.cuda.CUDAGraph | None = None
        self._result: Result | None = None
        self._to_compute: float = WARM_UP

    @property
    def is_recorded(self) -> bool:
        """True once the work is recorded and calls replay it."""
        return self._graph is not None

    def __call__(self) -> Result:
        """Do the work; its results are overwritten by the next replay."""
        if self._graph is None and self._to_compute <= 0:
            self._record()
        if self._graph is not None:
            self._graph.replay()
            return cast("Result", self._result)
        self._to_compute -= 1
        current = torch.cuda.current_stream()
        self._stream.wait_stream(current)
        with torch.cuda.stream(self._stream):
            result = self._compute()
        current.wait_stream(self._stream)
        return result

    def _record(self) -> None:
        """Record the work; nothing is computed."""
        graph = torch.cuda.CUDAGraph()
        self._stream.wait_stream(torch.cuda.current_stream())
        try:
            # Threads that make batches use the device meanwhile.
            with torch.cuda.graph(graph, stream=self._stream, capture_error_mode="thread_local"):
                self._result = self._compute()
        except RuntimeError as error:
            reason = str(error).splitlines()[0]
            logger.warning("cannot be recorded as a CUDA graph, so it is slower: %s", reason)
            self._to_compute = float("inf")
            return
        self._graph = graph
