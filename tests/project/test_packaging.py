"""pyproject.toml, constraints.txt and the changelog agree with each other and with the code."""

from __future__ import annotations

import fnmatch
import importlib.metadata
import re
import sys
from pathlib import Path
from typing import Any

import pytest
from packaging.requirements import Requirement
from packaging.specifiers import SpecifierSet
from packaging.utils import canonicalize_name

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

PYTHONS = ("3.10", "3.11", "3.12", "3.13")


@pytest.fixture(scope="module")
def pyproject(repository: Path) -> dict[str, Any]:
    return tomllib.loads((repository / "pyproject.toml").read_text(encoding="utf-8"))


@pytest.fixture(scope="module")
def constraints(repository: Path) -> list[Requirement]:
    lines = (repository / "constraints.txt").read_text(encoding="utf-8").splitlines()
    return [Requirement(line) for line in lines if line and not line.startswith("#")]


def declared(pyproject: dict[str, Any]) -> list[Requirement]:
    project = pyproject["project"]
    lists = [project["dependencies"], *project["optional-dependencies"].values()]
    return [Requirement(line) for group in lists for line in group]


def pinned(constraints: list[Requirement], python: str) -> dict[str, str]:
    """Return the version of each package that the constraints give ``python``."""
    environment = {"python_version": python, "python_full_version": f"{python}.0"}
    pins: dict[str, str] = {}
    for constraint in constraints:
        if constraint.marker and not constraint.marker.evaluate(environment):
            continue
        name = canonicalize_name(constraint.name)
        assert name not in pins, f"{name} is pinned twice for Python {python}"
        (specifier,) = constraint.specifier
        assert specifier.operator == "==", constraint
        pins[name] = specifier.version
    return pins


@pytest.mark.parametrize("python", PYTHONS)
def test_every_dependency_is_pinned_within_its_range(
    python: str, pyproject: dict[str, Any], constraints: list[Requirement]
) -> None:
    pins = pinned(constraints, python)
    for requirement in declared(pyproject):
        version = pins[canonicalize_name(requirement.name)]
        assert requirement.specifier.contains(version), (str(requirement), version)


def test_what_the_dependencies_need_is_pinned(
    pyproject: dict[str, Any], constraints: list[Requirement]
) -> None:
    """The pins are complete: a wheelhouse is made from them without a resolver."""
    pins = pinned(constraints, f"{sys.version_info[0]}.{sys.version_info[1]}")
    todo = [(r.name, frozenset(r.extras)) for r in declared(pyproject)]
    seen = set()
    while todo:
        name, extras = todo.pop()
        if (name, extras) in seen:
            continue
        seen.add((name, extras))
        assert canonicalize_name(name) in pins, f"constraints.txt lacks {name}"
        try:
            lines = importlib.metadata.requires(name) or []
        except importlib.metadata.PackageNotFoundError:
            continue  # an extra that is not installed here
        for line in lines:
            needed = Requirement(line)
            if re.match(r"nvidia-|cuda-|triton", needed.name):
                continue  # torch's own, which it pins exactly, and only its CUDA builds need
            environments = [{"extra": extra} for extra in extras] or [{"extra": ""}]
            if needed.marker is None or any(map(needed.marker.evaluate, environments)):
                todo.append((needed.name, frozenset(needed.extras)))
    assert len(seen) > 30


def test_the_known_good_versions(constraints: list[Requirement], pyproject: dict[str, Any]) -> None:
    for python in PYTHONS:
        pins = pinned(constraints, python)
        assert pins["torch"] == "2.13.0"
    assert SpecifierSet(pyproject["project"]["requires-python"]) == SpecifierSet(">=3.10,<3.14")
    (mujoco,) = [r for r in declared(pyproject) if r.name == "mujoco"]
    verdicts = {v: mujoco.specifier.contains(v) for v in ("3.16.0", "3.17.0", "4.0.0", "4.0.1")}
    assert verdicts == {"3.16.0": False, "3.17.0": True, "4.0.0": False, "4.0.1": True}


def test_the_version_is_one(pyproject: dict[str, Any], repository: Path) -> None:
    import robo_manip_baselines

    version = pyproject["project"]["version"]
    assert robo_manip_baselines.__version__ == version
    changelog = (repository / "CHANGELOG.md").read_text(encoding="utf-8")
    newest = re.search(r"^## \[([^]]+)\]", changelog, flags=re.MULTILINE)
    assert newest is not None
    assert newest[1] == version


def test_every_data_file_of_a_package_is_installed(
    pyproject: dict[str, Any], project_files: list[Path]
) -> None:
    patterns = ["*/py.typed"]
    for package, globs in pyproject["tool"]["setuptools"]["package-data"].items():
        if package != "*":
            patterns += [f"{package.replace('.', '/')}/{glob}" for glob in globs]
    packages = ("robo_manip_baselines", "face_prediction")
    data = [f for f in project_files if f.parts[0] in packages and f.suffix != ".py"]
    left_out = [str(f) for f in data if not any(fnmatch.fnmatch(str(f), p) for p in patterns)]
    assert left_out == []


def test_every_package_folder_has_an_init(repository: Path, project_files: list[Path]) -> None:
    """setuptools installs a folder of modules only if it has one."""
    folders = {
        f.parent
        for f in project_files
        if f.suffix == ".py" and f.parts[0] in ("robo_manip_baselines", "face_prediction")
    }
    assert [str(f) for f in folders if not (repository / f / "__init__.py").is_file()] == []


def test_every_marker_in_use_is_declared(
    pyproject: dict[str, Any], repository: Path, project_files: list[Path]
) -> None:
    builtin = {"parametrize", "skip", "skipif", "xfail", "usefixtures", "filterwarnings"}
    options = pyproject["tool"]["pytest"]["ini_options"]
    markers = {line.partition(":")[0] for line in options["markers"]}
    used = set()
    for f in project_files:
        if f.parts[0] == "tests" and f.suffix == ".py":
            used |= set(re.findall(r"pytest\.mark\.(\w+)", (repository / f).read_text("utf-8")))
    assert used - builtin <= markers
    assert options["filterwarnings"][0] == "error"


def test_every_program_of_bin_is_installed(pyproject: dict[str, Any], repository: Path) -> None:
    from robo_manip_baselines import commands

    for script in (repository / "bin").glob("*.py"):
        name = script.stem.lower()
        target = pyproject["project"]["scripts"][f"rmb-{name}"]
        module, _, function = target.partition(":")
        assert module == commands.__name__
        assert f'run("{name}")' in script.read_text(encoding="utf-8")
        assert callable(getattr(commands, function))
