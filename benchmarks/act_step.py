"""Time of a training step and of a prediction of ACT, beside the public code's way of computing.

Both networks have the same layers and sizes (the paper's Table III unless options say otherwise)
and random weights; how the other one computes is in `act_public.py`.
Prints Markdown tables. Run: ``python benchmarks/act_step.py``.
"""

from __future__ import annotations

import copy
import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass, fields
from itertools import pairwise
from typing import Any, cast

from robo_manip_baselines.runs.command import parse, run_command
from robo_manip_baselines.training.requirements import prepare_pytorch

prepare_pytorch()  # before PyTorch is imported: how its threads wait

import torch  # noqa: E402
from act_public import PublicWay  # noqa: E402
from torch import Tensor  # noqa: E402

from robo_manip_baselines.policy.act.config import ActConfig  # noqa: E402
from robo_manip_baselines.policy.act.model import ActModel  # noqa: E402
from robo_manip_baselines.policy.cuda_graph import WARM_UP, Replay  # noqa: E402
from robo_manip_baselines.policy.interface import Batch, PolicyDims, PolicyModel  # noqa: E402
from robo_manip_baselines.policy.presets import TrainSettings  # noqa: E402
from robo_manip_baselines.runs.errors import RequestError, require_choice  # noqa: E402
from robo_manip_baselines.training.device import (  # noqa: E402
    StepTimer,
    choose_device,
    prepare_device,
)
from robo_manip_baselines.training.state import TrainerState  # noqa: E402
from robo_manip_baselines.training.step import LossModule, TrainingStep, map_batch  # noqa: E402

PHASES = ("transfer", "forward", "backward", "optimiser")
LEARNING_RATE = 1e-5
WEIGHT_DECAY = 1e-4
LONGEST = 30
"""Operators and kernels in a profile."""
SHAPES = 70
"""Characters of an operator's shapes."""


@dataclass(frozen=True)
class Options:
    """Time ACT: phases of a training step, and predictions."""

    device: str = "auto"
    """auto, cpu or cuda."""
    precision: str = "bf16"
    """bf16 (autocast) or fp32, of our network; the other one is fp32."""
    compile: bool = False
    """Use torch.compile for our network."""
    cuda_graph: bool = False
    """Replay our step and our prediction from CUDA graphs; CUDA only."""
    batch_size: int = 8
    """Examples in a training step."""
    steps: int = 5
    """Training steps of each, in turn, after some to warm up."""
    predictions: int = 30
    """Predictions of one example by each."""
    num_cameras: int = 3
    """Cameras; 0 for none."""
    image_size: tuple[int, int] = (480, 640)
    """Height and width."""
    state_size: int = 14
    """Numbers of the state."""
    action_size: int = 7
    """Numbers of an action."""
    threads: int = 2
    """Threads of the processor."""
    processor_time: bool = False
    """Count the seconds that processors work, not those that pass: for a machine that others use
    too. With --threads 1; CPU only."""
    public: bool = True
    """Time the public code's way, too."""
    profile: bool = False
    """Say in which operators and kernels our steps spend the GPU's time; CUDA only."""

    def __post_init__(self) -> None:
        require_choice("device", self.device, ("auto", "cpu", "cuda"))
        require_choice("precision", self.precision, ("bf16", "fp32"))
        for name in ("cuda_graph", "profile"):
            if getattr(self, name) and self.where.type != "cuda":
                raise RequestError(f"{name}: needs a CUDA device; leave it out")

        if self.processor_time and self.where.type != "cpu":
            raise RequestError("processor_time: says nothing about a GPU; leave it out")

    @property
    def clock(self) -> Callable[[], float]:
        """Clock, in seconds."""
        return time.process_time if self.processor_time else time.perf_counter

    @property
    def where(self) -> torch.device:
        """The device that ``device`` names."""
        return choose_device(self.device)


def make_batch(options: Options, size: int, as_float: bool) -> Batch:
    """A batch in main memory; images as each of the two networks wants them."""
    generator = torch.Generator().manual_seed(0)
    chunk = ActConfig().chunk_size
    is_pad = torch.arange(chunk)[None] >= torch.linspace(chunk // 5, chunk, size).long()[:, None]
    shape = (size, 1, options.num_cameras, *options.image_size, 3)
    images = torch.randint(0, 256, shape, generator=generator, dtype=torch.uint8)
    if as_float:
        images = images.permute(0, 1, 2, 5, 3, 4).float().div_(255.0).contiguous()
    batch = Batch(
        state=torch.randn(size, 1, options.state_size, generator=generator),
        images=images if options.num_cameras else None,
        action=torch.randn(size, chunk, options.action_size, generator=generator),
        is_pad=is_pad,
        noise=torch.randn(size, ActConfig().latent_size, generator=generator),
        num_valid=(~is_pad).sum().float(),
        num_examples=torch.tensor(float(size)),
    )
    if options.where.type == "cuda":
        batch = map_batch(batch, lambda value: value.pin_memory())
    return batch


def _copy(source: Batch, target: Batch) -> None:
    """Overwrite the tensors of ``target``."""
    for field in fields(Batch):
        value = getattr(source, field.name)
        if value is not None:
            getattr(target, field.name).copy_(value, non_blocking=True)


def _wait(device: torch.device) -> None:
    """Let the device finish what it was given."""
    if device.type == "cuda":
        torch.cuda.synchronize()


class PublicStep:
    """A step of training as public code does it: in fp32, with AdamW."""

    def __init__(self, model: PolicyModel) -> None:
        groups = cast("Any", model.parameter_groups(LEARNING_RATE))
        self.model, self.optimizer = model, torch.optim.AdamW(groups, weight_decay=WEIGHT_DECAY)

    def __call__(self, batch: Batch, mark: Callable[[str], None]) -> None:
        """Change the weights."""
        loss = self.model.loss(batch)["loss"]
        mark("forward")
        loss.backward()
        mark("backward")
        self.optimizer.step()
        self.optimizer.zero_grad(set_to_none=True)


class OurStep:
    """A step of training as the trainer does it."""

    def __init__(self, model: PolicyModel, options: Options) -> None:
        settings = TrainSettings(learning_rate=LEARNING_RATE, weight_decay=WEIGHT_DECAY, epochs=1)
        loss: Any = LossModule(model)
        self.mark: Callable[[str], None] = lambda phase: None
        self.step = TrainingStep(
            torch.compile(loss) if options.compile else loss,
            TrainerState(model, settings),
            autocast=torch.bfloat16 if options.precision == "bf16" else None,
            clip_norm=settings.clip_norm,
            timer=cast("StepTimer", self),
            is_recorded=options.cuda_graph,
        )

    def __call__(self, batch: Batch, mark: Callable[[str], None]) -> None:
        """Change the weights; a recorded step is all in its forward phase."""
        self.mark = mark
        self.step(batch)


class TimedNetwork:
    """Runs steps of one network and takes the time of each phase."""

    def __init__(self, model: PolicyModel, batch: Batch, options: Options, ours: bool) -> None:
        self.device, self.clock, self.host_batch = options.where, options.clock, batch
        model = model.to(self.device).train()
        self.step: Callable[[Batch, Callable[[str], None]], None]
        self.step = OurStep(model, options) if ours else PublicStep(model)

    def load(self) -> Batch:
        """Bring the batch from main memory."""
        return map_batch(self.host_batch, lambda v: v.to(self.device, non_blocking=True))

    def phases(self) -> list[float]:
        """Seconds of each phase of a step."""
        marks: list[float] = []

        def mark(phase: str) -> None:
            _wait(self.device)
            marks.append(self.clock())

        mark("start")
        batch = self.load()
        mark("transfer")
        self.step(batch, mark)
        mark("optimiser")
        return [after - before for before, after in pairwise(marks)]

    def run(self, steps: int) -> float:
        """Seconds a step when nothing waits between the phases."""
        _wait(self.device)
        start = self.clock()
        for _ in range(steps):
            self.step(self.load(), lambda phase: None)
        _wait(self.device)
        return (self.clock() - start) / steps


def predictor(model: PolicyModel, options: Options, ours: bool) -> Callable[[], Tensor]:
    """A prediction for one example, from images in main memory to actions in main memory."""
    device = options.where
    batch = make_batch(options, 1, as_float=not ours)
    model = model.to(device).eval()
    if ours and isinstance(model, ActModel):
        model = model.for_inference(
            torch.bfloat16 if options.precision == "bf16" else torch.float32
        )
    predict = torch.compile(model.predict) if ours and options.compile else model.predict
    on_device = map_batch(batch, lambda value: value.to(device))

    @torch.inference_mode()
    def eager() -> Tensor:
        images = None if batch.images is None else batch.images.to(device, non_blocking=True)
        return predict(batch.state.to(device, non_blocking=True), images, None).cpu()

    if not (ours and options.cuda_graph):
        return eager
    forward = Replay(lambda: predict(on_device.state, on_device.images, None), device)

    @torch.inference_mode()
    def replayed() -> Tensor:
        _copy(batch, on_device)
        return forward().cpu()

    return replayed


def time_predictions(predict: Callable[[], Tensor], number: int, clock: Callable[[], float]) -> str:
    """Mean, median and 95th percentile in milliseconds, as cells of a table."""
    for _ in range(WARM_UP + 1):
        predict()
    times = []
    for _ in range(number):
        start = clock()
        predict()
        times.append(1e3 * (clock() - start))
    last = statistics.quantiles(times, n=20, method="inclusive")[-1] if len(times) > 1 else times[0]
    return f"{statistics.fmean(times):.1f} | {statistics.median(times):.1f} | {last:.1f}"


def main() -> None:
    """Print both tables."""
    options = parse(Options, example="python benchmarks/act_step.py --steps 3")
    torch.set_num_threads(options.threads)
    torch.manual_seed(0)
    device = options.where
    prepare_device(device, options.compile)
    name = torch.cuda.get_device_name() if device.type == "cuda" else f"{options.threads} threads"
    height, width = options.image_size
    print(
        f"{device.type} ({name}), torch {torch.__version__}, batch {options.batch_size}, "
        f"{options.num_cameras} cameras of {height}x{width}, ours {options.precision}"
        f"{', compiled' * options.compile}{', CUDA graph' * options.cuda_graph}"
        f"{', processor time' * options.processor_time}"
    )
    dims = PolicyDims(
        options.state_size, options.action_size, options.num_cameras, options.image_size
    )
    models: dict[str, PolicyModel] = {"ours": ActModel(ActConfig(), dims)}
    if options.public:
        models["public way"] = PublicWay(ActConfig(paper_compat=True), dims)
    if options.steps:
        networks = {
            key: TimedNetwork(
                model,
                make_batch(options, options.batch_size, as_float=key != "ours"),
                options,
                ours=key == "ours",
            )
            for key, model in models.items()
        }
        print_steps(networks, options.steps)
        if options.profile:
            batch = make_batch(options, options.batch_size, as_float=False)
            first = TimedNetwork(copy.deepcopy(models["ours"]), batch, options, ours=True)
            print_kernels(networks["ours"], first, options.steps)
    if options.predictions:
        print("\n| one prediction | mean, ms | median, ms | 95 %, ms |\n|---|---|---|---|")
        for key, model in models.items():
            cells = time_predictions(
                predictor(model, options, ours=key == "ours"), options.predictions, options.clock
            )
            print(f"| {key} | {cells} |", flush=True)


def print_steps(networks: dict[str, TimedNetwork], steps: int) -> None:
    """Steps of each network in turn, so that whatever else the machine does is shared."""
    for network in networks.values():
        for _ in range(WARM_UP + 1):
            network.phases()
    phases: dict[str, list[list[float]]] = {key: [] for key in networks}
    for _ in range(steps):
        for key, network in networks.items():
            phases[key].append(network.phases())
    print(f"\n| training step, ms | {' | '.join(PHASES)} | sum | without waiting |")
    print("|---|" + "---|" * (len(PHASES) + 2))
    sums: dict[str, float] = {}
    for key, rows in phases.items():
        medians = [statistics.median(column) for column in zip(*rows, strict=True)]
        sums[key] = sum(medians)
        cells = [*medians, sums[key], networks[key].run(steps)]
        print(f"| {key} | {' | '.join(f'{1e3 * cell:.1f}' for cell in cells)} |", flush=True)
    if len(sums) == 2:
        print(f"\nours is {sums['public way'] / sums['ours']:.1f} times as fast")


def print_kernels(network: TimedNetwork, first: TimedNetwork, steps: int) -> None:
    """Where the GPU's time goes in a step: in which operators, of what shapes, and which kernels.

    Operators are those of the second step of ``first``, whose kernels are launched one by one also
    where later ones are replayed; kernels those of the steps as they are timed, the longest first.
    """
    from torch.profiler import ProfilerActivity, profile

    first.run(1)
    activities = [ProfilerActivity.CPU, ProfilerActivity.CUDA]
    with profile(activities=activities, record_shapes=True) as profiler:
        first.run(1)
    operators = [
        event
        for event in profiler.key_averages(group_by_input_shape=True)
        if event.self_device_time_total > 0 and event.input_shapes
    ]
    operators.sort(key=lambda event: -event.self_device_time_total)
    print("\n| operator | shapes | calls | ms |\n|---|---|---|---|")
    for event in operators[:LONGEST]:
        shapes = " ".join("x".join(map(str, shape)) for shape in event.input_shapes if shape)
        cells = f"{event.count} | {event.self_device_time_total / 1e3:.3f}"
        print(f"| {event.key} | {shapes[:SHAPES]} | {cells} |")

    with profile(activities=[ProfilerActivity.CUDA]) as profiler:
        seconds = network.run(steps)
    kernels = [e for e in profiler.key_averages() if e.self_device_time_total > 0]
    kernels.sort(key=lambda event: -event.self_device_time_total)
    busy = sum(event.self_device_time_total for event in kernels) / steps / 1e3
    calls = sum(event.count for event in kernels) / steps
    print(f"\n| kernel, of {1e3 * seconds:.2f} ms a step | calls | ms |\n|---|---|---|")
    for event in kernels[:LONGEST]:
        cells = f"{event.count / steps:.1f} | {event.self_device_time_total / steps / 1e3:.3f}"
        print(f"| {event.key[:70]} | {cells} |")
    print(
        f"| all kernels and copies, some of them at once | {calls:.0f} | {busy:.2f} |", flush=True
    )


if __name__ == "__main__":
    run_command(main)
