"""A benchmark of the second task, from a YAML file: tables and report of two conditions."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from .test_add_an_environment import run_python

CONDITIONS = """
env: ChinTouchEnv
presets:
  smoke: [baseline, current]
conditions:
  - {name: baseline, policy: Mlp, obs: baseline}
  - {name: current, policy: Mlp, obs: current}
  - {name: late, policy: Mlp, obs: current, delay: 3}
"""


@pytest.mark.slow
def test_another_task_is_benchmarked_by_a_yaml_file(site: Path, tmp_path: Path) -> None:
    file, out = tmp_path / "chin.yaml", tmp_path / "out"
    file.write_text(CONDITIONS)
    options = f"chin --conditions_file {file} --preset smoke --num_episodes 2 --no_videos"
    done = run_python(site, "bin/Benchmark.py", *options.split(), "--out", str(out))
    assert done.returncode == 0, done.stderr
    rows = [json.loads(line) for line in (out / "results.jsonl").read_text().splitlines()]
    assert [(row["env"], row["condition"], row["seed"]) for row in rows] == [
        ("ChinTouchEnv", condition, seed)
        for condition in ("baseline", "current")
        for seed in (1000, 1001)
    ]
    assert all(row["chin_distance"] > 0.0 for row in rows)
    tables = {path.stem for path in (out / "tables").glob("*.md")}
    assert {"success", "success_differences", "completion_times", "failures"} <= tables
    assert not [name for name in tables if "paper" in name]  # it has none
    assert "Too far" in (out / "tables" / "failures.md").read_text()
    page = (out / "report.html").read_text()
    assert "Benchmark ChinTouchEnv" in page
    assert "Too far" in page
    assert "cube" not in page
