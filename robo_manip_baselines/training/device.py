"""Where training runs, and in which precision."""

from __future__ import annotations

import shutil

import torch

from robo_manip_baselines.errors import RequestError

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
