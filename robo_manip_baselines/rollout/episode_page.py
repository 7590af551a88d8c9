"""Episodes in the browser: 3-D scene, cameras and curves of one step, and a slider over all steps.

Everything shown is what the file holds. The scene is drawn from the recorded state, not simulated
again; cameras that were not recorded are drawn from it, too, where there is OpenGL.
"""

from __future__ import annotations

import contextlib
import json
import logging
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import mujoco
import numpy as np
from numpy.typing import NDArray

from robo_manip_baselines.data import EpisodeReader, read_metadata
from robo_manip_baselines.data.files import FAILED_FOLDER
from robo_manip_baselines.envs.mujoco.cell.opengl import opengl_problem
from robo_manip_baselines.envs.mujoco.cell.viser_scene import ViserScene
from robo_manip_baselines.envs.mujoco.tasks.face_env import FaceEnv, world_of
from robo_manip_baselines.observation import CAMERAS
from robo_manip_baselines.rollout.demonstrate import remake_env
from robo_manip_baselines.runs.browser import PageOptions, serve_page
from robo_manip_baselines.runs.errors import RequestError

if TYPE_CHECKING:
    import viser

Floats = NDArray[np.float64]

IMAGE_SIZE = (240, 320)
"""Height and width of each camera's image on the page, pixels."""

FRAME_PERIOD = 0.04
"""s between frames while an episode plays."""

CHART_PERIOD = 0.2
"""s between moves of the time line in the charts while an episode plays: all their data are sent
each time."""

SPEEDS = {"¼×": 0.25, "½×": 0.5, "1×": 1.0, "2×": 2.0, "4×": 4.0}

COLOURS = ("#0072b2", "#e69f00", "#009e73", "#cc79a7", "#56b4e9", "#d55e00", "#999999")
"""Of curves; Okabe and Ito's, which people with any colour vision can tell apart."""

CAMERA = {"position": (0.75, -0.25, 0.75), "look_at": (0.02, 0.5, 0.2)}
"""m, world: where the page's viewer stands at first, and looks to."""

PATH_COLOURS = {"gripper": (0, 114, 178), "target": (230, 159, 0)}

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class Curve:
    """Curve of a chart.

    Attributes:
        label: in the legend.
        values: (T,) of an episode.
        is_dashed: for commands and targets.
        colour: index into `COLOURS`.
    """

    label: str
    values: Floats
    is_dashed: bool = False
    colour: int = 0


def target_curves(episode: EpisodeReader) -> list[Curve]:
    """Return gripper and target, x, y and z, m in the world frame."""
    name = episode.task.names.target
    gripper = episode.array("end_effector_position")
    target = episode.array(episode.task.target_field)[:, 0]
    return [
        Curve(f"{what} {axis}", points[:, i], is_dashed=points is target, colour=i)
        for what, points in (("gripper", gripper), (name, target))
        for i, axis in enumerate("xyz")
    ]


def distance_curve(episode: EpisodeReader) -> list[Curve]:
    """Return the distance between gripper and target, cm."""
    target = episode.array(episode.task.target_field)[:, 0]
    offset = episode.array("end_effector_position") - target
    return [Curve("distance", 100.0 * np.linalg.norm(offset, axis=1), colour=3)]


def joint_curves(episode: EpisodeReader) -> dict[str, list[Curve]]:
    """Return each actuator's measured and commanded position, rad or m, by name."""
    joints = episode.attributes["joint_names"]
    actions = episode.attributes["action_names"]
    grippers = [name for name in actions if name not in joints]
    measured = dict(zip(joints, episode.array("joint_position").T, strict=True))
    measured |= dict(zip(grippers, episode.array("gripper_position").T, strict=True))
    command = dict(zip(actions, episode.array("action").T, strict=True))
    return {
        name: [Curve("measured", measured[name]), Curve("command", command[name], True, 1)]
        for name in actions
    }


def with_time_line(time: Floats, curves: Sequence[Curve], step: int) -> tuple[Floats, ...]:
    """Return the data of a chart with a vertical line at a step.

    Returns:
        Times (T + 2,), each curve, and the line, which is NaN but at two points of one time.
    """
    low, high = curve_range(curves)
    rows = np.insert(np.arange(len(time)), step + 1, [step, step])
    line = np.full(len(rows), np.nan)
    line[step + 1 : step + 3] = low, high
    return (time[rows], *(curve.values[rows] for curve in curves), line)


def curve_range(curves: Sequence[Curve]) -> tuple[float, float]:
    """Return the lower and upper end of a chart's axis, with a margin."""
    values = np.concatenate([curve.values for curve in curves])
    low, high = float(values.min()), float(values.max())
    margin = 0.05 * (high - low) or 0.5
    return low - margin, high + margin


class RecordedWorld:
    """Simulator that shows recorded states of the episodes of one model.

    Args:
        episode: open file of the first episode.

    Raises:
        RequestError: this release's environment is not the recorded one.
    """

    def __init__(self, episode: EpisodeReader) -> None:
        shown = {"cameras": (), "image_size": IMAGE_SIZE, "render_size": None}
        self._env = remake_env(episode, **shown)
        self.world: FaceEnv = world_of(self._env)
        self.key = self.key_of(episode)

    @staticmethod
    def key_of(episode: EpisodeReader) -> str:
        """Return what episodes have in common that one model can show."""
        attributes = episode.attributes
        kept = (attributes["env_id"], attributes["xml_hash"], attributes["env_kwargs"])
        return json.dumps(kept, sort_keys=True)

    def load(self, episode: EpisodeReader) -> None:
        """Take the states of an episode."""
        self._env.reset(seed=int(episode.attributes["seed"]))  # places what is only drawn
        own = [item.name for item in episode.task.fields if item.name in episode.fields]
        self._rows = {name: episode.array(name) for name in own}
        self._qpos = episode.array("qpos")
        self._poses = self.world.face.placed_bodies(
            episode.array("mouth_position")[:, 0],
            episode.array("head_orientation"),
            episode.array("jaw_opening"),
        )

    def show(self, step: int) -> mujoco.MjData:
        """Return the state at a step, bodies and cameras in place."""
        model, data = self.world.model, self.world.data
        data.qpos[:] = self._qpos[step]
        for body, (position, orientation) in self._poses.items():
            place = model.body_mocapid[model.body(body).id]
            if place >= 0:  # a physical face moves by its joints, but for the mouth and the bust
                data.mocap_pos[place] = position[step]
                data.mocap_quat[place] = orientation[step]
        mujoco.mj_kinematics(model, data)
        self.world.show_row({name: values[step] for name, values in self._rows.items()})
        mujoco.mj_kinematics(model, data)
        mujoco.mj_camlight(model, data)
        return data

    def close(self) -> None:
        """Free the simulator."""
        self._env.close()


class EpisodePage:
    """Page over some episodes.

    Callbacks of the browser only note what is wanted; `update` shows it, in one thread.

    Args:
        server: of the page.
        paths: episode files, at least one.
        clock: current time, s.

    Attributes:
        step: that is shown.
        shown: file that is shown.
    """

    def __init__(
        self,
        server: viser.ViserServer,
        paths: Sequence[Path],
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._server, self._clock = server, clock
        self._paths = titles(paths)
        self._stack = contextlib.ExitStack()
        self._world: RecordedWorld | None = None
        self._drawn: list[Any] = []
        self._charts: list[tuple[Any, list[Curve]]] = []
        self._wake = threading.Event()
        self._played_from = (0.0, 0)
        self._chart_time = -np.inf
        self.shown: Path | None = None
        self.step = -1
        server.scene.configure_default_lights(cast_shadow=False)  # software rendering is slow
        server.initial_camera.position = CAMERA["position"]
        server.initial_camera.look_at = CAMERA["look_at"]
        self._add_controls()

    def _add_controls(self) -> None:
        gui, titles = self._server.gui, list(self._paths)
        gui.main_panel.dock_right()
        self._episode = gui.add_dropdown("Episode", titles, initial_value=titles[0])
        self._slider = gui.add_slider("Step", min=0, max=1, step=1, initial_value=0)
        buttons = gui.add_button_group("Move", ("first", "back", "next", "last"))
        self._play = gui.add_checkbox("Play", initial_value=False)
        self._speed = gui.add_dropdown("Speed", tuple(SPEEDS), initial_value="1×")
        self._text = gui.add_markdown("")
        self._joint: viser.GuiDropdownHandle[str] = gui.add_dropdown("Joint", ["–"])
        self._panel = gui.add_panel()
        self._cameras = self._panel.add_tab("Cameras")
        self._panel.dock_left()
        self._panel.set_width(IMAGE_SIZE[1] + 30)
        for control in (self._episode, self._slider, self._play, self._speed, self._joint):
            control.on_update(lambda _: self._wake.set())

        @buttons.on_click
        def _(event: Any) -> None:
            last = int(self._slider.max)
            step = int(self._slider.value)
            places = {"first": 0, "back": step - 1, "next": step + 1, "last": last}
            self._play.value = False
            self._slider.value = min(max(places[event.target.value], 0), last)
            self._wake.set()

    def update(self) -> None:
        """Show what is wanted by now."""
        path = self._paths[self._episode.value]
        if path != self.shown:
            self._load(path)
        if self._joint.value != self._shown_joint:
            self._draw_charts()
        step = int(self._slider.value)
        if self._play.value:
            step = self._played_step(step)
        else:
            self._played_from = (self._clock(), step)
        if step != self.step:
            self._show(step)

    def _played_step(self, step: int) -> int:
        """Return the step that playing has come to; stop at the end."""
        now, last = self._clock(), len(self._reader) - 1
        begin, first = self._played_from
        if step != self.step:  # the slider was moved meanwhile
            begin, first = self._played_from = (now, step)
        period = float(self._reader.attributes["control_period"])
        speed = SPEEDS[self._speed.value]
        if speed != self._shown_speed:
            begin, first = self._played_from = (now, step)
            self._shown_speed = speed
        if first >= last:
            begin, first = self._played_from = (now, 0)
        played = first + int((now - begin) * speed / period + 1e-6)
        if played >= last:
            self._play.value, played = False, last
            self._played_from = (now, last)
        return played

    def wait(self) -> None:
        """Wait until there may be something new to show."""
        self._wake.wait(FRAME_PERIOD if self._play.value else None)
        self._wake.clear()

    def close(self) -> None:
        """Close the file and the simulator."""
        self._stack.close()
        if self._world is not None:
            self._world.close()
            self._world = None

    # -- one episode ----------------------------------------------------------------------------

    def _load(self, path: Path) -> None:
        """Open an episode and draw what does not depend on the step."""
        self._stack.close()
        self._reader = self._stack.enter_context(EpisodeReader(path))
        self._reader.task.require_env()
        self.shown, self.step = path, -1
        self._played_from = (self._clock(), 0)
        self._shown_speed = SPEEDS[self._speed.value]
        self._target = self._reader.array(self._reader.task.target_field)[:, 0]
        self._gripper = self._reader.array("end_effector_position")
        self._joints = joint_curves(self._reader)
        with self._server.atomic():
            self._slider.max = len(self._reader) - 1
            self._slider.value = 0
            names = tuple(self._joints)
            self._joint.options = names
            self._draw_scene()
            self._draw_paths()
            self._draw_images()
            self._draw_charts()

    def _draw_scene(self) -> None:
        self._missing = ""
        if self._world is not None and self._world.key != RecordedWorld.key_of(self._reader):
            self._world.close()
            self._world = None
        if self._world is None:
            for item in self._drawn:
                item.remove()
            self._drawn = []
            try:
                self._world = RecordedWorld(self._reader)
            except RequestError as error:
                self._missing = str(error)
                return
            world = self._world.world
            scene = ViserScene(self._server.scene, world.model, varying=world.varying_geoms)
            self._drawn = [scene]
        self._world.load(self._reader)

    def _draw_paths(self) -> None:
        """Draw where gripper and target are during the whole episode."""
        for name, points in (("gripper", self._gripper), ("target", self._target)):
            pairs = np.stack([points[:-1], points[1:]], axis=1)
            if len(pairs):
                self._server.scene.add_line_segments(
                    f"/paths/{name}",
                    pairs,
                    PATH_COLOURS[name],
                    thickness=2.0,
                    thickness_units="screen",
                )

    def _draw_images(self) -> None:
        """Add an image for each camera that was recorded, or for all that can be drawn."""
        self._recorded = self._reader.cameras
        can_draw = self._world is not None and opengl_problem() is None
        cameras = self._recorded or (CAMERAS if can_draw else ())
        for image in getattr(self, "_images", {}).values():
            image.remove()
        blank = np.zeros((*IMAGE_SIZE, 3), np.uint8)
        self._images = {}
        with self._cameras:
            for camera in cameras:
                kind = "" if self._recorded else " (drawn from the state)"
                self._images[camera] = self._server.gui.add_image(blank, label=camera + kind)

    def _draw_charts(self) -> None:
        for chart, _ in self._charts:
            chart.remove()
        self._shown_joint = self._joint.value
        name = self._reader.task.names.target
        joint = self._joints.get(self._shown_joint) or next(iter(self._joints.values()))
        self._charts = [
            self._add_chart(f"gripper and {name}, m", target_curves(self._reader)),
            self._add_chart(f"gripper to {name}, cm", distance_curve(self._reader)),
            self._add_chart(f"{self._shown_joint}, rad or m", joint),
        ]

    def _add_chart(self, title: str, curves: list[Curve]) -> tuple[Any, list[Curve]]:
        series: list[dict[str, Any]] = [{"label": "time, s"}]
        for curve in curves:
            dash = {"dash": (6.0, 4.0)} if curve.is_dashed else {}
            points = {"points": {"show": False}}
            colour = COLOURS[curve.colour]
            series.append({"label": curve.label, "stroke": colour, "width": 1.5, **dash, **points})
        line = {"label": "now", "stroke": "#d55e00", "width": 1.5, "points": {"show": False}}
        low, high = curve_range(curves)
        chart: Any = self._server.gui.add_uplot(
            with_time_line(self._reader.array("time"), curves, max(self.step, 0)),
            (*series, line),  # type: ignore[arg-type]  # typed dicts with every key optional
            title=title,
            scales={"x": {"time": False}, "y": {"range": (low, high), "auto": False}},
            height=190,
        )
        return chart, curves

    # -- one step -------------------------------------------------------------------------------

    def _show(self, step: int) -> None:
        """Show a step everywhere at once."""
        images = self._views(step)
        with self._server.atomic():
            self.step = step
            if int(self._slider.value) != step:
                self._slider.value = step
            if self._world is not None:
                for scene in self._drawn:
                    scene.update(self._world.world.data)
            for camera, image in images.items():
                self._images[camera].image = image
            self._text.content = self._description(step)
            now = self._clock()
            if not self._play.value or now - self._chart_time >= CHART_PERIOD:
                self._chart_time = now
                time_of_step = self._reader.array("time")
                for chart, curves in self._charts:
                    chart.data = with_time_line(time_of_step, curves, step)

    def _views(self, step: int) -> dict[str, NDArray[np.uint8]]:
        """Return the images of a step by camera, after the simulator's state has been set."""
        data = None if self._world is None else self._world.show(step)
        if self._recorded:
            return {c: _fitted(self._reader.frame(c, step)) for c in self._images}
        if data is None or self._world is None:
            return {}
        return self._world.world.renderer.render(data, list(self._images))

    def _description(self, step: int) -> str:
        attributes, arrays = self._reader.attributes, self._reader.arrays
        phase = attributes["phase_names"][int(arrays["phase"][step])]
        distance = 100.0 * float(np.linalg.norm(self._gripper[step] - self._target[step]))
        end = "success" if attributes["is_success"] else "no success"
        motion = attributes["env_kwargs"].get("motion", "recorded")
        lines = [
            f"**{arrays['time'][step]:.2f} s**, step {step} of {len(self._reader) - 1}",
            f"phase **{phase}**, {distance:.1f} cm to the {self._reader.task.names.target}",
            f"seed {attributes['seed']}, {attributes['expert']}, {end}",
            f"motion {motion} ({attributes['motion_clip']}, {attributes['motion_subject']})",
        ]
        if self._missing:
            lines.append(f"no scene: {self._missing}")
        return "  \n".join(lines)


def titles(paths: Sequence[Path]) -> dict[str, Path]:
    """Return the files by the texts by which they are chosen.

    Raises:
        EpisodeFileError: a file is damaged.
    """
    found: dict[str, Path] = {}
    for path in paths:
        outcome = "success" if read_metadata(path)["is_success"] else "no success"
        folder = path.parent.parent if path.parent.name == FAILED_FOLDER else path.parent
        title = f"{folder.name}/{path.stem} ({outcome})".removeprefix("/")
        found[title if title not in found else f"{path} ({outcome})"] = path
    return found


def _fitted(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return an image as high as those of the page."""
    height, width = image.shape[:2]
    method = cv2.INTER_AREA if height > IMAGE_SIZE[0] else cv2.INTER_LINEAR
    size = max(1, round(width * IMAGE_SIZE[0] / height)), IMAGE_SIZE[0]
    return np.asarray(cv2.resize(image, size, interpolation=method), np.uint8)


def serve_episodes(paths: Sequence[Path], options: PageOptions) -> None:
    """Serve a page over episodes until the process is interrupted.

    Raises:
        RequestError: nothing can listen at the address, or a file is damaged.
        KeyboardInterrupt: at the end.
    """
    titles(paths)  # damaged files are found before anything is served
    with (
        serve_page(options, "Episodes") as (server, address),
        contextlib.closing(EpisodePage(server, paths)) as page,
    ):
        page.update()
        logger.info("%d episodes at %s (Ctrl-C ends it)", len(paths), address)
        while True:
            page.wait()
            page.update()
