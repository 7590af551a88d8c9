"""Draws the picture of docs/datasets.md: ``python docs/images/draw_dataset_view.py EPISODE STEP``.

Needs the extra ``view``, Playwright and Chromium.
"""

from __future__ import annotations

import io
import shutil
import sys
from contextlib import closing
from pathlib import Path

from PIL import Image
from playwright.sync_api import sync_playwright

from robo_manip_baselines.rollout.episode_page import EpisodePage
from robo_manip_baselines.runs.browser import PageOptions, serve_page
from robo_manip_baselines.runs.command import run_command

FLAGS = ("--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--ignore-gpu-blocklist")
SIZE = {"width": 1280, "height": 760}
QUALITY = 85  # of WebP, 0 to 100


def main() -> None:
    episode, step = Path(sys.argv[1]), int(sys.argv[2])
    with (
        serve_page(PageOptions(port=0), "Episodes") as (server, address),
        closing(EpisodePage(server, [episode])) as page,
    ):
        page.update()
        page._slider.value = step
        page.update()
        with sync_playwright() as driver:
            browser = driver.chromium.launch(
                executable_path=shutil.which("chromium"),
                args=[*FLAGS, "--enable-unsafe-swiftshader"],
            )
            shown = browser.new_page(viewport=SIZE)
            shown.set_default_timeout(180_000)  # WebGL without a GPU takes long to start
            shown.goto(address)
            shown.get_by_text(f"step {step} of").wait_for()
            shown.locator(".mantine-Notification-closeButton").first.click()
            shown.wait_for_timeout(40_000)  # the scene fades in
            png = shown.screenshot()
            browser.close()
    file = Path(__file__).with_name("dataset_view.webp")
    with Image.open(io.BytesIO(png)) as image:
        image.convert("RGB").save(file, quality=QUALITY, method=6)
    print(file, file.stat().st_size, "bytes")


if __name__ == "__main__":
    run_command(main)
