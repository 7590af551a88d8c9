"""The page over episodes shows what the files hold, at the step that is asked for."""

from __future__ import annotations

import re
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest

from robo_manip_baselines.data import EpisodeReader, episode_path, write_episode
from robo_manip_baselines.data.example import make_arrays, make_attributes, make_images
from robo_manip_baselines.envs.mujoco.tasks.face_env import world_of
from robo_manip_baselines.envs.mujoco.tasks.registry import make_env
from robo_manip_baselines.rollout.demonstrate import demonstrate
from robo_manip_baselines.rollout.episode_page import (
    Curve,
    EpisodePage,
    RecordedWorld,
    curve_range,
    target_curves,
    titles,
    with_time_line,
)
from robo_manip_baselines.runs.browser import PageOptions, serve_page

SCRIPT = Path(__file__).parents[2] / "bin" / "Dataset.py"
STEPS = 20


def record(folder: Path, seed: int, **env_kwargs: Any) -> Path:
    with closing(make_env("FeedingEnv", max_episode_steps=STEPS, **env_kwargs)) as env:
        recorded = demonstrate(env, "reactive", seed, codec="jpeg", quality=90)
    path = episode_path(folder, seed, True)
    return write_episode(path, *recorded)


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Two episodes: one of a visual, one of a physical face."""
    folder = tmp_path_factory.mktemp("recorded")
    cameras: dict[str, Any] = {"cameras": ("top", "angle"), "image_size": (24, 32)}
    visual = record(folder / "visual", 0, **cameras)
    return [visual, record(folder / "physical", 0, cameras=(), face="physical")]


def test_a_time_line_stands_at_its_step() -> None:
    time = np.array([0.0, 0.1, 0.2])
    curves = [Curve("a", np.array([1.0, 2.0, 3.0])), Curve("b", np.array([5.0, 5.0, 5.0]))]
    low, high = curve_range(curves)
    assert (low, high) == pytest.approx((0.8, 5.2))
    times, a, b, line = with_time_line(time, curves, 1)
    assert times.tolist() == [0.0, 0.1, 0.1, 0.1, 0.2]
    assert a.tolist() == [1.0, 2.0, 2.0, 2.0, 3.0]
    assert b.tolist() == [5.0] * 5
    np.testing.assert_array_equal(line, [np.nan, np.nan, low, high, np.nan])
    for step in (0, 2):
        times, *_, line = with_time_line(time, curves, step)
        assert np.all(np.diff(times) >= 0)
        assert times[np.isfinite(line)].tolist() == [time[step]] * 2


def test_a_flat_curve_has_an_axis() -> None:
    assert curve_range([Curve("a", np.zeros(3))]) == (-0.5, 0.5)


def test_titles_tell_files_apart(tmp_path: Path) -> None:
    paths = []
    for name in ("one/same", "two/same"):
        path = episode_path(tmp_path / name, 0, False)
        paths.append(write_episode(path, make_arrays(), make_images(), make_attributes(0)))
    found = titles(paths)
    assert list(found.values()) == paths
    assert next(iter(found)).startswith("same/episode_000000 (")


@pytest.mark.long
@pytest.mark.gl
@pytest.mark.parametrize("kind", [0, 1], ids=["visual", "physical"])
def test_the_recorded_state_is_the_simulated_one(recorded: list[Path], kind: int) -> None:
    """Everything stands where it stood when the same actions are simulated."""
    with EpisodeReader(recorded[kind]) as episode, closing(RecordedWorld(episode)) as shown:
        shown.load(episode)
        kwargs = {**episode.attributes["env_kwargs"], "cameras": ()}
        with closing(make_env("FeedingEnv", **kwargs)) as env:
            env.reset(seed=episode.attributes["seed"])
            world = world_of(env)
            for step, action in enumerate(episode.array("action")):
                here, there = shown.show(step), world.data
                for body in range(world.model.nbody):
                    name = world.model.body(body).name
                    # The bust stands under the mean of the mouth's places: of the file's steps
                    # here, of the whole motion there.
                    tolerance = 0.02 if name == "face/torso" else 1e-6
                    distance = np.abs(here.xpos[body] - there.xpos[body]).max()
                    assert distance < tolerance, (step, name)
                env.step(action)


@pytest.mark.long
@pytest.mark.parametrize("task", ["FaceWipingEnv", "DrinkingEnv"])
def test_what_is_only_drawn_is_as_it_was(task: str, tmp_path: Path) -> None:
    """Residue and liquid are no part of the simulator's state."""
    with closing(make_env(task, cameras=())) as env:
        expert = next(iter(world_of(env).task.experts))
        path = episode_path(tmp_path, 3, True)
        write_episode(path, *demonstrate(env, expert, 3, codec="jpeg", quality=90))
    with EpisodeReader(path) as episode, closing(RecordedWorld(episode)) as shown:
        shown.load(episode)
        with closing(make_env(task, cameras=())) as env:
            env.reset(seed=3)
            here, there = shown.world.model, world_of(env).model
            liquid = np.array([name.startswith("cup/slice") for name in _geoms(there)])
            for step, action in enumerate(episode.array("action")):
                shown.show(step)
                for name in ("site_pos", "site_quat", "site_rgba"):
                    found, wanted = getattr(here, name), getattr(there, name)
                    np.testing.assert_allclose(found, wanted, atol=1e-9, err_msg=f"{name}, {step}")
                # A simulated step draws the surface from before its outflow: a few mm higher.
                sizes = here.geom_size[liquid, 2], there.geom_size[liquid, 2]
                np.testing.assert_allclose(*sizes, atol=3e-3, err_msg=f"liquid, {step}")
                env.step(action)


def _geoms(model: mujoco.MjModel) -> list[str]:
    return [model.geom(geom).name for geom in range(model.ngeom)]


@pytest.fixture
def page(recorded: list[Path]) -> Iterator[tuple[EpisodePage, list[float]]]:
    """A page, and the time that its clock shows."""
    pytest.importorskip("viser", reason="pip install viser")
    now = [100.0]
    with (
        serve_page(PageOptions(port=0), "Test") as (server, _),
        closing(EpisodePage(server, recorded, clock=lambda: now[0])) as made,
    ):
        made.update()
        yield made, now


def shown_images(page: EpisodePage) -> dict[str, np.ndarray]:
    return {camera: np.asarray(handle.image) for camera, handle in page._images.items()}


@pytest.mark.long
@pytest.mark.gl
def test_a_step_is_shown_everywhere(
    page: tuple[EpisodePage, list[float]], recorded: list[Path]
) -> None:
    shown, _ = page
    assert (shown.shown, shown.step) == (recorded[0], 0)
    before = shown_images(shown)
    assert list(before) == ["angle", "top"]
    shown._slider.value = STEPS - 1
    shown.update()
    assert shown.step == STEPS - 1
    assert f"step {STEPS - 1} of {STEPS - 1}" in shown._text.content
    after = shown_images(shown)
    with EpisodeReader(recorded[0]) as episode:
        expected = episode.frame("top", STEPS - 1)
        curves = target_curves(episode)
        time = episode.array("time")
    small = after["top"][5::10, 5::10]  # drawn ten times as large
    assert np.abs(small.astype(int) - expected).mean() < 6
    assert not np.array_equal(before["top"], after["top"])
    chart, _ = shown._charts[0]
    for given, wanted in zip(chart.data, with_time_line(time, curves, STEPS - 1), strict=True):
        np.testing.assert_array_equal(given, wanted)


@pytest.mark.long
@pytest.mark.gl
def test_another_episode_has_its_own_scene_and_cameras(
    page: tuple[EpisodePage, list[float]], recorded: list[Path]
) -> None:
    shown, _ = page
    shown._episode.value = list(shown._paths)[1]
    shown.update()
    assert (shown.shown, shown.step) == (recorded[1], 0)
    images = shown_images(shown)
    assert sorted(images) == ["angle", "front_close", "top"]  # none was recorded: drawn
    assert all(image.std() > 10 for image in images.values())
    shown._joint.value = "right/elbow"
    shown.update()
    assert shown._charts[2][0].title.startswith("right/elbow")


@pytest.mark.long
@pytest.mark.gl
def test_playing_keeps_time_and_ends(page: tuple[EpisodePage, list[float]]) -> None:
    shown, now = page
    shown._play.value = True
    shown.update()
    now[0] += 0.1
    shown.update()
    assert shown.step == 5  # of 0.02 s
    shown._speed.value = "2×"
    shown.update()
    now[0] += 0.1
    shown.update()
    assert shown.step == 15
    now[0] += 9.0
    shown.update()
    assert shown.step == STEPS - 1
    assert not shown._play.value
    shown._play.value = True  # again, from the start
    shown.update()
    assert shown.step == 0


@pytest.mark.long
def test_an_episode_of_another_model_has_no_scene(tmp_path: Path) -> None:
    pytest.importorskip("viser", reason="pip install viser")
    path = episode_path(tmp_path, 0, True)
    write_episode(path, make_arrays(), make_images(), make_attributes(0) | {"is_success": True})
    with (
        serve_page(PageOptions(port=0), "Test") as (server, _),
        closing(EpisodePage(server, [path])) as made,
    ):
        made.update()
        assert "no scene: " in made._text.content
        assert "was recorded with another model" in made._text.content
        assert shown_images(made)


def test_an_empty_request_is_one_line(tmp_path: Path) -> None:
    pytest.importorskip("viser", reason="pip install viser")
    for arguments, line in (
        ([str(tmp_path)], "holds no episode_*.hdf5 file"),
        ([str(tmp_path), "--host", "0.0.0.0"], "other machines could connect"),
    ):
        command = [sys.executable, str(SCRIPT), "view", *arguments]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        assert done.returncode == 2
        assert line in done.stderr
        assert done.stderr.count("\n") == 1


@pytest.mark.slow
@pytest.mark.gl
def test_in_a_browser(recorded: list[Path], browser: Any) -> None:
    """Headless Chromium draws the scene, and its slider moves everything."""
    pytest.importorskip("viser", reason="pip install viser")
    command = [sys.executable, str(SCRIPT), "view", *map(str, recorded), "--port", "0"]
    with (
        # A page that stays open draws on, which without a GPU takes a core from later tests.
        closing(browser.new_page(viewport={"width": 1300, "height": 850})) as page,
        subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as process,
    ):
        assert process.stderr is not None
        try:
            line = process.stderr.readline()
            found = re.search(r"2 episodes at (http://127\.0\.0\.1:\d+/)", line)
            assert found, line
            page.set_default_timeout(120_000)  # WebGL without a GPU takes long to start
            errors: list[str] = []
            page.on("pageerror", lambda error: errors.append(str(error)))
            page.goto(found[1])
            page.get_by_text(f"step 0 of {STEPS - 1}").wait_for()
            page.get_by_text("last", exact=True).click()
            page.get_by_text(f"step {STEPS - 1} of {STEPS - 1}").wait_for()
            page.get_by_text("back", exact=True).click()
            page.get_by_text(f"step {STEPS - 2} of {STEPS - 1}").wait_for()
            pictures = page.locator("img").evaluate_all(
                "found => found.map(image => image.naturalWidth)"
            )
            assert pictures.count(320) == 2
            assert page.locator(".uplot canvas").count() == 3
            # The scene is drawn: the bust's blue, and the table, are in the middle of the window.
            page.wait_for_timeout(5000)  # it fades in
            picture = page.screenshot(clip={"x": 360, "y": 150, "width": 600, "height": 600})
            assert len(picture) > 20_000  # an empty one has 2 kB
            assert errors == []
        finally:
            process.send_signal(signal.SIGINT)
        assert process.wait(60) == 130
