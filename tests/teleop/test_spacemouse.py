"""SpaceMice: the installed pyspacemouse reads reports of mice that are not there."""

from __future__ import annotations

import builtins
import inspect
import os
import struct
from collections import deque
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest

from robo_manip_baselines.commands import teleop
from robo_manip_baselines.envs.mujoco.tasks.face_env import world_of
from robo_manip_baselines.runs.errors import RequestError
from robo_manip_baselines.teleop import teleoperate
from robo_manip_baselines.teleop.device import Mode, SessionView, TeleopEvent
from robo_manip_baselines.teleop.keyboard import ARROWS, KeyboardDevice
from robo_manip_baselines.teleop.options import SteeringOptions
from robo_manip_baselines.teleop.spacemouse import SpaceMouseDevice, find_mice

easyhid = pytest.importorskip("easyhid", reason="pip install pyspacemouse")
pyspacemouse = pytest.importorskip("pyspacemouse", reason="pip install pyspacemouse")

BOTH = ("left", "right")
PUSH, TURN, BUTTONS = 1, 2, 3
"""Numbers of a SpaceMouse Compact's reports."""


class Hid:
    """SpaceMouse Compact on the bus, whose reports are given."""

    vendor_id, product_id = 0x256F, 0xC635
    product_string, manufacturer_string = "SpaceMouse Compact", "3Dconnexion"
    release_number, serial_number = 1, ""

    def __init__(self, path: Path) -> None:
        path.touch()
        self.path = str(path)
        self.reports: deque[bytes] = deque()
        self.is_open, self.is_gone, self.is_busy = False, False, False

    def open(self) -> None:
        if self.is_busy:
            raise easyhid.HIDException("Failed to open device")
        self.is_open = True

    def close(self) -> None:
        self.is_open = False

    def set_nonblocking(self, enable: bool) -> None:
        assert enable

    def read(self, size: int) -> bytes:
        if self.is_gone:
            raise easyhid.HIDException("Failed to read from HID device: -1")
        return self.reports.popleft() if self.reports else b""

    def push(self, *axes: int) -> None:
        """As the mouse reports it: x right, y towards the person, z down, full at 350."""
        self.reports.append(struct.pack("<Bhhh", PUSH, *axes))

    def turn(self, *axes: int) -> None:
        self.reports.append(struct.pack("<Bhhh", TURN, *axes))

    def buttons(self, *masks: int) -> None:
        """The first one is 1, the second one 2."""
        self.reports.extend(struct.pack("<BB", BUTTONS, mask) for mask in masks)


@pytest.fixture
def bus(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> list[Hid]:
    """Connected devices: two mice, not in the order of their numbers."""
    connected = [Hid(tmp_path / "hidraw10"), Hid(tmp_path / "hidraw9")]

    class Enumeration:
        device_list = connected

        def find(self, **_: Any) -> list[Hid]:
            return connected

    monkeypatch.setattr(pyspacemouse.api, "Enumeration", Enumeration)
    return connected


class Mice:
    """The device under test, its window, and its mice."""

    def __init__(
        self, env: gymnasium.Env[Any, Any], view: SessionView, arms: tuple[str, ...] = BOTH
    ) -> None:
        world = world_of(env)
        self.view = replace(view, world=world, steered=arms)
        self.screen = KeyboardDevice(world, arms)
        self.device = SpaceMouseDevice(arms, lambda: self.screen, SteeringOptions(speed=0.2))
        self.update()

    def update(self, **changes: Any) -> Any:
        return self.device.update(replace(self.view, **changes))


@pytest.fixture
def make_mice(
    bus: list[Hid], windows: list[Any], feeding_env: gymnasium.Env[Any, Any], view: SessionView
) -> Callable[..., Mice]:
    feeding_env.reset(seed=0)
    return lambda *args: Mice(feeding_env, view, *args)


def test_the_call_is_one_that_the_installed_release_knows() -> None:
    """Newer releases have changed it before."""
    convention = pyspacemouse.AxisConvention.HID_Z_UP
    call = {"nonblocking": True, "axis_convention": convention}
    inspect.signature(pyspacemouse.open_by_path).bind("/dev/hidraw3", **call)
    inspect.signature(pyspacemouse.open).bind(**call)
    assert pyspacemouse.get_connected_devices_by_path
    state = pyspacemouse.SpaceMouseState()
    for name in ("t", "x", "y", "z", "roll", "pitch", "yaw", "buttons"):
        assert hasattr(state, name)


def test_pushes_move_along_the_axes_of_the_world(
    make_mice: Callable[..., Mice], bus: list[Hid]
) -> None:
    del bus[0]
    mice = make_mice(("right",))
    for report, wanted in (
        ((350, 0, 0), [0.2, 0, 0]),
        ((0, -350, 0), [0, 0.2, 0]),  # away from the person
        ((0, 0, -350), [0, 0, 0.2]),  # lifted
        ((0, 0, 2000), [0, 0, -0.2]),
        ((30, 0, 0), [0, 0, 0]),  # of 350: less than the dead zone
    ):
        bus[0].push(*report)
        command = mice.update().arms["right"]
        np.testing.assert_allclose(command.linear, wanted, atol=1e-12)
        np.testing.assert_allclose(command.angular, 0.0, atol=1e-12)
    bus[0].push(0, 0, 0)
    for axis in range(3):
        report = [0, 0, 0]
        report[axis] = 350
        bus[0].turn(*report)
        angular = mice.update().arms["right"].angular
        wanted = np.eye(3)[axis] * (1 if axis == 0 else -1)
        np.testing.assert_allclose(angular, wanted, atol=1e-12)


def test_beyond_the_dead_zone_motion_begins_at_nothing(
    make_mice: Callable[..., Mice], bus: list[Hid]
) -> None:
    del bus[0]
    mice = make_mice(("right",))
    bus[0].push(36, 0, 0)
    assert 0.0 < mice.update().arms["right"].linear[0] < 0.001
    bus[0].push(350 // 2, 0, 0)
    assert mice.update().arms["right"].linear[0] == pytest.approx(0.2 * 0.4 / 0.9)


def test_a_mouse_is_read_to_its_newest_report(
    make_mice: Callable[..., Mice], bus: list[Hid]
) -> None:
    del bus[0]
    mice = make_mice(("right",))
    for size in range(0, 350, 50):
        bus[0].push(size, 0, 0)
        bus[0].turn(0, 0, 0)
    bus[0].push(0, 0, 350)
    np.testing.assert_allclose(mice.update().arms["right"].linear, [0, 0, -0.2], atol=1e-12)
    assert not bus[0].reports
    # Held still, it goes on, without a report.
    np.testing.assert_allclose(mice.update().arms["right"].linear, [0, 0, -0.2], atol=1e-12)


def test_two_mice_steer_two_arms(make_mice: Callable[..., Mice], bus: list[Hid]) -> None:
    mice = make_mice()
    nine, ten = bus[1], bus[0]
    nine.push(350, 0, 0)
    ten.push(0, 0, -350)
    asked = mice.update()
    assert asked.arms["left"].linear[0] == pytest.approx(0.2)
    assert asked.arms["right"].linear[2] == pytest.approx(0.2)
    named = find_mice([Path(ten.path), Path(nine.path)], 2)
    assert [path.name for path, _ in named] == ["hidraw10", "hidraw9"]
    mice.device.close()
    assert not nine.is_open
    assert not ten.is_open


def test_one_mouse_steers_the_active_arm(make_mice: Callable[..., Mice], bus: list[Hid]) -> None:
    del bus[0]
    mice = make_mice()
    bus[0].push(350, 0, 0)
    for arm, other in (BOTH, BOTH[::-1]):
        asked = mice.update(active_arm=arm)
        assert asked.arms[arm].linear[0] == pytest.approx(0.2)
        assert np.abs(asked.arms[other].linear).max() < 1e-9


def test_buttons(make_mice: Callable[..., Mice], bus: list[Hid]) -> None:
    del bus[0]
    mice = make_mice()
    hand = mice.screen.hand
    bus[0].buttons(1)
    assert mice.update().events == ()
    assert hand.goals["right"].opening == 1.0
    bus[0].buttons(0)
    assert mice.update().arms["right"].opening == 0.0
    assert mice.update().arms["right"].opening == 0.0
    for mode, event in (
        (Mode.PRACTICE, TeleopEvent.RECORD),
        (Mode.RECORDING, TeleopEvent.SAVE),
        (Mode.REVIEW, TeleopEvent.SAVE),
    ):
        bus[0].buttons(2, 0)
        assert mice.update(mode=mode).events == (event,)
    opening = hand.goals["right"].opening
    bus[0].buttons(1, 3, 2, 0)
    assert mice.update().events == (TeleopEvent.SWITCH_ARM,)
    bus[0].buttons(2, 3, 0)
    assert mice.update(has_policy=True).events == (TeleopEvent.GIVE_BACK,)
    assert hand.goals["right"].opening == opening


def test_moving_the_mouse_takes_over_from_the_policy(
    make_mice: Callable[..., Mice], bus: list[Hid]
) -> None:
    del bus[0]
    mice = make_mice()
    acting = {"has_policy": True, "is_policy_acting": True}
    assert mice.update(**acting).events == ()
    bus[0].push(0, 350, 0)
    asked = mice.update(**acting)
    assert asked.events == (TeleopEvent.TAKE_OVER,)
    assert asked.arms["right"].linear[1] == pytest.approx(-0.2)


def test_a_session_goes_where_mouse_and_keys_lead_and_stays_there(
    bus: list[Hid],
    windows: list[Any],
    make_session: Callable[..., Any],
    feeding_env: gymnasium.Env[Any, Any],
) -> None:
    del bus[0]
    heights = []

    class Person(SpaceMouseDevice):
        def update(self, view: SessionView) -> Any:
            heights.append(view.arms["right"].position[2])
            place = len(heights)
            if place in (1, 90):
                bus[0].buttons(2, 0)
            if place in (5, 30):
                bus[0].push(0, 0, -350 if place == 5 else 0)
            if place == 60:
                windows[0].press(next(code for code, row in ARROWS.items() if row[0] == "PgUp"))
            return super().update(view)

    device = Person(
        ("right",), lambda: KeyboardDevice(world_of(feeding_env), ("right",)), SteeringOptions()
    )
    session, store = make_session(feeding_env, device, steered=("right",), seeds=(3,))
    assert session.run().saved == 1
    assert len(store.episodes) == 1
    assert heights[59] - heights[4] == pytest.approx(25 * 0.25 * 0.02)
    assert heights[31:60] == [heights[31]] * 29
    assert heights[-1] - heights[59] == pytest.approx(0.005)
    assert windows[0].is_closed
    assert not bus[0].is_open


# -- what can be wrong ----------------------------------------------------------------------------


def refused(match: str, *options: str, out: Path) -> None:
    given = ["--device", "spacemouse", *options, "--cameras", "none", "--out", str(out)]
    with pytest.raises(RequestError, match=match) as caught:
        teleop.main(["FeedingEnv", *given])
    assert "\n" not in str(caught.value)
    assert not out.exists()


def test_no_mouse(bus: list[Hid], tmp_path: Path) -> None:
    bus.clear()
    refused("no SpaceMouse is connected.*plug one in", out=tmp_path / "out")


def test_a_path_that_is_none(bus: list[Hid], tmp_path: Path) -> None:
    wanted = r"--mice /dev/null: no SpaceMouse; connected: .*hidraw9, .*hidraw10"
    refused(wanted, "--mice", "/dev/null", out=tmp_path / "out")
    two = [mouse.path for mouse in bus]
    refused("--mice names 2 for 1 arm; give --arm both", "--mice", *two, out=tmp_path / "out")


def test_no_permission(bus: list[Hid], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of the second one: the first one is let go of."""
    bus[0].is_busy = True
    both = ("--arm", "both")
    refused("cannot be opened; end what else uses it", *both, out=tmp_path / "out")
    assert not bus[1].is_open
    monkeypatch.setattr(os, "access", lambda *_: False)
    rule = r'KERNELS=="\*:256F:C635\.\*", TAG\+="uaccess".*udevadm control --reload'
    refused(f"SpaceMouseCompact .*no permission; run: .*{rule}", *both, out=tmp_path / "out")


def test_the_library_of_the_bus_is_missing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail() -> None:
        raise AttributeError("hid_enumerate")

    monkeypatch.setattr(pyspacemouse.api, "Enumeration", fail)
    refused("hidapi is missing; run: .*apt-get install libhidapi-hidraw0", out=tmp_path / "out")


def test_the_package_is_missing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    real = builtins.__import__

    def lacking(name: str, *args: Any, **kwargs: Any) -> Any:
        if name == "pyspacemouse":
            raise ModuleNotFoundError("No module named 'pyspacemouse'", name="pyspacemouse")
        return real(name, *args, **kwargs)

    monkeypatch.setattr(builtins, "__import__", lacking)
    refused(r"needs pyspacemouse; run: .*\[teleop\]", out=tmp_path / "out")


def test_a_mouse_that_is_unplugged_ends_the_session(
    make_mice: Callable[..., Mice], bus: list[Hid]
) -> None:
    mice = make_mice()
    bus[0].is_gone = True
    with pytest.raises(RequestError, match=r"hidraw10\) does not answer; plug it in"):
        mice.update()


def test_the_screen_is_the_page_where_there_is_no_display(
    monkeypatch: pytest.MonkeyPatch, feeding_env: gymnasium.Env[Any, Any], tmp_path: Path
) -> None:
    made: list[tuple[str, dict[str, Any]]] = []
    monkeypatch.setattr(teleoperate, "make_device", lambda name, **k: made.append((name, k)))
    for problem, name in (("no display", "web"), (None, "keyboard")):
        monkeypatch.setattr(teleoperate, "viewer_problem", lambda problem=problem: problem)
        options = teleop.TeleopOptions("FeedingEnv", device="spacemouse", out=tmp_path)
        teleoperate.open_device(teleop.to_config(options), {}, world_of(feeding_env))
        made[-1][1]["screen"]()
        assert made[-1][0] == name
