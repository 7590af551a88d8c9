"""The page on evaluation agrees with the code."""

from __future__ import annotations

import re
import typing
from collections.abc import Callable
from dataclasses import fields
from pathlib import Path
from typing import Any

import pytest

from robo_manip_baselines.commands.rollout import PolicyOptions
from robo_manip_baselines.envs.mujoco.tasks.feeding import ENTRY
from robo_manip_baselines.envs.mujoco.tasks.safety import EpisodeSafety
from robo_manip_baselines.observation import Corruption, ObservationSpec
from robo_manip_baselines.policy.checkpoint import Checkpoint
from robo_manip_baselines.rollout.results import EpisodeResult, read_results

PAGE = (Path(__file__).parents[2] / "docs" / "evaluation.md").read_text(encoding="utf-8")
EXAMPLES = re.findall(r"```python\n(.*?)```", PAGE, flags=re.DOTALL)

TYPES = {
    str: "str",
    int: "int",
    bool: "bool",
    float: "float",
    dict[str, str]: "object",
    dict[str, Any] | None: "object or null",
    float | None: "float or null",
    int | None: "int or null",
    EpisodeSafety | None: "object or null",
}


def rows(heading: str) -> list[list[str]]:
    """The cells of the tables below a heading, their heads apart."""
    section = PAGE.partition(f"## {heading}\n")[2].partition("\n## ")[0]
    tables = re.findall(r"(?:^\|.*\n)+", section, flags=re.MULTILINE)
    lines = [line for table in tables for line in table.splitlines()[2:]]
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]


def test_every_field_is_there_with_its_type() -> None:
    hints = typing.get_type_hints(EpisodeResult)
    declared = [["`version`", "int"]]
    declared += [
        [f"`{item.name}`", TYPES[hints[item.name]]]
        for item in fields(EpisodeResult)
        if item.name != "columns"
    ]
    for column in ENTRY.columns:
        kind = {"float": "float", "vector": "[x, y, z]"}[column.kind]
        declared.append([f"`{column.name}`", kind + " or null" * column.is_optional])
    assert [row[:2] for row in rows("`results.jsonl`")] == declared


def test_every_kind_of_failure_is_there() -> None:
    kinds = [[f"`{kind}`", what] for kind, what in ENTRY.failures.items()]
    assert rows("Kinds of failure") == kinds


def test_every_option_is_there() -> None:
    named = set(re.findall(r"`--(\w+)`", " ".join(row[0] for row in rows("Options"))))
    kinds = (PolicyOptions, ObservationSpec, Corruption)
    options = {item.name for kind in kinds for item in fields(kind)}
    options -= {"corruption", "stats_sha256", "seed", "render_size"}
    assert options | {"no_corruption", "corruption_seed"} <= named


@pytest.mark.long
def test_examples_run(
    make_checkpoint: Callable[..., Checkpoint], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    make_checkpoint(tmp_path / "runs" / "act_current_pred_h2_cpu_seed0")
    assert len(EXAMPLES) == 2
    # One short episode instead of four, in this process.
    short = EXAMPLES[1].replace("1004", "1001").replace("workers=2", "workers=0")
    assert short.count("1001") == short.count("workers=0") == 1
    exec(short, {"__name__": "__main__"})
    (result,) = read_results("results/FeedingEnv_act_current_pred_h2_cpu_seed0")
    assert result.seed == 1000
    exec(EXAMPLES[0], {})
