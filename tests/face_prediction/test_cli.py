"""The command line: help, exit codes, and imports."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from face_prediction.commands.cli import COMMANDS, main
from robo_manip_baselines.runs.errors import RequestError

HEAVY = ("mediapipe", "cv2", "mujoco", "matplotlib", "torch", "OpenGL")


def python(*arguments: str, cwd: Path | None = None) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, *arguments], capture_output=True, text=True, cwd=cwd, check=False
    )


@pytest.mark.parametrize(
    ("command", "words"),
    [
        ("extract", ("(default: 30.0)", "--running_mode", "--min_presence_confidence")),
        ("export-motion", ("(default: 0.08)", "--max_rotation")),
        ("export-surface", ("--attribution",)),
    ],
)
def test_help_shows_defaults_and_an_example(capsys, command, words) -> None:
    with pytest.raises(SystemExit) as exited:
        main([command, "--help"])
    assert exited.value.code == 0
    shown = " ".join(capsys.readouterr().out.split())
    for word in (f"Example: face-prediction {command}", *words):
        assert word in shown
    assert "Attributes:" not in shown


def test_help_lists_the_commands_and_examples(capsys) -> None:
    assert main(["--help"]) == 0
    shown = capsys.readouterr().out
    for word in (*COMMANDS, "Example:"):
        assert word in shown


@pytest.mark.parametrize(
    ("arguments", "word"),
    [
        (["nonsense"], "'nonsense'; valid: build-dataset, "),
        (["extrct"], "did you mean 'extract'"),
        (["extract", "--nonsense"], "--nonsense"),
        (["extract", "--fps", "many", "a.mp4"], "'many'"),
        (["extract", "a.mp4", "--max_gap", "7"], "--max_gap 7.0: must be 0 to 1"),
        ([], "extract, export-motion, export-surface"),
    ],
)
def test_a_wrong_command_line_is_one_line(arguments: list[str], word: str) -> None:
    with pytest.raises(RequestError) as caught:
        main(arguments)
    assert word in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_wrong_request_is_one_line_and_2(tmp_path: Path, repository: Path) -> None:
    model = tmp_path / "m.task"
    model.touch()
    result = python(
        "-m", "face_prediction", "extract", "absent.mp4", "--model", str(model), cwd=repository
    )
    assert result.returncode == 2
    assert result.stderr == "error: absent.mp4: no such file\n"
    assert result.stdout == ""


def test_importing_needs_no_detector_display_or_robot(repository: Path) -> None:
    script = (
        f"import sys\nfor name in {HEAVY}: sys.modules[name] = None\n"
        "import face_prediction, face_prediction.commands.cli, face_prediction.motion.report\n"
    )
    result = python("-c", script, cwd=repository)
    assert result.returncode == 0, result.stderr


@pytest.mark.parametrize("command", COMMANDS)
def test_help_needs_nothing_heavy(command: str, repository: Path) -> None:
    script = (
        "import atexit, sys\nfrom face_prediction.commands.cli import main\n"
        f"atexit.register(lambda: print({{*{HEAVY}}} & set(sys.modules), file=sys.stderr))\n"
        f"main(['{command}', '--help'])\n"
    )
    result = python("-c", script, cwd=repository)
    assert result.returncode == 0
    assert result.stderr == "set()\n"
