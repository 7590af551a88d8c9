"""What carries out a training run, put together where a checkpoint left off."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import safetensors.torch
import torch

from robo_manip_baselines.data.demonstrations import Demonstrations
from robo_manip_baselines.policy.checkpoint import MODEL, Checkpoint, read_trainer
from robo_manip_baselines.training.device import autocast_type
from robo_manip_baselines.training.distributed import Processes
from robo_manip_baselines.training.frames import FrameSource, free_memory
from robo_manip_baselines.training.job import Job
from robo_manip_baselines.training.loader import BatchLoader
from robo_manip_baselines.training.metrics import RunningMean
from robo_manip_baselines.training.state_noise import StateNoise
from robo_manip_baselines.training.step import TrainStep
from robo_manip_baselines.training.trainer_state import Progress, restore
from robo_manip_baselines.training.validation import Validation


@dataclass(frozen=True)
class Parts:
    """What a run is carried out with.

    Attributes:
        train_step: the network with its optimiser, where training begins or goes on.
        mean: of the losses since they were last written.
        progress: how far the run has come.
        loader: of the training batches.
        validation: None without episodes held out, and in all processes but the first.
    """

    train_step: TrainStep
    mean: RunningMean
    progress: Progress
    loader: BatchLoader
    validation: Validation | None


@contextmanager
def assembled(
    job: Job, start: Checkpoint | None, device: torch.device, processes: Processes
) -> Iterator[Parts]:
    """Put the parts of a run together; images are held or read while the block lasts.

    Args:
        job: what to train on what.
        start: where to go on from, None to begin.
        device: to train on.
        processes: that train together.

    Raises:
        RequestError: the network cannot be built, the device lacks the precision, or the
            checkpoint has lost what training needs.
    """
    settings, seed = job.options.training, job.options.seed
    autocast = autocast_type(settings.precision, device, bool(job.sizes.cameras))
    model = job.make_model(is_start=start is None).to(device)
    train_step = TrainStep(
        model,
        settings,
        total_steps=job.total_steps,
        seed=seed,
        autocast=autocast,
        processes=processes,
    )
    mean, progress = RunningMean(), Progress()
    if start:
        weights = safetensors.torch.load_file(start.folder / MODEL)
        progress = restore(train_step, mean, weights, *read_trainer(start))
    with _frames(job.demonstrations) as frames:
        loader = BatchLoader(
            job.demonstrations,
            job.normalization,
            job.demonstrations.indices(job.split.train),
            job.schedule,
            chunk_size=model.chunk_size,
            noise_size=model.noise_size,
            state_noise=StateNoise.of(job.demonstrations.spec, settings),
            seed=seed,
            device=device,
            rank=processes.rank,
            world_size=processes.world_size,
            frames=frames,
        )
        validation = None
        if job.split.validation and processes.is_main:
            validation = Validation(
                job.demonstrations,
                job.normalization,
                frames,
                episodes=job.demonstrations.indices(job.split.validation),
                batch_size=settings.batch_size,
                seed=seed,
                model=model,
                device=device,
                autocast=autocast,
            )
        yield Parts(train_step, mean, progress, loader, validation)


def _frames(
    demonstrations: Demonstrations,
) -> contextlib.AbstractContextManager[FrameSource | None]:
    if not demonstrations.spec.cameras:
        return contextlib.nullcontext()
    # Half of what is free is the source's own measure; the processes of one machine share it.
    share = free_memory() // 2 // int(os.environ.get("LOCAL_WORLD_SIZE", "1"))
    return FrameSource(demonstrations, memory_budget=share)
