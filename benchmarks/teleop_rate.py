"""Rate of the teleoperation loop with the device ``web``: with a browser or without, and cameras.

A scripted hand moves the right arm in a circle while an episode is recorded. The browser is
headless Chromium on the same machine, which draws the scene without a GPU: the worst case. The
processor time of the session's own process is about the same on a busy machine as on an idle one;
below 20 ms a step, a core of its own holds 50 Hz. Prints a Markdown table.

Example: python benchmarks/teleop_rate.py --seconds 20
"""

from __future__ import annotations

import math
import os
import select
import shutil
import subprocess
import sys
import time
from contextlib import ExitStack, closing
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
from annotated_types import Interval

from robo_manip_baselines.envs.mujoco.cell.scene import CONTROL_PERIOD
from robo_manip_baselines.envs.mujoco.tasks.face_env import world_of
from robo_manip_baselines.envs.mujoco.tasks.registry import make_env
from robo_manip_baselines.observation import CAMERAS
from robo_manip_baselines.rollout.demonstrate import Demonstration
from robo_manip_baselines.runs.browser import PageOptions
from robo_manip_baselines.runs.command import parse, run_command
from robo_manip_baselines.teleop.device import (
    Mode,
    SessionView,
    TeleopCommand,
    TeleopEvent,
    TeleopInput,
)
from robo_manip_baselines.teleop.session import SessionSummary, TeleopSession
from robo_manip_baselines.teleop.web import WebDevice

KWARGS: dict[str, Any] = {"cameras": [], "image_size": [480, 640], "face_motion": "episode"}

WARM_UP = 150
"""Control steps of practice, with the page open, before the measurement."""

VISIT = """
import sys, time
from playwright.sync_api import sync_playwright
with sync_playwright() as driver:
    browser = driver.chromium.launch(executable_path=sys.argv[1], args=sys.argv[3:])
    page = browser.new_page(viewport={"width": 640, "height": 480})
    page.goto(sys.argv[2])
    page.wait_for_selector("[data-rmb=mode]", timeout=300000)
    print("open", flush=True)
    time.sleep(3600)
"""
FLAGS = ("--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")


@dataclass(frozen=True)
class Options:
    """Measure the rate of the loop.

    Attributes:
        seconds: Simulated time of each measurement.
        env: Task.
    """

    seconds: Annotated[float, Interval(ge=1.0, le=600.0)] = 12.0
    env: str = "FeedingEnv"


class CirclingHand:
    """Device that shows the page and moves the arm by itself; it records one episode.

    Args:
        page: shown.
        steps: of the episode.
    """

    is_paced = True

    def __init__(self, page: WebDevice, steps: int) -> None:
        self._page, self._steps, self._practised = page, steps, 0
        self.visitor: subprocess.Popen[str] | None = None
        self.busy = 0.0

    def update(self, view: SessionView) -> TeleopInput:
        """Show the page, and return the next part of the circle."""
        self._page.update(view)
        if view.mode is Mode.PRACTICE:
            self._practised += self._is_open()
            is_warm = self._practised > WARM_UP
            self._begin = time.process_time()
            return TeleopInput(events=(TeleopEvent.RECORD,) if is_warm else ())
        if view.mode is Mode.REVIEW or view.step >= self._steps:
            self.busy = time.process_time() - self._begin
            return TeleopInput(events=(TeleopEvent.SAVE,))
        angle = 2.0 * math.pi * view.step * CONTROL_PERIOD / 4.0
        circle = np.array([0.0, 0.08 * math.cos(angle), 0.08 * math.sin(angle)])
        return TeleopInput({"right": TeleopCommand(circle)})

    def _is_open(self) -> bool:
        """Return whether the visitor, if there is one, sees the page."""
        if self.visitor is None:
            return True
        assert self.visitor.stdout is not None
        return bool(self._practised or select.select([self.visitor.stdout], [], [], 0.0)[0])

    def close(self) -> None:
        """Close the page."""
        self._page.close()


class Nowhere:
    """Keeps no episode."""

    def save(self, episode: Demonstration) -> str:
        """Drop it."""
        return ""

    def poll(self) -> str:
        """Nothing is going on."""
        return ""


def measure(
    options: Options, chromium: str | None, cameras: tuple[str, ...]
) -> tuple[SessionSummary, float]:
    """Return the summary of a session of one episode, and processor time in s of a step."""
    steps = round(options.seconds / CONTROL_PERIOD)
    with ExitStack() as closer:
        env = closer.enter_context(closing(make_env(options.env, cameras=())))
        env.reset(seed=0)
        page = WebDevice(world_of(env), ("right",), cameras=cameras, page=PageOptions(port=0))
        hand = CirclingHand(page, steps)
        closer.callback(page.close)
        if chromium:
            command = [sys.executable, "-c", VISIT, chromium, page.address, *FLAGS]
            visitor = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
            closer.callback(visitor.communicate)
            closer.callback(visitor.terminate)
            hand.visitor = visitor
        session = TeleopSession(
            env,
            hand,
            Nowhere(),
            [0],
            world_of(env).observation_spec.arm_names,
            env_kwargs=KWARGS,
            operator="benchmark",
            device_name="web",
            step_limit=steps,
            codec="jpeg",
            quality=90,
        )
        summary = session.run()
    return summary, hand.busy / summary.steps


def main() -> None:
    """Print the table."""
    options = parse(Options, example="python benchmarks/teleop_rate.py --seconds 20")
    chromium = shutil.which("chromium") or shutil.which("google-chrome")
    cores, load = os.cpu_count(), os.getloadavg()[0]
    print(f"{cores} cores, of which other work wants {load:.1f}")
    print("| browser | cameras | loop rate, Hz | late steps | processor time, ms a step |")
    print("|---|---|---|---|---|")
    visits = [(None, ()), *([(chromium, ()), (chromium, CAMERAS)] if chromium else [])]
    for browser, cameras in visits:
        summary, busy = measure(options, browser, cameras)
        name = "same machine, without a GPU" if browser else "none"
        late = f"{summary.missed} of {summary.steps}"
        print(
            f"| {name} | {len(cameras) or 'none'} | {summary.rate:.1f} | {late} "
            f"| {1000 * busy:.1f} |",
            flush=True,
        )


if __name__ == "__main__":
    run_command(main)
