"""The page: what keys and handles do, and a session in headless Chromium."""

from __future__ import annotations

import re
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import mink
import numpy as np
import pytest

from robo_manip_baselines.data import EpisodeReader
from robo_manip_baselines.data.files import list_failures
from robo_manip_baselines.data.verify import verify_dataset
from robo_manip_baselines.envs.mujoco.cell.rendering import CameraRenderer
from robo_manip_baselines.envs.mujoco.expert.phases import DOWN
from robo_manip_baselines.envs.mujoco.tasks.face_env import world_of
from robo_manip_baselines.envs.mujoco.tasks.registry import make_env
from robo_manip_baselines.runs.browser import PageOptions
from robo_manip_baselines.runs.errors import RequestError
from robo_manip_baselines.runs.images import encode_image
from robo_manip_baselines.teleop.arms import SteeredArms
from robo_manip_baselines.teleop.device import (
    ArmPose,
    SessionView,
    TeleopCommand,
    TeleopEvent,
)
from robo_manip_baselines.teleop.goal import MAX_AHEAD, Goal
from robo_manip_baselines.teleop.hand import (
    MOVES,
    POSES,
    TURNS,
    VIEW_AT,
    VIEW_FROM,
    Drag,
    Hand,
    Key,
    Opening,
)
from robo_manip_baselines.teleop.web import (
    EVENTS,
    HANDLE_SIZE,
    PREVIEW_QUALITY,
    PREVIEW_SIZE,
    Previews,
    key_map,
    status_html,
)

ROOT = Path(__file__).resolve().parents[2]
START = ArmPose(np.array([0.2, 0.5, 0.3]), np.array([0.0, 0.0, 0.0, 1.0]), 1.0)


def arrive(goal: Goal, pose: ArmPose, steps: int, speed: float = 0.25) -> ArmPose:
    """Follow the commands of a goal, as an arm without limits would."""
    for _ in range(steps):
        command: TeleopCommand = goal.command(pose, speed, 1.5)
        assert np.linalg.norm(command.linear) <= speed + 1e-9
        turned = mink.SO3.exp(command.angular * 0.02) @ mink.SO3(pose.orientation)
        pose = ArmPose(pose.position + command.linear * 0.02, turned.wxyz, command.opening or 0.0)
    return pose


def test_a_goal_is_reached_and_held() -> None:
    goal = Goal(np.array([0.1, 0.6, 0.1]), DOWN.wxyz, 0.3)
    reached = arrive(goal, START, 120)
    np.testing.assert_allclose(reached.position, goal.position, atol=1e-9)
    turn = mink.SO3(reached.orientation).inverse() @ DOWN
    assert np.linalg.norm(turn.log()) < 1e-6
    assert reached.opening == 0.3
    held = goal.command(reached, 0.25, 1.5)
    assert np.abs([*held.linear, *held.angular]).max() < 1e-4


def test_keys_move_the_goal_of_the_active_arm(view: SessionView) -> None:
    hand = Hand(("left", "right"))
    hand.follow(view)
    for key in ("A", "W", "W", "Q"):
        hand.take(Key(key), view, 0.01)
    moved = START.position + np.array([-0.01, 0.02, -0.01])
    np.testing.assert_allclose(hand.goals["right"].position, moved)
    np.testing.assert_array_equal(hand.goals["left"].position, START.position)
    hand.take(Key("X"), view, 0.01)
    np.testing.assert_allclose(hand.goals["right"].orientation, DOWN.wxyz)
    hand.take(Key("space"), view, 0.01)
    assert hand.goals["right"].opening == 0.0
    hand.take(Key("space"), view, 0.01)
    assert hand.goals["right"].opening == 1.0
    hand.take(Opening(0.4), view, 0.01)
    hand.take(Drag("left", np.array([0.0, 0.4, 0.2]), DOWN.wxyz), view, 0.01)
    assert hand.goals["right"].opening == 0.4
    np.testing.assert_array_equal(hand.goals["left"].position, [0.0, 0.4, 0.2])
    assert set(hand.commands(view, 0.2)) == {"left", "right"}


def test_turns_and_their_opposites_cancel(view: SessionView) -> None:
    for one, other in (("I", "K"), ("J", "L"), ("U", "O")):
        hand = Hand(("right",))
        hand.follow(view)
        hand.take(Key(one), view, 0.01)
        turned = mink.SO3(hand.goals["right"].orientation).inverse() @ mink.SO3(START.orientation)
        assert np.degrees(np.linalg.norm(turned.log())) == pytest.approx(5.0)
        hand.take(Key(other), view, 0.01)
        np.testing.assert_allclose(hand.goals["right"].orientation, START.orientation, atol=1e-12)


def test_tipping_down_points_the_gripper_down(view: SessionView) -> None:
    hand = Hand(("right",))
    hand.follow(view)
    hand.take(Key("K"), view, 0.01)
    ahead = mink.SO3(hand.goals["right"].orientation).apply(np.array([1.0, 0.0, 0.0]))
    assert ahead[2] < 0.0


def test_a_key_that_is_held_does_not_run_away(view: SessionView) -> None:
    hand = Hand(("right",))
    hand.follow(view)
    for _ in range(100):
        hand.take(Key("E"), view, 0.02)
    np.testing.assert_allclose(hand.goals["right"].position[2], 0.3 + MAX_AHEAD)


def test_every_key_has_one_meaning_and_is_on_the_page() -> None:
    keys = [*MOVES, *TURNS, *POSES, "space", *(key for key, _, _ in EVENTS.values())]
    assert len(set(keys)) == len(keys)
    text = key_map(list(EVENTS)).lower()
    for key in keys:
        name = {"escape": "esc", "delete": "del"}.get(key, key).lower()
        assert f">{name}</kbd>" in text


def test_the_status_shows_the_session(view: SessionView) -> None:
    text = status_html(replace(view, is_policy_acting=True, has_policy=True))
    shown = dict(re.findall(r"data-rmb='(\w+)'>([^<]*)<", text))
    assert shown["mode"] == "recording"
    assert shown["time"] == "1.0 of 12 s"
    assert shown["loop"] == "50.0 Hz, 2 late"
    assert shown["acting"] == "the policy"
    assert shown["gripper"] == "0.200 0.500 0.300"
    assert shown["message"] == "&lt;recording&gt;"
    assert "acting" not in status_html(view)


@pytest.mark.gl
def test_previews_show_what_a_task_changes_in_its_model() -> None:
    """Residue on a cheek, whose place is drawn with the episode, after the page has opened."""
    with (
        closing(make_env("FaceWipingEnv", cameras=())) as env,
        closing(Previews(world_of(env).model, ("front_close",))) as previews,
    ):
        env.reset(seed=0)
        world, images = world_of(env), None
        while images is None:
            images = previews.exchange(world)
            time.sleep(0.02)
        with CameraRenderer(world.model, *PREVIEW_SIZE) as renderer:
            wanted = renderer.render(world.data, ["front_close"])["front_close"]
    assert images["front_close"] == encode_image(wanted, "jpeg", PREVIEW_QUALITY).tobytes()


def test_another_address_needs_a_token(monkeypatch: pytest.MonkeyPatch) -> None:
    from robo_manip_baselines.commands import teleop

    monkeypatch.delenv("RMB_TOKEN", raising=False)
    with pytest.raises(RequestError, match=r"^--host 0\.0\.0\.0: .*give a token"):
        teleop.main(["FeedingEnv", "--host", "0.0.0.0"])


def test_without_viser_the_line_says_what_to_install(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    from robo_manip_baselines.commands import teleop
    from robo_manip_baselines.runs import browser

    monkeypatch.setattr(browser, "find_spec", lambda name: None)
    out = tmp_path / "out"
    with pytest.raises(RequestError, match=r"needs viser.*\[teleop\]"):
        teleop.main(["FeedingEnv", "--device", "web", "--cameras", "none", "--out", str(out)])
    assert not out.exists()


# -- in the browser -------------------------------------------------------------------------------

PATIENCE = 120_000
"""ms; a busy machine without a GPU is slow, a broken page never gets there."""


class Session:
    """A session in a process of its own, and its page."""

    def __init__(self, browser: Any, out: Path, *options: str) -> None:
        command = [sys.executable, "bin/Teleop.py", "FeedingEnv", "--port", "0", "--out", str(out)]
        pipes: Any = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "text": True}
        self.process = subprocess.Popen([*command, *options], cwd=ROOT, **pipes)
        assert self.process.stdout is not None
        said, found = "", None
        while not found:
            line = self.process.stdout.readline()
            assert line, f"the command ended: {said}"
            said += line
            found = re.search(r"open (http\S+)", line)
        self.address = found[1]
        self.page = browser.new_page(viewport={"width": 900, "height": 600})
        self.page.set_default_timeout(PATIENCE)
        self.page.goto(self.address)
        self.page.wait_for_selector("[data-rmb=mode]")
        self.page.wait_for_selector("canvas")

    def text(self, name: str) -> str:
        return self.page.inner_text(f"[data-rmb={name}]")

    def wait(self, condition: Callable[[], bool], what: str) -> None:
        """Wait until something holds."""
        end = time.monotonic() + PATIENCE / 1000
        while not condition():
            assert time.monotonic() < end, f"{what}: {self.text('gripper')}, {self.text('message')}"
            time.sleep(0.1)

    @property
    def gripper(self) -> np.ndarray:
        return np.array([float(part) for part in self.text("gripper").split()])

    def go(self, place: np.ndarray) -> None:
        """Bring the gripper to a place (3,) m by keys of 5 mm.

        Each few keys are waited for where they lead: a page that is late shows an old place, from
        which one would steer too far.
        """
        goal = self.gripper
        steps = np.round((place - goal) / 0.005).astype(int)
        for axis, (less, more) in enumerate((("a", "d"), ("s", "w"), ("q", "e"))):
            key, left = more if steps[axis] > 0 else less, abs(int(steps[axis]))
            while left:
                count = min(left, 10)
                for _ in range(count):
                    self.page.keyboard.press(key)
                goal[axis] += np.sign(steps[axis]) * count * 0.005
                self.wait(lambda: bool(np.allclose(self.gripper, goal, atol=2e-3)), f"to {goal}")
                left -= count

    def close(self) -> None:
        self.page.close()
        self.process.kill()
        self.process.communicate()


@pytest.fixture
def session(browser: Any, tmp_path: Path) -> Iterator[Session]:
    """A session of one episode with one small camera."""
    pytest.importorskip("viser", reason="pip install viser")
    options = ["--num_episodes", "1", "--time_limit", "600", "--operator", "Ada"]
    images = ["--cameras", "top", "--image_size", "24x32"]
    with closing(Session(browser, tmp_path / "out", *options, *images)) as opened:
        yield opened


def on_screen(page: Any, point: np.ndarray) -> np.ndarray:
    """(2,) pixels at which the first view of the browser's camera shows a point (3,) m, world."""
    box = page.locator("canvas").first.bounding_box()
    size = np.array([box["width"], box["height"]])
    back = np.array(VIEW_FROM) - VIEW_AT
    back /= np.linalg.norm(back)
    right = np.cross([0.0, 0.0, 1.0], back)
    right /= np.linalg.norm(right)
    x, y, depth = np.array([right, np.cross(back, right), -back]) @ (point - VIEW_FROM)
    half = np.tan(np.radians(75.0) / 2)  # viser's field of view, vertical
    middle = np.array([box["x"], box["y"]]) + size / 2
    return middle + np.array([x, -y]) / depth / half * size[1] / 2


@pytest.mark.slow
@pytest.mark.gl
def test_the_cube_is_picked_by_keys_recorded_and_saved(session: Session, tmp_path: Path) -> None:
    with closing(make_env("FeedingEnv", cameras=())) as env:
        env.reset(seed=0)
        world = world_of(env)
        cube = world.object_position()[0]
        arms = SteeredArms(world)
        arms.reset()
        start = arms.poses["right"]
    assert session.text("mode").lower() == "practice"
    # A handle is dragged along the gripper's own axis, which points away from its base.
    axis = mink.SO3(start.orientation).apply(np.array([1.0, 0.0, 0.0]))
    ends = [on_screen(session.page, start.position + s * HANDLE_SIZE * axis) for s in (0.6, 1.1)]
    session.page.mouse.move(*ends[0])
    session.page.mouse.down()
    for share in np.linspace(0.1, 1.0, 10):
        session.page.mouse.move(*(ends[0] + share * (ends[1] - ends[0])))
    session.page.mouse.up()
    moved = (0.02, 0.12)  # m; 0.08 by the drag, less what the pointer needs to be seen as dragging
    session.wait(lambda: bool((session.gripper - start.position) @ axis > moved[0]), "dragged")
    assert (session.gripper - start.position) @ axis < moved[1]
    # From the start of the seed again, now recorded.
    session.page.keyboard.press("r")
    session.wait(lambda: session.text("mode").lower() == "recording", "recording")
    session.wait(lambda: bool(np.allclose(session.gripper, start.position, atol=2e-3)), "reset")
    session.page.keyboard.press("x")
    session.go(cube + np.array([0.0, 0.0, 0.13]))
    session.go(cube + np.array([0.0, 0.0, 0.03]))
    session.page.keyboard.press("Space")
    begin = float(session.text("time").split()[0])
    session.wait(lambda: float(session.text("time").split()[0]) > begin + 0.6, "closed")
    session.go(cube + np.array([0.0, 0.0, 0.13]))
    session.page.get_by_text("Save (Enter)").click()
    assert session.process.wait(PATIENCE / 1000) == 0
    (path,) = list_failures(tmp_path / "out")  # it was picked, and not fed
    assert verify_dataset(tmp_path / "out") == []
    with EpisodeReader(path) as episode:
        heights = episode.array("object_pose")[:, 2]
        known = episode.attributes
        assert episode.frame("top", 10).shape == (24, 32, 3)
    assert heights[-1] > heights[0] + 0.06
    assert (known["device"], known["expert"]) == ("web", "Ada")
    assert 1.0 < known["loop_rate"] < 51.0
    assert known["missed_deadlines"] >= 0


@pytest.mark.slow
def test_a_page_elsewhere_is_closed_to_those_without_the_token(tmp_path: Path) -> None:
    """The guard is that of every page; the session uses it."""
    pytest.importorskip("viser", reason="pip install viser")
    from urllib.error import HTTPError
    from urllib.request import urlopen

    from robo_manip_baselines.teleop.web import WebDevice

    with closing(make_env("FeedingEnv", cameras=())) as env:
        env.reset(seed=0)
        page = PageOptions("0.0.0.0", 0, "0123456789abcdef")
        device = WebDevice(world_of(env), ("right",), page=page)
        with closing(device):
            address = device.address.partition("?")[0]
            port = address.rpartition(":")[2].rstrip("/")
            with pytest.raises(HTTPError, match="403"):
                urlopen(f"http://127.0.0.1:{port}/")
            assert "token=0123456789abcdef" in device.address
            assert TeleopEvent.RECORD in EVENTS
