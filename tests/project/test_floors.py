"""Floors of the packages: a folder imports only from folders below it (docs/architecture.md)."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import pytest

ROBOT = (
    "commands",
    "benchmark",
    "teleop",
    "rollout",
    "training",
    "policy",
    "data",
    "envs.mujoco.tasks",
    "envs.mujoco.expert",
    "envs.mujoco.face",
    "envs.mujoco.cell",
    "observation",
    "runs",
)
FACE = (
    "commands",
    "live",
    "evaluation",
    "training",
    "models",
    "dataset",
    "prediction",
    "forecast",
    "motion",
    "tracking",
)
FLOORS = {"robo_manip_baselines": ROBOT, "face_prediction": FACE}
BENEATH = "robo_manip_baselines.runs"
"""Module that face_prediction may import of the other package."""


def imported(source: str) -> set[str]:
    """Absolute names of imported modules, and of names that may be modules, at any depth."""
    names: set[str] = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            names |= {node.module, *(f"{node.module}.{alias.name}" for alias in node.names)}
    return names


def floor_of(package: str, module: str) -> int | None:
    """Number of a module's floor, 0 on top; None for what lies beside the folders."""
    inside = f"{module.removeprefix(package).lstrip('.')}."
    for number, folder in enumerate(FLOORS[package]):
        if inside.startswith(f"{folder}."):
            return number
    return None


@pytest.mark.parametrize("package", FLOORS)
def test_a_folder_imports_only_from_folders_below_it(package: str, repository: Path) -> None:
    upward = []
    for path in sorted((repository / package).rglob("*.py")):
        module = ".".join(path.relative_to(repository).with_suffix("").parts)
        own = floor_of(package, module)
        for name in sorted(imported(path.read_text(encoding="utf-8"))):
            other = floor_of(package, name) if name.startswith(f"{package}.") else None
            if own is not None and other is not None and other < own:
                upward.append(f"{module} imports {name}")
    assert upward == []


def test_every_folder_has_a_floor(repository: Path) -> None:
    for package, floors in FLOORS.items():
        for path in (repository / package).rglob("*.py"):
            parts = path.relative_to(repository / package).parts
            module = ".".join([package, *parts[:-1]])
            is_between = any(floor.startswith(".".join(parts[:-1])) for floor in floors)
            assert floor_of(package, module) is not None or is_between, path


def test_the_packages_meet_in_files_and_in_runs(repository: Path) -> None:
    for path in (repository / "face_prediction").rglob("*.py"):
        for name in imported(path.read_text(encoding="utf-8")):
            if name.startswith("robo_manip_baselines"):
                assert f"{name}.".startswith(f"{BENEATH}."), f"{path} imports {name}"
    for path in (repository / "robo_manip_baselines").rglob("*.py"):
        names = imported(path.read_text(encoding="utf-8"))
        assert not any(name.split(".")[0] == "face_prediction" for name in names), path


def test_one_module_names_what_is_of_the_other_package(repository: Path) -> None:
    """A reference ``module:name`` is imported when it is used (docs/decisions/0014)."""
    found = {
        path.relative_to(repository).as_posix()
        for path in (repository / "robo_manip_baselines").rglob("*.py")
        if re.search(r"[\"']face_prediction[.:]", path.read_text(encoding="utf-8"))
    }
    assert found == {"robo_manip_baselines/envs/mujoco/face/perception.py"}


def test_runs_know_no_faces_and_no_robots(repository: Path) -> None:
    heavy = {"torch", "mujoco", "gymnasium", "mediapipe", "cv2", "h5py"}
    for path in (repository / "robo_manip_baselines/runs").rglob("*.py"):
        tree = ast.parse(path.read_text(encoding="utf-8"))
        top = {
            alias.name.split(".")[0]
            if isinstance(node, ast.Import)
            else str(node.module).split(".")[0]
            for node in tree.body
            if isinstance(node, ast.Import | ast.ImportFrom)
            for alias in node.names
        }
        assert not top & heavy, path


OPENERS = {
    r"np\.load\b|np\.lib\.format|\bNpzFile\b|_MAGIC = b.*NUMPY": "runs/npz.py",
    r"safetensors\.torch\.load|safe_open|import load_file": "runs/tensors.py",
    r"h5py\.File\(.*\"r\"": "runs/hdf5.py",
}
"""Call that opens a file of arrays -> the one module that checks sizes before reading."""


@pytest.mark.parametrize("pattern", OPENERS)
def test_one_module_opens_each_kind_of_array_file(pattern: str, repository: Path) -> None:
    found = {
        path.relative_to(repository / "robo_manip_baselines").as_posix()
        if path.is_relative_to(repository / "robo_manip_baselines")
        else str(path)
        for package in FLOORS
        for path in (repository / package).rglob("*.py")
        if re.search(pattern, path.read_text(encoding="utf-8"))
    }
    assert found == {OPENERS[pattern]}


def test_documents_are_read_in_one_place(repository: Path) -> None:
    """Nothing but ``runs/documents.py`` parses JSON or YAML."""
    parsers = {("json", "load"), ("json", "loads"), ("json", "JSONDecoder")}
    parsers |= {("yaml", name) for name in ("load", "safe_load", "load_all", "compose", "parse")}
    found = {
        path.relative_to(repository).as_posix()
        for package in FLOORS
        for path in (repository / package).rglob("*.py")
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.Attribute)
        and isinstance(node.value, ast.Name)
        and (node.value.id, node.attr) in parsers
    }
    assert found == {"robo_manip_baselines/runs/documents.py"}
