"""The page on evaluation says what the code does."""

from __future__ import annotations

import re
import typing
from collections.abc import Callable
from dataclasses import fields
from pathlib import Path

import pytest

from robo_manip_baselines.commands.rollout import PolicyOptions
from robo_manip_baselines.envs.mujoco.tasks.feeding.failure import FAILURES
from robo_manip_baselines.observation.spec import CorruptionOptions
from robo_manip_baselines.policy.checkpoint import Checkpoint
from robo_manip_baselines.rollout.results import EpisodeResult, Offset, ResultsFile

PAGE = (Path(__file__).parents[2] / "docs" / "evaluation.md").read_text(encoding="utf-8")
EXAMPLES = re.findall(r"```python\n(.*?)```", PAGE, flags=re.DOTALL)

SPELT = {
    str: "str",
    int: "int",
    bool: "bool",
    float: "float",
    dict[str, str]: "object",
    float | None: "float or null",
    int | None: "int or null",
    Offset | None: "[x, y, z] or null",
}


def rows(heading: str) -> list[list[str]]:
    """The cells of the table below a heading, its head apart."""
    section = PAGE.partition(f"## {heading}\n")[2].partition("\n## ")[0]
    lines = [line for line in section.splitlines() if line.startswith("|")][2:]
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]


def test_every_field_is_there_with_its_type() -> None:
    hints = typing.get_type_hints(EpisodeResult)
    declared = [[f"`{item.name}`", SPELT[hints[item.name]]] for item in fields(EpisodeResult)]
    assert [row[:2] for row in rows("`results.jsonl`")] == declared


def test_every_kind_of_failure_is_there() -> None:
    assert rows("Kinds of failure") == [[f"`{kind}`", what] for kind, what in FAILURES.items()]


def test_every_option_is_there() -> None:
    named = set(re.findall(r"`--(\w+)`", " ".join(row[0] for row in rows("Options"))))
    options = {item.name for kind in (PolicyOptions, CorruptionOptions) for item in fields(kind)}
    assert options - {"corruption"} | {"no_corruption"} <= named


@pytest.mark.long
def test_examples_run(
    make_checkpoint: Callable[..., Checkpoint], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    make_checkpoint(tmp_path / "runs" / "act_current_pred_h2_cpu_seed0")
    assert len(EXAMPLES) == 2
    # One episode instead of four, in this process.
    short = EXAMPLES[1].replace("1004", "1001").replace("workers=2", "workers=0")
    assert short.count("1001") == short.count("workers=0") == 1
    names: dict[str, object] = {"__name__": "__main__"}
    exec(short, names)
    (result,) = typing.cast(list[EpisodeResult], names["results"])
    assert result.seed == 1000
    with ResultsFile(Path("results/FeedingEnv_act_current_pred_h2_cpu_seed0"), {}, {}) as file:
        file.append(result)
    exec(EXAMPLES[0], {})
