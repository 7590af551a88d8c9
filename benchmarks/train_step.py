"""Time of each phase of real training steps: data, transfer, forward, backward, optimiser.

Takes the command line of ``bin/Train.py`` and trains as it does, into a temporary folder. Without
``--dataset`` it makes up episodes whose images are as hard to decode as rendered ones.
Prints a Markdown table.
Run: ``python benchmarks/train_step.py Act --preset cpu --steps 60``.

- ``wait for data``: wait of a step for its batch while batches are made ahead of it.
- ``make a batch``: one batch made with nothing going on beside it, copy to the device included.
- ``transfer``: its copy from page-locked memory to the device alone; not on CPU.
- ``forward``, ``backward``, ``optimizer``: on CUDA measured with events on the stream.
- ``step``: from one step to the next, the whole loop; its inverse is the speed.
"""

from __future__ import annotations

import contextlib
import sys
import tempfile
import time
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from robo_manip_baselines.runs.command import run_command
from robo_manip_baselines.runs.errors import RequestError
from robo_manip_baselines.runs.images import encode_image
from robo_manip_baselines.training.requirements import prepare_pytorch

prepare_pytorch()  # before PyTorch is imported: how its threads wait

import torch  # noqa: E402

from robo_manip_baselines.commands.train import parse_config  # noqa: E402
from robo_manip_baselines.data import episode_path, write_episode  # noqa: E402
from robo_manip_baselines.data.example import make_arrays, make_attributes  # noqa: E402
from robo_manip_baselines.policy.interface import Batch  # noqa: E402
from robo_manip_baselines.runs.metrics import read_metrics  # noqa: E402
from robo_manip_baselines.training.config import METRICS, TrainConfig  # noqa: E402
from robo_manip_baselines.training.device import (  # noqa: E402
    PHASES,
    Processes,
    autocast_type,
    choose_device,
    describe_device,
)
from robo_manip_baselines.training.images import ImageStore  # noqa: E402
from robo_manip_baselines.training.setup import TrainSetup  # noqa: E402
from robo_manip_baselines.training.trainer import Trainer, train  # noqa: E402

EPISODES = 10
EPISODE_STEPS = 120
WARM_UP = 5
"""Steps before the clock runs: kernels are chosen, memory is taken, threads start."""
TRANSFERS = 20
"""Copies of a batch to the device that are timed."""


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


def time_transfer(batch: Batch, device: torch.device) -> float:
    """Seconds to copy a batch from page-locked memory."""
    tensors = [getattr(batch, field.name) for field in fields(batch)]
    pinned = [tensor.cpu().pin_memory() for tensor in tensors if tensor is not None]
    torch.cuda.synchronize(device)
    start = time.perf_counter()
    for _ in range(TRANSFERS):
        for tensor in pinned:
            tensor.to(device, non_blocking=True)
    torch.cuda.synchronize(device)
    return (time.perf_counter() - start) / TRANSFERS


def time_batches(config: TrainConfig[Any], device: torch.device) -> dict[str, float]:
    """Seconds to make a batch, and to copy it to the device."""
    setup = TrainSetup.load(config)
    on_cuda = device.type == "cuda"
    with contextlib.ExitStack() as stack:
        images = None
        if setup.dims.cameras:
            images = stack.enter_context(ImageStore(setup.demonstrations))
        loader = Trainer(setup, None, device, Processes(), images=images).loader
        loader.batch(0)
        start, made = time.perf_counter(), min(setup.total_steps, 10)
        batches = [loader.batch(step) for step in range(made)]
        if on_cuda:
            torch.cuda.synchronize(device)
        making = (time.perf_counter() - start) / made
    transfer = time_transfer(batches[0], device) if on_cuda else float("nan")
    return {"make a batch": making, "transfer": transfer}


def time_phases(config: TrainConfig[Any]) -> dict[str, float]:
    """Seconds of each phase, means over the steps after the warm-up, from the run's metrics."""
    train(config)
    lines = [x for x in read_metrics(config.folder / METRICS) if x["kind"] == "train"]
    before, lines = lines[0], lines[1:]
    steps = np.diff([before["step"], *(line["step"] for line in lines)])
    phases = {
        phase: float(np.average([line[f"seconds_{phase}"] for line in lines], weights=steps))
        for phase in PHASES
    }
    whole = (lines[-1]["seconds"] - before["seconds"]) / steps.sum()
    return {**phases, "step": whole}


def main() -> None:
    """Print the table."""
    args = sys.argv[1:]
    if not any(arg.startswith("--steps") for arg in args):
        args += ["--steps", "50"]
    config = parse_config(args)
    device = choose_device(config.device)
    with tempfile.TemporaryDirectory() as folder:
        if config.dataset is None:
            make_episodes(Path(folder, "episodes"), config.spec.cameras, config.spec.image_size)
            config = replace(config, dataset=Path(folder, "episodes"))
        steps = config.training.steps or 0
        if steps <= WARM_UP:
            raise RequestError(f"steps {steps}: must be more than the {WARM_UP} of the warm-up")
        config = replace(
            config,
            out=Path(folder, "run"),
            logger="none",
            log_every=WARM_UP,
            validate_every=steps,
            checkpoint_every=steps,
        )
        phases = time_phases(config)
        making = time_batches(config, device)
    cameras = len(config.spec.cameras)
    precision = autocast_type(config.training.precision, device, bool(cameras))
    shape = f"{cameras} cameras"
    if cameras:
        shape += f" of {config.spec.image_size[0]}x{config.spec.image_size[1]}"
    print(
        f"{config.policy}, preset {config.preset}, batch {config.training.batch_size}, {shape}, "
        f"{describe_device(device)}, {'bf16' if precision else 'fp32'}, PyTorch "
        f"{torch.__version__}, {steps} steps"
    )
    if device.type == "cuda":
        print(f"{torch.cuda.max_memory_allocated(device) / 2**30:.2f} GiB of GPU memory")
    print("\n| phase | ms |\n|---|---|")
    rows = {"wait for data": phases.pop("data"), **making, **phases}
    for name, seconds in rows.items():
        print(f"| {name} | {'-' if np.isnan(seconds) else f'{1e3 * seconds:.2f}'} |")


if __name__ == "__main__":
    run_command(main)
