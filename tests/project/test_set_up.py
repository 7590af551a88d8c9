"""`make` and what it calls: the right Python is found, and every refusal says what to do."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import pytest

from robo_manip_baselines.envs.mujoco.cell import opengl as opengl_check


@pytest.fixture
def bare_tree(tmp_path: Path, repository: Path) -> Path:
    """A folder with what .ci/setup reads and no .venv."""
    (tmp_path / ".ci").mkdir()
    for name in (".ci/setup", "pyproject.toml", "setup.py", "constraints.txt"):
        shutil.copy(repository / name, tmp_path / name)
    return tmp_path


def fake_python(folder: Path, name: str, version: str) -> Path:
    """A program that answers ``-c`` as a Python of ``version`` would and does nothing else."""
    folder.mkdir(exist_ok=True)
    path = folder / name
    path.write_text(f"#!/bin/sh\n[ $1 = -c ] && echo {version}\n", encoding="utf-8")
    path.chmod(0o755)
    return path


def set_up(
    tree: Path, *arguments: str, path: str | None = None
) -> subprocess.CompletedProcess[str]:
    environment = os.environ | ({"PATH": path} if path else {})
    return subprocess.run(
        ["/bin/bash", str(tree / ".ci/setup"), *arguments],
        env=environment,
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        check=False,
    )


@pytest.mark.parametrize("version", ["2.7", "3.9", "3.14"])
def test_an_unfit_python_is_refused_with_what_was_found(bare_tree: Path, version: str) -> None:
    python = fake_python(bare_tree / "bin", "some-python", version)
    result = set_up(bare_tree, str(python))
    assert result.returncode == 2
    assert result.stderr.count("\n") == 1
    assert f"{python} is {version}" in result.stderr
    assert "Python 3.10 to 3.13" in result.stderr
    assert not (bare_tree / ".venv").exists()


@pytest.fixture
def tools(bare_tree: Path) -> Path:
    """A folder to be the whole PATH: the few tools that the script calls, and no Python."""
    folder = bare_tree / "tools"
    folder.mkdir()
    for tool in ("dirname", "cat", "rm", "sha256sum", "cut"):
        (folder / tool).symlink_to(str(shutil.which(tool)))
    return folder


def test_no_python_at_all(bare_tree: Path, tools: Path) -> None:
    result = set_up(bare_tree, path=str(tools))
    assert result.returncode == 2
    assert "found: none" in result.stderr
    assert "apt-get install python3 python3-venv" in result.stderr


def test_an_old_python3_is_passed_over(bare_tree: Path, tools: Path) -> None:
    fake_python(tools, "python3", "3.8")
    fit = fake_python(tools, "python3.11", "3.11")
    result = set_up(bare_tree, path=str(tools))
    assert f"making .venv with Python 3.11 ({fit})" in result.stdout


def test_installed_is_installed(bare_tree: Path) -> None:
    """A second run does nothing; a changed pin, or a moved folder, installs again."""
    venv = bare_tree / ".venv" / "bin"
    venv.mkdir(parents=True)
    log = bare_tree / "log"
    python = venv / "python"
    python.write_text(
        f"#!/bin/sh\n[ $1 = -c ] && echo 3.11 || echo $@ >> {log}\n", encoding="utf-8"
    )
    python.chmod(0o755)

    for _ in range(2):
        assert set_up(bare_tree).returncode == 0
    assert len(log.read_text().splitlines()) == 1
    assert "-c constraints.txt" in log.read_text()

    with (bare_tree / "constraints.txt").open("a") as constraints:
        constraints.write("# changed\n")
    assert set_up(bare_tree).returncode == 0
    assert len(log.read_text().splitlines()) == 2


def test_an_environment_that_was_not_finished_is_made_again(bare_tree: Path, tools: Path) -> None:
    """A run that was stopped while it made .venv leaves a Python in it, and no pip."""
    venv = bare_tree / ".venv" / "bin"
    venv.mkdir(parents=True)
    python = venv / "python"
    python.write_text('#!/bin/sh\ncase "$2" in *pip*) exit 1;; esac\necho 3.11\n', encoding="utf-8")
    python.chmod(0o755)
    fit = fake_python(tools, "python3.11", "3.11")
    result = set_up(bare_tree, path=str(tools))
    assert f"making .venv with Python 3.11 ({fit})" in result.stdout
    assert not python.exists()


PIP_SAYS = """Obtaining file:///x
  Installing build dependencies: started
Collecting av>=14.0 (from robo_manip_baselines==0.1.0)
  Downloading av-14.0.0-cp311-cp311-manylinux.whl.metadata (4.7 kB)
Collecting torch>=2.6
Downloading av-14.0.0-cp311-cp311-manylinux_2_28_x86_64.whl (9.9 MB)
Downloading https://pytorch.org/whl/torch-2.13.0-cp311-cp311-linux_x86_64.whl (190.4 MB)
Downloading nvidia_cublas-12.8-py3-none-manylinux_2_27_x86_64.whl (1.2 GB)
Installing collected packages: av, torch, nvidia_cublas
Successfully installed av torch nvidia_cublas
"""


@pytest.mark.parametrize("code", [0, 1])
def test_an_install_is_not_silent(bare_tree: Path, code: int) -> None:
    """A line for each stage, with the time; all that pip says only where it fails."""
    venv = bare_tree / ".venv" / "bin"
    venv.mkdir(parents=True)
    (bare_tree / "says").write_text(PIP_SAYS)
    python = venv / "python"
    script = f"[ $1 = -c ] && echo 3.11 && exit 0\ncat {bare_tree / 'says'}; exit {code}\n"
    python.write_text(f"#!/bin/sh\n{script}", encoding="utf-8")
    python.chmod(0o755)
    result = set_up(bare_tree)
    assert result.returncode == code
    lines = [re.sub(r"\b\d+ s\b", "N s", line) for line in result.stdout.splitlines()]
    assert lines[1:5] == [
        "set-up: N s: looking up packages",
        "set-up: N s: downloading torch-2.13.0-cp311-cp311-linux_x86_64.whl (190.4 MB)",
        "set-up: N s: downloading nvidia_cublas-12.8-py3-none-manylinux_2_27_x86_64.whl (1.2 GB)",
        "set-up: N s: installing 3 packages",
    ]
    assert lines[5:] == ([] if code else ["set-up: installed after N s"])
    assert ("Successfully installed" in result.stderr) == bool(code)


def test_help_lists_the_targets(repository: Path) -> None:
    environment = {k: v for k, v in os.environ.items() if not k.startswith(("MAKE", "MFLAGS"))}
    listing = subprocess.run(
        ["make"], cwd=repository, env=environment, capture_output=True, text=True, check=True
    ).stdout
    for target in ("demo", "test", "test-fast", "check", "wheelhouse", "clean"):
        assert f"make {target} " in listing


@pytest.fixture(scope="module")
def wheelhouse(load_script: Callable[[str], ModuleType]) -> ModuleType:
    return load_script(".ci/wheelhouse.py")


def test_wheelhouse_pins_are_those_of_the_other_python(wheelhouse: ModuleType) -> None:
    """numpy 2.4 needs 3.11: what is chosen follows the machine it is for, not this one."""
    chosen = {python: wheelhouse.pins(python, with_torch=False) for python in wheelhouse.SUPPORTED}
    numpy = {python: [p for p in chosen[python] if p.startswith("numpy")] for python in chosen}
    assert numpy["3.10"] == ["numpy==2.2.6"]
    assert numpy["3.11"] == numpy["3.12"] == numpy["3.13"] == ["numpy==2.4.6"]
    assert "tomli" in " ".join(chosen["3.10"])
    assert "tomli" not in " ".join(chosen["3.11"])
    assert not any(pin.startswith("torch") for pins in chosen.values() for pin in pins)
    assert "torch==2.13.0" in wheelhouse.pins("3.12", with_torch=True)


def test_wheelhouse_refuses_an_unsupported_python(repository: Path) -> None:
    command = [sys.executable, str(repository / ".ci/wheelhouse.py"), "--python", "3.9"]
    result = subprocess.run(command, capture_output=True, text=True, check=False)
    assert result.returncode == 2
    assert "valid: 3.10, 3.11, 3.12, 3.13" in result.stderr


def test_opengl_check_names_the_valid_backends(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("MUJOCO_GL", "vulkan")
    assert opengl_check.main([]) == 2
    message = capsys.readouterr().err
    assert "MUJOCO_GL=vulkan" in message
    assert "egl, osmesa, glfw" in message
    assert message.count("\n") == 1


def test_opengl_check_prints_the_apt_line_when_it_may_not_install(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The libraries of EGL are absent and the user is not root: one line, nothing is run."""
    monkeypatch.setenv("MUJOCO_GL", "egl")
    monkeypatch.setattr(os, "geteuid", lambda: 1000)
    monkeypatch.setattr(opengl_check, "_PROBE", "raise ImportError('no libEGL')")
    assert opengl_check.main(["--install"]) == 2
    message = capsys.readouterr().err
    assert "no libEGL" in message
    assert "run: sudo apt-get update && sudo apt-get install -y" in message
    assert "libegl1" in message


@pytest.mark.parametrize(
    ("variables", "message"),
    [
        ({"MUJOCO_EGL_DEVICE_ID": "99"}, "MUJOCO_EGL_DEVICE_ID=99: there is no such EGL device"),
        ({"MUJOCO_EGL_DEVICE_ID": "-1"}, "MUJOCO_EGL_DEVICE_ID=-1: there is no such EGL device"),
        ({"MUJOCO_EGL_DEVICE_ID": "gpu"}, "='gpu': must be the number of an EGL device"),
        ({"MUJOCO_EGL_DEVICE_ID": ""}, "='': must be the number of an EGL device"),
        ({"MUJOCO_EGL_DEVICE_ID": "1"}, r"=1: this EGL device cannot draw \[it broke\]"),
        ({"PYOPENGL_PLATFORM": "glx"}, "PYOPENGL_PLATFORM=glx: does not go with MUJOCO_GL=egl"),
        ({"MUJOCO_GL": "glfw", "DISPLAY": ""}, "needs a display"),
    ],
)
def test_a_wrong_variable_is_no_missing_library(
    variables: dict[str, str], message: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("MUJOCO_GL", "egl")
    monkeypatch.delenv("PYOPENGL_PLATFORM", raising=False)
    for name, value in variables.items():
        monkeypatch.setenv(name, value)
    monkeypatch.setattr(opengl_check, "_count_egl_devices", lambda: 3)
    line = opengl_check.explain_failure(opengl_check.backend_in_use(), "it broke")
    assert re.search(message, line)
    assert "apt-get" not in line
    if "MUJOCO_EGL_DEVICE_ID" in variables:
        assert "there are 3, valid: 0 to 2, or unset it" in line


@pytest.mark.gl
def test_opengl_check_knows_how_many_devices_there_are(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("MUJOCO_GL", "egl")
    monkeypatch.setenv("MUJOCO_EGL_DEVICE_ID", "4096")
    assert opengl_check.main(["--install"]) == 2
    message = capsys.readouterr().err
    assert re.search(r"=4096: there is no such EGL device; there (is|are) \d+, valid: 0", message)
    assert message.count("\n") == 1


def test_without_egl_the_library_is_what_is_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MUJOCO_EGL_DEVICE_ID", "0")
    monkeypatch.delenv("PYOPENGL_PLATFORM", raising=False)
    monkeypatch.setattr(opengl_check, "_count_egl_devices", lambda: 0)
    assert "apt-get install" in opengl_check.explain_failure("egl", "no libEGL")


def test_opengl_check_installs_at_once_when_root(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """As root it runs the line, then looks again; here a stand-in for apt-get "installs"."""
    installed = tmp_path / "installed"
    apt = tmp_path / "apt-get"
    apt.write_text(f"#!/bin/sh\necho $@ >> {installed}\n", encoding="utf-8")
    apt.chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}:{os.environ['PATH']}")
    monkeypatch.setenv("MUJOCO_GL", "egl")
    monkeypatch.setattr(os, "geteuid", lambda: 0)
    probe = (
        f"import pathlib; assert pathlib.Path({str(installed)!r}).exists(); print('renderer: X')"
    )
    monkeypatch.setattr(opengl_check, "_PROBE", probe)

    assert opengl_check.main([]) == 2
    assert not installed.exists()
    assert opengl_check.main(["--install"]) == 0
    assert "update" in installed.read_text().splitlines()[0]
    assert "libegl1" in installed.read_text().splitlines()[1]
    assert "egl works (X)" in capsys.readouterr().out


@pytest.mark.gl
def test_opengl_check_really_renders() -> None:
    assert opengl_check.opengl_problem() is None
