"""Device in the browser: the scene in 3-D with handles to drag, camera images, buttons and keys.

The page is served by viser, whose callbacks run in a thread of their own: they put what the person
did into a queue, which `WebDevice.update` empties in the session's loop. Nothing is drawn while
nobody looks.
"""

from __future__ import annotations

import base64
import contextlib
import html
import logging
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from robo_manip_baselines.envs.mujoco.cell.rendering import MODEL_CHANGES, CameraRenderer
from robo_manip_baselines.envs.mujoco.cell.viser_scene import ViserScene
from robo_manip_baselines.envs.mujoco.tasks.face_env import FaceEnv
from robo_manip_baselines.runs.browser import PageOptions, require_viser, serve_page
from robo_manip_baselines.runs.images import encode_image
from robo_manip_baselines.runs.processes import Worker, wait_for
from robo_manip_baselines.teleop.device import (
    Mode,
    SessionView,
    TeleopEvent,
    TeleopInput,
)
from robo_manip_baselines.teleop.hand import (
    MOVES,
    POSES,
    TURNS,
    VIEW_AT,
    VIEW_FROM,
    Action,
    Drag,
    Hand,
    Key,
    Opening,
    status_rows,
)

logger = logging.getLogger(__name__)

SCENE_STEPS = 2
"""Control steps between two drawings of the scene: 25 a second."""

STATUS_STEPS = 10
"""Control steps between two updates of the text: 5 a second."""

PREVIEW_SIZE = (180, 240)
"""Height and width of the camera images on the page."""

PREVIEW_QUALITY = 80

HANDLE_SIZE = 0.16
"""m, length of the axes that can be dragged."""

EVENTS: Mapping[TeleopEvent, tuple[str, str, str]] = {
    TeleopEvent.RECORD: ("R", "Record", "player-record"),
    TeleopEvent.SAVE: ("enter", "Save", "device-floppy"),
    TeleopEvent.REDO: ("backspace", "Redo", "rotate"),
    TeleopEvent.DISCARD: ("delete", "Discard", "trash"),
    TeleopEvent.TAKE_OVER: ("T", "Take over", "hand-grab"),
    TeleopEvent.GIVE_BACK: ("B", "Give back", "robot"),
    TeleopEvent.SWITCH_ARM: ("tab", "Other arm", "arrows-exchange"),
    TeleopEvent.QUIT: ("escape", "End the session", "door-exit"),
}
"""Event -> key, label and icon of its button."""

ALLOWED: Mapping[Mode, frozenset[TeleopEvent]] = {
    Mode.PRACTICE: frozenset({TeleopEvent.RECORD}),
    Mode.RECORDING: frozenset({TeleopEvent.SAVE, TeleopEvent.REDO, TeleopEvent.DISCARD}),
    Mode.REVIEW: frozenset({TeleopEvent.SAVE, TeleopEvent.REDO, TeleopEvent.DISCARD}),
}
"""Events that do something in a mode."""

COLOURS: Mapping[Mode, str] = {
    Mode.PRACTICE: "#4a6785",
    Mode.RECORDING: "#c0332b",
    Mode.REVIEW: "#8a6d1d",
}
"""Background of the mode's name."""


class WebDevice:
    """The page; it is open when this has been made.

    Args:
        world: environment of the session, unwrapped.
        arms: that the person steers.
        has_policy: whether a policy may act.
        cameras: to show; none where there is no OpenGL.
        page: address.

    Attributes:
        address: to open in a browser, token included.
        hand: goals of the arms.

    Raises:
        RequestError: viser is not installed, or nothing can listen at the address.
    """

    is_paced = True

    def __init__(
        self,
        world: FaceEnv,
        arms: Sequence[str],
        *,
        has_policy: bool = False,
        cameras: Sequence[str] = (),
        page: PageOptions | None = None,
    ) -> None:
        require_viser("teleop")
        self._closing = contextlib.ExitStack()
        self.hand, self._arms = Hand(arms), tuple(arms)
        self._actions: deque[Action] = deque()
        label = f"Teleoperation · {world.task.name}"
        self._server, self.address = self._closing.enter_context(
            serve_page(page or PageOptions(), label)
        )
        self._cameras = Previews(world.model, cameras) if cameras else None
        if self._cameras:
            self._closing.callback(self._cameras.close)
        self._steps = 0
        with self._server.atomic():
            self._make_scene(world)
            self._make_controls(has_policy, cameras)
        logger.info("open %s in a browser; Ctrl-C here ends the session", self.address)

    def update(self, view: SessionView) -> TeleopInput:
        """Show the session, and return what the person did since the last time."""
        actions = [self._actions.popleft() for _ in range(len(self._actions))]
        step, speed = self._step.value / 1000.0, self._speed.value
        asked = self.hand.update(view, actions, step, speed)
        if self._server.get_clients():
            self._show(view)
        self._steps += 1
        return asked

    def close(self) -> None:
        """Close the page."""
        self._closing.close()

    # -- the page -------------------------------------------------------------------------------

    def _make_scene(self, world: FaceEnv) -> None:
        server, scene = self._server, self._server.scene
        scene.set_up_direction("+z")
        scene.configure_default_lights(cast_shadow=False)
        server.initial_camera.position = VIEW_FROM
        server.initial_camera.look_at = VIEW_AT
        self._scene = ViserScene(scene, world.model, varying=world.varying_geoms)
        self.handles: dict[str, Any] = {}
        for arm in self._arms:
            handle = scene.add_transform_controls(f"/goal/{arm}", HANDLE_SIZE, depth_test=False)
            self.handles[arm] = handle
            handle.on_update(self._dragged(arm))

    def _dragged(self, arm: str) -> Callable[[Any], Any]:
        async def note(event: Any) -> None:
            target = event.target
            pose = (np.array(target.position, float), np.array(target.wxyz, float))
            self._actions.append(Drag(arm, *pose))

        return note

    def _noting(self, action: Action) -> Callable[[Any], Any]:
        async def note(_: Any) -> None:
            self._actions.append(action)

        return note

    def _make_controls(self, has_policy: bool, cameras: Sequence[str]) -> None:
        gui = self._server.gui
        gui.configure_theme(
            control_width="large",
            show_share_button=False,
            show_logo=False,
            brand_color=(74, 103, 133),
        )
        gui.main_panel.dock_right()
        self._status = gui.add_html("")
        self._status_text = ""
        self._buttons: dict[TeleopEvent, Any] = {}
        shown = [event for event in EVENTS if self._is_shown(event, has_policy)]
        for event in shown:
            key, label, icon = EVENTS[event]
            button = gui.add_button(
                f"{label} ({_key_name(key)})",
                icon=icon,  # pyright: ignore[reportArgumentType]
                color="red" if event is TeleopEvent.RECORD else None,
            )
            button.on_click(self._noting(event))
            self._buttons[event] = button
            self._add_key(key, label, event)
        with gui.add_folder("Gripper"):
            self._opening = gui.add_slider("Opening", 0.0, 1.0, 0.01, 1.0)
            self._speed = gui.add_slider("Speed, m/s", 0.05, 0.5, 0.05, 0.25)
            self._step = gui.add_slider("Step of a key, mm", 1, 20, 1, 5)

            @self._opening.on_update
            async def note_opening(event: Any) -> None:
                if event.client_id is not None:  # and not set by `_show`
                    self._actions.append(Opening(float(self._opening.value)))

        if cameras:
            with gui.add_folder("Cameras"):
                self._images = gui.add_html(_waiting_text(cameras))
        with gui.add_folder("Keys"):
            gui.add_html(key_map(shown))
        for key, (label, _) in (*MOVES.items(), *TURNS.items()):
            self._add_key(key, label, Key(key))
        for key, label in (*POSES.items(), ("space", "open or close the gripper")):
            self._add_key(key, label, Key(key))

    def _is_shown(self, event: TeleopEvent, has_policy: bool) -> bool:
        if event in (TeleopEvent.TAKE_OVER, TeleopEvent.GIVE_BACK):
            return has_policy
        return event is not TeleopEvent.SWITCH_ARM or len(self._arms) > 1

    def _add_key(self, key: str, label: str, action: Action) -> None:
        command = self._server.gui.add_command(
            label.capitalize(),
            hotkey=key,  # pyright: ignore[reportArgumentType]
        )
        command.on_trigger(self._noting(action))

    # -- showing --------------------------------------------------------------------------------

    def _show(self, view: SessionView) -> None:
        """Draw what is due."""
        with self._server.atomic():
            if self._steps % SCENE_STEPS == 0:
                self._scene.update(view.world.data)
                for arm, goal in self.hand.goals.items():
                    handle = self.handles[arm]
                    if np.abs(handle.position - goal.position).max() > 1e-6:
                        handle.position = goal.position
                    if np.abs(handle.wxyz - goal.orientation).max() > 1e-6:
                        handle.wxyz = goal.orientation
            if self._steps % STATUS_STEPS == 0:
                self._show_status(view)
            if self._cameras and (pictures := self._cameras.exchange(view.world)):
                self._images.content = pictures_html(pictures)

    def _show_status(self, view: SessionView) -> None:
        text = status_html(view)
        if text != self._status_text:
            self._status.content = self._status_text = text
        opening = round(self.hand.goals[view.active_arm].opening, 2)
        if abs(self._opening.value - opening) > 0.005:
            self._opening.value = opening
        for event, button in self._buttons.items():
            is_off = event not in ALLOWED[view.mode] and event in _OF_MODES
            if event is TeleopEvent.SAVE:
                is_off = is_off or view.step == 0
            if event is TeleopEvent.TAKE_OVER:
                is_off = not view.is_policy_acting
            if event is TeleopEvent.GIVE_BACK:
                is_off = view.is_policy_acting or view.mode is not Mode.RECORDING
            if button.disabled != is_off:
                button.disabled = is_off


_OF_MODES = frozenset().union(*ALLOWED.values())


def status_html(view: SessionView) -> str:
    """Return the state of a session as HTML."""
    cells = "".join(
        f"<span style='opacity:.65'>{name}</span>"
        f"<span style='font-variant-numeric:tabular-nums' data-rmb='{name}'>"
        f"{html.escape(value)}</span>"
        for name, value in status_rows(view).items()
    )
    grid = "display:grid;grid-template-columns:auto 1fr auto 1fr;gap:.1em .8em;margin:.5em 0"
    return (
        f"<div style='padding:.2em .4em;font-size:.85em'><div style='background:"
        f"{COLOURS[view.mode]};color:#fff;border-radius:4px;padding:.25em .6em;font-weight:600;"
        f"text-transform:uppercase;letter-spacing:.06em' data-rmb='mode'>{view.mode.value}</div>"
        f"<div style='{grid}'>{cells}</div>"
        f"<div style='min-height:1.3em' data-rmb='message'>{html.escape(view.message)}</div></div>"
    )


def key_map(events: Sequence[TeleopEvent]) -> str:
    """Return the keys and what they do as an HTML table."""
    rows = [(key, label) for key, (label, _) in (*MOVES.items(), *TURNS.items())]
    rows += [*POSES.items(), ("space", "open or close the gripper")]
    rows += [(EVENTS[event][0], EVENTS[event][1].lower()) for event in events]
    cells = [
        f"<td><kbd style='border:1px solid #999;border-radius:3px;padding:0 .35em'>"
        f"{_key_name(key)}</kbd></td><td style='padding:.1em .8em .1em .3em'>{label}</td>"
        for key, label in rows
    ]
    half = (len(cells) + 1) // 2
    lines = zip(cells[:half], [*cells[half:], "<td></td><td></td>"], strict=False)
    body = "".join(f"<tr>{left}{right}</tr>" for left, right in lines)
    return f"<table style='font-size:.8em;margin:.2em .4em'>{body}</table>"


def pictures_html(pictures: Mapping[str, bytes]) -> str:
    """Return JPEG images with their names as HTML."""
    parts = [
        f"<figure style='margin:0;flex:1'><img alt='{name}' style='width:100%;display:block;"
        f"border-radius:4px' src='data:image/jpeg;base64,{base64.b64encode(data).decode()}'/>"
        f"<figcaption style='font-size:.75em;opacity:.65'>{name}</figcaption></figure>"
        for name, data in pictures.items()
    ]
    return f"<div style='padding:.2em .4em;display:flex;gap:.3em'>{''.join(parts)}</div>"


def _waiting_text(cameras: Sequence[str]) -> str:
    return f"<div style='padding:.4em;opacity:.65'>{', '.join(cameras)}: starting…</div>"


def _key_name(key: str) -> str:
    return {"escape": "Esc", "delete": "Del"}.get(key, key.capitalize())


# -- camera images --------------------------------------------------------------------------------


class Previews:
    """Images of cameras, drawn in a process of its own whenever the last ones have been shown."""

    def __init__(self, model: mujoco.MjModel, cameras: Sequence[str]) -> None:
        self._worker = Worker(_PreviewDrawer, model, tuple(cameras))
        self._is_drawing = False

    def exchange(self, world: FaceEnv) -> dict[str, bytes] | None:
        """Return new images if there are some, and ask for those of the present state."""
        images = None
        if self._is_drawing:
            if not wait_for([self._worker], 0.0):
                return None
            images = self._worker.receive()
        data, model = world.data, world.model
        state = (data.qpos.copy(), data.mocap_pos.copy(), data.mocap_quat.copy())
        self._worker.submit((state, [getattr(model, name).copy() for name in MODEL_CHANGES]))
        self._is_drawing = True
        return images

    def close(self) -> None:
        """End the process."""
        self._worker.close(at_once=True)


class _PreviewDrawer:
    """Draws the cameras of a model, in a worker process: state in, JPEG images out."""

    def __init__(self, model: mujoco.MjModel, cameras: tuple[str, ...]) -> None:
        self._model, self._data, self._names = model, mujoco.MjData(model), cameras
        self._renderer = CameraRenderer(model, *PREVIEW_SIZE)
        self.close = self._renderer.close

    def __call__(
        self, given: tuple[tuple[NDArray[Any], ...], list[NDArray[Any]]]
    ) -> dict[str, bytes]:
        data = self._data
        (data.qpos[:], data.mocap_pos[:], data.mocap_quat[:]), changes = given
        for name, values in zip(MODEL_CHANGES, changes, strict=True):
            getattr(self._model, name)[:] = values
        mujoco.mj_kinematics(self._model, data)
        mujoco.mj_camlight(self._model, data)
        images = self._renderer.render(data, self._names)
        return {
            name: encode_image(image, "jpeg", PREVIEW_QUALITY).tobytes()
            for name, image in images.items()
        }
