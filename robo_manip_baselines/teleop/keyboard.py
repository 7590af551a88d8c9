"""Device of keys in MuJoCo's own window.

The window reports a key when it goes down, and again while it is held, but neither modifiers nor
its release: a key is a step. All letters and most other keys switch something on or off in the
window's drawing, so those that steer are among the ones it leaves free.
"""

from __future__ import annotations

import copy
import logging
import math
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import mujoco
import numpy as np

from robo_manip_baselines.envs.mujoco.cell.opengl import viewer_problem
from robo_manip_baselines.envs.mujoco.cell.rendering import MODEL_CHANGES
from robo_manip_baselines.envs.mujoco.cell.window import ViewerWindow
from robo_manip_baselines.envs.mujoco.tasks.face_env import FaceEnv
from robo_manip_baselines.runs.errors import RequestError
from robo_manip_baselines.teleop.device import SessionView, TeleopEvent, TeleopInput
from robo_manip_baselines.teleop.hand import (
    MOVES,
    POSES,
    TURNS,
    VIEW_AT,
    VIEW_FROM,
    Action,
    Hand,
    Key,
    status_rows,
)
from robo_manip_baselines.teleop.options import SteeringOptions

logger = logging.getLogger(__name__)

STATUS_STEPS = 10
"""Control steps between two updates of the text: 5 a second."""

ARROWS: Mapping[int, tuple[str, str, str]] = {
    263: ("left", "A", "J"),
    262: ("right", "D", "L"),
    265: ("up", "W", "I"),
    264: ("down", "S", "K"),
    266: ("PgUp", "E", "U"),
    267: ("PgDn", "Q", "O"),
}
"""Key code of GLFW -> name, key of `MOVES`, and key of `TURNS` while `TURN_KEY` is on."""

TURN_KEY = 46
"""Full stop: the keys of `ARROWS` turn the gripper, or move it again."""

KEYS: Mapping[int, tuple[str, Key]] = {
    324: ("pad 4", Key("J")),
    326: ("pad 6", Key("L")),
    328: ("pad 8", Key("I")),
    322: ("pad 2", Key("K")),
    327: ("pad 7", Key("U")),
    329: ("pad 9", Key("O")),
    268: ("Home", Key("X")),
    269: ("End", Key("C")),
    32: ("Space", Key("space")),
}
"""Key code of GLFW -> name and what it does; the number pad turns the gripper at any time."""

EVENTS: Mapping[int, tuple[str, TeleopEvent]] = {
    54: ("6", TeleopEvent.RECORD),
    55: ("7", TeleopEvent.SAVE),
    56: ("8", TeleopEvent.REDO),
    57: ("9", TeleopEvent.DISCARD),
    260: ("Insert", TeleopEvent.TAKE_OVER),
    261: ("Delete", TeleopEvent.GIVE_BACK),
    257: ("Enter", TeleopEvent.SWITCH_ARM),
    256: ("Esc", TeleopEvent.QUIT),
}
"""Key code of GLFW -> name and event. Esc is the only one that the window knows, too: it lets its
camera move freely, as it does anyway."""


class KeyboardDevice:
    """Window with the scene; it is open when this has been made.

    It draws a copy of the world, so that nothing that the window can do (a reset, a push with the
    mouse) changes the episode.

    Args:
        world: environment of the session, unwrapped.
        arms: that the person steers.
        has_policy: whether a policy may act.
        steering: step of a key, and speed.

    Attributes:
        hand: goals of the arms.

    Raises:
        RequestError: there is no display.
    """

    is_paced = True

    def __init__(
        self,
        world: FaceEnv,
        arms: Sequence[str],
        *,
        has_policy: bool = False,
        steering: SteeringOptions | None = None,
    ) -> None:
        if problem := viewer_problem():
            raise RequestError(f"--device keyboard: {problem}; --device web needs only a browser")
        self.hand = Hand(arms)
        self._steering = steering or SteeringOptions()
        self._pressed: deque[int] = deque()
        self._turns, self._steps = False, 0
        self._rows = key_rows(arms, has_policy)
        self._model = copy.copy(world.model)
        self._data = mujoco.MjData(self._model)
        mujoco.mj_copyData(self._data, self._model, world.data)
        self._window = ViewerWindow(
            self._model,
            self._data,
            key_callback=self._pressed.append,
            show_left_ui=False,
            show_right_ui=False,
        )
        self._viewer = self._window.viewer
        with self._viewer.lock():
            _look(self._viewer.cam)
        keys = "\n".join(f"  {key:<17} {label}" for key, label in self._rows)
        logger.info("keys in the window:\n%s", keys)

    def update(self, view: SessionView) -> TeleopInput:
        """Show the session, and return what the keys since the last time ask for."""
        if not self._viewer.is_running():  # the person has closed the window
            return TeleopInput(events=(TeleopEvent.QUIT,))
        actions = list(self._actions())
        asked = self.hand.update(view, actions, self._steering.key_step, self._steering.speed)
        mujoco.mj_copyData(self._data, self._model, view.world.data)
        for name in MODEL_CHANGES:
            getattr(self._model, name)[:] = getattr(view.world.model, name)
        if self._steps % STATUS_STEPS == 0:
            self._viewer.set_texts(self._texts(view))
        self._viewer.sync()
        self._steps += 1
        return asked

    def close(self) -> None:
        """Close the window."""
        self._window.close()

    def _actions(self) -> Iterator[Action]:
        """Empty the queue of the window's thread."""
        while self._pressed:
            code = self._pressed.popleft()
            if code == TURN_KEY:
                self._turns = not self._turns
            elif code in ARROWS:
                yield Key(ARROWS[code][1 + self._turns])
            elif code in KEYS:
                yield KEYS[code][1]
            elif code in EVENTS:
                yield EVENTS[code][1]

    def _texts(self, view: SessionView) -> list[Any]:
        """Return what the window shows over the scene: font, place, and two columns each."""
        font, places = mujoco.mjtFontScale.mjFONTSCALE_100, mujoco.mjtGridPos
        rows = status_rows(view) | {"arrows": "turn" if self._turns else "move"}
        message = view.message or "practice as long as you like"
        return [
            (font, places.mjGRID_TOPLEFT, *_columns([("mode", view.mode.value), *rows.items()])),
            (font, places.mjGRID_TOPRIGHT, *_columns(self._rows)),
            (font, places.mjGRID_BOTTOMLEFT, _plain(message), ""),
        ]


def key_rows(arms: Sequence[str], has_policy: bool) -> list[tuple[str, str]]:
    """Return keys and what they do, without those that do nothing for these arms."""
    names = {key: label for key, (label, _) in (*MOVES.items(), *TURNS.items())}
    names |= {**POSES, "space": "open or close the gripper"}
    rows = [(name, f"{names[one]} ({names[other]})") for name, one, other in ARROWS.values()]
    rows.append((".", "move, or (turn)"))
    rows.append(("pad 4 6, 8 2, 7 9", "turn, tip, roll"))
    rows += [(name, names[key.name]) for name, key in KEYS.values() if key.name not in TURNS]
    for name, event in EVENTS.values():
        is_shared = event in (TeleopEvent.TAKE_OVER, TeleopEvent.GIVE_BACK)
        if (has_policy or not is_shared) and (len(arms) > 1 or event is not TeleopEvent.SWITCH_ARM):
            rows.append((name, event.value))
    return rows


def _columns(rows: Sequence[tuple[str, str]]) -> tuple[str, str]:
    names, values = zip(*rows, strict=True)
    return _plain("\n".join(names)), _plain("\n".join(values))


def _plain(text: str) -> str:
    """Return a text in ASCII, the only letters that the window has."""
    return text.replace("–", "-").encode("ascii", "replace").decode()


def _look(camera: mujoco.MjvCamera) -> None:
    """Let a free camera stand at `VIEW_FROM` and look at `VIEW_AT`."""
    ahead = np.subtract(VIEW_AT, VIEW_FROM)
    camera.lookat[:] = VIEW_AT
    camera.distance = float(np.linalg.norm(ahead))
    camera.azimuth = math.degrees(math.atan2(ahead[1], ahead[0]))
    camera.elevation = math.degrees(math.asin(ahead[2] / camera.distance))
