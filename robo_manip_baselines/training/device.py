"""Device of a training run: its choice, its precision, its timer, and processes that share it."""

from __future__ import annotations

import gc
import os
import shutil
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import torch
import torch.distributed as dist
from torch import Tensor

from robo_manip_baselines.runs.errors import RequestError

DEVICE_TYPES = ("cpu", "cuda")


def choose_device(given: str, local_rank: int = 0) -> torch.device:
    """Return the device of ``--device``; ``auto`` is a GPU where there is one.

    ``local_rank``, the number of this process on its machine, is the number of its GPU.

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
            f"device '{given}': PyTorch {torch.__version__} finds no CUDA device; use --device cpu"
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
    where it saves most. Networks without images stay fp32 on CPU: they are quick enough, and keep
    all digits of positions.

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
    """Let PyTorch use TF32 products on CUDA, and choose convolutions by measuring.

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
    """Return the name of the device, for logs."""
    if device.type == "cuda":
        return f"{device} ({torch.cuda.get_device_name(device)})"
    return f"cpu ({torch.get_num_threads()} threads)"


def _has_fast_bf16() -> bool:
    """Return whether this processor multiplies bf16 in hardware, as far as PyTorch knows."""
    capabilities = getattr(torch.cpu, "get_capabilities", dict)()  # not in older releases
    return any(bool(capabilities.get(name)) for name in ("amx_bf16", "avx512_bf16"))


PHASES = ("data", "forward", "backward", "optimizer")
"""Of a training step; data: waiting for the batch; optimizer: clipping, AdamW and the average."""


class StepTimer:
    """Time of each phase of a training step, without making the GPU wait.

    Each step calls `mark` with the names of ``PHASES`` in order. ``data`` is measured on the host,
    the others where they run: on CUDA with events on the stream, read when the times are needed.
    """

    def __init__(self, device: torch.device) -> None:
        self._on_cuda = device.type == "cuda"
        self._reset()
        self.skip()

    def mark(self, phase: str) -> None:
        """Mark the end of a phase."""
        now = time.perf_counter()
        if phase == "data":
            self._steps += 1
        if phase == "data" or not self._on_cuda:
            self._seconds[phase] += now - self._last
        self._last = now
        if self._on_cuda:
            event = torch.cuda.Event(enable_timing=True)
            event.record()
            self._events.append((phase, event))

    def skip(self) -> None:
        """Leave out the time since the last mark: logging, validation, saving."""
        self._last = time.perf_counter()

    def read(self) -> dict[str, float]:
        """Return mean seconds a step by phase since the last call; on CUDA, wait for the device."""
        if self._events:
            torch.cuda.synchronize()
            for (_, start), (phase, end) in zip(self._events, self._events[1:], strict=False):
                if phase != "data":
                    self._seconds[phase] += start.elapsed_time(end) / 1e3
        means = {phase: total / max(self._steps, 1) for phase, total in self._seconds.items()}
        self._reset()
        return means

    def _reset(self) -> None:
        self._steps = 0
        self._seconds: dict[str, float] = dict.fromkeys(PHASES, 0.0)
        self._events: list[tuple[str, torch.cuda.Event]] = []


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
        values = [os.environ.get(name) for name in ("RANK", "WORLD_SIZE", "LOCAL_RANK")]
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
        """True for the process that writes files and logs."""
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
        """Return whether the flag is set in any process; waits for the device."""
        if self.world_size == 1:
            return flag
        value = torch.tensor([float(flag)], device=device)
        dist.all_reduce(value, op=dist.ReduceOp.MAX)
        return bool(value.item())

    def wait(self) -> None:
        """Wait until every process is here."""
        if self.world_size > 1:
            dist.barrier()
