"""The paper's three approaches on the same footage: Tables I and II, by sequence and by person.

Trains each approach under both splits and several seeds, evaluates them side by side with
``face-prediction evaluate``, and writes ``approaches.md``: Tables I and II over the seeds beside
the paper's, the order of the approaches, and a line for each training that shows if it has gone
flat. A call that was stopped goes on where it was, calls for some of the approaches, splits or
seeds add to one folder, and a larger number of steps extends the trainings that are there:

    python benchmarks/approaches.py --dataset face_dataset --splits sequence --seeds 0 --steps 4000

The seed of a training is also the number of the part that it leaves for the report.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any, Literal

import numpy as np

from face_prediction.commands.evaluate import EvaluateOptions, run_evaluate
from face_prediction.commands.fit import FitOptions, run_fit
from face_prediction.commands.train import run_train
from face_prediction.dataset.sequences import KINDS
from face_prediction.dataset.split import SplitName
from face_prediction.evaluation.tables import PAPER_TABLE_1, PAPER_TABLE_2, RESULTS
from face_prediction.models.settings import Decay
from face_prediction.training.options import FaceTrainOptions
from robo_manip_baselines.runs.command import parse, run_command
from robo_manip_baselines.runs.documents import read_json
from robo_manip_baselines.runs.errors import RequestError, require_choice
from robo_manip_baselines.runs.files import file_digest, write_text
from robo_manip_baselines.runs.markdown import markdown_table
from robo_manip_baselines.runs.metrics import read_metrics
from robo_manip_baselines.runs.ranges import Amount, Count, Fraction, Seed

EXAMPLE = "python benchmarks/approaches.py --dataset face_dataset --splits sequence --seeds 0"

APPROACHES: dict[str, tuple[str, tuple[str, ...]]] = {
    "cross_attention": ("cross_attention", ()),
    "simple_fusion": ("simple_fusion", ()),
    "cross_attention_residual": ("cross_attention", ("residual=true",)),
    "image_only": ("image_only", ()),
    "residual": ("residual", ()),
}
"""Row of the tables -> network and settings; ``residual`` is fitted, not trained."""
PAPER_NAMES = {
    "image_only": PAPER_TABLE_1[0][0],
    "simple_fusion": PAPER_TABLE_1[1][0],
    "cross_attention": PAPER_TABLE_1[2][0],
}
"""Row of the tables -> that of the paper's Table I."""
SPLITS: tuple[SplitName, ...] = ("sequence", "person")
BASELINES = ("persistence", "ar_landmarks")

CHANNELS = {32: (8, 16, 32), 64: (8, 16, 32, 64), 128: (8, 16, 32, 64, 64)}
"""Convolutions for images of a size: those of the preset cpu, with one less or more."""

TABLE, TIMES = "approaches.md", "times.md"
RUNS, EVALUATIONS = "runs", "evaluations"

TIMED_STEPS = 8
"""Steps of training whose processor time is measured, after two others; the median counts."""


@dataclass(frozen=True)
class Options:
    """Train the paper's approaches on a dataset, evaluate them, and write Tables I and II.

    Attributes:
        dataset: Folder made by build-dataset.
        approaches: Approaches; cross_attention_residual has a connection around its attention.
        splits: sequence, the paper's; person.
        seeds: Seeds of the trainings, each also the part or fold that it leaves for the report.
        preset: Sizes of the networks: cpu, at --size; or paper, 256 pixels, for a GPU.
        size: Side of the images in the preset cpu.
        settings: Settings of all networks, as NAME=VALUE: landmark_weight=468 is equation 4 to the
            letter (not of image_only). Give such trainings another --out.
        steps: Optimiser steps of each training; a larger number extends trainings. One that was
            begun with more is trained to that number.
        batch_size: Sequences of a step.
        learning_rates: Learning rates. Of several, the one that does best on the validation part of
            the first seed is used for all.
        augment: Augmentation: True, False or both, chosen likewise.
        schedule: Learning rate over the steps. Only constant can be extended to the same result.
        ema_decay: Decay of the moving average of the weights, which is what is kept.
        validate_every: Steps between validations.
        kinds: Kinds of footage in the tables.
        detector_model: MediaPipe's face_landmarker.task, for image_only.
        resamples: Resamples of the intervals of each evaluation.
        memory_gb: Memory for decoded images of a training in GB.
        only_times: Only measure processor times, of the preset cpu on images at random: seconds.
        out: Folder of runs, evaluations and tables.
    """

    dataset: Path = Path("face_dataset")
    approaches: tuple[str, ...] = tuple(APPROACHES)
    splits: tuple[str, ...] = SPLITS
    seeds: tuple[Seed, ...] = (0, 1, 2)
    preset: Literal["cpu", "paper"] = "cpu"
    size: Count = 32
    settings: tuple[str, ...] = ()
    steps: Count = 8000
    batch_size: Count = 4
    learning_rates: tuple[Amount, ...] = (1e-3,)
    augment: tuple[bool, ...] = (True,)
    schedule: Decay = "constant"
    ema_decay: Fraction = 0.998
    validate_every: Count = 250
    kinds: tuple[str, ...] = ("natural", "head_motion")
    detector_model: Path | None = None
    resamples: Count = 2000
    memory_gb: Amount = 2.0
    only_times: bool = False
    out: Path = Path("results/approaches")

    def __post_init__(self) -> None:
        for approach in self.approaches:
            require_choice("approach", approach, APPROACHES)
        for split in self.splits:
            require_choice("split", split, SPLITS)
        for kind in self.kinds:
            require_choice("kind of footage", kind, KINDS)
        if self.only_times and self.preset != "cpu":
            raise RequestError("--only_times: measures the preset cpu; leave one of the two out")
        if self.size not in CHANNELS:
            sizes = ", ".join(map(str, CHANNELS))
            raise RequestError(f"--size {self.size}: unknown; valid: {sizes}")


@dataclass(frozen=True)
class Training:
    """One training: its approach, split, seed, learning rate and augmentation."""

    approach: str
    split: SplitName
    seed: int
    learning_rate: float
    augment: bool

    @property
    def name(self) -> str:
        """Name of its folder."""
        parts = [self.approach, self.split, f"part{self.seed}_seed{self.seed}"]
        if self.approach != "residual":
            parts += [f"lr{self.learning_rate:g}"] + ["plain"] * (not self.augment)
        return "_".join(parts)

    @property
    def evaluation(self) -> str:
        """Name of the folder of its evaluation."""
        return f"{self.approach}_{self.split}_seed{self.seed}"


def train(options: Options, training: Training) -> Path:
    """Train, carry on or extend; return the folder of a training that is done.

    One that was begun with more steps than ``options.steps`` goes on to the number it was begun
    with: its learning rate may depend on that number, and the steps that are done are kept.

    Raises:
        RequestError: the training was interrupted, the folder holds one of other settings, or it
            cannot be done.
    """
    network, settings = APPROACHES[training.approach]
    folder = options.out / RUNS / training.name
    if network == "residual":
        if not (folder / "config.json").is_file():
            run_fit(FitOptions(options.dataset, training.seed, training.split, out=folder))
        return folder
    steps, config = options.steps, folder / "config.json"
    if config.is_file():  # of what is saved so far
        steps = max(steps, read_json(config)["training"]["steps"])
    sizes = (f"size={options.size}", f"channels={list(CHANNELS[options.size])}")
    given = FaceTrainOptions(
        model=network,  # type: ignore[arg-type]
        dataset=options.dataset,
        test_fold=training.seed,
        split=training.split,
        out=folder,
        seed=training.seed,
        preset=options.preset,
        settings=(*(sizes if options.preset == "cpu" else ()), *settings, *options.settings),
        steps=steps,
        batch_size=options.batch_size,
        learning_rate=training.learning_rate,
        schedule=options.schedule,
        warmup_steps=100,
        ema_decay=options.ema_decay,
        augment=training.augment,
        validate_every=options.validate_every,
        validation_sequences=48,
        log_every=50,
        memory_gb=options.memory_gb,
    )
    if run_train(given):
        raise RequestError(f"{training.name}: interrupted; the same command carries on")
    return folder


def choose(options: Options, approach: str, split: SplitName) -> tuple[float, bool]:
    """Learning rate and augmentation that do best on the first seed's validation part."""
    ways = list(product(options.learning_rates, options.augment))
    if len(ways) == 1 or approach == "residual":
        return ways[0]
    errors: dict[tuple[float, bool], float] = {}
    for way in ways:
        folder = train(options, Training(approach, split, options.seeds[0], *way))
        found = read_json(folder / "config.json")["validation"]
        errors[way] = found.get("mouth_error", found["loss"])
    return min(ways, key=errors.__getitem__)


def evaluate(options: Options, training: Training, folder: Path) -> None:
    """Evaluate the weights in a folder beside the baselines, unless that is done."""
    out = options.out / EVALUATIONS / training.evaluation
    path, digest = out / RESULTS, file_digest(folder / "model.safetensors")
    if path.is_file():
        done = read_json(path)
        is_same = [c["sha256"] for c in done["checkpoints"]] == [digest]
        if is_same and set(options.kinds) <= set(done["kinds"]):
            return
    run_evaluate(
        EvaluateOptions(
            options.dataset,
            (folder,),
            baselines=BASELINES[1:],
            split=training.split,
            tracks=False,
            kinds=options.kinds,
            out=out,
            detector_model=options.detector_model,
            resamples=options.resamples,
            figures=False,
            progress=False,
        )
    )


@dataclass(frozen=True)
class Rows:
    """Numbers of one split, kind of footage and row: of each seed that has it.

    Attributes:
        seeds: S training seeds.
        table_1: (S, 5) mean and variance of abs dU and dV, SSIM; NaN where there is none.
        table_2: (S, 5 frames, 5).
        sequences: (S,) reported on.
    """

    seeds: tuple[int, ...]
    table_1: np.ndarray
    table_2: np.ndarray
    sequences: tuple[int, ...]


def read_rows(out: Path, split: SplitName, kind: str) -> dict[str, Rows]:
    """Rows of all evaluations of a split in a folder, those of the baselines first."""
    found: dict[str, dict[int, tuple[list[float], list[list[float]], int]]] = {}
    for approach in APPROACHES:  # those without images last: persistence has no images beside them
        for path in sorted((out / EVALUATIONS).glob(f"{approach}_{split}_seed*/{RESULTS}")):
            seed = int(path.parent.name.rpartition("seed")[2])
            summary = read_json(path)["kinds"].get(kind)
            for row in summary["rows"] if summary else ():
                numbers = row["numbers"]
                flat = _columns(numbers, "pooled_mean", "pooled_variance", "pooled_ssim")
                frames = [
                    _columns(_at(numbers, frame), "mean", "variance", "ssim")
                    for frame in range(len(row["missing"]))
                ]
                of_row = found.setdefault(row["name"], {})
                of_row.setdefault(seed, (flat, frames, summary["sequences"]))
    order = [*BASELINES, "image_only", "simple_fusion", "cross_attention"]
    order += ["cross_attention_residual", "residual"]
    result: dict[str, Rows] = {}
    for name in (name for name in order if name in found):
        seeds = tuple(sorted(found[name]))
        flat, frames, counts = zip(*(found[name][seed] for seed in seeds), strict=True)
        result[name] = Rows(seeds, np.array(flat), np.array(frames), counts)
    return result


def _at(numbers: dict[str, Any], frame: int) -> dict[str, Any]:
    keys = ("mean", "variance", "ssim")
    return {key: {"value": numbers[key]["value"][frame]} for key in keys if key in numbers}


def _columns(numbers: dict[str, Any], mean: str, variance: str, ssim: str) -> list[float]:
    """Mean and variance of abs dU, of abs dV, and SSIM, as in Table I."""
    none = {"value": [None, None]}
    pairs = zip(numbers.get(mean, none)["value"], numbers.get(variance, none)["value"], strict=True)
    values = [value for pair in pairs for value in pair]
    values.append(numbers.get(ssim, {"value": None})["value"])
    return [np.nan if value is None else value for value in values]


def page(options: Options) -> str:
    """All tables of everything that a folder holds."""
    out = options.out
    parts = [
        "# The paper's approaches",
        "Mean over the training seeds, in brackets the least and the greatest. The paper's figures "
        "are those that it prints, of its own recordings at 256 pixels; their variances cannot be "
        "variances in these units.",
    ]
    for split, kind in product(SPLITS, options.kinds):
        rows = read_rows(out, split, kind)
        if not rows:
            continue
        parts.append(f"## Split by {split}, {kind}")
        parts += [table_1(rows), table_2(rows), orders(rows)]
    trainings = list(training_lines(out))
    if trainings:
        head = ["training", "steps", "best at step", "validation error at 1/4", "1/2", "3/4", "end"]
        head += ["best", "gain of the last third"]
        parts.append("## Each training")
        parts.append(
            "Distance of the mouth centre on the validation part, in crops (image_only: loss). "
            "*Gain of the last third*: how much lower the best error is than that of the first two "
            "thirds of the steps; a curve that has gone flat gains nothing."
        )
        parts.append(markdown_table(head, trainings))
    return "\n\n".join(parts) + "\n"


def table_1(rows: dict[str, Rows]) -> str:
    """Table I over the seeds, with the paper's rows."""
    head = ["Table I", "trainings", "sequences", "mean dU", "var dU", "mean dV", "var dV", "SSIM"]
    paper = dict(PAPER_TABLE_1)
    lines = [head]
    for name, row in rows.items():
        cells = [_spread(row.table_1[:, i], 5 if i in (1, 3) else 4) for i in range(4)]
        counts = [str(len(row.seeds)), ", ".join(map(str, row.sequences))]
        lines.append([name, *counts, *cells, _spread(row.table_1[:, 4], 3)])
        if name in PAPER_NAMES:
            printed = ["–" if x is None else f"{x:.3f}" for x in paper[PAPER_NAMES[name]]]
            lines.append([f"*paper, {PAPER_NAMES[name]}*", "", "100", *printed])
    return markdown_table(lines[0], lines[1:])


def table_2(rows: dict[str, Rows]) -> str:
    """Table II over the seeds: each row of Table I by frame, the paper's approach 3 beside them."""
    lines = [["Table II", "", *(str(frame) for frame in range(71, 76))]]
    for column, heading in enumerate(PAPER_TABLE_2):
        digits = {"var dU": 5, "var dV": 5, "SSIM": 3}.get(heading, 4)
        for name, row in rows.items():
            values = row.table_2[:, :, column]
            if not np.isnan(values).all():
                lines.append([heading, name, *(_spread(frame, digits) for frame in values.T)])
        printed = [f"{value:.3f}" for value in PAPER_TABLE_2[heading]]
        lines.append([heading, "*paper, approach 3*", *printed])
    return markdown_table(lines[0], lines[1:])


def orders(rows: dict[str, Rows]) -> str:
    """Sentences: in how many seeds the paper's order of its approaches is found."""
    columns = {"dU": 0, "dV": 2, "SSIM": 4}
    pairs = (
        ("cross_attention", "simple_fusion", "3 before 2"),
        ("simple_fusion", "image_only", "2 before 1"),
        ("cross_attention_residual", "simple_fusion", "3 with the residual connection before 2"),
        ("cross_attention", "persistence", "3 before a copy of the last frame"),
        ("cross_attention_residual", "persistence", "3 with it before a copy"),
    )
    lines = [["order", *columns]]
    for one, other, words in pairs:
        if one not in rows or other not in rows:
            continue
        common = sorted({*rows[one].seeds} & {*rows[other].seeds})
        cells: list[str] = []
        for heading, column in columns.items():
            values = [
                [rows[name].table_1[rows[name].seeds.index(seed), column] for seed in common]
                for name in (one, other)
            ]
            sign = -1 if heading == "SSIM" else 1
            # a forecast without landmarks is behind every other
            ours, theirs = (np.nan_to_num(sign * np.array(v), nan=np.inf) for v in values)
            cells.append(f"{np.sum(ours < theirs)} of {len(common)} seeds")
        lines.append([words, *cells])
    return markdown_table(lines[0], lines[1:]) if len(lines) > 1 else ""


def training_lines(out: Path) -> Iterator[list[str]]:
    """A row for each training: its errors on the validation part."""
    for path in sorted((out / RUNS).glob("*/metrics.jsonl")):
        lines = [line for line in read_metrics(path) if line["kind"] == "validation"]
        if not lines:
            continue
        steps = np.array([line["step"] for line in lines])
        errors = np.array([line.get("mouth_error", line["loss"]) for line in lines])
        least = np.minimum.accumulate(errors)
        quarters = [np.searchsorted(steps, share * steps[-1]) for share in (0.25, 0.5, 0.75, 1.0)]
        before = least[max(np.searchsorted(steps, 2 / 3 * steps[-1], side="right") - 1, 0)]
        yield [
            path.parent.name,
            str(steps[-1]),
            str(steps[errors.argmin()]),
            *(f"{errors[place]:.4f}" for place in quarters),
            f"{least[-1]:.4f}",
            f"{100 * (1 - least[-1] / before):.1f} %",
        ]


def _spread(values: np.ndarray, digits: int) -> str:
    """Mean, and least and greatest of several."""
    known = values[~np.isnan(values)]
    if not len(known):
        return "–"
    text = f"{known.mean():.{digits}f}"
    if len(known) > 1:
        text += f" ({known.min():.{digits}f} to {known.max():.{digits}f})"
    return text


def times_table(options: Options) -> str:
    """Measure processor times of training steps on images at random; return a Markdown table."""
    import torch

    from face_prediction.models.interface import Future, History
    from face_prediction.models.settings import make_predictor_model, preset_settings

    lines = [["approach", "weights", "a step of training, ms", f"{options.steps} steps, min"]]
    for approach in options.approaches:
        network, changes = APPROACHES[approach]
        if network == "residual":
            continue
        settings, _ = preset_settings(network, "cpu")
        wanted = {"size": options.size, "channels": CHANNELS[options.size]}
        settings = settings.changed(wanted | dict.fromkeys(("residual",) * len(changes), True))
        model = make_predictor_model(network, settings)
        optimizer = torch.optim.Adam(model.parameters())
        size, count = options.size, options.batch_size

        def pictures(frames: int, count: int = count, size: int = size) -> torch.Tensor:
            return torch.randint(255, (count, frames, size, size, 3), dtype=torch.uint8)

        history = History(torch.rand(count, model.history, 468, 2), pictures(model.history))
        future = Future(torch.rand(count, model.horizon, 468, 2), pictures(model.horizon))
        times: list[float] = []
        for _ in range(TIMED_STEPS + 2):
            begin = time.process_time()
            loss = model.loss(history, future).total
            optimizer.zero_grad(set_to_none=True)
            loss.backward()
            optimizer.step()
            times.append(time.process_time() - begin)
        step = statistics.median(times[2:])
        weights = sum(parameter.numel() for parameter in model.parameters())
        cells = [f"{weights:,}", f"{1e3 * step:.0f}", f"{step * options.steps / 60:.0f}"]
        lines.append([approach, *cells])
    return markdown_table(lines[0], lines[1:]) + "\n"


def main() -> None:
    """Run the command."""
    options = parse(Options, EXAMPLE)
    options.out.mkdir(parents=True, exist_ok=True)
    if options.only_times:
        write_text(options.out / TIMES, times_table(options))
        print((options.out / TIMES).read_text("utf-8"))
        return
    for seed in options.seeds:
        splits: list[SplitName] = [name for name in SPLITS if name in options.splits]
        for split in splits:
            for approach in options.approaches:
                training = Training(approach, split, seed, *choose(options, approach, split))
                evaluate(options, training, train(options, training))
                write_text(options.out / TABLE, page(options))
    print(f"{page(options)}\nwritten to {options.out}")


if __name__ == "__main__":
    run_command(main)
