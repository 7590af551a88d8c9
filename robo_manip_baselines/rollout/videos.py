"""Videos of episodes: camera views side by side, tracks and captions drawn in, H.264.

Images are RGB, (H, W, 3) uint8; drawing functions return a new image and leave theirs alone.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import closing, contextmanager
from fractions import Fraction
from itertools import chain
from pathlib import Path
from typing import Any, TypeVar

import cv2
import gymnasium
import numpy as np
from numpy.typing import NDArray

from robo_manip_baselines.data import EpisodeReader, read_metadata
from robo_manip_baselines.envs.mujoco.cell.rendering import project
from robo_manip_baselines.envs.mujoco.tasks.face_env import CONTROL_PERIOD, FaceEnv, world_of
from robo_manip_baselines.observation import CAMERAS
from robo_manip_baselines.rollout.demonstrate import remake_env, replay
from robo_manip_baselines.rollout.results import EpisodeResult
from robo_manip_baselines.rollout.rollout import Recording
from robo_manip_baselines.rollout.workers import EnvConfig
from robo_manip_baselines.runs.images import REDUCTIONS, decode_image
from robo_manip_baselines.runs.progress import track
from robo_manip_baselines.runs.videos import h264_stream

Colour = tuple[int, int, int]
Item = TypeVar("Item")
Made = TypeVar("Made")

YELLOW: Colour = (255, 214, 10)
CYAN: Colour = (0, 229, 255)
WHITE: Colour = (255, 255, 255)
BLACK: Colour = (0, 0, 0)

FRAME_STEPS = 2
"""Control steps between two frames: 25 frames/s, half of what is simulated."""

FPS = 1.0 / (FRAME_STEPS * CONTROL_PERIOD)

TRACK_STEPS = 100
"""Control steps of the target's past that are drawn: 2 s."""

VIEW_SIZE = (360, 480)
"""Height and width of each camera's view in pixels: three of them fit a screen."""

PREVIEW_SIZE = (240, 320)
"""Likewise in a preview, which has to be fast: a renderer without a GPU pays for each pixel."""

PREVIEW_PRESET, PREVIEW_CRF = "superfast", 24
"""Encoding of a preview: twice as fast as that of other videos and as true, in a file half as large
again (``benchmarks/preview_video.py``)."""

LOOK = {"image_size": VIEW_SIZE, "render_size": None, "multisamples": 4}
"""Arguments of an environment whose images are for people: with smooth edges, and without shadows,
which take three times as long on a CPU (116 and 37 ms for three views)."""

THREADS = 2
"""Threads that draw frames while others are rendered and encoded."""

CLOSE_UP = "front_close"
ZOOM = 3
"""Magnification of the fourth view, of the surroundings of the target."""

HOLD_FRAMES = round(1.0 * FPS)
"""Repetitions of the last frame, with the outcome: 1 s."""


class VideoWriter:
    """An H.264 file that browsers play, there when it is whole and not before.

    Use as a context manager; the file appears when the block ends well. The first frame decides
    the size; an odd height or width gets a row or column of its edge repeated, because 4:2:0
    video has even sizes only.

    Args:
        path: file to write, ``….mp4``.
        fps: frames a second.
        crf: quality of libx264, 0 (lossless) to 51; 20 shows no blocks in rendered scenes.
        preset: of libx264: slower ones make smaller files.
    """

    def __init__(
        self, path: str | Path, fps: float, *, crf: int = 20, preset: str = "veryfast"
    ) -> None:
        if fps <= 0:
            raise ValueError(f"a video needs a positive number of frames a second, not {fps}")
        self._shape: tuple[int, ...] | None = None
        self._file = self._open(Path(path), Fraction(fps).limit_denominator(1001), crf, preset)

    def __enter__(self) -> VideoWriter:
        self._file.__enter__()
        return self

    def __exit__(self, *error: Any) -> None:
        self._file.__exit__(*error)

    @contextmanager
    def _open(self, path: Path, rate: Fraction, crf: int, preset: str) -> Iterator[None]:
        import av  # slow to import; only videos need it

        settings = {"crf": crf, "preset": preset, "threads": 1}  # the same bytes on any machine
        with h264_stream(path, rate, **settings) as (self._container, self._stream):
            self._frame_type = av.VideoFrame
            yield
            if self._shape is None:
                raise ValueError(f"no frame was written to '{path}'")

    def write(self, image: np.ndarray) -> None:
        """Append a frame.

        Raises:
            ValueError: if it is not (H, W, 3) uint8, or unlike the first.
        """
        if image.ndim != 3 or image.shape[2] != 3 or image.dtype != np.uint8:
            raise ValueError(f"a frame is (H, W, 3) uint8, not {image.shape} {image.dtype}")
        even = pad_to_even(image)
        if self._shape is None:
            self._shape = image.shape
            self._stream.height, self._stream.width = even.shape[:2]
        if image.shape != self._shape:
            raise ValueError(f"frame of {image.shape} in a video of {self._shape}")
        # Planes of 4:2:0, by OpenCV: the conversion inside PyAV takes five times as long.
        planes = np.asarray(cv2.cvtColor(even, cv2.COLOR_RGB2YUV_I420), np.uint8)
        frame = self._frame_type.from_ndarray(planes, format="yuv420p")
        self._container.mux(self._stream.encode(frame))


def pad_to_even(image: np.ndarray) -> np.ndarray:
    """Repeat the last row or column of an image with an odd height or width."""
    height, width = image.shape[:2]
    if height % 2 == width % 2 == 0:
        return image
    return np.pad(image, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge")


def side_by_side(images: Sequence[np.ndarray]) -> np.ndarray:
    """Join images in a row, (H, sum of widths, 3), each scaled to the height of the first."""
    if not images:
        raise ValueError("no image to put side by side")
    height, row = images[0].shape[0], []
    for image in images:
        if image.shape[0] != height:
            width = max(1, round(image.shape[1] * height / image.shape[0]))
            method = cv2.INTER_AREA if height < image.shape[0] else cv2.INTER_LINEAR
            image = np.asarray(cv2.resize(image, (width, height), interpolation=method))
        row.append(image)
    return np.concatenate(row, axis=1)


LINE_WIDTH = 2
"""Pixels, of a track and of the ring at its end."""


def draw_track(
    image: np.ndarray,
    points: np.ndarray,
    colour: Colour = YELLOW,
    *,
    radius: int = 8,
) -> np.ndarray:
    """Draw where a point has been: a line that fades towards its past, a ring at its present.

    Args:
        image: (H, W, 3) uint8.
        points: (N, 2) pixels, x right and y down, oldest first; rows that are NaN (not in view)
            interrupt the line.
        colour: RGB.
        radius: of the ring, in pixels.
    """
    points = np.asarray(points, dtype=np.float64).reshape(-1, 2)
    # Far outside the image a line is cut off unseen; OpenCV's fixed-point numbers overflow.
    limit = 4 * max(image.shape)
    valid = np.isfinite(points).all(axis=1) & (np.abs(points) < limit).all(axis=1)
    fixed = np.round(np.where(valid[:, None], points, 0) * 16).astype(int)  # 1/16 pixel
    opacity = np.zeros(image.shape[:2], dtype=np.uint8)
    # From the past to the present: a brighter piece covers a fainter one, and none adds to another.
    places, is_valid, last = fixed.tolist(), valid.tolist(), len(points) - 1
    for index in range(1, len(points)):
        if is_valid[index - 1] and is_valid[index]:
            value = round(255 * (0.15 + 0.85 * index / last))
            ends = places[index - 1], places[index]
            cv2.line(opacity, *ends, value, LINE_WIDTH, cv2.LINE_AA, shift=4)
    drawn = _paint(image, opacity, colour)
    if len(points) and valid[-1]:
        centre = fixed[-1].tolist()
        # The dark rim lies outside only: what is in the ring stays to be seen.
        rim = radius * 16 + 8 * LINE_WIDTH + 8
        cv2.circle(drawn, centre, rim, BLACK, 1, cv2.LINE_AA, shift=4)
        cv2.circle(drawn, centre, radius * 16, colour, LINE_WIDTH, cv2.LINE_AA, shift=4)
    return drawn


def put_caption(image: np.ndarray, text: str) -> np.ndarray:
    """Write one line at the lower left, white with a dark rim, sized to the image."""
    (height, width), font = image.shape[:2], cv2.FONT_HERSHEY_SIMPLEX
    scale = max(height / 700, 0.35)
    margin = round(12 * scale) + 4
    text_width = cv2.getTextSize(text, font, scale, 1)[0][0]
    if text_width > width - 2 * margin > 0:
        scale *= (width - 2 * margin) / text_width
    # The rim is grown from the letters: drawn thicker, letters of OpenCV 5 are also wider apart.
    opacity = np.zeros((height, width), dtype=np.uint8)
    cv2.putText(opacity, text, (margin, height - margin), font, scale, 255, 1, cv2.LINE_AA)
    rim = np.asarray(cv2.dilate(opacity, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (5, 5))))
    return _paint(_paint(image, rim, BLACK), opacity, WHITE)


def _paint(image: np.ndarray, opacity: np.ndarray, colour: Colour) -> np.ndarray:
    """Lay a colour over an image, opacity (H, W) uint8 from 0 to 255."""
    painted = image.copy()
    column, row, width, height = cv2.boundingRect(opacity)
    box = slice(row, row + height), slice(column, column + width)
    part, touched = painted[box], opacity[box] > 0
    weight = opacity[box][touched][:, None] / np.float32(255)
    mixed = part[touched] * (1 - weight) + np.asarray(colour, dtype=np.float32) * weight
    part[touched] = np.round(mixed).astype(np.uint8)
    return painted


def preview_writer(path: Path) -> VideoWriter:
    """Return the writer of a preview."""
    return VideoWriter(path, FPS, crf=PREVIEW_CRF, preset=PREVIEW_PRESET)


def write_preview(path: Path, episodes: Sequence[Path]) -> None:
    """Write one H.264 video of some episodes, one after the other, with a progress bar.

    Raises:
        RequestError: an episode is damaged or of another model, or there is no OpenGL.
    """
    steps = [int(read_metadata(episode)["num_steps"]) for episode in episodes]
    total = sum(-(-count // FRAME_STEPS) for count in steps)
    frames = chain.from_iterable(map(preview_frames, episodes))
    _write_frames(frames, total, preview_writer(path), path.name)


def _write_frames(
    frames: Iterable[np.ndarray], total: int, writer: VideoWriter, title: str
) -> None:
    """Encode frames in a thread of their own, while the next ones are made."""
    with writer as video:
        shown = track(frames, total, "frame", title)
        for _ in _in_threads(video.write, shown, threads=1):  # in order
            pass


def preview_frames(path: Path) -> Iterator[NDArray[np.uint8]]:
    """Draw an episode; yield (H, W, 3) uint8 frames, the cameras side by side.

    Each view has `PREVIEW_SIZE`; of recorded images the height.

    The recorded images are shown where all cameras were recorded at the size of the views or
    larger. Otherwise the episode is replayed and rendered, without shadows, as images are recorded:
    those take five times as long.
    """
    changes = {"cameras": (), "image_size": PREVIEW_SIZE, "render_size": None}
    with EpisodeReader(path) as episode, closing(remake_env(episode, **changes)) as env:
        world = world_of(env)
        env.reset(seed=int(episode.attributes["seed"]))
        recorded = episode.attributes["image_size"]
        is_recorded = set(CAMERAS) <= set(episode.attributes["cameras"])
        (height, width), reduction = PREVIEW_SIZE, 1
        is_recorded = is_recorded and recorded[0] >= height
        if is_recorded:
            width = round(recorded[1] * height / recorded[0])
            reduction = max(r for r in REDUCTIONS if recorded[0] >= r * height)
        target = episode.array(world.task.target_field)[:, 0]
        # The cameras stand still.
        lines = {c: project(world.model, world.data, c, target, (height, width)) for c in CAMERAS}
        names, phases = episode.attributes["phase_names"], episode.array("phase")
        title = f"seed {episode.attributes['seed']}, {episode.attributes['expert']}"

        def draw(shown: tuple[int, dict[str, NDArray[np.uint8]]]) -> NDArray[np.uint8]:
            step, views = shown
            past = slice(max(0, step - TRACK_STEPS), step + 1, FRAME_STEPS)
            caption = f"{title}: {names[phases[step]]}, {step * CONTROL_PERIOD:.1f} s"
            drawn = []
            for camera in CAMERAS:
                view = views[camera]
                if is_recorded:
                    view = _resized(decode_image(view, reduction), height, width)
                drawn.append(draw_track(view, lines[camera][past]))
            return side_by_side([put_caption(drawn[0], caption), *drawn[1:]])

        views = _recorded_views(episode) if is_recorded else _rendered_views(env, episode)
        yield from _in_threads(draw, views)


def _recorded_views(
    episode: EpisodeReader,
) -> Iterator[tuple[int, dict[str, NDArray[np.uint8]]]]:
    """Yield the steps to show with their encoded images, by camera."""
    for step in range(0, len(episode), FRAME_STEPS):
        yield step, {camera: episode.encoded_frame(camera, step) for camera in CAMERAS}


def _rendered_views(
    env: gymnasium.Env[Any, Any], episode: EpisodeReader
) -> Iterator[tuple[int, dict[str, NDArray[np.uint8]]]]:
    """Replay an episode; yield the steps to show with their images, by camera."""
    world = world_of(env)
    for step in replay(env, episode):
        if step % FRAME_STEPS == 0:
            yield step, world.renderer.render(world.data, CAMERAS)


def _resized(image: NDArray[np.uint8], height: int, width: int) -> NDArray[np.uint8]:
    if image.shape[:2] == (height, width):
        return image
    return np.asarray(cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA), np.uint8)


def _in_threads(
    function: Callable[[Item], Made], items: Iterable[Item], threads: int = THREADS
) -> Iterator[Made]:
    """Yield what a function makes of items, in their order, a few items ahead of the reader.

    Items are taken in the reader's thread, which owns the OpenGL context; OpenCV and the encoder
    let other threads run meanwhile. With one thread the items are done in their order.
    """
    with ThreadPoolExecutor(threads, thread_name_prefix="frames") as pool:
        ahead: deque[Future[Made]] = deque()
        for item in items:
            ahead.append(pool.submit(function, item))
            if len(ahead) > 2 * threads:
                yield ahead.popleft().result()
        while ahead:
            yield ahead.popleft().result()


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
    """Return the file name of the video of an episode."""
    return f"seed_{result.seed:06d}_{result.failure or 'success'}.mp4"


def write_video(path: Path, config: EnvConfig, result: EpisodeResult, recording: Recording) -> None:
    """Write an H.264 video of an episode of a policy, in the environment in which it acted.

    Raises:
        RequestError: there is no OpenGL.
        RuntimeError: the replayed episode ends otherwise than recorded.
    """
    last = len(recording.actions) - 1
    frames = last // FRAME_STEPS + 1 + (last % FRAME_STEPS > 0) + HOLD_FRAMES
    shown = video_frames(config, result, recording)
    _write_frames(shown, frames, VideoWriter(path, FPS), path.name)


def video_frames(
    config: EnvConfig, result: EpisodeResult, recording: Recording
) -> Iterator[NDArray[np.uint8]]:
    """Replay an episode of a policy and draw it; yield (H, W, 3) uint8 frames.

    The three cameras stand side by side, then the surroundings of the target, enlarged. Yellow is
    the true target with its past; cyan are the present and predicted positions that the policy
    observed. The last frame is repeated for a second.
    """
    title = f"{result.policy} {result.condition}, seed {result.seed}".strip()
    last = len(recording.actions) - 1
    with closing(config.make(**LOOK)) as env:
        world = world_of(env)
        world.renders_images = False  # of the policy's own cameras
        _, info = env.reset(seed=result.seed)
        track: list[NDArray[np.float64]] = []
        steps = zip(recording.vectors, recording.actions, strict=True)
        for step, (vector, action) in enumerate(steps):
            track = [*track[-TRACK_STEPS:], world.target_track()[0]]
            if step % FRAME_STEPS == 0 or step == last:
                caption = f"{title}: {info['phase']}, {step * CONTROL_PERIOD:.1f} s"
                if step == last:
                    caption += f"  {result.failure.replace('_', ' ') or 'SUCCESS'}"
                observed = config.spec.target_positions(vector)
                frame = _draw(world, np.array(track), observed, caption)
                yield from [frame] * (1 + HOLD_FRAMES if step == last else 1)
            _, _, _, _, info = env.step(action)
        if bool(info["is_success"]) != result.is_success:
            raise RuntimeError(f"seed {result.seed} ends otherwise than recorded")


def _draw(
    world: FaceEnv, track: NDArray[np.float64], observed: NDArray[np.float64], caption: str
) -> NDArray[np.uint8]:
    views = world.renderer.render(world.data, CAMERAS)
    drawn = []
    for camera in CAMERAS:
        ringed = draw_track(views[camera], _pixels(world, camera, track))
        drawn.append(_dots(ringed, _pixels(world, camera, observed), 2))
    # The surroundings of the target, enlarged to the size of the view.
    height, width = VIEW_SIZE
    line = _pixels(world, CLOSE_UP, track)
    size = np.array([width, height])
    low = np.clip(np.nan_to_num(line[-1]) - size / ZOOM / 2, 0, size - size / ZOOM).round()
    column, row = low.astype(int)
    part = views[CLOSE_UP][row : row + round(height / ZOOM), column : column + round(width / ZOOM)]
    large = np.asarray(cv2.resize(part, (width, height), interpolation=cv2.INTER_CUBIC))
    ringed = draw_track(large, (line - low) * ZOOM, radius=16)
    close = _dots(ringed, (_pixels(world, CLOSE_UP, observed) - low) * ZOOM, 5)
    return side_by_side([put_caption(drawn[0], caption), *drawn[1:], close])


def _pixels(world: FaceEnv, camera: str, points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return points (N, 3) m, world, in the view of a camera: (N, 2) pixels."""
    return project(world.model, world.data, camera, points, VIEW_SIZE)


def _dots(image: NDArray[np.uint8], points: NDArray[np.float64], radius: int) -> NDArray[np.uint8]:
    """Draw dots joined by a line; the first, which is about the present, has a dark rim."""
    drawn = image.copy()
    limit = 4 * max(image.shape)
    seen = points[(np.abs(points) < limit).all(axis=1)]  # NaN is not less
    fixed = np.round(seen * 16).astype(np.int32)  # 1/16 pixel
    cv2.polylines(drawn, [fixed.reshape(-1, 1, 2)], False, CYAN, 1, cv2.LINE_AA, shift=4)
    for number, (x, y) in enumerate(fixed.tolist()):
        if number == 0:
            cv2.circle(drawn, (x, y), (radius + 1) * 16, BLACK, -1, cv2.LINE_AA, shift=4)
        cv2.circle(drawn, (x, y), radius * 16, CYAN, -1, cv2.LINE_AA, shift=4)
    return drawn
