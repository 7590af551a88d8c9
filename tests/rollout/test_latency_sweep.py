"""The sweep over latencies: what is evaluated, what is left out, and that it can be continued."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import pytest

from robo_manip_baselines.policy.checkpoint import Checkpoint
from robo_manip_baselines.rollout.results import Proportion, read_results


@pytest.fixture(scope="module")
def latency(load_script: Callable[[str], ModuleType]) -> ModuleType:
    return load_script("benchmarks/latency.py")


def test_every_combination_has_a_folder(latency: ModuleType) -> None:
    options = latency.Options(
        Path("run"), ("naive", "ensemble"), delays=(0, 4), action_steps=(8, 16)
    )
    names = [str(options.evaluation(*place).out.name) for place in options.combinations()]
    naive = ["naive_d0_s8", "naive_d0_s16", "naive_d4_s8", "naive_d4_s16"]
    assert names == [*naive, "ensemble_d0", "ensemble_d4"]


def test_the_table_has_a_row_for_each(latency: ModuleType, tmp_path: Path) -> None:
    share = Proportion.of(3, 4)
    cells = [
        latency.Cell("naive", 2, 8, share, share),
        latency.Cell("ensemble", 2, None, share, share),
    ]
    rates = "75 (30 to 95) | 75 (30 to 95)"
    assert latency.table(cells).splitlines()[2:] == [
        f"| naive | 2 | 8 | {rates} |",
        f"| ensemble | 2 | ensemble | {rates} |",
    ]
    latency.draw(tmp_path / "map.png", cells)
    assert (tmp_path / "map.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.long
def test_a_sweep_is_continued(
    latency: ModuleType,
    make_checkpoint: Callable[..., Checkpoint],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    make_checkpoint(tmp_path / "run")
    line = (
        f"latency.py --checkpoint {tmp_path}/run --out {tmp_path}/out --strategies naive rtc "
        "--delays 0 4 --action_steps 2 --num_episodes 2 --workers 0 --num_envs 2"
    )
    monkeypatch.setattr(sys, "argv", line.split())
    latency.main()
    page = capsys.readouterr().out
    assert "left out: naive, delay 4, 2 action steps: inference_delay 4: must be at most" in page
    assert "left out: rtc, delay 0, 2 action steps: strategy 'rtc': not with MlpModel" in page
    (cell,) = json.loads((tmp_path / "out/latency.json").read_text())
    assert (cell["strategy"], cell["delay"], cell["steps"]) == ("naive", 0, 2)
    rows = tmp_path / "out/naive_d0_s2/results.jsonl"
    before = rows.read_bytes()
    assert len(read_results(rows.parent)) == 2
    latency.main()
    assert rows.read_bytes() == before
