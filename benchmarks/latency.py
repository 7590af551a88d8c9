"""Success of a checkpoint by latency: delays x action steps x strategies, as tables and maps.

Each combination is an evaluation in a folder of its own, and a call that was stopped goes on where
it was:

    python benchmarks/latency.py --checkpoint runs/flow --delays 0 4 8 --action_steps 8 16

Writes ``latency.md``, ``latency.json`` and ``latency.png`` beside them.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from robo_manip_baselines.benchmark.report.figures import styled_figure
from robo_manip_baselines.policy.presets import STRATEGIES, Chunk, Delay
from robo_manip_baselines.rollout.evaluation import (
    FIRST_SEED,
    EvaluationConfig,
    EvaluationPlan,
    evaluate,
)
from robo_manip_baselines.rollout.results import Proportion
from robo_manip_baselines.runs.command import parse, run_command
from robo_manip_baselines.runs.errors import RequestError, require_choice
from robo_manip_baselines.runs.files import atomic_file, write_json, write_text
from robo_manip_baselines.runs.markdown import markdown_table
from robo_manip_baselines.runs.ranges import Episodes, Processes, Seed

EXAMPLE = "python benchmarks/latency.py --checkpoint runs/flow --delays 0 4 8 --num_episodes 100"

TABLE, NUMBERS, MAP = "latency.md", "latency.json", "latency.png"


@dataclass(frozen=True)
class Options:
    """Evaluate a checkpoint with delays between observations and actions.

    Attributes:
        checkpoint: Folder of a training run, or of one of its checkpoints.
        strategies: Ways to execute chunks; those with which the policy cannot act are left out.
        delays: Control steps between an observation and the first action that is made from it.
        action_steps: Actions of each chunk that are executed; the ensemble has none.
        num_episodes: Episodes of each combination.
        seed: Seed of the first episode.
        num_envs: Episodes that run at once; results do not depend on it.
        workers: Processes in which environments step.
        out: Folder to write to.
    """

    checkpoint: Path
    strategies: tuple[str, ...] = STRATEGIES
    delays: tuple[Delay, ...] = (0, 2, 4, 8)
    action_steps: tuple[Chunk, ...] = (8, 16)
    num_episodes: Episodes = 50
    seed: Seed = FIRST_SEED
    num_envs: Episodes = 8
    workers: Processes = 2
    out: Path = Path("results/latency")

    def __post_init__(self) -> None:
        for strategy in self.strategies:
            require_choice("strategy", strategy, STRATEGIES)

    def combinations(self) -> Iterator[tuple[str, int, int | None]]:
        """Yield strategy, delay and action steps, which the ensemble has not."""
        for strategy in self.strategies:
            for delay in self.delays:
                for steps in (None,) if strategy == "ensemble" else self.action_steps:
                    yield strategy, delay, steps

    def evaluation(self, strategy: str, delay: int, steps: int | None) -> EvaluationConfig:
        """Return the evaluation of a combination."""
        name = f"{strategy}_d{delay}" + (f"_s{steps}" if steps else "")
        return EvaluationConfig(
            checkpoint=self.checkpoint,
            seeds=range(self.seed, self.seed + self.num_episodes),
            out=self.out / name,
            strategy=strategy,
            inference_delay=delay,
            n_action_steps=steps,
            num_envs=self.num_envs,
            workers=self.workers,
        )


@dataclass(frozen=True)
class Cell:
    """Result of a combination; ``steps`` is None for the ensemble."""

    strategy: str
    delay: int
    steps: int | None
    success: Proportion
    strict_success: Proportion


def sweep(options: Options) -> list[Cell]:
    """Evaluate every combination that the policy and the numbers allow."""
    cells: list[Cell] = []
    for strategy, delay, steps in options.combinations():
        config = options.evaluation(strategy, delay, steps)
        plan = EvaluationPlan.of(config)
        try:
            plan.make_policy(1)
        except RequestError as error:
            print(f"left out: {strategy}, delay {delay}, {steps} action steps: {error}")
            continue
        _, summary, _ = evaluate(config)
        cells.append(Cell(strategy, delay, steps, summary.success, summary.strict_success))
        write(options.out, cells)
    return cells


def write(folder: Path, cells: list[Cell]) -> None:
    """Write the table, the numbers and the map of what has been evaluated so far."""
    write_json(folder / NUMBERS, [asdict(cell) for cell in cells])
    write_text(folder / TABLE, table(cells))
    draw(folder / MAP, cells)


def table(cells: list[Cell]) -> str:
    """Return a Markdown table, a row for each combination."""
    head = ["strategy", "delay", "action steps", "success, %", "strict success, %"]
    rows = [
        [c.strategy, c.delay, c.steps or "ensemble", *map(_percent, (c.success, c.strict_success))]
        for c in cells
    ]
    return markdown_table(head, rows) + "\n"


def _percent(share: Proportion) -> str:
    values = (100.0 * (x or 0.0) for x in (share.rate, share.low, share.high))
    return "{:.0f} ({:.0f} to {:.0f})".format(*values)


def draw(path: Path, cells: list[Cell]) -> None:
    """Draw a map of success over delay and action steps for each strategy."""
    strategies = list(dict.fromkeys(cell.strategy for cell in cells))
    delays = sorted({cell.delay for cell in cells})
    with styled_figure("agg", "white") as figure:
        steps = {s: sorted({c.steps or 0 for c in cells if c.strategy == s}) for s in strategies}
        widths = [len(steps[s]) for s in strategies]
        figure.set_size_inches(
            1.6 + 0.62 * sum(widths) + 0.55 * len(widths), 1.5 + 0.5 * len(delays)
        )
        grid = figure.subplots(1, len(strategies), squeeze=False, width_ratios=widths)[0]
        colors: Any = {"cmap": "cividis", "vmin": 0.0, "vmax": 100.0}
        image = None
        for axes, strategy in zip(grid, strategies, strict=True):
            rates = np.full((len(delays), len(steps[strategy])), np.nan)
            for c in cells:
                if c.strategy == strategy:
                    place = delays.index(c.delay), steps[strategy].index(c.steps or 0)
                    rates[place] = 100.0 * (c.success.rate or 0.0)
            image = axes.imshow(rates, origin="lower", aspect="auto", **colors)
            for (row, column), rate in np.ndenumerate(rates):
                if np.isfinite(rate):
                    color = "black" if rate > 50.0 else "white"
                    axes.text(column, row, f"{rate:.0f}", ha="center", va="center", color=color)
            axes.set_title(strategy.replace("_", "\n"), fontsize=9)
            names = [str(s) if s else "all" for s in steps[strategy]]
            axes.set_xticks(range(len(names)), names)
            axes.set_yticks(range(len(delays)), map(str, delays) if axes is grid[0] else [])
        grid[0].set_ylabel("delay, control steps")
        figure.supxlabel("actions executed of each chunk", fontsize=9)
        figure.colorbar(image, ax=list(grid), label="success, %")
        with atomic_file(path) as temporary:
            figure.savefig(temporary, format="png", dpi=150)


def main() -> None:
    """Run the command."""
    options = parse(Options, EXAMPLE)
    options.out.mkdir(parents=True, exist_ok=True)
    cells = sweep(options)
    print(f"{table(cells)}\nwritten to {options.out}")


if __name__ == "__main__":
    run_command(main)
