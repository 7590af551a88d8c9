"""The training loop, and the loss on the episodes held out."""

from __future__ import annotations

import contextlib
import logging
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torch import nn
from torch.nn.parallel import DistributedDataParallel

from robo_manip_baselines.envs.mujoco.tasks.registry import task_entry
from robo_manip_baselines.policy.checkpoint import Checkpoint, write_checkpoint
from robo_manip_baselines.policy.interface import PolicyModel
from robo_manip_baselines.runs.checkpoints import (
    BEST,
    prune_checkpoints,
    remove_later_checkpoints,
    remove_partial_checkpoints,
    step_folder,
)
from robo_manip_baselines.runs.command import EXIT_INTERRUPTED
from robo_manip_baselines.runs.errors import RequestError
from robo_manip_baselines.runs.extras import pip_install
from robo_manip_baselines.runs.files import locked, require_out_folder
from robo_manip_baselines.runs.interrupt import StopRequest
from robo_manip_baselines.runs.metrics import MetricsLog, read_metrics, write_curves
from robo_manip_baselines.runs.progress import StepProgress
from robo_manip_baselines.runs.seeds import derive_seed
from robo_manip_baselines.training.augmentation import ImageAugmentation
from robo_manip_baselines.training.batching import (
    BatchLoader,
    ExampleSampler,
    ObjectNoise,
    StateNoise,
)
from robo_manip_baselines.training.config import CURVES, METRICS, RUN, TrainConfig
from robo_manip_baselines.training.device import (
    Processes,
    StepTimer,
    autocast_type,
    choose_device,
    describe_device,
    prepare_device,
)
from robo_manip_baselines.training.images import ImageStore
from robo_manip_baselines.training.setup import TrainSetup
from robo_manip_baselines.training.state import (
    TrainerState,
    learning_rate_factor,
    set_learning_rate,
)
from robo_manip_baselines.training.step import LossModule, TrainingStep

KEPT_CHECKPOINTS = 2

HELD_OUT_STARTS = 8
"""Examples of each episode: enough for a smooth curve, little of training's time."""

_STEPS_BETWEEN_VOTES = 10
"""On several GPUs, steps between asking whether any process is to stop: asking waits."""

logger = logging.getLogger(__name__)


def train(config: TrainConfig[Any], *, resume: bool = False) -> int:
    """Train a policy until the budget is spent or somebody asks to stop.

    Writes the run folder, ``config.folder``: options, checkpoints, metrics and their curves. Under
    ``torchrun`` every process calls this.

    Returns the exit code: 0, or 130 after an interruption whose state is saved. With ``resume`` the
    run in the run folder, if there is one, is continued.

    Raises:
        RequestError: the configuration does not fit the demonstrations, the machine or the run
            folder, or the loss is not finite any more.
    """
    processes = Processes.from_environment()
    if not processes.is_main:
        logging.getLogger().setLevel(logging.WARNING)
    device = choose_device(config.device, processes.local_rank)
    prepare_device(device, config.training.compile)
    with processes.joined(device):
        # A function of its own: nothing of it must outlive the block and hold on to the processes.
        return _train(config, resume, device, processes)


def _train(
    config: TrainConfig[Any], resume: bool, device: torch.device, processes: Processes
) -> int:
    if processes.is_main:
        require_out_folder(config.folder, RUN, [config.demonstrations])
    setup = TrainSetup.load(config)
    with contextlib.ExitStack() as stack:
        if processes.is_main:
            stack.enter_context(locked(config.folder))
        start = setup.find_start(resume)
        before = EarlyStopping.of_run(config, start.step if start else 0)
        if start and start.step >= setup.total_steps:
            done = config.folder, start.step
            logger.info("%s is finished: %d steps; a larger --steps extends it", *done)
        elif start and before.is_over:
            done = config.folder, start.step, before
            logger.info("%s is finished: %d steps, %s; --early_stopping 0 extends it", *done)
        else:
            processes.wait()  # until every process has seen the folder as it was
            log = stack.enter_context(setup.open_log(start)) if processes.is_main else None
            images = None
            if setup.dims.cameras:
                images = stack.enter_context(ImageStore(setup.demonstrations))
            trainer = Trainer(setup, start, device, processes, images=images, log=log)
            stop = stack.enter_context(StopRequest(once_more=processes.world_size == 1))
            if trainer.run(stop) < setup.total_steps and not trainer.ended_early:
                return EXIT_INTERRUPTED
        if processes.is_main:
            run = config.folder
            if write_curves(run / CURVES, read_metrics(run / METRICS), config.name):
                logger.info("curves: %s", run / CURVES)
            else:
                logger.info("no image of the curves; run: %s", pip_install("matplotlib"))
    return 0


class EarlyStopping:
    """End of a training after a number of validations without a smaller loss.

    Args:
        patience: that number; 0 never ends it.

    Attributes:
        best: smallest loss so far.
        best_step: steps that had been done then.
        waited: validations since.
    """

    def __init__(self, patience: int) -> None:
        self._patience = patience
        self.best, self.best_step, self.waited = math.inf, 0, 0

    @classmethod
    def of_run(cls, config: TrainConfig[Any], step: int) -> EarlyStopping:
        """Return what the validations of a run's first steps, up to ``step``, have led to."""
        state = cls(config.training.early_stopping)
        for line in read_metrics(config.folder / METRICS) if state._patience and step else ():
            if line["kind"] == "validation" and line["step"] <= step and "loss" in line:
                state.add(line["step"], line["loss"])
        return state

    def add(self, step: int, loss: float) -> bool:
        """Include a validation; return whether its loss is the smallest."""
        if loss < self.best:
            self.best, self.best_step, self.waited = loss, step, 0
            return True
        self.waited += 1
        return False

    @property
    def is_over(self) -> bool:
        """True if the training ends here."""
        return 0 < self._patience <= self.waited

    def __bool__(self) -> bool:
        """Return whether the training may end early."""
        return self._patience > 0

    def __str__(self) -> str:
        return (
            f"{self.waited} validations after the smallest held-out loss, {self.best:.4g} at step "
            f"{self.best_step}"
        )


class Trainer:
    """One process of a training run, at its beginning or at a checkpoint.

    Args:
        setup: of the run.
        start: checkpoint to continue, None to begin.
        device: of the network.
        processes: that train together.
        images: None without cameras.
        log: None in all processes but the first.

    Attributes:
        state: network, optimiser and moving average.
        loader: of the training batches.
        held_out: loss on the episodes held out; None without any, and in all processes but the
            first.
        ended_early: whether `run` ended by early stopping.

    Raises:
        RequestError: the network cannot be built, the device lacks the precision, or the
            checkpoint lacks the trainer's state.
    """

    def __init__(
        self,
        setup: TrainSetup,
        start: Checkpoint | None,
        device: torch.device,
        processes: Processes,
        *,
        images: ImageStore | None = None,
        log: MetricsLog | None = None,
    ) -> None:
        config, given, settings = setup.config, setup.demonstrations, setup.config.training
        self._setup, self._device, self._processes, self._log = setup, device, processes, log
        self._autocast = autocast_type(settings.precision, device, bool(given.spec.cameras))
        model = setup.make_model(initial_weights=start is None).to(device)
        self.state = TrainerState(model, settings)
        seconds = self.state.restore(start) if start else 0.0
        self._saved_step = start.step if start else 0
        self._early, self.ended_early = EarlyStopping.of_run(config, self._saved_step), False
        if processes.is_main and self._early:
            remove_partial_checkpoints(config.folder / BEST)
            remove_later_checkpoints(config.folder / BEST, self._saved_step)
        done = setup.total_steps, self._saved_step, seconds
        self._progress = StepProgress(*done, shown=processes.is_main)
        self._timer = StepTimer(device)
        loss: nn.Module = LossModule(model)
        if processes.world_size > 1:
            loss = DistributedDataParallel(loss, gradient_as_bucket_view=True)
        self._step = TrainingStep(
            torch.compile(loss) if settings.compile else loss,
            self.state,
            autocast=self._autocast,
            clip_norm=settings.clip_norm,
            timer=self._timer,
            is_recorded=settings.cuda_graph and device.type == "cuda" and processes.world_size == 1,
        )
        names = task_entry(config.env).names
        noise = StateNoise(given.spec, names, settings.state_noise, settings.clock_noise)
        augment: ImageAugmentation | None = None
        if images is not None and settings.augment != "none":
            changes = settings.augment, images.shape, settings.augment_shift
            augment = ImageAugmentation(*changes)
        episodes = given.indices(setup.split.train)
        self.loader = BatchLoader(
            *(given, setup.normalization, episodes, setup.sampler, model),
            seed=config.seed,
            device=device,
            rank=processes.rank,
            world_size=processes.world_size,
            encoding=setup.encoding,
            skip=settings.skip,
            state_noise=noise,
            object_noise=ObjectNoise(given, names, setup.normalization, settings.object_noise),
            action_noise=settings.action_noise,
            intervention_weight=settings.intervention_weight,
            images=images,
            augment=augment,
        )
        self.held_out: HeldOutLoss | None = None
        if setup.split.validation and processes.is_main:
            self.held_out = HeldOutLoss(setup, model, images, device, self._autocast)
        self._announce()

    def run(self, stop: StopRequest) -> int:
        """Train until the budget is spent or a stop is requested; return the steps done in all.

        Raises:
            RequestError: the loss is not finite any more.
        """
        config, total_steps = self._setup.config, self._setup.total_steps
        settings, model, optimizer = config.training, self.state.model, self.state.optimizer
        timer, progress = self._timer, self._progress
        batches = self.loader.batches(progress.step, total_steps)
        with progress, contextlib.closing(batches):
            timer.skip()
            for batch in batches:
                timer.mark("data")
                step = progress.step
                if not model.training:
                    model.train()
                torch.manual_seed(derive_seed(config.seed, "dropout", self._processes.rank, step))
                set_learning_rate(optimizer, learning_rate_factor(step, total_steps, settings))
                losses = self._step(batch)
                if self.state.average:
                    self.state.average.update(step)
                timer.mark("optimizer")
                self.state.losses.add(losses)
                progress.advance()

                is_stopping = self._is_stopping(stop)
                if progress.is_due(config.log_every):
                    progress.report(self._log_losses())
                if progress.is_due(config.validate_every):
                    self._validate()
                    is_stopping |= self.ended_early
                if progress.is_due(config.checkpoint_every) or is_stopping:
                    self._save()
                if is_stopping:
                    break
                timer.skip()
        return progress.step

    def _is_stopping(self, stop: StopRequest) -> bool:
        """Return whether any process was asked to stop."""
        waits = self._processes.world_size > 1 and self._device.type == "cuda"
        if waits and self._progress.step % _STEPS_BETWEEN_VOTES:
            return False
        return self._processes.any(stop.is_made, self._device)

    def _validate(self) -> None:
        """Write the loss on the episodes held out, keep the best checkpoint, and perhaps end."""
        if self.held_out:
            losses = self.held_out(self.state.evaluated)
            self._write("validation", losses)
            if self._early and self._early.add(self._progress.step, losses["loss"]):
                self._write_checkpoint(self._setup.config.folder / BEST)
        if self._early and self._processes.any(self._early.is_over, self._device):
            self.ended_early = True
            if self._processes.is_main:
                logger.info("stopped early: %s", self._early)

    def _log_losses(self) -> float:
        """Write the mean losses since the last line; return the loss."""
        means = self._processes.mean(self.state.losses.means()).tolist()  # the one transfer
        losses = dict(zip(self.state.losses.names, means, strict=True))
        self.state.losses.reset()
        self._require_finite(math.isfinite(losses["loss"]))
        values = {
            **losses,
            "learning_rate": float(self.state.optimizer.param_groups[0]["lr"]),
            "seconds": self._progress.seconds,
            **{f"seconds_{phase}": seconds for phase, seconds in self._timer.read().items()},
        }
        self._write("train", values)
        return losses["loss"]

    def _write(self, kind: str, values: Mapping[str, float]) -> None:
        if self._log:
            step = self._progress.step
            self._log.write(kind, step, {"epoch": self._setup.sampler.epochs(step), **values})

    def _save(self) -> None:
        """Write a checkpoint, if all weights are finite, and remove old ones."""
        weights = self.state.evaluated.state_dict()
        flags = [torch.isfinite(v).all() for v in weights.values() if v.is_floating_point()]
        if self.state.losses.sums is not None:
            flags.append(self.state.losses.sums.isfinite().all())
        self._require_finite(bool(torch.stack(flags).all()))
        if self._processes.is_main:
            run = self._setup.config.folder
            self._write_checkpoint(run)
            self._saved_step = self._progress.step
            prune_checkpoints(run, KEPT_CHECKPOINTS)
            # Not before: a run that is killed goes on from here, and has the best one until here.
            prune_checkpoints(run / BEST, 1)

    def _write_checkpoint(self, run: Path) -> None:
        """Write a checkpoint into a run folder."""
        step, weights = self._progress.step, self.state.evaluated.state_dict()
        tensors, json = self.state.state_dict(step, self._progress.seconds)
        checkpoint = self._setup.checkpoint(step)
        write_checkpoint(step_folder(run, step), checkpoint, weights, tensors, json)

    def _require_finite(self, is_finite: bool) -> None:
        if self._processes.any(not is_finite, self._device):
            saved = self._saved_step
            kept = f"; the checkpoint of step {saved} is kept" if saved else ""
            raise RequestError(
                f"the loss is not finite any more at step {self._progress.step}; lower "
                f"--learning_rate, try --clip_norm 1 or --precision fp32{kept}"
            )

    def _announce(self) -> None:
        setup, config, sampler = self._setup, self._setup.config, self._setup.sampler
        total, processes = setup.total_steps, self._processes.world_size
        examples = "starts" if config.training.sampler == "episode" else "frames"
        parameters = list(self.state.model.parameters())
        for line in (
            f"preset: {config.preset}, seed {config.seed}",
            f"run folder: {config.folder}"
            + (f", resumed at step {self._saved_step}" if self._saved_step else ""),
            f"episodes: {len(setup.split.train)} for training, {len(setup.split.validation)} held "
            "out",
            f"budget: {sampler.epochs(total):.4g} epochs x {sampler.frames_per_epoch} {examples} = "
            f"{total} steps of {sampler.batch_size} = {total * sampler.batch_size} frames",
            f"device: {describe_device(self._device)}"
            + (f", {processes} processes" if processes > 1 else "")
            + f", precision {'bf16' if self._autocast else 'fp32'}",
            f"{config.policy}: {sum(p.numel() for p in parameters):,} weights, "
            f"{sum(p.numel() for p in parameters if p.requires_grad):,} trained",
        ):
            logger.info("%s", line)


class HeldOutLoss:
    """Mean loss over fixed examples of the episodes held out, always with the same noise.

    Of ``model`` the chunk size, observation steps and noise size are read; ``images`` are None
    without cameras, ``autocast`` in fp32.
    """

    def __init__(
        self,
        setup: TrainSetup,
        model: PolicyModel,
        images: ImageStore | None,
        device: torch.device,
        autocast: torch.dtype | None,
    ) -> None:
        seed = derive_seed(setup.config.seed, "validation")
        given, batch_size = setup.demonstrations, setup.config.training.batch_size
        episodes = given.indices(setup.split.validation)
        sampler = ExampleSampler(given.lengths[list(episodes)], "episode", batch_size, seed)
        data = given, setup.normalization, episodes, sampler, model
        coding: Any = {"encoding": setup.encoding, "skip": setup.config.training.skip}
        self._loader = BatchLoader(*data, seed=seed, device=device, images=images, **coding)
        self._steps = -(-HELD_OUT_STARTS * len(episodes) // batch_size)
        self._device, self._autocast = device, autocast

    @torch.no_grad()
    def __call__(self, model: PolicyModel) -> dict[str, float]:
        """Return the mean of each part of the loss, every valid step counting the same."""
        was_training = model.training
        model.eval()
        names: list[str] = []
        sums, weight = torch.zeros((), device=self._device), torch.zeros((), device=self._device)
        autocast = torch.autocast(self._device.type, self._autocast, enabled=bool(self._autocast))
        with autocast, contextlib.closing(self._loader.batches(0, self._steps)) as batches:
            for batch in batches:
                parts = model.loss(batch)
                names = list(parts)
                values = torch.stack([value.double() for value in parts.values()])
                sums = sums + values * batch.num_valid
                weight = weight + batch.num_valid
        model.train(was_training)
        return dict(zip(names, (sums / weight).tolist(), strict=True))
