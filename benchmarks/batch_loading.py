"""Throughput of training batches: vectors alone, images held in memory, images decoded ahead.

Records a few episodes of three 480 x 640 cameras, unless --dataset names some.
Prints Markdown tables. Run: ``python benchmarks/batch_loading.py``.
"""

from __future__ import annotations

import contextlib
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from robo_manip_baselines.data import EpisodeReader, list_episodes
from robo_manip_baselines.data.demonstrations import Demonstrations, load_demonstrations
from robo_manip_baselines.data.normalization import mean_std
from robo_manip_baselines.observation import CAMERAS, ObservationSpec
from robo_manip_baselines.observation.images import fit_image
from robo_manip_baselines.observation.spec import parse_image_size
from robo_manip_baselines.rollout.demonstrate import Collection, collect
from robo_manip_baselines.runs.command import parse, run_command
from robo_manip_baselines.runs.errors import RequestError
from robo_manip_baselines.runs.images import decode_image
from robo_manip_baselines.runs.threads import processors
from robo_manip_baselines.training.images import ImageStore
from robo_manip_baselines.training.requirements import prepare_pytorch

prepare_pytorch()  # before PyTorch is imported: how its threads wait

import torch  # noqa: E402

from robo_manip_baselines.policy.interface import PolicyModel  # noqa: E402
from robo_manip_baselines.training.batching import BatchLoader, ExampleSampler  # noqa: E402
from robo_manip_baselines.training.device import choose_device  # noqa: E402

EXAMPLE = "python benchmarks/batch_loading.py --batch_size 8 --image_size 240x320"

CHUNK_SIZE, NOISE_SIZE = 100, 32  # ACT's (paper, Table III; public ACT code)


@dataclass(frozen=True)
class Options:
    """Measure how fast training batches come, and what their parts take."""

    dataset: Path | None = None
    """Folder of episodes with three cameras; recorded into a temporary folder if not given."""
    num_episodes: int = 2
    """Episodes to record, or to read of --dataset."""
    batch_size: int = 8
    """Examples of a batch."""
    batches: int = 60
    """Batches with images to time; ten times as many without."""
    image_size: str = "480x640"
    """Height x width to train at; smaller than recorded images are shrunk."""
    step_ms: float = 20.0
    """Assumed duration of a training step, in ms: the wait between steps."""
    threads: int = 0
    """Threads that decode; 0 for one for each processor."""
    device: str = "auto"
    """cpu, cuda, or auto: cuda where there is one."""


@dataclass(frozen=True)
class Source:
    """Demonstrations, and what makes batches of them."""

    demonstrations: Demonstrations
    options: Options
    device: torch.device

    @property
    def blind(self) -> Source:
        """The same without cameras."""
        given = self.demonstrations
        return replace(self, demonstrations=replace(given, spec=replace(given.spec, cameras=())))

    def loader(self, images: ImageStore | None, depth: int = 4) -> BatchLoader:
        """Make a loader over all episodes and frames."""
        given, model = self.demonstrations, PolicyModel()
        model.chunk_size, model.noise_size = CHUNK_SIZE, NOISE_SIZE
        return BatchLoader(
            given,
            mean_std(given.state, given.action),
            range(len(given.seeds)),
            ExampleSampler(given.lengths, "frame", self.options.batch_size, 0),
            model,
            seed=0,
            device=self.device,
            images=images,
            depth=depth,
        )

    def wait(self) -> None:
        """Wait until the device has done what it was asked for."""
        if self.device.type == "cuda":
            torch.cuda.synchronize(self.device)


def batch_row(name: str, source: Source, images: ImageStore | None, batches: int) -> str:
    """Time batches one after another, then with a pause for each step; return a table row."""
    loader = source.loader(images)
    first = 10
    for _ in loader.batches(0, first):
        source.wait()
    start = time.perf_counter()
    for _ in loader.batches(first, first + batches):
        source.wait()
    each = (time.perf_counter() - start) / batches
    waited = []
    with contextlib.closing(loader.batches(first, first + batches)) as ahead:
        while True:
            start = time.perf_counter()
            if next(ahead, None) is None:
                break
            source.wait()
            waited.append(time.perf_counter() - start)
            time.sleep(source.options.step_ms / 1e3)
    steady = waited[len(waited) // 5 :]  # the first ones find nothing made ahead
    return (
        f"| {name} | {each * 1e3:.2f} | {1 / each:.0f} | {np.median(steady) * 1e3:.2f} "
        f"| {np.max(steady) * 1e3:.2f} |"
    )


def phase_rows(source: Source) -> Iterator[str]:
    """Time the parts of one batch, one after another in one thread; yield table rows."""
    given, size = source.demonstrations, source.options.batch_size
    sampler = ExampleSampler(given.lengths, "frame", size, 0)
    loader = source.blind.loader(None, depth=0)
    times: dict[str, list[float]] = {}

    @contextlib.contextmanager
    def timed(name: str) -> Iterator[None]:
        start = time.perf_counter()
        yield
        source.wait()
        times.setdefault(name, []).append(time.perf_counter() - start)

    out = torch.empty((size, len(CAMERAS), *given.spec.image_size, 3), dtype=torch.uint8)
    out = out.pin_memory() if source.device.type == "cuda" else out
    with contextlib.ExitStack() as files:
        episodes = [files.enter_context(EpisodeReader(path)) for path in given.paths]
        for step in range(1, 12):
            with timed("sampler: examples of the step"):
                examples = sampler.batch(step)
            with timed("vectors: chunks, noise, copying"):
                loader.batch(step)
            chosen = [(episodes[e], c, int(t)) for e, t in examples for c in CAMERAS]
            with timed("images: reading and checksums"):
                data = [episode.encoded_frame(camera, t) for episode, camera, t in chosen]
            with timed("images: decoding"):
                decoded = [decode_image(encoded) for encoded in data]
            with timed("images: shrinking"):
                decoded = [fit_image(image, given.spec.image_size) for image in decoded]
            with timed("images: putting together"):
                joined = out.numpy().reshape(-1, *out.shape[2:])
                for place, image in enumerate(decoded):
                    joined[place] = image
            if source.device.type == "cuda":
                with timed("images: to the device"):
                    out.to(source.device, non_blocking=True)
    for name, values in times.items():
        yield f"| {name} | {np.median(values[1:]) * 1e3:.2f} |"


def load(options: Options, folder: Path) -> Demonstrations:
    """Record what is missing, then read it."""
    spec = ObservationSpec(obs="current_pred", image_size=parse_image_size(options.image_size))
    if options.dataset:
        return load_demonstrations(options.dataset, spec, limit=options.num_episodes)
    kwargs = {"cameras": CAMERAS}
    # More seeds than episodes: a failure is no demonstration.
    for seeds in (range(options.num_episodes), range(2 * options.num_episodes)):
        collect(Collection("FeedingEnv", folder, "reactive", seeds, kwargs))
        if len(list_episodes(folder)) >= options.num_episodes:
            return load_demonstrations(folder, spec, limit=options.num_episodes)
    raise RuntimeError("the expert failed in more than half of its episodes")


def main() -> None:
    """Print the tables."""
    options: Options = parse(Options, EXAMPLE)
    for name in ("num_episodes", "batch_size", "batches"):
        if getattr(options, name) < 1:
            raise RequestError(f"{name} {getattr(options, name)}: must be 1 or more")
    device = choose_device(options.device)
    with tempfile.TemporaryDirectory() as folder:
        given = load(options, Path(folder))
        source = Source(given, options, device)
        height, width = given.spec.image_size
        print(
            f"batch size {options.batch_size}, chunk size {CHUNK_SIZE}, {len(CAMERAS)} cameras of "
            f"{height}x{width}; {len(given.paths)} episodes, {given.offsets[-1]} steps; "
            f"{device_name(device)}, {processors()} processors"
        )
        print("\n| phase of one batch, one thread | ms |\n|---|---|")
        print("\n".join(phase_rows(source)), flush=True)
        step = f"{options.step_ms:g} ms"
        print(
            f"\n| batches | ms | a second | wait between steps of {step}, median | largest |"
            "\n|---|---|---|---|---|"
        )
        print(batch_row("vectors only", source.blind, None, 10 * options.batches), flush=True)
        threads = options.threads or None
        with ImageStore(given, memory_budget=0, threads=threads) as images:
            print(batch_row("images decoded ahead", source, images, options.batches), flush=True)
        start = time.perf_counter()
        with ImageStore(given, threads=threads) as images:
            loading = time.perf_counter() - start
            if images.held is None:
                print("\nnot enough free memory to hold all images")
                return
            print(batch_row("images held", source, images, options.batches))
            print(f"\nholding {images.held.nbytes / 1e9:.2f} GB of images took {loading:.1f} s")


def device_name(device: torch.device) -> str:
    """Say what the device is."""
    return torch.cuda.get_device_name(device) if device.type == "cuda" else "CPU"


if __name__ == "__main__":
    run_command(main)
