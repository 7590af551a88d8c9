"""Cost of an observation's three camera images, next to the public ALOHA cell's.

Measures, in one run on one machine and in turns: the three cameras of FeedingEnv as a policy sees
them, the same with shadows and multisampling, and the cameras ``top``, ``angle`` and
``front_close`` of gym-aloha 0.1.5 drawn by ``mujoco.Renderer`` as that model has them (shadows,
4 samples a pixel) and with both off. Only the assets of gym-aloha are read:

    pip install --no-deps --target /tmp/gym-aloha gym-aloha==0.1.5
    python benchmarks/render_cameras.py --gym_aloha /tmp/gym-aloha
"""

from __future__ import annotations

import contextlib
import os
import platform
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from robo_manip_baselines.envs.mujoco.cell.opengl import backend_in_use
from robo_manip_baselines.envs.mujoco.cell.rendering import CameraRenderer
from robo_manip_baselines.envs.mujoco.tasks.feeding.env import FeedingEnv
from robo_manip_baselines.observation import CAMERAS
from robo_manip_baselines.runs.command import parse, run_command
from robo_manip_baselines.runs.errors import RequestError
from robo_manip_baselines.runs.files import write_json

EXAMPLE = "python benchmarks/render_cameras.py --gym_aloha /tmp/gym-aloha --rounds 50"
SCENE = Path("gym_aloha", "assets", "bimanual_viperx_transfer_cube.xml")
HOW_TO_GET_IT = (
    "run: pip install --no-deps --target /tmp/gym-aloha gym-aloha==0.1.5; "
    "then give --gym_aloha /tmp/gym-aloha"
)
OURS, OURS_FINE = "FeedingEnv", "FeedingEnv, shadows + 4x MSAA"
PUBLIC, PUBLIC_PLAIN = "gym-aloha, as it comes", "gym-aloha, no shadows, no MSAA"

Draw = Callable[[], object]


@dataclass(frozen=True)
class Options:
    """Measure the cost of three camera images, here and in the public ALOHA cell.

    Attributes:
        rounds: how often each set of three images is drawn, in turns.
        height: image height in pixels.
        width: image width in pixels.
        gym_aloha: folder that holds the package gym_aloha; the installed one by default.
        json: file to write the figures to.
    """

    rounds: int = 30
    height: int = 480
    width: int = 640
    gym_aloha: Path | None = None
    json: Path | None = None

    def __post_init__(self) -> None:
        if self.rounds < 1 or self.height < 1 or self.width < 1:
            raise RequestError("--rounds, --height and --width must be 1 or more")


def find_public_scene(folder: Path | None) -> Path:
    """Return the public cell's XML file, in ``folder`` or in the installed package.

    Raises:
        RequestError: it is not there, with how to get it.
    """
    if folder is not None:
        if (folder / SCENE).is_file():
            return folder / SCENE
        raise RequestError(f"--gym_aloha {folder} has no {SCENE}; {HOW_TO_GET_IT}")
    package = find_spec("gym_aloha")  # finds, does not import: its dependencies are not needed
    if package is None or package.origin is None:
        raise RequestError(f"gym-aloha is not installed; {HOW_TO_GET_IT}")
    return Path(package.origin).parents[1] / SCENE


@contextlib.contextmanager
def our_cell(height: int, width: int) -> Iterator[dict[str, Draw]]:
    """FeedingEnv's cameras at the start of an episode, plain and fine."""
    env = FeedingEnv(cameras=())
    try:
        env.reset(seed=0)
        model, data = env.model, env.data
        with (
            CameraRenderer(model, height, width) as plain,
            CameraRenderer(model, height, width, shadows=True, multisamples=4) as fine,
        ):
            yield {
                OURS: lambda: plain.render(data, CAMERAS),
                OURS_FINE: lambda: fine.render(data, CAMERAS),
            }
    finally:
        env.close()


@contextlib.contextmanager
def public_cell(scene: Path, height: int, width: int) -> Iterator[dict[str, Draw]]:
    """The public cell's cameras, drawn as its users do: update and render for each camera."""
    model = mujoco.MjModel.from_xml_path(str(scene))
    model.vis.global_.offwidth = max(width, model.vis.global_.offwidth)
    model.vis.global_.offheight = max(height, model.vis.global_.offheight)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)

    def draw(renderer: mujoco.Renderer, shadows: bool) -> list[np.ndarray]:
        images = []
        for camera in CAMERAS:
            renderer.update_scene(data, camera)
            renderer.scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = shadows
            images.append(renderer.render())
        return images

    with mujoco.Renderer(model, height, width) as default:
        model.vis.quality.offsamples = 0
        with mujoco.Renderer(model, height, width) as plain:
            yield {
                PUBLIC: lambda: draw(default, shadows=True),
                PUBLIC_PLAIN: lambda: draw(plain, shadows=False),
            }


def measure(draws: dict[str, Draw], rounds: int) -> dict[str, NDArray[np.float64]]:
    """Return (rounds, 2) ms of each draw: wall time, and processor time of all threads together.

    Rounds take turns. The first is not counted: it compiles shaders.
    """
    times: dict[str, list[tuple[float, float]]] = {name: [] for name in draws}
    for _ in range(rounds + 1):
        for name, draw in draws.items():
            wall, cpu = time.perf_counter(), time.process_time()
            draw()
            times[name].append((time.perf_counter() - wall, time.process_time() - cpu))
    return {name: 1000 * np.array(rows[1:]) for name, rows in times.items()}


def summarise(times: dict[str, NDArray[np.float64]]) -> dict[str, dict[str, float]]:
    """Return the median wall time, its 10 % and 90 % quantiles and the median processor time, ms.

    ``ratio`` is the median over rounds of the wall time in units of our own cell's.
    """
    return {
        name: {
            "median_ms": float(np.median(rows[:, 0])),
            "p10_ms": float(np.quantile(rows[:, 0], 0.1)),
            "p90_ms": float(np.quantile(rows[:, 0], 0.9)),
            "cpu_ms": float(np.median(rows[:, 1])),
            "ratio": float(np.median(rows[:, 0] / times[OURS][:, 0])),
        }
        for name, rows in times.items()
    }


def print_table(summary: dict[str, dict[str, float]], options: Options) -> None:
    """Print the figures."""
    print(
        f"three cameras, {options.width}x{options.height}, {options.rounds} rounds, "
        f"MuJoCo {mujoco.__version__}, {os.cpu_count()} CPUs, {platform.machine()}"
    )
    print(
        f"{'ms per set of images':32s} {'median':>8s} {'10 %':>8s} {'90 %':>8s} "
        f"{'CPU':>8s} {'ratio':>7s}"
    )
    for name, row in summary.items():
        print(
            f"{name:32s} {row['median_ms']:8.1f} {row['p10_ms']:8.1f} {row['p90_ms']:8.1f} "
            f"{row['cpu_ms']:8.1f} {row['ratio']:6.1f}x"
        )


def report(summary: dict[str, dict[str, float]], options: Options) -> dict[str, Any]:
    """Return the figures and what they were measured with, ready for JSON."""
    return {
        "height": options.height,
        "width": options.width,
        "rounds": options.rounds,
        "mujoco": mujoco.__version__,
        "cpus": os.cpu_count(),
        "results": summary,
    }


def main() -> None:
    """Run the benchmark."""
    if "MUJOCO_GL" not in os.environ:  # mujoco.Renderer needs it set before Python starts
        environment = os.environ | {"MUJOCO_GL": backend_in_use()}
        os.execve(sys.executable, [sys.executable, *sys.argv], environment)
    options = parse(Options, EXAMPLE)
    scene = find_public_scene(options.gym_aloha)
    with (
        our_cell(options.height, options.width) as ours,
        public_cell(scene, options.height, options.width) as public,
    ):
        summary = summarise(measure(ours | public, options.rounds))
    print_table(summary, options)
    if options.json is not None:
        write_json(options.json, report(summary, options))


if __name__ == "__main__":
    run_command(main)
