"""The command line as a user meets it: help, exit codes, and what importing needs."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from face_prediction.commands.cli import main


def python(*arguments: str, cwd: Path | None = None) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, *arguments], capture_output=True, text=True, cwd=cwd, check=False
    )


@pytest.mark.parametrize(
    ("command", "words"),
    [
        ((), ("extract", "export-motion", "export-surface", "build-dataset", "Example:")),
        (("extract",), ("Example: face-prediction extract", "(default: 30.0)", "--running_mode")),
        (("export-motion",), ("Example: face-prediction", "(default: 0.08)", "--max_rotation")),
        (("export-surface",), ("Example: face-prediction", "--attribution")),
    ],
)
def test_help_shows_defaults_and_an_example(capsys, command, words) -> None:
    with pytest.raises(SystemExit) as exited:
        main([*command, "--help"])
    assert exited.value.code == 0
    shown = " ".join(capsys.readouterr().out.split())
    for word in words:
        assert word in shown


@pytest.mark.parametrize(
    ("arguments", "word"),
    [
        (["nonsense"], "nonsense"),
        (["extract", "--nonsense"], "--nonsense"),
        (["extract", "--fps", "many", "a.mp4"], "'many'"),
        ([], "extract, export-motion, export-surface"),
    ],
)
def test_a_wrong_command_line_is_one_line_and_2(arguments: list[str], word: str, caplog) -> None:
    assert main(arguments) == 2
    (record,) = caplog.records
    assert word in record.getMessage()
    assert "\n" not in record.getMessage()


def test_a_wrong_request_is_one_line_and_2(tmp_path: Path, repository: Path) -> None:
    model = tmp_path / "m.task"
    model.touch()
    result = python(
        "-m", "face_prediction", "extract", "absent.mp4", "--model", str(model), cwd=repository
    )
    assert result.returncode == 2
    assert result.stderr == "face-prediction: absent.mp4: no such file\n"
    assert result.stdout == ""


def test_importing_needs_no_detector_display_or_robot(repository: Path) -> None:
    heavy = ("mediapipe", "cv2", "mujoco", "robo_manip_baselines", "matplotlib", "torch", "OpenGL")
    script = (
        f"import sys\nfor name in {heavy}: sys.modules[name] = None\n"
        "import face_prediction, face_prediction.commands.cli, face_prediction.motion.report\n"
    )
    result = python("-c", script, cwd=repository)
    assert result.returncode == 0, result.stderr
