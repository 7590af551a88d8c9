"""Fixtures of all tests: the rendering backend, the development clips, hypothesis' profiles."""

from __future__ import annotations

import importlib.util
import os
import shutil
import signal
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import hypothesis
import pytest

# MuJoCo chooses its backend on first import: before any test module is collected.
if sys.platform == "linux":
    os.environ.setdefault("MUJOCO_GL", "egl")

# pytest-xdist starts a process for each core: threads of torch on top of that only wait for each
# other, and small networks in tests get a hundred times slower.
os.environ.setdefault("OMP_NUM_THREADS", "1")

from robo_manip_baselines.envs.mujoco.cell.opengl import opengl_problem

# Commands that tests start inherit signals that are ignored, as they are behind nohup or a shell's
# "&", and would not end when a test asks them to.
for number, action in (
    (signal.SIGINT, signal.default_int_handler),
    (signal.SIGHUP, signal.SIG_DFL),
):
    if signal.getsignal(number) is signal.SIG_IGN:
        signal.signal(number, action)

ROOT = Path(__file__).resolve().parent.parent

# Time limits fail by chance on a busy machine. The same examples are drawn on every run, unless
# HYPOTHESIS_PROFILE=explore asks for many new ones.
hypothesis.settings.register_profile("repeatable", derandomize=True, deadline=None)
hypothesis.settings.register_profile("explore", deadline=None, max_examples=1000)
hypothesis.settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "repeatable"))


def shared_problem() -> tuple[Path, str | None]:
    """Return the folder of development data and why it cannot be used, if so."""
    folder = Path(os.environ.get("RMB_SHARED") or ROOT.parent / "shared")
    if (folder / "faces").is_dir():
        return folder, None
    return folder, f"no development clips: {folder / 'faces'} is not there (set $RMB_SHARED)"


@pytest.fixture(scope="session")
def shared_dir() -> Path:
    """The folder of development data (clips of faces, the detector's model); skips where absent."""
    folder, problem = shared_problem()
    if problem:
        pytest.skip(problem)
    return folder


@pytest.fixture(scope="session")
def browser() -> Iterator[Any]:
    """Headless Chromium, by Playwright; skips where there is none.

    ``RMB_CHROMIUM`` names one that is in no folder of ``PATH``.
    """
    playwright = pytest.importorskip("playwright.sync_api", reason="pip install playwright")
    names = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
    found = os.environ.get("RMB_CHROMIUM") or next(filter(None, map(shutil.which, names)), None)
    if found is None:
        pytest.skip("no Chromium: apt-get install chromium, or name one in $RMB_CHROMIUM")
    flags = (
        # As root, and in containers, there is no sandbox; the pages are ours.
        *("--no-sandbox", "--disable-quic", "--no-first-run", "--disable-sync"),
        *("--disable-background-networking", "--disable-component-update"),
        # 3-D scenes without a GPU.
        *("--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"),
        "--ignore-gpu-blocklist",
    )
    with playwright.sync_playwright() as driver:
        started = driver.chromium.launch(executable_path=found, args=list(flags))
        yield started
        started.close()


@pytest.fixture(scope="session")
def repository() -> Path:
    """The root of the source tree."""
    return ROOT


@pytest.fixture(scope="session")
def load_script() -> Callable[[str], ModuleType]:
    """Import a script anew by its path in the source tree, such as ``benchmarks/latency.py``."""

    def load(path: str) -> ModuleType:
        file = ROOT / path
        spec = importlib.util.spec_from_file_location(file.stem, file)
        assert spec is not None
        assert spec.loader is not None
        module = importlib.util.module_from_spec(spec)
        sys.modules[file.stem] = module  # where a dataclass looks up its annotations
        spec.loader.exec_module(module)
        return module

    return load


def pytest_runtest_setup(item: pytest.Item) -> None:
    """Skip, with the reason, what this machine cannot run."""
    if item.get_closest_marker("gl") and (problem := opengl_problem()):
        pytest.skip(problem)
    if item.get_closest_marker("cuda") and not _has_cuda():
        pytest.skip("no CUDA device")
    if item.get_closest_marker("shared") and (problem := shared_problem()[1]):
        pytest.skip(problem)


def _has_cuda() -> bool:
    import torch  # slow to import

    return torch.cuda.is_available()
