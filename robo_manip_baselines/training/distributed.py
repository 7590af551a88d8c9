"""The processes that train together, started by ``torchrun``; one alone without it."""

from __future__ import annotations

import gc
import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import torch
import torch.distributed as dist
from torch import Tensor

from robo_manip_baselines.errors import RequestError


@dataclass(frozen=True)
class Processes:
    """This process among those that train together.

    Attributes:
        rank: number of this process, 0 is the one that writes.
        world_size: how many there are.
        local_rank: number of this process on its machine.
    """

    rank: int = 0
    world_size: int = 1
    local_rank: int = 0

    @classmethod
    def from_environment(cls) -> Processes:
        """Read what ``torchrun`` sets.

        Raises:
            RequestError: it is set in part only.
        """
        names = ("RANK", "WORLD_SIZE", "LOCAL_RANK")
        values = [os.environ.get(name) for name in names]
        if values[0] is None and values[1] in (None, "1"):
            return cls()
        if None in values or "MASTER_ADDR" not in os.environ:
            raise RequestError(
                "RANK, WORLD_SIZE, LOCAL_RANK and MASTER_ADDR must be set together; start "
                "several processes with torchrun"
            )
        return cls(*(int(value or 0) for value in values))

    @property
    def is_main(self) -> bool:
        """Whether this process writes files and says things."""
        return self.rank == 0

    @contextmanager
    def joined(self, device: torch.device) -> Iterator[None]:
        """Meet the other processes for the length of a block: NCCL on CUDA, gloo on CPU."""
        if self.world_size == 1:
            yield
            return
        if device.type == "cuda":
            dist.init_process_group("nccl", device_id=device)
        else:
            dist.init_process_group("gloo")
        try:
            yield
        finally:
            # Cycles, as DistributedDataParallel has them, would keep the group's threads until the
            # interpreter ends, which then aborts now and then.
            gc.collect()
            dist.destroy_process_group()

    def mean(self, values: Tensor) -> Tensor:
        """Average over the processes; in place."""
        if self.world_size > 1:
            dist.all_reduce(values)
            values /= self.world_size
        return values

    def any(self, flag: bool, device: torch.device) -> bool:
        """Whether the flag is set in any process; waits for the device."""
        if self.world_size == 1:
            return flag
        value = torch.tensor([float(flag)], device=device)
        dist.all_reduce(value, op=dist.ReduceOp.MAX)
        return bool(value.item())

    def wait(self) -> None:
        """Wait until every process is here."""
        if self.world_size > 1:
            dist.barrier()
