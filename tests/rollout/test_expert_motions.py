"""``benchmarks/expert_motions.py``: cells are measured once, and the table shows them."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType, SimpleNamespace

import pytest

from robo_manip_baselines.envs.mujoco.tasks.registry import task_names


@pytest.fixture
def module(
    load_script: Callable[[str], ModuleType], repository: Path, monkeypatch: pytest.MonkeyPatch
) -> ModuleType:
    monkeypatch.syspath_prepend(str(repository / "benchmarks"))
    return load_script("benchmarks/expert_motions.py")


def test_a_table_is_continued_row_by_row(
    module: ModuleType,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    calls: list[tuple[str, str]] = []

    def play(
        env: str, expert: str, face: str, motion: str, seeds: range
    ) -> Iterator[SimpleNamespace]:
        if len(calls) == 3 and "stopped" not in calls[-1]:
            calls.append(("stopped", motion))
            raise KeyboardInterrupt
        calls.append((env, motion))
        for seed in seeds:
            is_success = seed > 0
            yield SimpleNamespace(
                is_success=is_success,
                is_success_strict=seed > 1,
                completion_time=float(seed) if is_success else None,
                safety=SimpleNamespace(success_safe=seed > 2),
            )

    monkeypatch.setattr(module, "run_expert", play)
    out = tmp_path / "experts"
    line = f"expert_motions --out {out} --envs FeedingEnv DrinkingEnv --motions still sway"
    monkeypatch.setattr(sys, "argv", [*line.split(), "--num_episodes", "4"])
    with pytest.raises(KeyboardInterrupt):
        module.main()
    assert calls[:3] == [("FeedingEnv", "still"), ("DrinkingEnv", "still"), ("FeedingEnv", "sway")]
    module.main()
    assert calls[4:] == [("DrinkingEnv", "sway")]
    module.main()
    assert len(calls) == 5
    table = (out / "motions.md").read_text()
    assert table in capsys.readouterr().out
    assert "| motion | FeedingEnv | DrinkingEnv |" in table
    assert "| still | 3 / 2 / 1 | 3 / 2 / 1 |" in table
    assert "| sway | 3 / 2 / 1 | 3 / 2 / 1 |" in table
    cells = module.read_cells(out / "cells.jsonl").values()
    assert {cell.completion_time for cell in cells} == {2.0}
    assert not (out / ".lock").exists()


def test_a_cell_that_is_missing_is_a_dash(module: ModuleType) -> None:
    cell = module.MotionCell(
        task_names()[0], "servo", "still", "visual", 0, 2, 1, 1, 0, 3.0, None, {}
    )
    other = module.MotionCell(
        task_names()[1], "servo", "sway", "visual", 0, 2, 0, 0, 0, None, None, {}
    )
    rows = module.make_table([cell, other]).rows
    assert [c.text for c in rows[0].cells] == ["still", "1 / 1 / 0", "–"]
    assert [c.text for c in rows[1].cells] == ["sway", "–", "0 / 0 / 0"]
