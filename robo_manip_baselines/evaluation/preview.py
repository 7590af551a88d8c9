"""Videos of recorded episodes: the three cameras side by side, with the mouth's track."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import closing
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from robo_manip_baselines.data import EpisodeReader, read_metadata
from robo_manip_baselines.envs.mujoco.face_env import CONTROL_PERIOD, world_of
from robo_manip_baselines.envs.mujoco.projection import project
from robo_manip_baselines.evaluation.episode_replay import remake_env, replay
from robo_manip_baselines.evaluation.video import (
    VideoWriter,
    draw_track,
    put_caption,
    side_by_side,
)
from robo_manip_baselines.observation import CAMERAS

FRAME_STEPS = 2
"""Control steps between two frames: 25 frames/s, half of what is simulated."""

TRACK_STEPS = 100
"""Control steps of the mouth's past that are drawn: 2 s."""

VIEW_SIZE = (360, 480)
"""Height and width of each camera's view in pixels: three of them fit a screen."""

MULTISAMPLES = 4


def write_preview(path: Path, episodes: Sequence[Path]) -> None:
    """Write one H.264 video of some episodes, one after the other, with a progress bar.

    Args:
        path: of the video, ``....mp4``.
        episodes: files.

    Raises:
        RequestError: an episode is damaged or of another model, or there is no OpenGL.
    """
    steps = [int(read_metadata(episode)["num_steps"]) for episode in episodes]
    frames = sum(-(-count // FRAME_STEPS) for count in steps)
    with (
        VideoWriter(path, 1.0 / (FRAME_STEPS * CONTROL_PERIOD)) as video,
        tqdm(total=frames, unit="frame", desc=path.name) as progress,
    ):
        for episode in episodes:
            for frame in preview_frames(episode):
                video.write(frame)
                progress.update()


def preview_frames(path: Path) -> Iterator[NDArray[np.uint8]]:
    """Act an episode out and draw it; yield (H, 3 W, 3) uint8 frames."""
    with (
        EpisodeReader(path) as episode,
        closing(
            remake_env(
                episode,
                cameras=(),
                image_size=VIEW_SIZE,
                shadows=True,
                multisamples=MULTISAMPLES,
            )
        ) as env,
    ):
        world = world_of(env)
        mouth = episode.array("mouth_position")[:, 0]
        names, phases = episode.attributes["phase_names"], episode.array("phase")
        title = f"seed {episode.attributes['seed']}, {episode.attributes['expert']}"
        for step in replay(env, episode):
            if step % FRAME_STEPS:
                continue
            views = world.renderer.render(world.data, CAMERAS)
            past = mouth[max(0, step - TRACK_STEPS) : step + 1]
            drawn = [
                draw_track(views[camera], project(world.model, world.data, camera, past, VIEW_SIZE))
                for camera in CAMERAS
            ]
            seconds = step * CONTROL_PERIOD
            drawn[0] = put_caption(drawn[0], f"{title}: {names[phases[step]]}, {seconds:.1f} s")
            yield side_by_side(drawn)
