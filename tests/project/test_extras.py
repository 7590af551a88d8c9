"""Messages about a missing package name a command that resolves."""

from __future__ import annotations

import re
import shlex
import subprocess
import sys
from importlib.metadata import requires
from pathlib import Path

import pytest

from robo_manip_baselines.runs import extras


def test_a_checkout_is_installed_as_itself(repository: Path) -> None:
    command = extras.install_command("train", repository)
    program, *arguments = shlex.split(command)
    assert program == sys.executable
    assert arguments[-2:] == ["-e", f"{repository}[train]"]
    assert arguments[:-2] == ["-m", "pip", "install", "-c", str(repository / "constraints.txt")]


def test_a_path_with_spaces_stays_one_argument(tmp_path: Path) -> None:
    folder = tmp_path / "my checkout"
    folder.mkdir()
    (folder / "pyproject.toml").touch()
    assert shlex.split(extras.install_command("ray", folder))[-1] == f"{folder}[ray]"


@pytest.mark.long
def test_pip_accepts_the_command(repository: Path, tmp_path: Path) -> None:
    options = ["--dry-run", "--no-deps", "--no-index", "--no-build-isolation", "--quiet"]
    line = shlex.split(extras.install_command("train", repository)) + options
    if subprocess.run([*line[:3], "--version"], capture_output=True, check=False).returncode:
        pytest.skip("no pip here")
    result = subprocess.run(line, capture_output=True, text=True, check=False, cwd=tmp_path)
    assert result.returncode == 0, result.stderr


@pytest.mark.parametrize("extra", ["train", "face-prediction", "face_prediction", "ray", "dev"])
def test_a_wheel_names_what_the_extra_requires(extra: str, tmp_path: Path) -> None:
    """In ``site-packages`` there is no checkout, and no index holds the package."""
    names = shlex.split(extras.install_command(extra, tmp_path))[4:]
    assert names
    assert not any("robo_manip_baselines" in name or ";" in name for name in names)
    assert set(names) <= {
        text.split(";")[0].strip() for text in requires(extras.DISTRIBUTION) or []
    }


def test_an_extra_that_is_none() -> None:
    with pytest.raises(ValueError, match="no extra 'gpu'"):
        extras.requirements("gpu")


def test_no_message_names_a_package_of_no_index(repository: Path) -> None:
    """A requirement on the name alone is only right where wheels lie beside it."""
    folders = ("robo_manip_baselines", "face_prediction", "bin", "benchmarks", "docs")
    found = [
        f"{path.relative_to(repository)}: {line.strip()}"
        for folder in folders
        for path in sorted((repository / folder).rglob("*"))
        if path.suffix in (".py", ".md", ".jinja", ".yaml")
        for line in path.read_text(encoding="utf-8").splitlines()
        if re.search(r"install.*robo_manip_baselines\[", line)
    ]
    assert found == []
