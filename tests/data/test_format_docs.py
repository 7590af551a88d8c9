"""The format's page says what the code does."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from robo_manip_baselines.data import EpisodeReader, episode_path, write_episode
from robo_manip_baselines.data.example import make_arrays, make_attributes, make_images
from robo_manip_baselines.data.schema import (
    SCHEMA,
    SCHEMA_VERSION,
    SYMBOLS,
    EpisodeSchema,
    shape_text,
)
from robo_manip_baselines.envs.mujoco.tasks.registry import task_entry

FEEDING = EpisodeSchema.of(task_entry("FeedingEnv"))
PAGE = (Path(__file__).parents[2] / "docs" / "episode_format.md").read_text(encoding="utf-8")
EXAMPLES = re.findall(r"```python\n(.*?)```", PAGE, flags=re.DOTALL)


def field_table(schema: EpisodeSchema) -> str:
    """The fields as a Markdown table, as printed in ``docs/episode_format.md``."""
    lines = ["| name | shape | type | unit | frame | what it is |", "|---|---|---|---|---|---|"]
    lines += [
        f"| `{f.name}` | {shape_text(f)} | {f.dtype} | {f.unit or '–'} | {f.frame or '–'} "
        f"| {f.description} |"
        for f in schema.fields
    ]
    return "\n".join(lines)


def attribute_table(schema: EpisodeSchema) -> str:
    """The attributes as a Markdown table, as printed in ``docs/episode_format.md``."""
    lines = ["| name | kind | what it is |", "|---|---|---|"]
    for item in schema.attributes:
        kind = f"{item.length} numbers" if item.kind == "vector" else item.kind
        lines.append(f"| `{item.name}` | {kind} | {item.description} |")
    return "\n".join(lines)


def symbol_table() -> str:
    """The shape symbols as a Markdown table, as printed in ``docs/episode_format.md``."""
    lines = ["| symbol | size |", "|---|---|"]
    lines += [f"| {symbol} | {text} |" for symbol, text in SYMBOLS.items()]
    return "\n".join(lines)


@pytest.mark.parametrize("table", [field_table(FEEDING), attribute_table(FEEDING), symbol_table()])
def test_tables_are_the_declaration(table: str) -> None:
    assert f"\n\n{table}\n\n" in PAGE


def test_page_names_schema_and_version() -> None:
    assert f"`{SCHEMA}`" in PAGE
    assert f"version {SCHEMA_VERSION}" in PAGE


def test_examples_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = tmp_path / "dataset" / "FeedingEnv"
    path = episode_path(folder, 12, True)
    write_episode(path, make_arrays(150), make_images(150), make_attributes(12))
    monkeypatch.chdir(tmp_path)
    with EpisodeReader(path) as episode:
        truth = episode.frame("top", 100)
        action = episode.array("action")
    assert len(EXAMPLES) == 2
    for example in EXAMPLES:
        names: dict[str, object] = {}
        exec(example, names)
        np.testing.assert_array_equal(names["image"], truth)
        np.testing.assert_array_equal(names["action"], action)
    plain = EXAMPLES[0]
    assert "robo_manip_baselines" not in plain
    assert len(plain.strip().splitlines()) <= 8  # imports, then six lines
