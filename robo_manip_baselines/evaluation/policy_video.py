"""Videos of evaluation episodes, acted out again from their seeds and recorded actions.

Legend: T steps of an episode, S elements of the state, F = H + 1 frames of a prediction.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import closing
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from robo_manip_baselines.envs.mujoco.face_env import CONTROL_PERIOD, FaceEnv, world_of
from robo_manip_baselines.envs.mujoco.projection import project
from robo_manip_baselines.evaluation.preview import (
    FRAME_STEPS,
    MULTISAMPLES,
    TRACK_STEPS,
    VIEW_SIZE,
)
from robo_manip_baselines.evaluation.result import EpisodeResult
from robo_manip_baselines.evaluation.rollout import Recording
from robo_manip_baselines.evaluation.slots import split_vector
from robo_manip_baselines.evaluation.task import Task
from robo_manip_baselines.evaluation.video import (
    VideoWriter,
    draw_track,
    put_caption,
    side_by_side,
)
from robo_manip_baselines.observation import CAMERAS, ObservationSpec

CYAN = (0, 229, 255)

CLOSE_UP = "front_close"
ZOOM = 3
"""How much larger the fourth view shows the surroundings of the mouth."""

HOLD_SECONDS = 1.0
"""for which the last frame, with the outcome, stays."""


def pick_for_video(results: Sequence[EpisodeResult], number: int) -> list[EpisodeResult]:
    """Pick the first successes and the first failures by seed, half of each.

    Where there are too few of one kind, the other fills up. Of an odd number, the larger half goes
    to the successes.
    """
    ordered = sorted(results, key=lambda result: result.seed)
    good = [result for result in ordered if result.is_success]
    bad = [result for result in ordered if not result.is_success]
    of_good = max(number - number // 2, number - len(bad))
    picked = good[:of_good]
    return picked + bad[: number - len(picked)]


def video_name(result: EpisodeResult) -> str:
    """Name the video of an episode."""
    return f"seed_{result.seed:06d}_{result.failure or 'success'}.mp4"


def write_video(path: Path, task: Task, result: EpisodeResult, recording: Recording) -> None:
    """Write an H.264 video of an episode.

    Raises:
        RequestError: there is no OpenGL.
        RuntimeError: the episode, acted out again, ends otherwise than recorded.
    """
    last = len(recording.actions) - 1
    frames = last // FRAME_STEPS + 1 + (last % FRAME_STEPS > 0)
    frame = None
    with VideoWriter(path, 1.0 / (FRAME_STEPS * CONTROL_PERIOD)) as video:
        drawn = video_frames(task, result, recording)
        for frame in tqdm(drawn, total=frames, unit="frame", desc=path.name, mininterval=1.0):
            video.write(frame)
        if frame is not None:
            for _ in range(round(HOLD_SECONDS / (FRAME_STEPS * CONTROL_PERIOD))):
                video.write(frame)


def video_frames(
    task: Task, result: EpisodeResult, recording: Recording
) -> Iterator[NDArray[np.uint8]]:
    """Act an episode out and draw it; yield (H, W, 3) uint8 frames.

    The three cameras stand side by side, then the surroundings of the mouth, enlarged. Yellow is
    where the mouth truly is and has been; cyan is where the policy was told that it is and will be.
    """
    title = f"{result.policy} {result.arm}, seed {result.seed}".strip()
    look = {"image_size": VIEW_SIZE, "shadows": True, "multisamples": MULTISAMPLES}
    with closing(task.make(**look)) as env:
        world = world_of(env)
        _, info = env.reset(seed=result.seed)
        mouths: list[NDArray[np.float64]] = []
        last = len(recording.actions) - 1
        for step, (vector, action) in enumerate(
            zip(recording.vectors, recording.actions, strict=True)
        ):
            mouths = [*mouths[-TRACK_STEPS:], world.mouth_track[0]]
            if step % FRAME_STEPS == 0 or step == last:
                told = told_mouths(task.spec, vector)
                caption = f"{title}: {info['phase']}, {step * CONTROL_PERIOD:.1f} s"
                if step == last:
                    caption += f"  {result.failure.replace('_', ' ') or 'SUCCESS'}"
                yield _draw(world, np.array(mouths), told, caption)
            _, _, _, _, info = env.step(action)
        if bool(info["is_success"]) != result.is_success:
            raise RuntimeError(f"seed {result.seed} ends otherwise than recorded")


def told_mouths(spec: ObservationSpec, vector: NDArray[np.float32]) -> NDArray[np.float64]:
    """Return the mouth positions in a vector (S,), (F, 3) m, world; F is 0 if it shows none."""
    parts = split_vector(spec, vector)
    if "mouth" in parts:
        return parts["mouth"][None, :3].astype(np.float64)
    if "prediction" in parts:
        return parts["prediction"][: 4 * spec.frames].reshape(-1, 4)[:, 1:].astype(np.float64)
    return np.empty((0, 3))


def _draw(
    world: FaceEnv, mouths: NDArray[np.float64], told: NDArray[np.float64], caption: str
) -> NDArray[np.uint8]:
    views = world.renderer.render(world.data, CAMERAS)

    def pixels(camera: str, points: NDArray[np.float64]) -> NDArray[np.float64]:
        return project(world.model, world.data, camera, points, VIEW_SIZE)

    close = _zoom(
        views[CLOSE_UP],
        pixels(CLOSE_UP, mouths[-1]),
        pixels(CLOSE_UP, mouths),
        pixels(CLOSE_UP, told),
    )
    drawn = [
        _dots(draw_track(views[camera], pixels(camera, mouths)), pixels(camera, told), 2)
        for camera in CAMERAS
    ]
    drawn[0] = put_caption(drawn[0], caption)
    return side_by_side([*drawn, close])


def _zoom(
    image: NDArray[np.uint8],
    centre: NDArray[np.float64],
    track: NDArray[np.float64],
    told: NDArray[np.float64],
) -> NDArray[np.uint8]:
    """Enlarge what is around ``centre`` to the size of the image, and draw into that."""
    height, width = image.shape[:2]
    size = np.array([width, height]) / ZOOM
    low = np.clip(np.nan_to_num(centre) - size / 2, 0, np.array([width, height]) - size).round()
    column, row = low.astype(int)
    part = image[row : row + round(size[1]), column : column + round(size[0])]
    large = np.asarray(cv2.resize(part, (width, height), interpolation=cv2.INTER_CUBIC))
    ringed = draw_track(large, (track - low) * ZOOM, radius=16)
    return _dots(ringed, (told - low) * ZOOM, 5)


def _dots(image: NDArray[np.uint8], points: NDArray[np.float64], radius: int) -> NDArray[np.uint8]:
    """Draw dots joined by a line; the first, which is about the present, has a dark rim."""
    drawn = image.copy()
    limit = 4 * max(image.shape)
    seen = points[(np.abs(points) < limit).all(axis=1)]  # NaN is not less
    fixed = np.round(seen * 16).astype(np.int32)  # 1/16 pixel
    cv2.polylines(drawn, [fixed.reshape(-1, 1, 2)], False, CYAN, 1, cv2.LINE_AA, shift=4)
    for number, (x, y) in enumerate(fixed.tolist()):
        if number == 0:
            cv2.circle(drawn, (x, y), (radius + 1) * 16, (0, 0, 0), -1, cv2.LINE_AA, shift=4)
        cv2.circle(drawn, (x, y), radius * 16, CYAN, -1, cv2.LINE_AA, shift=4)
    return drawn
