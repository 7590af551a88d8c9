"""Demonstrations: same files from any number of processes, killed or not."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from robo_manip_baselines.commands.rollout import parse_options, to_collection
from robo_manip_baselines.data import EpisodeReader, list_episodes, read_metadata, write_episode
from robo_manip_baselines.data.files import list_failures
from robo_manip_baselines.data.schema import EpisodeSchema
from robo_manip_baselines.data.verify import verify_dataset
from robo_manip_baselines.envs.mujoco.face.motion import DEFAULT_LIBRARY
from robo_manip_baselines.envs.mujoco.tasks.face_env import world_of
from robo_manip_baselines.observation import CAMERAS
from robo_manip_baselines.rollout import demonstrate as demonstrate_module
from robo_manip_baselines.rollout.demonstrate import (
    Collection,
    collect,
    deviation,
    remake_env,
    replay,
)
from robo_manip_baselines.rollout.videos import (
    PREVIEW_SIZE,
    preview_frames,
    side_by_side,
    write_preview,
)
from robo_manip_baselines.runs.errors import RequestError

pytestmark = pytest.mark.long

ROOT = Path(__file__).resolve().parents[2]
ARGUMENTS = ["FeedingEnv", "--scripted", "--num_episodes", "3", "--cameras", "none"]


def collection(out: Path, *more: str, **changes: Any) -> Collection:
    options, _ = parse_options([*ARGUMENTS, "--workers", "1", "--out", str(out), *more])
    return replace(to_collection(options), **changes)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three episodes, recorded in this process."""
    out = tmp_path_factory.mktemp("demonstrations") / "one"
    collect(collection(out))
    return out


def contents(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in list_episodes(folder)}


def test_any_number_of_workers_writes_the_same_bytes(folder: Path, tmp_path: Path) -> None:
    collect(collection(tmp_path, workers=2))
    assert contents(tmp_path) == contents(folder)
    assert len(contents(folder)) == 3


def test_the_replay_reproduces_every_recorded_state(folder: Path) -> None:
    for path in list_episodes(folder):
        found = deviation(path)
        assert (found.qpos, found.qvel) == (0.0, 0.0)
        assert found.steps > 100


def test_a_replay_that_strays_is_noticed(folder: Path, tmp_path: Path) -> None:
    with EpisodeReader(list_episodes(folder)[0]) as episode:
        arrays, known = episode.arrays, episode.attributes
        schema = EpisodeSchema.of(episode.task)
    derived = {item.name for item in schema.attributes if item.is_derived}
    arrays["action"][50, 0] += 0.01  # rad
    path = tmp_path / "episode_000000.hdf5"
    write_episode(path, arrays, {}, {k: v for k, v in known.items() if k not in derived})
    found = deviation(path)
    assert found.qpos > 1e-4
    assert found.qvel > 1e-4


def test_the_files_are_whole_and_say_what_happened(folder: Path) -> None:
    assert verify_dataset(folder) == []
    summary = json.loads((folder / "summary.json").read_text())
    assert summary["episodes"] == summary["successes"] == 3
    assert summary["failed_seeds"] == []
    times = [read_metadata(path)["completion_time"] for path in list_episodes(folder)]
    assert summary["completion_time_mean"] == pytest.approx(np.mean(times))
    assert summary["completion_time_sd"] == pytest.approx(np.std(times, ddof=1))
    with EpisodeReader(list_episodes(folder)[1]) as episode:
        mouth, clock = episode.array("mouth_position"), episode.array("time")
        # What was the truth 5 frames (1/6 s) ahead is the truth then, between two control steps.
        later = np.stack([np.interp(clock + 5 / 30, clock, axis) for axis in mouth[:, 0].T], -1)
        inside = clock + 5 / 30 < clock[-1]
        # Interpolating 50 Hz samples of a 30 Hz polyline misses its corners by little.
        np.testing.assert_allclose(mouth[inside, 5], later[inside], atol=2e-3)
        np.testing.assert_allclose(np.diff(clock), 0.02, atol=1e-9)


def test_a_collection_is_json(tmp_path: Path) -> None:
    asked = collection(tmp_path, "--seed", "5", "--clips", "clm_cap12", workers=2)
    again = Collection.from_json(json.loads(json.dumps(asked.to_json())))
    assert again == asked
    assert again.env_kwargs["clips"] == ["clm_cap12"]
    assert again.seeds == range(5, 8)


def test_carries_on_where_it_was(folder: Path, tmp_path: Path) -> None:
    out = tmp_path / "some"
    shutil.copytree(folder, out)
    (out / "episode_000001.hdf5").unlink()
    (out / ".episode_000001.hdf5.999999999.partial").write_bytes(b"half")
    kept = (out / "episode_000000.hdf5").stat().st_mtime_ns
    collect(collection(out))
    assert contents(out) == contents(folder)
    assert (out / "episode_000000.hdf5").stat().st_mtime_ns == kept
    assert not list(out.glob(".*.partial"))


def test_the_summary_is_of_the_whole_folder(folder: Path, tmp_path: Path) -> None:
    """Two calls, the second with other seeds: as one call over all of them."""
    out = tmp_path / "two calls"
    shutil.copytree(folder, out)
    found = collect(collection(out, "--seed", "7", "--num_episodes", "1"))
    summary = json.loads((out / "summary.json").read_text())
    assert (summary["episodes"], summary["first_seed"]) == (4, 0)
    paths = list_episodes(out)
    times = [read_metadata(path)["completion_time"] for path in paths]
    assert found.successes == summary["successes"] == len(paths)
    assert summary["completion_time_mean"] == pytest.approx(np.mean(times))
    again = collect(collection(out, "--seed", "7", "--num_episodes", "1"))
    assert (again.episodes, again.steps, again.steps_per_second) == (4, 0, None)


@pytest.mark.gl
@pytest.mark.parametrize("cameras", ["top,angle,front_close", "none"])
def test_the_preview_is_the_episode(cameras: str, tmp_path: Path) -> None:
    """Recorded images where there are some, else rendered ones: the same views, the same bytes."""
    wanted = collection(tmp_path, "--num_episodes", "1", "--image_size", "360x480")
    kwargs = {"cameras": () if cameras == "none" else cameras.split(","), "max_episode_steps": 12}
    collect(replace(wanted, env_kwargs={**wanted.env_kwargs, **kwargs}))
    episodes = list_episodes(tmp_path) or list_failures(tmp_path)
    for name in ("a.mp4", "b.mp4"):
        write_preview(tmp_path / name, episodes)
    assert (tmp_path / "a.mp4").read_bytes() == (tmp_path / "b.mp4").read_bytes()
    frames = list(preview_frames(episodes[0]))
    height, width = PREVIEW_SIZE
    assert {frame.shape for frame in frames} == {(height, 3 * width, 3)}
    assert len(frames) == 6
    changes = {"image_size": PREVIEW_SIZE, "render_size": None}
    with EpisodeReader(episodes[0]) as episode, closing(remake_env(episode, **changes)) as env:
        for step in replay(env, episode):
            if step % 2 == 0:
                views = world_of(env).renderer.render(world_of(env).data, CAMERAS)
                plain = side_by_side(list(views.values())).astype(int)
                # JPEG, the track and the caption; another step or camera would differ by 10
                assert np.abs(frames[step // 2] - plain).mean() < 3.0


def test_refuses_to_mix_settings(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "mixed"
    shutil.copytree(folder, out)
    with pytest.raises(RequestError, match="holds episodes with expert reactive, not anticip"):
        collect(collection(out, expert="anticipatory"))
    with monkeypatch.context() as patch:
        versions = {"python": "3", "mujoco": "3.99", "numpy": "2", "robo_manip_baselines": "1"}
        patch.setattr(demonstrate_module, "software_versions", lambda *_: versions)
        with pytest.raises(RequestError, match=r"holds episodes with versions .*, not .*3\.99"):
            collect(collection(out))
    with pytest.raises(RequestError, match="holds episodes with env_kwargs"):
        collect(collection(out, "--face_motion", "after_lift"))


def test_a_motion_is_recorded_with_its_episodes_and_replayed(tmp_path: Path) -> None:
    given = ["--motion", "recorded + tremor:rating=3", "--expert", "servo", "--num_episodes", "1"]
    collect(collection(tmp_path, *given))
    (path,) = list_episodes(tmp_path)
    attributes = read_metadata(path)
    assert attributes["env_kwargs"]["motion"] == "recorded+tremor:rating=3"
    assert attributes["motion_subject"] != "synthetic"
    found = deviation(path)
    assert (found.qpos, found.qvel) == (0.0, 0.0)
    assert not verify_dataset(tmp_path)


def test_killed_and_continued_it_ends_with_the_same_files(folder: Path, tmp_path: Path) -> None:
    """SIGKILL at several moments; what is there is always whole."""
    out = tmp_path / "killed"
    command = [sys.executable, "bin/Rollout.py", *ARGUMENTS, "--preview", "0", "--out", str(out)]
    for patience in (2.5, 3.5):
        process = subprocess.Popen(
            command, cwd=ROOT, stderr=subprocess.DEVNULL, start_new_session=True
        )
        time.sleep(patience)
        os.killpg(process.pid, signal.SIGKILL)
        process.wait()
        for path in list_episodes(out) if out.is_dir() else []:
            assert path.read_bytes() == (folder / path.name).read_bytes()
    subprocess.run(command, cwd=ROOT, check=True, capture_output=True)
    assert contents(out) == contents(folder)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["FeedinEnv", "--scripted"], "unknown environment 'FeedinEnv'"),
        (["FeedingEnv"], "--scripted"),
        (["FeedingEnv", "--scripted", "--cameras", "side"], "unknown camera 'side'"),
        (["FeedingEnv", "--scripted", "--expert", "chef"], "unknown expert 'chef'"),
        (["FeedingEnv", "--scripted", "--clips", "me"], "unknown clip 'me'"),
        (["FeedingEnv", "--scripted", "--num_episodes", "-3"], "num_episodes -3"),
        (["FeedingEnv", "--scripted", "--num_episodes", "0"], "num_episodes 0"),
        (["FeedingEnv", "--scripted", "--num_episodes", "many"], "many"),
        (["FeedingEnv", "--scripted", "--seed", "-1"], "-1"),
        (["FeedingEnv", "--scripted", "--workers", "0"], "workers 0"),
        (["FeedingEnv", "--scripted", "--preview", "-1"], "preview -1"),
        (["FeedingEnv", "--scripted", "--image_size", "big"], "image size 'big'"),
        (["FeedingEnv", "--scripted", "--image_codec", "gif"], "unknown image codec 'gif'"),
        (["FeedingEnv", "--scripted", "--image_quality", "0"], "image_quality 0"),
        (["FeedingEnv", "--scripted", "--face_motion", "no"], "unknown face motion 'no'"),
        (["FeedingEnv", "--scripted", "--motion", "hop"], "unknown motion 'hop'"),
        (["FeedingEnv", "--scripted", "--motion_library", "no.npz"], "'no.npz' does not exist"),
        (["FeedingEnv", "--scripted", "--sedd", "1"], "--sedd"),
        (["FeedingEnv", "--scripted", "--obs", "current"], "--obs goes with --policy"),
        (["FeedingEnv", "--scripted", "--arms", "both"], "arms both: the expert 'reactive' gives"),
        (["FeedingEnv", "--scripted", "--out", "/proc/nowhere"], "/proc/nowhere"),
    ],
)
def test_bad_requests_get_one_line_and_exit_code_2(
    tmp_path: Path, arguments: list[str], message: str
) -> None:
    if "--cameras" not in arguments:
        arguments = [*arguments, "--cameras", "none"]
    refused(arguments, message, tmp_path)


@pytest.mark.parametrize(
    ("environment", "message"),
    [
        # No device at that number: as where no driver is installed, EGL gives no display.
        ({"MUJOCO_GL": "egl", "MUJOCO_EGL_DEVICE_ID": "99"}, "no such EGL device"),
        ({"MUJOCO_GL": "crayon"}, "MUJOCO_GL=crayon renders nothing; valid: egl, osmesa, glfw"),
        ({"MUJOCO_GL": "disable"}, "--cameras none"),
    ],
)
def test_without_opengl_cameras_are_refused(
    tmp_path: Path, environment: dict[str, str], message: str
) -> None:
    refused(["FeedingEnv", "--scripted"], message, tmp_path, environment)


def test_a_damaged_motion_library_is_refused_by_name(tmp_path: Path) -> None:
    library = tmp_path / "motion.npz"
    library.write_bytes(DEFAULT_LIBRARY.read_bytes()[:1000])
    folder = tmp_path / "here"
    folder.mkdir()
    arguments = ["FeedingEnv", "--scripted", "--cameras", "none"]
    refused(
        [*arguments, "--motion_library", str(library)],
        "motion.npz': damaged or not an .npz",
        folder,
    )


def refused(
    arguments: list[str], message: str, folder: Path, environment: dict[str, str] | None = None
) -> None:
    """Run Rollout.py in a folder and expect one line, exit code 2 and nothing half-written."""
    result = subprocess.run(
        [sys.executable, str(ROOT / "bin/Rollout.py"), *arguments],
        cwd=folder,
        env={**os.environ, **(environment or {})},
        capture_output=True,
        text=True,
        check=False,
    )
    assert result.returncode == 2, result.stderr
    assert message in result.stderr
    assert len(result.stderr.strip().splitlines()) == 1
    assert not list(folder.iterdir())
