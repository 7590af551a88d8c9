"""Keys in MuJoCo's window: a stand-in for it, and the window itself on a virtual display."""

from __future__ import annotations

import ctypes
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import closing
from ctypes.util import find_library
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium
import mujoco
import numpy as np
import pytest

from robo_manip_baselines.commands import teleop
from robo_manip_baselines.data import EpisodeReader
from robo_manip_baselines.data.files import list_failures
from robo_manip_baselines.data.verify import verify_dataset
from robo_manip_baselines.envs.mujoco.expert.phases import DOWN
from robo_manip_baselines.envs.mujoco.tasks.face_env import world_of
from robo_manip_baselines.envs.mujoco.tasks.registry import make_env
from robo_manip_baselines.runs.errors import RequestError
from robo_manip_baselines.teleop import keyboard, teleoperate
from robo_manip_baselines.teleop.device import Mode, SessionView, TeleopEvent, TeleopInput
from robo_manip_baselines.teleop.hand import MOVES, POSES, TURNS
from robo_manip_baselines.teleop.keyboard import ARROWS, EVENTS, KEYS, TURN_KEY, KeyboardDevice
from robo_manip_baselines.teleop.options import SteeringOptions

ROOT = Path(__file__).resolve().parents[2]
CODES = {row[0]: code for code, row in (*ARROWS.items(), *KEYS.items(), *EVENTS.items())}
CODES["."] = TURN_KEY
BOTH = ("left", "right")
Windows = list[Any]
Env = gymnasium.Env[Any, Any]
Update = Callable[..., TeleopInput]


@pytest.fixture
def device(windows: Windows, feeding_env: Env) -> KeyboardDevice:
    feeding_env.reset(seed=0)
    return KeyboardDevice(world_of(feeding_env), BOTH, has_policy=True)


@pytest.fixture
def update(device: KeyboardDevice, windows: Windows, view: SessionView, feeding_env: Env) -> Update:
    """Press keys by their names, and return what is asked for then."""
    view = replace(view, world=world_of(feeding_env))
    device.update(view)

    def press(*names: str, **changes: Any) -> TeleopInput:
        for name in names:
            windows[0].press(CODES[name])
        return device.update(replace(view, **changes))

    return press


def test_arrows_move_the_active_arm(device: KeyboardDevice, update: Update) -> None:
    start = device.hand.goals["left"].position
    update("left", "up", "up", "PgUp")
    moved = start + np.array([-0.005, 0.01, 0.005])
    np.testing.assert_allclose(device.hand.goals["right"].position, moved)
    np.testing.assert_array_equal(device.hand.goals["left"].position, start)
    asked = update("PgDn", active_arm="left")
    np.testing.assert_allclose(device.hand.goals["left"].position, start - [0.0, 0.0, 0.005])
    assert asked.arms["left"].linear[2] < 0.0
    assert asked.arms["right"].linear[2] > 0.0  # goes on to its own goal


def test_the_full_stop_makes_arrows_turn(device: KeyboardDevice, update: Update) -> None:
    goals = device.hand.goals
    start = goals["right"]
    update(".", "down", "right", "PgDn")
    np.testing.assert_array_equal(goals["right"].position, start.position)
    assert np.abs(goals["right"].orientation - start.orientation).max() > 0.01
    update("PgUp", "left", "up")
    np.testing.assert_allclose(goals["right"].orientation, start.orientation, atol=1e-12)
    update("pad 2", ".", "up")
    assert goals["right"].position[1] > start.position[1]
    update("Home", "Space")
    np.testing.assert_allclose(goals["right"].orientation, DOWN.wxyz)
    assert goals["right"].opening == 0.0


def test_events(update: Update) -> None:
    names = ("6", "7", "8", "9", "Insert", "Delete", "Enter", "Esc")
    assert update(*names).events == (
        *(TeleopEvent.RECORD, TeleopEvent.SAVE, TeleopEvent.REDO, TeleopEvent.DISCARD),
        *(TeleopEvent.TAKE_OVER, TeleopEvent.GIVE_BACK),
        *(TeleopEvent.SWITCH_ARM, TeleopEvent.QUIT),
    )
    assert update().events == ()


def test_keys_do_nothing_while_the_policy_acts_or_after_an_episode(
    device: KeyboardDevice, update: Update
) -> None:
    start = device.hand.goals["right"].position
    update("up", is_policy_acting=True)
    update("up", mode=Mode.REVIEW)
    np.testing.assert_array_equal(device.hand.goals["right"].position, start)


def test_no_key_is_one_of_the_windows_own() -> None:
    """Esc apart, which lets the window's camera move freely."""
    shortcuts = {row[2] for row in (*mujoco.mjVISSTRING, *mujoco.mjRNDSTRING)} - {""}
    taken = {ord(key) for key in {*shortcuts, *"012345[]-="}}
    taken |= {258, 259, *range(290, 297)}  # Tab, Backspace, F1 to F7
    ours = [*ARROWS, *KEYS, *EVENTS, TURN_KEY]
    assert len(set(ours)) == len(ours) == len(CODES)
    assert not taken & set(ours)
    reached = {key for _, *keys in ARROWS.values() for key in keys}
    reached |= {key.name for _, key in KEYS.values()}
    assert reached == {*MOVES, *TURNS, *POSES, "space"}
    assert {event for _, event in EVENTS.values()} == set(TeleopEvent)


def test_the_window_shows_the_state_and_the_keys(update: Update, windows: Windows) -> None:
    (window,) = windows
    assert window.cam.distance > 1.0
    state, keys, message = window.texts
    for row in ("mode", "seed", "arrows"):
        assert row in state[2].split("\n")
    assert "recording" in state[3].split("\n")
    assert len(keys[2].split("\n")) == len(keys[3].split("\n"))
    for name in CODES:
        assert name.split()[-1] in keys[2]
    assert message[2] == "<recording>"
    for *_, one, other in window.texts:
        assert (one + other).isascii()
    alone = keyboard.key_rows(("right",), has_policy=False)
    assert not {"take over", "give back", "switch arm"} & {label for _, label in alone}


def test_the_window_shows_what_a_task_changes_in_its_model(
    windows: Windows, view: SessionView
) -> None:
    """Liquid in a cup: the window draws a copy of the model, made before the episode."""
    with closing(make_env("DrinkingEnv", cameras=())) as env:
        world = world_of(env)
        device = KeyboardDevice(world, ("right",))
        env.reset(seed=0)
        device.update(replace(view, world=world))
        liquid = world.model.geom("cup/slice_5").id
        np.testing.assert_array_equal(
            windows[0].model.geom_size[liquid], world.model.geom_size[liquid]
        )
        assert windows[0].model.geom_size[liquid, 2] > 0.001


def test_an_episode_is_recorded_whatever_happens_in_the_window(
    windows: Windows, make_session: Callable[..., Any], feeding_env: Env
) -> None:
    presses = {0: "6", 5: "PgUp", 6: "PgUp", 60: "7"}

    class Person(KeyboardDevice):
        updates = 0

        def update(self, view: SessionView) -> TeleopInput:
            if self.updates in presses:
                windows[0].press(CODES[presses[self.updates]])
            self.updates += 1
            mujoco.mj_resetData(windows[0].model, windows[0].data)  # Backspace
            return super().update(view)

    heights = []
    for _ in range(2):
        device = Person(world_of(feeding_env), ("right",))
        session, store = make_session(feeding_env, device, steered=("right",), seeds=(3,))
        summary = session.run()
        assert summary.saved == 1
        assert 55 <= len(store.episodes[0].arrays["time"]) <= 60
        assert windows[-1].is_closed
        heights.append(windows[-1].heights)
        windows.clear()
    assert heights[0] == heights[1]
    assert heights[0][-1] - heights[0][4] == pytest.approx(0.01, abs=0.002)


def test_the_step_and_the_speed_are_options(
    windows: Windows, feeding_env: Env, view: SessionView
) -> None:
    device = KeyboardDevice(
        world_of(feeding_env), BOTH, steering=SteeringOptions(key_step=0.02, speed=0.1)
    )
    windows[0].press(CODES["PgUp"])
    asked = device.update(replace(view, world=world_of(feeding_env)))
    assert device.hand.goals["right"].position[2] == pytest.approx(0.32)
    assert np.linalg.norm(asked.arms["right"].linear) == pytest.approx(0.1)


def test_closing_the_window_ends_the_session(update: Update, windows: Windows) -> None:
    windows[0].close()
    assert update("up").events == (TeleopEvent.QUIT,)


def test_without_a_display_one_line_says_so(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    out = tmp_path / "out"
    given = ["--device", "keyboard", "--cameras", "none", "--out", str(out)]
    with pytest.raises(RequestError, match=r"keyboard: no display .*; --device web") as caught:
        teleop.main(["FeedingEnv", *given])
    assert "\n" not in str(caught.value)
    assert not out.exists()


def test_the_device_is_the_keyboard_where_there_is_a_display(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    for problem, name in ((None, "keyboard"), ("no display", "web")):
        monkeypatch.setattr(teleoperate, "viewer_problem", lambda problem=problem: problem)
        assert teleop.to_config(teleop.TeleopOptions("FeedingEnv")).device == name


# -- the window itself ----------------------------------------------------------------------------


class Display:
    """Virtual display, and fingers on its keyboard (the X server's test extension)."""

    def __init__(self) -> None:
        libraries = [find_library(name) for name in ("X11", "Xtst")]
        if shutil.which("Xvfb") is None or None in libraries:
            pytest.skip("no virtual display: apt-get install xvfb libxtst6")
        command = ["Xvfb", "-displayfd", "1", "-screen", "0", "640x480x24"]
        self.server = subprocess.Popen(
            command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
        )
        assert self.server.stdout is not None
        self.name = f":{self.server.stdout.readline().strip()}"
        self._x, self._test = (ctypes.CDLL(str(name)) for name in libraries)
        self._x.XOpenDisplay.restype = ctypes.c_void_p
        self._x.XStringToKeysym.restype = ctypes.c_ulong
        self._connection = ctypes.c_void_p(self._x.XOpenDisplay(self.name.encode()))
        # Without a window manager, keys go to the window under the pointer.
        self._test.XTestFakeMotionEvent(self._connection, -1, 200, 150, ctypes.c_ulong(0))
        self._x.XFlush(self._connection)

    def press(self, key: str, seconds: float = 0.05) -> None:
        """Hold a key, by its name in X."""
        symbol = ctypes.c_ulong(self._x.XStringToKeysym(key.encode()))
        code = self._x.XKeysymToKeycode(self._connection, symbol)
        for is_down in (1, 0):
            self._test.XTestFakeKeyEvent(self._connection, code, is_down, ctypes.c_ulong(0))
            self._x.XFlush(self._connection)
            time.sleep(seconds)

    def close(self) -> None:
        self._x.XCloseDisplay(self._connection)
        with self.server as server:  # closes its pipe, and waits
            server.terminate()


@pytest.fixture
def display() -> Iterator[Display]:
    opened = Display()
    yield opened
    opened.close()


@pytest.mark.slow
def test_real_keys_steer_both_arms_and_record(display: Display, tmp_path: Path) -> None:
    given = ["--arm", "both", "--num_episodes", "1", "--cameras", "none", "--time_limit", "300"]
    given += ["--out", str(tmp_path / "out")]
    log = tmp_path / "log"
    with log.open("w") as stream:
        program = subprocess.Popen(
            [sys.executable, str(ROOT / "bin" / "Teleop.py"), "FeedingEnv", *given],
            env={**os.environ, "DISPLAY": display.name, "LIBGL_ALWAYS_SOFTWARE": "1"},
            stdout=stream,
            stderr=subprocess.STDOUT,
        )
    try:
        end = time.monotonic() + 120.0
        while "keys in the window" not in log.read_text():
            assert program.poll() is None, log.read_text()
            assert time.monotonic() < end, log.read_text()
            time.sleep(0.2)
        # A window that is drawn without a GPU takes keys late, but loses none.
        display.press("6")
        display.press("Prior", 2.0)
        display.press("KP_8")
        display.press("Return")
        display.press("Right")
        display.press("Right")
        display.press("space")
        time.sleep(3.0)
        display.press("7")
        assert program.wait(120.0) == 0, log.read_text()
    finally:
        program.kill()
        program.wait()
    (path,) = list_failures(tmp_path / "out")
    assert verify_dataset(path.parent) == []
    with EpisodeReader(path) as episode:
        known, action = episode.attributes, episode.array("action")
    assert (known["device"], known["source"]) == ("keyboard", "teleop")
    # Both arms moved; the left gripper opened and the right one stayed closed.
    moved = np.abs(action[-1] - action[0])
    assert moved[:6].max() > 0.01
    assert moved[7:13].max() > 0.05
    assert action[-1, 6] > action[0, 6]
    assert action[-1, 13] == action[0, 13]
