"""``bin/Dataset.py export`` and ``import`` as a user runs them."""

from __future__ import annotations

import json
import logging
import subprocess
import sys
from pathlib import Path

import pytest

from robo_manip_baselines.commands.dataset import main
from robo_manip_baselines.data import list_episodes
from robo_manip_baselines.runs.errors import RequestError

SCRIPT = Path(__file__).parents[2] / "bin" / "Dataset.py"


def run(*args: object) -> int:
    return main([str(arg) for arg in args])


@pytest.mark.parametrize("name", ["rmb", "aloha"])
def test_there_and_back(
    name: str, one_arm: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run("export", one_arm, tmp_path / "there", "--format", name) == 0
    assert "episodes    3, of which 3 new" in capsys.readouterr().out
    assert run("import", "--format", name, tmp_path / "there", tmp_path / "back") == 0
    assert "episodes    3, of which 3 new" in capsys.readouterr().out
    assert len(list_episodes(tmp_path / "back")) == 3
    assert run("verify", tmp_path / "back") == 0
    assert run("info", tmp_path / "back") == 0


def test_lerobot(one_arm: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("pyarrow", reason="the format lerobot needs the extra formats")
    out = tmp_path / "dataset"
    options = ("--obs", "current_pred", "--horizon", 3, "--error", "uniform", "--cameras", "top")
    codec = ("--video_codec", "h264", "--crf", 20)
    assert run("export", one_arm, out, "--format", "lerobot", *options, *codec) == 0
    assert "observation.state  34 elements (current_pred_h3_uniform)" in capsys.readouterr().out
    info = json.loads((out / "meta/info.json").read_text())
    assert [name for name in info["features"] if "images" in name] == ["observation.images.top"]
    assert info["features"]["observation.images.top"]["info"]["video.crf"] == 20


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--format", "hdf"], "unknown format 'hdf'; valid: aloha, lerobot, rmb"),
        (["--format", "rmb", "--obs", "current"], "--obs: not for the format rmb"),
        (["--format", "rmb", "--error", "uniform"], "--error: not for the format rmb"),
        (["--format", "aloha", "--no_recorded"], "--no_recorded: not for the format aloha"),
        (["--format", "aloha", "--crf", "3"], "--crf: not for the format aloha"),
        (["--format", "lerobot", "--video_codec", "vp9"], "unknown video codec 'vp9'"),
        (["--format", "lerobot", "--obs", "baseline", "--error", "uniform"], "shows nothing"),
    ],
)
def test_wrong_requests_write_nothing(
    options: list[str], message: str, one_arm: Path, tmp_path: Path
) -> None:
    with pytest.raises(RequestError, match=message):
        run("export", one_arm, tmp_path / "out", *options)
    assert not any(tmp_path.iterdir())


def test_nothing_is_written_into_what_is_read(one_arm: Path, tmp_path: Path) -> None:
    for command in ("export", "import"):
        with pytest.raises(RequestError, match="is read; name another folder"):
            run(command, one_arm, one_arm, "--format", "rmb")
    (tmp_path / "file").touch()
    with pytest.raises(RequestError, match="is a file; name a folder"):
        run("export", one_arm, tmp_path / "file", "--format", "rmb")


def test_a_missing_folder_is_one_line(tmp_path: Path) -> None:
    for command in ("export", "import"):
        args = [command, str(tmp_path / "none"), str(tmp_path / "out"), "--format", "rmb"]
        done = subprocess.run(
            [sys.executable, str(SCRIPT), *args], capture_output=True, text=True, check=False
        )
        assert done.returncode == 2
        assert done.stderr.startswith(f"error: '{tmp_path / 'none'}' is no folder")
        assert done.stderr.count("\n") == 1
    assert not any(tmp_path.iterdir())


def test_progress_is_logged(
    one_arm: Path,
    tmp_path: Path,
    caplog: pytest.LogCaptureFixture,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("robo_manip_baselines.runs.progress.FIRST_LINE", 0.0)
    with caplog.at_level(logging.INFO):
        run("export", one_arm, tmp_path / "out", "--format", "rmb")
    assert "export: 100 % of 3 episodes" in caplog.text
