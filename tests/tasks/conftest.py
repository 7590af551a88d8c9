"""The task of ``docs/add-an-environment.md``, installed as another package's."""

from __future__ import annotations

import re
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from robo_manip_baselines.envs.mujoco.tasks import registry

TASKS = Path(__file__).parent


def install(site: Path, name: str, entry_points: str) -> None:
    """Leave in a folder of ``sys.path`` what pip leaves of an installed package: its metadata."""
    info = site / f"{name}-0.1.0.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 0.1.0\n")
    (info / "entry_points.txt").write_text(entry_points)


@pytest.fixture(scope="session")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Site directory in which the package of the page is installed."""
    folder = tmp_path_factory.mktemp("site")
    project = (TASKS / "pyproject.toml").read_text()
    groups = re.findall(r'\[project\.entry-points\."(.+)"\]\n((?:.+\n)+)', project)
    points = "\n".join(f"[{group}]\n{lines}" for group, lines in groups).replace('"', "")
    install(folder, "chin_touch", points)
    return folder


@pytest.fixture(scope="session")
def chin_touch(site: Path) -> Iterator[str]:
    """Name of the installed task, known here and in worker processes, which inherit the path."""
    before = sys.path[:]
    sys.path[:0] = [str(site), str(TASKS)]
    registry._references.cache_clear()
    yield "ChinTouchEnv"
    sys.path[:] = before
    registry._references.cache_clear()
