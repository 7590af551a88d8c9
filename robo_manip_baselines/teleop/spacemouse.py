"""Device of one or two SpaceMice: knobs that are pushed and turned in six directions.

A screen goes with it, the window or the page, and their keys work, too: a mouse only adds motion
and two buttons.
"""

from __future__ import annotations

import contextlib
import io
import logging
import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Protocol

import numpy as np

from robo_manip_baselines.runs.errors import RequestError
from robo_manip_baselines.runs.extras import install_command
from robo_manip_baselines.teleop.device import (
    Floats,
    Mode,
    SessionView,
    TeleopCommand,
    TeleopDevice,
    TeleopEvent,
    TeleopInput,
)
from robo_manip_baselines.teleop.hand import Hand
from robo_manip_baselines.teleop.options import SteeringOptions

logger = logging.getLogger(__name__)

MAX_REPORTS = 64
"""Reports that are read in a control period; a SpaceMouse sends four or five."""

AXES = ("x", "y", "z", "roll", "pitch", "yaw")

BUTTONS = (
    "first button: open or close the gripper; second: record, then save; "
    "both: give back to the policy, or the other arm"
)


class Screen(TeleopDevice, Protocol):
    """Device with a screen and keys."""

    hand: Hand
    """Goals that its keys set."""


class SpaceMouseDevice:
    """One mouse, for the active arm, or two, the first one for the first arm.

    Args:
        arms: that the person steers.
        screen: opens the device that shows the session.
        steering: speeds, dead zone, and paths of the mice.

    Raises:
        RequestError: there is no mouse, or it cannot be opened; says what to do.
    """

    is_paced = True

    def __init__(
        self,
        arms: Sequence[str],
        screen: Callable[[], Screen],
        steering: SteeringOptions | None = None,
    ) -> None:
        self._arms, self._steering = tuple(arms), steering or SteeringOptions()
        self._moved: set[str] = set()
        with contextlib.ExitStack() as opened:
            self._mice: list[Mouse] = []
            for path, name in find_mice(self._steering.mice, len(self._arms)):
                self._mice.append(Mouse(path, name, self._steering.dead_zone))
                opened.callback(self._mice[-1].close)
            self._screen = screen()
            opened.callback(self._screen.close)
            self._closing = opened.pop_all()
        for place, mouse in enumerate(self._mice):
            arm = self._arms[place] if len(self._mice) > 1 else "active"
            logger.info("%s (%s) steers the %s arm", mouse.name, mouse.path, arm)
        logger.info("%s", BUTTONS)

    def update(self, view: SessionView) -> TeleopInput:
        """Show the session, and return what mice and keys ask for."""
        hand = self._screen.hand
        hand.follow(view, self._moved)  # keys go on from where a mouse has led
        self._moved = set()
        asked = self._screen.update(view)
        arms, events = dict(asked.arms), list(asked.events)
        for place, mouse in enumerate(self._mice):
            arm = self._arms[place] if len(self._mice) > 1 else view.active_arm
            axes, chords = mouse.read()
            for chord in chords:
                if chord == {0} and view.mode is not Mode.REVIEW and not view.is_policy_acting:
                    hand.toggle(arm)
                    arms[arm] = TeleopCommand(opening=hand.goals[arm].opening)
                elif chord == {1}:
                    is_practice = view.mode is Mode.PRACTICE
                    events.append(TeleopEvent.RECORD if is_practice else TeleopEvent.SAVE)
                elif chord == {0, 1}:
                    has_policy = view.has_policy
                    events.append(TeleopEvent.GIVE_BACK if has_policy else TeleopEvent.SWITCH_ARM)
            if axes.any():
                if view.is_policy_acting:
                    events.append(TeleopEvent.TAKE_OVER)
                self._moved.add(arm)
                linear = self._steering.speed * axes[:3]
                angular = self._steering.turn_speed * axes[3:]
                opening = hand.goals[arm].opening if arm in hand.goals else None
                arms[arm] = TeleopCommand(linear, angular, opening)
        return TeleopInput(arms, tuple(events))

    def close(self) -> None:
        """Let go of the mice, and close the screen."""
        self._closing.close()


class Mouse:
    """A SpaceMouse; it is open when this has been made.

    Args:
        path: of the device, as ``/dev/hidraw3``.
        name: of its model.
        dead_zone: share of the deflection that counts as none.

    Raises:
        RequestError: it cannot be opened; says what to do.
    """

    def __init__(self, path: Path, name: str, dead_zone: float) -> None:
        import pyspacemouse

        self.path, self.name, self._dead_zone = path, name, dead_zone
        self._pressed: set[int] = set()
        self._time = -1.0
        convention = pyspacemouse.AxisConvention.HID_Z_UP  # x right, y away, z up: the world's
        try:
            with contextlib.redirect_stdout(io.StringIO()):  # it prints that it was found
                self._device = pyspacemouse.open_by_path(
                    path, nonblocking=True, axis_convention=convention
                )
        except (RuntimeError, FileNotFoundError) as error:
            raise RequestError(_why_not(path, name)) from error

    def read(self) -> tuple[Floats, list[set[int]]]:
        """Return the deflection now, and the buttons that were pressed since the last time.

        Returns:
            (6,), -1 to 1: pushed along the world's axes and turned about them; sets of buttons
            that were down together, each as soon as all of them are up again.

        Raises:
            RequestError: the mouse was unplugged.
        """
        from easyhid import HIDException

        chords: list[set[int]] = []
        state = None
        for _ in range(MAX_REPORTS):
            try:
                state = self._device.read()
            except HIDException as error:
                raise RequestError(
                    f"{self.name} ({self.path}) does not answer; plug it in and start again (what "
                    "was saved stays)"
                ) from error
            if state.t == self._time:  # nothing new
                break
            self._time = state.t
            down = {place for place, is_down in enumerate(state.buttons) if is_down}
            if self._pressed and not down:
                chords.append(self._pressed)
            self._pressed = self._pressed | down if down else set()
        size = np.array([getattr(state, axis) for axis in AXES], dtype=np.float64)
        beyond = (np.abs(size) - self._dead_zone) / (1.0 - self._dead_zone)
        return np.sign(size) * np.clip(beyond, 0.0, 1.0), chords

    def close(self) -> None:
        """Let go of it."""
        self._device.close()


def find_mice(wanted: Sequence[Path], count: int) -> list[tuple[Path, str]]:
    """Return paths and models of the mice to use.

    Args:
        wanted: their paths; those that are connected, by number, if empty.
        count: largest number of them.

    Raises:
        RequestError: there is none, or not the wanted one; says what to do.
    """
    option = "--device spacemouse"
    try:
        import pyspacemouse
    except ModuleNotFoundError as error:
        raise RequestError(
            f"{option} needs {error.name}; run: {install_command('teleop')}"
        ) from error
    except OSError as error:  # hidapi is there and does not load
        raise RequestError(f"{option}: {_no_hidapi()}") from error
    try:
        found = pyspacemouse.get_connected_devices_by_path()
    except RuntimeError as error:
        raise RequestError(f"{option}: {_no_hidapi()}") from error
    known = {Path(path): name for path, name in found.items()}
    if not known:
        raise RequestError(
            f"{option}: no SpaceMouse is connected (`lsusb` lists them as 3Dconnexion); plug one "
            "in, or choose another --device"
        )
    listed = sorted(known, key=lambda path: (len(str(path)), str(path)))  # hidraw9 before hidraw10
    for path in wanted:
        if path not in known:
            raise RequestError(
                f"--mice {path}: no SpaceMouse; connected: {', '.join(map(str, listed))}"
            )
    if len(wanted) > count:
        raise RequestError(f"--mice names {len(wanted)} for {count} arm; give --arm both")
    return [(path, known[path]) for path in (wanted or listed[:count])]


def _no_hidapi() -> str:
    sudo = "" if os.geteuid() == 0 else "sudo "
    return f"the library hidapi is missing; run: {sudo}apt-get install libhidapi-hidraw0"


def _why_not(path: Path, name: str) -> str:
    """Return one line on why a connected mouse cannot be opened, and what to do."""
    import pyspacemouse

    if not path.exists():
        return f"{name} ({path}) is gone; plug it in again"
    if os.access(path, os.R_OK | os.W_OK):
        return f"{name} ({path}) cannot be opened; end what else uses it, for example spacenavd"
    numbers = {model: ids for model, *ids in pyspacemouse.get_supported_devices()}
    vendor, product = numbers[name]
    # The name of the HID device has both numbers, by cable and by Bluetooth.
    rule = f'KERNEL=="hidraw*", KERNELS=="*:{vendor:04X}:{product:04X}.*", TAG+="uaccess"'
    return (
        f"{name} ({path}): no permission; run: echo '{rule}' | sudo tee "
        "/etc/udev/rules.d/70-spacemouse.rules && sudo udevadm control --reload, and plug it in "
        "again"
    )
