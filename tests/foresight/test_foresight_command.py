"""``bin/Benchmark.py foresight``: its folder, resumption, workers, refusals."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from robo_manip_baselines.benchmark.foresight.episodes import Cell
from robo_manip_baselines.benchmark.foresight.grid import PRESETS, ForesightPreset, lead_cells
from robo_manip_baselines.benchmark.foresight.study import possible_cells, read_study, requests
from robo_manip_baselines.commands.benchmark import main
from robo_manip_baselines.runs.errors import RequestError

CELLS = tuple(lead_cells("dyskinetic", (4,)))


@pytest.fixture(autouse=True)
def tiny(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(PRESETS, "tiny", ForesightPreset(CELLS, 2))


def run(out: Path, *options: str) -> int:
    return main(["foresight", "--preset", "tiny", "--out", str(out), *options])


def files(folder: Path) -> dict[str, bytes]:
    found = {p for p in folder.rglob("*") if p.is_file() and p.name not in (".lock", "README.md")}
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in sorted(found)}


@pytest.mark.long
def test_a_killed_run_goes_on_to_the_same_bytes_and_workers_change_none(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    whole, killed, spread = (tmp_path / name for name in ("whole", "killed", "spread"))
    assert run(whole, "--num_workers", "1") == 0
    assert "best lead" in capsys.readouterr().out
    expected = files(whole)
    assert {"foresight.json", "foresight.jsonl", "figures/surface.png"} <= set(expected)
    rows = expected["foresight.jsonl"].splitlines(keepends=True)
    assert len(rows) == 2 * len(CELLS)
    # Killed in a row: rows of an interrupted run are in no order.
    killed.mkdir()
    (killed / "foresight.json").write_bytes(expected["foresight.json"])
    (killed / "foresight.jsonl").write_bytes(rows[3] + rows[0] + rows[5][:40])
    assert run(killed, "--num_workers", "1") == 0
    assert files(killed) == expected
    assert run(spread, "--num_workers", "2") == 0
    assert files(spread) == expected
    # Done already: nothing is played, and the page shows the figures.
    assert run(whole, "--num_workers", "1") == 0
    assert files(whole) == expected
    page = (whole / "README.md").read_text(encoding="utf-8")
    for name in ("surface", "tracking", "forecasters"):
        assert f"(figures/{name}.png)" in page
        assert (whole / f"figures/{name}.png").exists()
    assert "| dyskinetic | 4 | direct | truth | 7 |" in page


def test_only_what_is_missing_is_asked_for() -> None:
    done = {(CELLS[0], 0), (CELLS[1], 0), *((cell, 1) for cell in CELLS)}
    (first, second) = requests(CELLS, range(3), done)
    assert (first.seed, first.cells) == (0, CELLS[2:])
    assert (second.seed, second.cells) == (2, CELLS)


def test_a_changed_input_is_refused(tmp_path: Path) -> None:
    settings = {"motion_sha256": "0" * 64}
    manifest = {"schema": "robo_manip_baselines/foresight", "version": 1, "settings": settings}
    (tmp_path / "foresight.json").write_text(json.dumps(manifest))
    with pytest.raises(RequestError, match=r"holds episodes with motion_sha256 0+, not \w+; give"):
        run(tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["foresight.json"]


def test_a_damaged_row_is_named(tmp_path: Path) -> None:
    (tmp_path / "foresight.jsonl").write_text('{"version": 1}\n')
    with pytest.raises(RequestError, match=r"line 1: .*remove that line"):
        read_study(tmp_path)


def test_other_folders_are_left_alone(tmp_path: Path) -> None:
    (tmp_path / "thesis.tex").write_text("mine")
    with pytest.raises(RequestError, match=r"holds thesis.tex and no study of bin/Benchmark.py"):
        run(tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.tex"]


def test_a_dry_run_writes_nothing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(tmp_path / "new", "--dry_run") == 0
    assert "8 of 8 to do" in capsys.readouterr().out
    assert not (tmp_path / "new").exists()


def test_its_name_comes_first() -> None:
    with pytest.raises(RequestError, match="its name comes first"):
        main(["--preset", "smoke", "foresight"])


def test_unknown_presets_are_refused() -> None:
    with pytest.raises(RequestError, match="unknown preset 'paper'; valid: cpu, full, smoke, tiny"):
        main(["foresight", "--preset", "paper"])


def test_a_predictor_is_not_asked_beyond_its_horizon() -> None:
    near = Cell("recorded", 0, "direct", "residual", 3)
    other = near._replace(motion="sway")
    cells = [near, near._replace(lead=25), other, other._replace(lead=25), CELLS[0]]
    assert possible_cells(cells) == (near, other, CELLS[0])
