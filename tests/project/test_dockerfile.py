"""The Dockerfile installs what the README names, and copies only what there is."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import pytest

from robo_manip_baselines.envs.mujoco.cell.opengl import APT_PACKAGES

INSTRUCTIONS = {"FROM", "ARG", "RUN", "ENV", "WORKDIR", "COPY", "CMD"}


@pytest.fixture(scope="module")
def instructions(repository: Path) -> list[tuple[str, str]]:
    """Name and arguments of every instruction, continued lines joined."""
    text = (repository / "Dockerfile").read_text(encoding="utf-8")
    lines = [line for line in text.splitlines() if not line.startswith("#")]
    joined = "\n".join(lines).replace("\\\n", " ")
    return [(name, rest.strip()) for name, _, rest in map(split, joined.splitlines()) if name]


def split(line: str) -> tuple[str, str, str]:
    return line.strip().partition(" ")


def test_instructions_are_known_and_the_base_is_tested(
    instructions: list[tuple[str, str]], repository: Path
) -> None:
    assert {name for name, _ in instructions} <= INSTRUCTIONS
    (base,) = (rest for name, rest in instructions if name == "FROM")
    version = re.fullmatch(r"python:3\.(\d+)-slim-bookworm", base)
    assert version
    project = (repository / "pyproject.toml").read_text(encoding="utf-8")
    assert f"Python :: 3.{version[1]}" in project


def test_what_is_copied_exists_and_is_not_ignored(
    instructions: list[tuple[str, str]], repository: Path
) -> None:
    ignored = (repository / ".dockerignore").read_text(encoding="utf-8").splitlines()
    copied = [
        word for name, rest in instructions if name == "COPY" for word in shlex.split(rest)[:-1]
    ]
    assert {"pyproject.toml", "constraints.txt", "robo_manip_baselines", "bin"} <= set(copied)
    for path in copied:
        assert (repository / path).exists(), path
        assert path not in ignored


def test_the_packages_are_those_that_rendering_needs(instructions: list[tuple[str, str]]) -> None:
    (line,) = (rest for name, rest in instructions if name == "RUN" and "apt-get" in rest)
    installed = line.partition("--no-install-recommends")[2].partition("&&")[0].split()
    assert installed == list(APT_PACKAGES["egl"])
    assert ("ENV", "MUJOCO_GL=egl") in instructions


def test_the_installation_is_that_of_the_documentation(
    instructions: list[tuple[str, str]], repository: Path
) -> None:
    page = (repository / "docs" / "installation.md").read_text(encoding="utf-8")
    (documented,) = re.findall(r"^pip install (.*)$", page, flags=re.MULTILINE)
    (line,) = (rest for name, rest in instructions if name == "RUN" and "pip install" in rest)
    words = shlex.split(line)
    assert shlex.split(documented) == words[-4:]
    (image,) = re.findall(r"^docker build -t (\S+) \.$", page, flags=re.MULTILINE)
    assert f" {image} python bin/Rollout.py" in page
    argument = re.search(r"--build-arg (\w+)=", page)
    assert argument
    assert any(n == "ARG" and rest.startswith(f"{argument[1]}=") for n, rest in instructions)


def test_the_programs_that_it_runs_exist(
    instructions: list[tuple[str, str]], repository: Path
) -> None:
    named = [
        word
        for name, rest in instructions
        if name in ("CMD", "RUN")
        for word in re.findall(r"bin/\w+\.py|python -m ([\w.]+)", rest)
    ]
    modules = [word for word in named if word]
    assert modules
    for module in modules:
        assert (repository / f"{module.replace('.', '/')}.py").exists()
