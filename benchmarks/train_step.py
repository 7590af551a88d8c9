"""Time of each phase of real training steps: data, transfer, forward, backward, optimiser.

Takes the command line of ``bin/Train.py`` and trains as it does, but writes nothing. Without
``--dataset`` it makes up episodes whose pictures are as hard to decode as rendered ones.
Prints a Markdown table.
Run: ``python benchmarks/train_step.py Act --preset cpu --steps 60``.

- ``wait for data``: what a step waits for its batch while batches are made ahead of it.
- ``make a batch``: one batch made with nothing going on beside it, copy to the device included.
- ``transfer``: its copy from page-locked memory to the device alone; not on CPU.
- ``forward``, ``backward``, ``optimizer``: on CUDA measured with events on the stream.
- ``step``: from one step to the next, the whole loop; its inverse is the speed.
"""

from __future__ import annotations

import sys
import tempfile
import time
from dataclasses import fields
from pathlib import Path

import cv2
import numpy as np

from robo_manip_baselines.runs.command import run_command
from robo_manip_baselines.training.requirements import prepare_pytorch

prepare_pytorch()  # before PyTorch is imported: how its threads wait

import torch  # noqa: E402

from robo_manip_baselines.data import encode_image, episode_path, write_episode  # noqa: E402
from robo_manip_baselines.data.example import make_arrays, make_attributes  # noqa: E402
from robo_manip_baselines.policy.interface import Batch  # noqa: E402
from robo_manip_baselines.training.device import (  # noqa: E402
    Processes,
    choose_device,
    describe_device,
    prepare_device,
)
from robo_manip_baselines.training.options import parse_options  # noqa: E402
from robo_manip_baselines.training.setup import Job  # noqa: E402
from robo_manip_baselines.training.trainer import Parts, assembled  # noqa: E402

EPISODES = 10
EPISODE_STEPS = 120
WARM_UP = 5
"""Steps before the clock runs: kernels are chosen, memory is taken, threads start."""


def make_episodes(folder: Path, cameras: tuple[str, ...], size: tuple[int, int]) -> None:
    """Write episodes of numbers and of smoothed noise: about 39 kB a frame at 480 x 640."""
    rng = np.random.default_rng(0)
    coarse = (20, max(size[0] // 32, 2), max(size[1] // 32, 2), 3)
    frames = [
        encode_image(cv2.resize(noise, size[::-1]), "jpeg")
        for noise in rng.integers(0, 256, coarse, dtype=np.uint8)
    ]
    for seed in range(EPISODES):
        images = {c: [frames[i % len(frames)] for i in range(EPISODE_STEPS)] for c in cameras}
        path = episode_path(folder, seed, success=True)
        write_episode(path, make_arrays(EPISODE_STEPS, seed), images, make_attributes(seed))


def time_transfer(batch: Batch, device: torch.device, repeats: int = 20) -> float:
    """Seconds to copy a batch from page-locked memory."""
    tensors = [getattr(batch, field.name) for field in fields(batch)]
    pinned = [tensor.cpu().pin_memory() for tensor in tensors if tensor is not None]
    torch.cuda.synchronize(device)
    start = time.perf_counter()
    for _ in range(repeats):
        for tensor in pinned:
            tensor.to(device, non_blocking=True)
    torch.cuda.synchronize(device)
    return (time.perf_counter() - start) / repeats


def measure(parts: Parts, steps: int, device: torch.device) -> dict[str, float]:
    """Seconds by phase, means over ``steps`` steps after the warm-up."""
    clock = parts.train_step.clock
    started = time.perf_counter()
    for step, batch in enumerate(parts.loader.batches(0, WARM_UP + steps)):
        if step == WARM_UP:
            clock.read()
            clock.skip()
            started = time.perf_counter()
        parts.train_step(batch, step)
    phases = clock.read()  # waits for the device
    whole = (time.perf_counter() - started) / steps
    start, made = time.perf_counter(), min(steps, 10)
    batches = [parts.loader.batch(step) for step in range(made)]
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    making = (time.perf_counter() - start) / made
    transfer = time_transfer(batches[0], device) if device.type == "cuda" else float("nan")
    return {
        "wait for data": phases["data"],
        "make a batch": making,
        "transfer": transfer,
        **{phase: phases[phase] for phase in ("forward", "backward", "optimizer")},
        "step": whole,
    }


def main() -> None:
    """Print the table."""
    args = sys.argv[1:]
    if not any(arg.startswith("--steps") for arg in args):
        args += ["--steps", "50"]
    options = parse_options(args, torch.cuda.is_available())
    device = choose_device(options.device)
    prepare_device(device, options.training.compile)
    with tempfile.TemporaryDirectory() as folder:
        if options.dataset is None:
            make_episodes(Path(folder), options.spec.cameras, options.spec.image_size)
            options = parse_options([*args, "--dataset", folder], torch.cuda.is_available())
        job = Job.of(options)
        steps = job.total_steps
        with assembled(job, None, device, Processes()) as parts:
            phases = measure(parts, steps, device)
            precision = "bf16" if parts.train_step.autocast else "fp32"
    shape = f"{len(options.spec.cameras)} cameras"
    if options.spec.cameras:
        shape += f" of {options.image_size}"
    print(
        f"{options.policy}, preset {options.preset}, batch {options.training.batch_size}, {shape}, "
        f"{describe_device(device)}, {precision}, PyTorch {torch.__version__}, {steps} steps"
    )
    if device.type == "cuda":
        print(f"{torch.cuda.max_memory_allocated(device) / 2**30:.2f} GiB of GPU memory")
    print("\n| phase | ms |\n|---|---|")
    for name, seconds in phases.items():
        print(f"| {name} | {'-' if np.isnan(seconds) else f'{1e3 * seconds:.2f}'} |")


if __name__ == "__main__":
    run_command(main)
