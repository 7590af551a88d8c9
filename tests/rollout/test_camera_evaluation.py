"""A policy and an expert whose mouth comes from a camera: options, rows, refusals."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from robo_manip_baselines.commands.rollout import main, parse_options, to_collection, to_evaluation
from robo_manip_baselines.data import EpisodeReader, list_episodes
from robo_manip_baselines.data.demonstrations import load_demonstrations
from robo_manip_baselines.data.files import list_failures
from robo_manip_baselines.envs.mujoco.face import camera_mouth
from robo_manip_baselines.observation import Corruption, ObservationSpec
from robo_manip_baselines.policy.checkpoint import Checkpoint
from robo_manip_baselines.rollout.demonstrate import collect, deviation
from robo_manip_baselines.rollout.evaluation import EvaluationConfig, EvaluationPlan
from robo_manip_baselines.rollout.results import EpisodeResult, read_results
from robo_manip_baselines.runs.errors import RequestError

pytestmark = [pytest.mark.gl, pytest.mark.long]


class EveryOther:
    """Tracker that finds the mouth half a metre ahead of the camera, in every other image."""

    def reset(self) -> None:
        self.images = 0

    def update(self, image: Any, time: float, depth: Any = None) -> Any:
        self.images += 1
        return np.tile([0.0, 0.0, -0.5], (25, 1)) if self.images % 2 else None

    def close(self) -> None:
        pass


@pytest.fixture(autouse=True)
def tracker(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(camera_mouth, "find_tracker", lambda: lambda fov, ahead: EveryOther())


@pytest.fixture(scope="module")
def run_folder(
    make_checkpoint: Callable[..., Checkpoint], tmp_path_factory: pytest.TempPathFactory
) -> Path:
    run = tmp_path_factory.mktemp("runs") / "mlp_run"
    make_checkpoint(run / "checkpoints" / "step_00000005")
    return run


def command_line(run: Path, text: str = "") -> list[str]:
    line = f"FeedingEnv --policy Mlp --checkpoint {run} --workers 0 --num_episodes 2 {text}"
    return line.split()


def config(run: Path, text: str) -> EvaluationConfig:
    return to_evaluation(*parse_options(command_line(run, text)))


def test_rows_say_that_the_mouth_came_from_a_camera(run_folder: Path, tmp_path: Path) -> None:
    out = tmp_path / "camera"
    main(command_line(run_folder, f"--mouth_source camera --camera_latency 2 --out {out}"))
    main(command_line(run_folder, f"--out {tmp_path / 'truth'}"))
    for row in read_results(out):
        assert row.condition == "current_pred_h2_under_camera_2"
        assert row.observation is not None
        assert row.observation["mouth_source"] == "camera"
        assert row.observation["camera_latency"] == 2
        # 30 steps of 0.02 s have 19 images, the first at the start
        assert row.frames_without_detection == 9
    for line in (tmp_path / "truth/results.jsonl").read_text().splitlines():
        assert "frames_without_detection" not in json.loads(line)
        assert "mouth_source" not in json.loads(line)["observation"]
        assert EpisodeResult.from_line(line).frames_without_detection is None


def test_a_camera_takes_the_place_of_what_the_policy_was_trained_with(
    make_checkpoint: Callable[..., Checkpoint], tmp_path: Path
) -> None:
    spec = ObservationSpec(
        "current_pred", cameras=(), object_pose=True, corruption=Corruption("uniform", delay=2)
    )
    run = tmp_path / "run"
    make_checkpoint(run / "checkpoints" / "step_00000005", spec=spec)
    plan = EvaluationPlan.of(config(run, "--mouth_source depth_camera"))
    assert plan.env.spec.mouth_source == "depth_camera"
    assert not plan.env.spec.corruption
    assert plan.condition == "current_pred_h2_uniform_delay2_under_depth_camera"
    with pytest.raises(RequestError, match="goes without 'delay3'; leave the corruption out"):
        parse_options(command_line(run, "--mouth_source camera --delay 3"))


def test_a_policy_that_sees_no_mouth_is_refused(
    make_checkpoint: Callable[..., Checkpoint], tmp_path: Path
) -> None:
    spec = ObservationSpec("baseline", cameras=(), object_pose=True)
    make_checkpoint(tmp_path / "run/checkpoints/step_00000005", spec=spec)
    with pytest.raises(RequestError, match="preset 'baseline', which shows no mouth"):
        EvaluationPlan.of(config(tmp_path / "run", "--mouth_source camera"))


def test_demonstrations_of_the_servo(tmp_path: Path) -> None:
    line = "FeedingEnv --scripted --expert servo --mouth_source camera --cameras none --preview 0"
    options, _ = parse_options([*line.split(), "--num_episodes", "1", "--workers", "1"])
    collection = to_collection(options)
    collection = type(collection)(
        **{**vars(collection), "out": tmp_path / "servo"},
    )
    collect(collection)
    (path,) = [*list_episodes(tmp_path / "servo"), *list_failures(tmp_path / "servo")]
    with EpisodeReader(path) as episode:
        assert episode.attributes["env_kwargs"]["mouth_source"] == "camera"
        assert not episode.attributes["is_success"]  # it goes where the camera says
        found = np.abs(episode.array("mouth_position")[:, 0] - [0.0, 0.5, 0.35]).max()
        assert found < 0.1  # and the truth is recorded
    assert deviation(path).qpos < 1e-6  # replayed without a camera


def test_an_expert_that_knows_the_truth_is_refused(tmp_path: Path) -> None:
    line = "FeedingEnv --scripted --mouth_source camera --cameras none --preview 0 --out"
    with pytest.raises(RequestError, match="the expert 'reactive' of FeedingEnv knows the true"):
        main([*line.split(), str(tmp_path / "none")])
    assert not (tmp_path / "none").exists()


def test_nothing_is_trained_by_camera(tmp_path: Path) -> None:
    with pytest.raises(RequestError, match="demonstrations hold the true mouth"):
        load_demonstrations(tmp_path, ObservationSpec("current", mouth_source="camera"))
