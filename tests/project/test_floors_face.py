"""Floors of ``face_prediction``: a folder imports only from folders below it."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

PACKAGE = Path(__file__).resolve().parents[2] / "face_prediction"
FLOORS = (
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
"""Folders from top to bottom."""

MODULES = sorted(path.relative_to(PACKAGE) for path in PACKAGE.rglob("*.py"))


def imports(path: Path) -> Iterator[str]:
    """Dotted names of all that a module imports, inside functions too."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            # `from package import name` may import a module
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def test_every_folder_is_a_floor() -> None:
    folders = {path.name for path in PACKAGE.iterdir() if any(path.glob("*.py"))}
    assert folders == set(FLOORS)


@pytest.mark.parametrize("module", MODULES, ids=str)
def test_a_module_imports_from_floors_below(module: Path) -> None:
    floor = module.parts[0] if len(module.parts) > 1 else None
    for name in imports(PACKAGE / module):
        parts = name.split(".")
        if parts[0] == "robo_manip_baselines":
            assert parts[1] == "runs", f"{module} imports {name}"
        if parts[0] != "face_prediction" or len(parts) < 2 or floor is None:
            continue
        assert parts[1] in FLOORS, f"{module} imports {name}"
        if floor == "commands" == parts[1]:
            # the command line loads commands by name; a command imports no other command
            assert module.stem == "cli", f"{module} imports {name}"
        else:
            assert FLOORS.index(parts[1]) >= FLOORS.index(floor), f"{module} imports {name}"
