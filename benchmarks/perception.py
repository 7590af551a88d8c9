"""Does an injected error stand for a real detector? A servo feeds with each, on the same seeds.

The mouth that the servo sees is the truth, the truth as late as a camera's report, the paper's
injected error, a trained predictor's recorded output, or that of MediaPipe's detector and the
shipped predictor on rendered images, without and with depth. Rows are appended as episodes end, so
that a call that was stopped goes on where it was::

    python benchmarks/perception.py --episodes 100 --out docs/results/perception

writes ``episodes.jsonl``, ``tables.md`` and ``by_distance.png``; ``--limit 300`` stops after so
many seconds. ``--pictures docs/images/perception_approach.png`` draws what the detector sees
instead. The camera needs OpenGL, MediaPipe and its model file; without them its conditions are left
out with the reason.
"""

from __future__ import annotations

import argparse
import json
import os
import time as clock
from collections import deque
from collections.abc import Generator, Iterator, Sequence
from contextlib import closing
from dataclasses import asdict, dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

os.environ.setdefault("MUJOCO_GL", "egl")

import numpy as np
from numpy.typing import NDArray

from robo_manip_baselines.envs.mujoco.cell.opengl import opengl_problem
from robo_manip_baselines.envs.mujoco.expert.servo import ARM_LAG
from robo_manip_baselines.envs.mujoco.face.camera_mouth import CAMERA
from robo_manip_baselines.envs.mujoco.tasks.face_env import FaceEnv, world_of
from robo_manip_baselines.envs.mujoco.tasks.feeding.expert import WITHDRAWN
from robo_manip_baselines.envs.mujoco.tasks.feeding.success import MOUTH_TOLERANCE
from robo_manip_baselines.envs.mujoco.tasks.registry import make_env, task_entry
from robo_manip_baselines.observation import FRAME_PERIOD
from robo_manip_baselines.rollout.results import Proportion
from robo_manip_baselines.runs.command import run_command
from robo_manip_baselines.runs.errors import RequestError
from robo_manip_baselines.runs.files import AppendFile, atomic_file, write_json, write_text
from robo_manip_baselines.runs.markdown import markdown_table
from robo_manip_baselines.runs.processes import answers
from robo_manip_baselines.runs.versions import software_versions

SOFTWARE = ("mujoco", "numpy", "robo_manip_baselines")
TASK, EXPERT, FIRST_SEED = "FeedingEnv", "servo", 1000
HORIZON = 24  # frames that the servo is shown, more than it looks ahead
LATE = {"delay": 1, "detector_rate": 30.0}  # the camera's latency and rate, and nothing else

CONDITIONS: dict[str, dict[str, Any]] = {
    "truth": {},
    "truth, late": {"corruption": LATE},
    "uniform": {"corruption": {"error": "uniform"}},
    "uniform, late": {"corruption": {"error": "uniform", **LATE}},
    "model": {"corruption": {"error": "model"}},
    "model, late": {"corruption": {"error": "model", **LATE}},
    "camera": {"mouth_source": "camera"},
    "depth_camera": {"mouth_source": "depth_camera"},
}
"""Name -> arguments of the environment. ``uniform`` is the paper's injection."""

ENOUGH = 20  # episodes of each for a verdict

DISTANCES = (0.0, 0.05, 0.1, 0.15, 0.2, 0.3, 10.0)
"""m, edges of the classes of distance between gripper and mouth."""


@dataclass(frozen=True)
class Errors:
    """Sums over the control steps in which the gripper is at some distance. SI units.

    Attributes:
        steps: number of them.
        unseen: of which the newest image shows no face.
        seen, aim: (5,) sums of squares: across the view right and up, along the view, across the
            approach, along it; of the mouth in the newest image, and of where the servo aims.
    """

    steps: int
    unseen: int
    seen: tuple[float, ...]
    aim: tuple[float, ...]


@dataclass(frozen=True)
class Row:
    """Result of an episode. SI units.

    Attributes:
        condition: of `CONDITIONS`.
        seed: of the episode.
        is_success, is_success_strict, completion_time, failure, face_force: see result rows.
        steps: control steps, until the servo turns home without success or the episode ends.
        frames, frames_without_detection: images; None without a camera.
        errors: one `Errors` for each class of distance.
        steps_per_second: of this machine, the servo and the environment together.
        latency: s, median of detector and predictor on an image; None without a camera.
        steps_per_cpu_second: of one core, all threads together, whatever else it does.
    """

    condition: str
    seed: int
    is_success: bool
    is_success_strict: bool
    completion_time: float | None
    failure: str
    face_force: float
    steps: int
    frames: int | None
    frames_without_detection: int | None
    errors: tuple[Errors, ...]
    steps_per_second: float
    latency: float | None
    steps_per_cpu_second: float | None = None

    @classmethod
    def from_line(cls, line: str) -> Row:
        """Read a line of ``episodes.jsonl``."""
        values = json.loads(line)
        errors = tuple(Errors(**item) for item in values.pop("errors"))
        return cls(**values, errors=errors)


def play(world: FaceEnv, condition: str, seed: int) -> Row:
    """Let the servo feed once."""
    task = task_entry(TASK)
    world.reset(seed=seed)
    actor: Any = task.make_expert(EXPERT, world)
    metrics = task.make_metrics()
    actor.reset()
    view = world.data.camera(CAMERA).xmat.reshape(3, 3).copy()
    classes = len(DISTANCES) - 1
    steps, unseen = np.zeros(classes, int), np.zeros(classes, int)
    seen, aim = np.zeros((classes, 5)), np.zeros((classes, 5))
    camera, lost, is_lost = world.camera_mouth, 0, False
    frames, latencies, force = 0, [], 0.0
    ended, info = False, {}
    begun, worked = clock.perf_counter(), clock.process_time()
    while not ended:
        _, _, ended, _, info = world.step(actor.act())
        has_given_up = actor.phases_done >= WITHDRAWN and not info["is_success"]
        ended = ended or has_given_up or world.step_count >= task.max_episode_steps
        metrics.update(info)
        force = max(force, float(info["face_force"]))
        if camera and camera.frames > frames:
            is_lost, lost, frames = camera.frames_without_face > lost, lost, camera.frames
            lost = camera.frames_without_face
            latencies.append(camera.seconds)
        target, now = world.observed_target, world.time
        then = now + ARM_LAG * FRAME_PERIOD
        apart = float(np.linalg.norm(world.gripper_position - world.mouth_track[0]))
        place = int(np.searchsorted(DISTANCES, apart, side="right")) - 1
        steps[place] += 1
        unseen[place] += is_lost
        if target is not None:
            at = float(target.time)
            seen[place] += _squares(target.position[0] - world.mouth_at(at), view)
            aim[place] += _squares(target.at(then) - world.mouth_at(then), view)
    taken, worked = clock.perf_counter() - begun, clock.process_time() - worked
    failure, _ = metrics.result(info)
    return Row(
        condition,
        seed,
        bool(info["is_success"]),
        bool(info["is_success_strict"]),
        info["completion_time"],
        failure,
        round(force, 3),
        world.step_count,
        camera.frames if camera else None,
        world.frames_without_detection,
        tuple(
            Errors(int(n), int(m), tuple(s.tolist()), tuple(a.tolist()))
            for n, m, s, a in zip(steps, unseen, seen.round(9), aim.round(9), strict=True)
        ),
        round(world.step_count / taken, 1),
        round(float(np.median(latencies)), 4) if latencies else None,
        round(world.step_count / worked, 1),
    )


def _squares(error: NDArray[np.float64], view: NDArray[np.float64]) -> NDArray[np.float64]:
    """Squares (5,) of an error (3,) m, world; ``view`` is world from camera."""
    x, y, z = (error @ view).tolist()
    return np.array([x * x, y * y, z * z, error[1] ** 2 + error[2] ** 2, error[0] ** 2])


def remaining(
    conditions: Sequence[str], episodes: int, done: dict[tuple[str, int], Row]
) -> Iterator[tuple[str, int]]:
    """Yield what is to be played, ten seeds of every condition at a time."""
    for first in range(FIRST_SEED, FIRST_SEED + episodes, 10):
        for condition in conditions:
            for seed in range(first, min(first + 10, FIRST_SEED + episodes)):
                if (condition, seed) not in done:
                    yield condition, seed


def run(options: argparse.Namespace) -> list[Row]:
    """Play what is missing; return all rows."""
    path, begun = options.out / "episodes.jsonl", clock.perf_counter()
    done = {(row.condition, row.seed): row for row in read_rows(path)}
    conditions = [name for name in options.conditions if not is_left_out(name)]
    todo = deque(remaining(conditions, options.episodes, done))
    options.out.mkdir(parents=True, exist_ok=True)

    def requests() -> Iterator[tuple[str, int]]:
        while todo and not (options.limit and clock.perf_counter() - begun > options.limit):
            yield todo.popleft()

    rows: Generator[Row] = answers(Player, (), requests(), options.workers)
    with closing(AppendFile(path, is_flushed=True)) as file, closing(rows):
        for row in rows:
            done[row.condition, row.seed] = row
            file.append(f"{json.dumps(asdict(row))}\n".encode())
    if todo:
        print("time is up; the same command goes on", flush=True)
    return [done[key] for key in sorted(done)]


def open_world(condition: str) -> FaceEnv:
    """Make the environment of a condition.

    Raises:
        RequestError: the camera's detector or OpenGL is missing.
    """
    seen = {"obs": "current_pred", "horizon": HORIZON, "cameras": ()}
    return world_of(make_env(TASK, **seen, **CONDITIONS[condition]))


def is_left_out(condition: str) -> bool:
    """Return whether a condition cannot be played here, and print why."""
    if "mouth_source" not in CONDITIONS[condition]:
        return False
    try:
        problem = opengl_problem()
        if not problem:
            open_world(condition).close()
    except RequestError as error:
        problem = str(error)
    if problem:
        print(f"{condition}: left out: {problem}", flush=True)
    return bool(problem)


class Player:
    """Environments of a worker process: conditions and seeds in, rows out."""

    def __init__(self) -> None:
        self._worlds: dict[str, FaceEnv] = {}

    def __call__(self, request: tuple[str, int]) -> Row:
        """Play one episode."""
        condition, seed = request
        if condition not in self._worlds:
            self._worlds[condition] = open_world(condition)
        return play(self._worlds[condition], condition, seed)

    def close(self) -> None:
        """Free detectors and OpenGL contexts."""
        for world in self._worlds.values():
            world.close()


def read_rows(path: Path) -> list[Row]:
    """Read the rows that are there; a torn last one is left out."""
    lines = path.read_text().splitlines(keepends=True) if path.is_file() else []
    whole = [line for line in lines if line.endswith("\n")]
    if len(whole) < len(lines):
        write_text(path, "".join(whole))
    return [Row.from_line(line) for line in whole]


# -- tables ---------------------------------------------------------------------------------------


def tables(rows: Sequence[Row]) -> str:
    """All tables, as Markdown."""
    groups = {name: [row for row in rows if row.condition == name] for name in CONDITIONS}
    groups = {name: own for name, own in groups.items() if own}
    parts = [
        f"Recorded motion, seeds from {FIRST_SEED} on; errors within 0.2 m of the mouth.",
        outcome_table(groups),
        failure_table(groups),
    ]
    if "camera" in groups:
        parts += [difference_table(groups), finding(groups)]
        parts += [distance_table(groups), speed_table(groups)]
    return "\n\n".join(parts) + "\n"


def outcome_table(groups: dict[str, list[Row]]) -> str:
    """Success, errors of the aim within 0.2 m of the mouth, and forces."""
    near = DISTANCES.index(0.2)
    head = ["the servo sees", "episodes", "success", "strict success", "completion s"]
    head += ["aim: lateral mm", "depth mm", "across mm", "along mm", "largest force N"]
    rows = []
    for name, own in groups.items():
        times = [row.completion_time for row in own if row.completion_time is not None]
        errors = _rms(own, "aim", range(near))
        numbers = ["-"] * 4 if name == "truth" else [f"{value:.1f}" for value in errors]
        cells = [
            name,
            str(len(own)),
            _proportion([row.is_success for row in own]),
            _proportion([row.is_success_strict for row in own]),
            f"{np.mean(times):.2f}" if times else "-",
            *numbers,
            f"{np.mean([r.face_force for r in own]):.1f} (mean), "
            f"{max(r.face_force for r in own):.1f}",
        ]
        rows.append(cells)
    return markdown_table(head, rows)


def failure_table(groups: dict[str, list[Row]]) -> str:
    """Kinds of failure."""
    kinds = [
        kind for kind in task_entry(TASK).failures if any(_count(o, kind) for o in groups.values())
    ]
    if not kinds:
        return "No episode failed."
    rows = [[name, *(_count(own, kind) for kind in kinds)] for name, own in groups.items()]
    return markdown_table(["the servo sees", *kinds], rows)


def _count(rows: Sequence[Row], kind: str) -> int:
    return sum(row.failure == kind for row in rows)


def difference_table(groups: dict[str, list[Row]]) -> str:
    """Success with each minus success with the camera, on the seeds that both have."""
    rng = np.random.default_rng(0)
    rows = []
    ours = {row.seed: row.is_success for row in groups["camera"]}
    for name, own in groups.items():
        if name == "camera":
            continue
        shared = [row for row in own if row.seed in ours]
        apart = np.array([float(row.is_success) - float(ours[row.seed]) for row in shared])
        drawn = rng.choice(apart, (10_000, len(apart))).mean(axis=1)
        low, high = 100 * np.quantile(drawn, [0.025, 0.975])
        rows.append((name, f"{100 * apart.mean():+.0f}", f"{low:+.0f} … {high:+.0f}"))
    return markdown_table(["success minus that of `camera`", "points", "95 %"], rows)


def finding(groups: dict[str, list[Row]]) -> str:
    """Return whether the paper's injected error stands for the camera, in a sentence or two."""
    near = range(DISTANCES.index(0.2))
    if "uniform" not in groups:
        return ""
    injected, seen = (_rms(groups[name], "aim", near) for name in ("uniform", "camera"))
    wrong = [100.0 * np.mean([not r.is_success for r in groups[n]]) for n in ("uniform", "camera")]
    episodes = [len(groups[name]) for name in ("uniform", "camera")]
    verdict = "Too few episodes to say whether the injected error stands for the real thing."
    if min(episodes) >= ENOUGH:
        stands = seen[0] < 2 * injected[0] and abs(wrong[1] - wrong[0]) < 10
        does = "stands" if stands else "does not stand"
        verdict = f"The injected error {does} for the real thing."
    return (
        f"Episodes with the injected error: {episodes[0]}; with the camera: {episodes[1]}. "
        f"With the paper's injected error the servo's aim is off by {injected[0]:.1f} mm across "
        f"the view and {injected[1]:.1f} mm along it, and {wrong[0]:.0f} % of the episodes fail; "
        f"with the camera by {seen[0]:.1f} and {seen[1]:.1f} mm, and {wrong[1]:.0f} % fail. "
        f"{verdict}"
    )


def distance_table(groups: dict[str, list[Row]]) -> str:
    """Detection and error by the distance between gripper and mouth."""
    head = ["gripper to mouth, m", "source", "steps", "no face", "in the image: lateral mm"]
    head += ["depth mm", "aim: lateral mm", "depth mm"]
    rows = []
    for place in range(len(DISTANCES) - 1):
        low, high = DISTANCES[place : place + 2]
        label = f"{low:g} … {high:g}" if high < 1 else f"{low:g} and more"
        for name in ("camera", "depth_camera", "model, late", "uniform, late"):
            own = groups.get(name, [])
            steps = sum(row.errors[place].steps for row in own)
            if not steps:
                continue
            unseen = sum(row.errors[place].unseen for row in own) / steps
            seen, aim = (_rms(own, kind, [place]) for kind in ("seen", "aim"))
            share = f"{unseen:.1%}" if "camera" in name else "-"
            numbers = (f"{v:.1f}" for v in (*seen[:2], *aim[:2]))
            rows.append((label, name, steps, share, *numbers))
    return markdown_table(head, rows)


def speed_table(groups: dict[str, list[Row]]) -> str:
    """Control steps a second, and latency."""
    head = ["source", "control steps/s, median", "a second of one core"]
    head += ["detector and predictor, ms"]
    rows = []
    for name in ("truth", "camera", "depth_camera"):
        if own := groups.get(name):
            rates = [row.steps_per_second for row in own]
            taken = [row.latency for row in own if row.latency is not None]
            late = f"{1e3 * np.median(taken):.0f}" if taken else "-"
            known = [r.steps_per_cpu_second for r in own if r.steps_per_cpu_second is not None]
            core = f"{np.median(known):.0f}" if known else "-"
            rows.append((name, f"{np.median(rates):.0f}", core, late))
    return markdown_table(head, rows)


def _rms(rows: Sequence[Row], kind: str, places: Sequence[int] | range) -> NDArray[np.float64]:
    """Root mean squares (4,) in mm: across and along the view, across and along the approach."""
    chosen = [row.errors[place] for row in rows for place in places]
    total = sum((np.array(getattr(item, kind)) for item in chosen), np.zeros(5))
    mean = total / max(sum(item.steps for item in chosen), 1)
    return 1e3 * np.sqrt([mean[0] + mean[1], mean[2], mean[3], mean[4]])


def _proportion(outcomes: Sequence[bool]) -> str:
    found = Proportion.of(sum(outcomes), len(outcomes))
    assert found.rate is not None
    assert found.low is not None
    assert found.high is not None
    return f"{found.rate:.0%} ({found.low:.0%} … {found.high:.0%})"


# -- figures --------------------------------------------------------------------------------------


def draw_by_distance(rows: Sequence[Row], path: Path) -> None:
    """Error of the mouth in the image by the distance between gripper and mouth."""
    import matplotlib

    matplotlib.use("agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(1, 2, figsize=(8, 3.2), sharex=True, layout="constrained")
    middles = 100 * np.array([*((a + b) / 2 for a, b in pairwise(DISTANCES[:-1])), 0.36])
    for name in ("camera", "depth_camera"):
        own = [row for row in rows if row.condition == name]
        if not own:
            continue
        errors = np.array([_rms(own, "seen", [place]) for place in range(len(middles))])
        for axis, values in zip(axes, errors.T, strict=False):
            axis.plot(middles, values, "o-", label=name)
    for axis, title in zip(axes, ("across the view", "along the view"), strict=True):
        axis.set(title=title, xlabel="gripper to mouth, cm", ylim=(0, None))
        axis.axhline(1e3 * MOUTH_TOLERANCE[1 if "across" in title else 0], ls=":", color="grey")
    axes[0].set_ylabel("rms error of the mouth, mm")
    if axes[0].lines[1:]:
        axes[0].legend()
    with atomic_file(path) as temporary:
        figure.savefig(temporary, format="png", dpi=110)
    pyplot.close(figure)


def draw_pictures(path: Path, seed: int) -> None:
    """Frames of an episode with the landmarks that the detector finds as the gripper comes."""
    import cv2

    from face_prediction.live.sources import face_finder
    from face_prediction.tracking.detector import find_model
    from face_prediction.tracking.geometry import LIPS
    from robo_manip_baselines.envs.mujoco.cell.rendering import CameraRenderer, project

    env = make_env(TASK, cameras=())
    world = world_of(env)
    world.reset(seed=seed)
    actor = task_entry(TASK).make_expert(EXPERT, world)
    actor.reset()
    wanted = [0.30, 0.17, 0.10, 0.04]
    shown: list[NDArray[np.uint8]] = []
    with face_finder(find_model(None)) as find, CameraRenderer(world.model, 480, 640) as renderer:
        while wanted and world.step_count < 600:
            *_, info = world.step(actor.act())
            apart = float(np.linalg.norm(world.gripper_position - world.mouth_track[0]))
            is_due = apart < wanted[0] and info["time_since_lift"] is not None
            if world.step_count % 2 and not is_due:
                continue
            image = renderer.render(world.data, [CAMERA])[CAMERA]
            found = find(image, world.time)
            if not is_due:
                continue
            wanted.pop(0)
            place = project(world.model, world.data, CAMERA, world.mouth_track[0], (480, 640))
            if found is not None:
                for index, (x, y) in enumerate((found[:, :2] * (640, 480)).round().astype(int)):
                    colour = (255, 255, 0) if index in LIPS else (0, 255, 0)
                    cv2.circle(image, (int(x), int(y)), 1, colour, -1)
            cv2.drawMarker(image, place.round().astype(int).tolist(), (0, 0, 255), 1, 14, 2)
            column = int(np.clip(place[0] - 130, 0, 640 - 260))
            row = int(np.clip(place[1] - 150, 0, 480 - 240))
            shown.append(image[row : row + 240, column : column + 260])
    env.close()
    picture = np.ascontiguousarray(np.hstack(shown)[..., ::-1])
    with atomic_file(path) as temporary:
        temporary.write_bytes(cv2.imencode(".png", picture)[1].tobytes())


def main() -> None:
    """Play, write rows, tables and the figure."""
    parser = argparse.ArgumentParser(description="Feeding with a mouth that a camera sees.")
    parser.add_argument("--episodes", type=int, default=20)
    parser.add_argument("--out", type=Path, default=Path("results/perception"))
    parser.add_argument("--conditions", nargs="+", choices=list(CONDITIONS), default=[*CONDITIONS])
    parser.add_argument("--workers", type=int, default=1, help="processes")
    parser.add_argument("--limit", type=float, help="seconds after which no episode begins")
    parser.add_argument("--pictures", type=Path, help="draw the detector's view of one episode")
    parser.add_argument("--seed", type=int, default=FIRST_SEED, help="of --pictures")
    options = parser.parse_args()
    if options.pictures:
        draw_pictures(options.pictures, options.seed)
        return
    rows = run(options)
    if not rows:
        raise RequestError("no episode was played")
    text = tables(rows)
    write_text(options.out / "tables.md", text)
    write_json(options.out / "versions.json", software_versions(*SOFTWARE, "mediapipe"))
    draw_by_distance(rows, options.out / "by_distance.png")
    print(text)


if __name__ == "__main__":
    run_command(main)
