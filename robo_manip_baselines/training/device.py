"""Where training runs, and in which precision."""

from __future__ import annotations

import gc
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import torch
import torch.distributed as dist
from torch import Tensor

from robo_manip_baselines.runs.errors import RequestError

DEVICE_TYPES = ("cpu", "cuda")


def choose_device(given: str, local_rank: int = 0) -> torch.device:
    """Return the device that ``--device`` means; ``auto`` is a GPU where there is one.

    Args:
        given: ``auto``, ``cpu``, ``cuda`` or ``cuda:1``.
        local_rank: number of this process on its machine, which is the number of its GPU.

    Raises:
        RequestError: there is no such device.
    """
    if given == "auto":
        given = "cuda" if torch.cuda.is_available() else "cpu"
    try:
        device = torch.device(given)
    except RuntimeError:
        device = None
    if device is None or device.type not in DEVICE_TYPES:
        raise RequestError(f"device '{given}': must be auto, cpu, cuda or cuda:NUMBER")
    if device.type == "cpu":
        return torch.device("cpu")
    if not torch.cuda.is_available():
        raise RequestError(
            f"device '{given}': PyTorch {torch.__version__} finds no CUDA device; say --device cpu"
        )
    index = local_rank if device.index is None else device.index
    if index >= torch.cuda.device_count():
        raise RequestError(f"device 'cuda:{index}': there are {torch.cuda.device_count()}")
    return torch.device("cuda", index)


def autocast_type(
    precision: str, device: torch.device, has_images: bool = False
) -> torch.dtype | None:
    """Return the type of autocast, None for fp32 throughout.

    ``auto`` is bf16 on CUDA, and on CPUs with bf16 instructions if there are images to convolve,
    which is where it saves most of the time. Networks without images stay fp32 on CPU: they are
    quick enough, and keep all digits of positions.

    Raises:
        RequestError: the device computes no bf16.
    """
    if precision == "fp32":
        return None
    if precision == "auto" and device.type == "cpu":
        return torch.bfloat16 if has_images and _has_fast_bf16() else None
    if device.type == "cuda" and not torch.cuda.is_bf16_supported(including_emulation=False):
        if precision == "auto":
            return None
        raise RequestError(f"precision bf16: {torch.cuda.get_device_name(device)} has none")
    return torch.bfloat16


def prepare_device(device: torch.device, compile_network: bool) -> None:
    """Set what PyTorch does with fp32 on CUDA: TF32 products, convolutions chosen by measuring.

    Raises:
        RequestError: ``--compile`` on a CPU without a C++ compiler.
    """
    if device.type == "cuda":
        torch.cuda.set_device(device)
        torch.set_float32_matmul_precision("high")
        torch.backends.cudnn.benchmark = True
    elif compile_network and not any(map(shutil.which, ("g++", "clang++", "c++"))):
        raise RequestError("--compile on a CPU needs a C++ compiler: apt-get install g++")


def describe_device(device: torch.device) -> str:
    """Name the device for people."""
    if device.type == "cuda":
        return f"{device} ({torch.cuda.get_device_name(device)})"
    return f"cpu ({torch.get_num_threads()} threads)"


def _has_fast_bf16() -> bool:
    """Whether this processor multiplies bf16 in hardware, as far as PyTorch can tell."""
    capabilities = getattr(torch.cpu, "get_capabilities", dict)()  # not in older releases
    return any(bool(capabilities.get(name)) for name in ("amx_bf16", "avx512_bf16"))


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
