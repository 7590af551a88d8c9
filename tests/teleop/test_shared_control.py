"""A policy acts, a person takes over and gives back, and the steps are marked."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from robo_manip_baselines.commands import teleop
from robo_manip_baselines.data import EpisodeReader, read_metadata
from robo_manip_baselines.data.files import list_failures
from robo_manip_baselines.data.verify import verify_dataset
from robo_manip_baselines.envs.mujoco.tasks.face_env import world_of
from robo_manip_baselines.envs.mujoco.tasks.registry import make_env
from robo_manip_baselines.policy.checkpoint import read_checkpoint
from robo_manip_baselines.rollout.demonstrate import deviation
from robo_manip_baselines.runs.errors import RequestError
from robo_manip_baselines.teleop import teleoperate
from robo_manip_baselines.teleop.device import Mode, SessionView, TeleopEvent, TeleopInput

SHIPPED = ("--policy", "Act", "--checkpoint", "shipped:forecast")

EVENTS = {
    20: (TeleopEvent.TAKE_OVER,),
    35: (TeleopEvent.GIVE_BACK,),
    50: (TeleopEvent.SAVE,),
}


class Alternating:
    """Device that records, takes over at step 20, gives back at 35, and saves at 50."""

    is_paced = False

    def __init__(self) -> None:
        self.views: list[SessionView] = []
        self._done: set[int] = set()

    def update(self, view: SessionView) -> TeleopInput:
        self.views.append(view)
        if view.mode is Mode.PRACTICE:
            return TeleopInput(events=(TeleopEvent.RECORD,))
        return TeleopInput(events=EVENTS.get(view.step, ()))

    def close(self) -> None:
        pass


class Circling:
    """Policy that counts, and moves the waist."""

    def __init__(self, start: NDArray[np.float32]) -> None:
        self.attribute = {"name": "Circling", "sha256": "0" * 64}
        self.resets: list[int] = []
        self._start, self._count = start, 0

    def reset(self, seed: int) -> None:
        self.resets.append(seed)

    def act(self) -> NDArray[np.float32]:
        self._count += 1
        action = self._start.copy()
        action[0] += 0.002 * self._count
        return action


def test_steps_of_the_person_are_marked_and_go_on_from_the_policy(
    make_session: Callable[..., Any],
) -> None:
    with closing(make_env("FeedingEnv", cameras=())) as env:
        env.reset(seed=3)
        state = world_of(env).state()
        start = np.append(state.joint_position[0], state.gripper_position[0]).astype(np.float32)
        policy, device = Circling(start), Alternating()
        session, store = make_session(env, device, seeds=(3,), policy=policy)
        session.run()
    (episode,) = store.episodes
    mark, action = episode.arrays["intervention"], episode.arrays["action"]
    np.testing.assert_array_equal(mark, (np.arange(50) >= 20) & (np.arange(50) < 35))
    assert episode.attributes["policy"] == policy.attribute
    # The person moves nothing: the arm stays where the policy commanded it to be.
    np.testing.assert_allclose(action[20:35], np.tile(action[19], (15, 1)), atol=1e-6)
    assert np.abs(np.diff(action[35:, 0])).min() > 1e-3
    assert policy.resets[-1] == 3  # for the rest, as at the start of an episode
    assert len(policy.resets) == 3  # practice, recording, given back
    acting = [view.is_policy_acting for view in device.views]
    assert acting[0] is False  # practice is the person's
    assert acting[1] is True


@pytest.mark.long
def test_a_shipped_policy_acts_as_in_an_evaluation(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(teleoperate, "open_device", lambda *_: Alternating())
    out = tmp_path / "out"
    options = ["--device", "web", "--cameras", "none", "--seed", "1000", "--num_episodes", "1"]
    teleop.main(["FeedingEnv", *options, *SHIPPED, "--out", str(out)])
    (path,) = list_failures(out)
    assert verify_dataset(out) == []
    found = deviation(path)
    assert (found.qpos, found.qvel) == (0.0, 0.0)
    checkpoint = read_checkpoint("shipped:forecast")
    known = read_metadata(path)
    assert known["policy"] == {"name": "Act", "sha256": checkpoint.content_hash}
    # The episode says what the world was, and not what the policy was shown of it.
    assert set(known["env_kwargs"]) == {"cameras", "image_size", "face_motion"}
    with EpisodeReader(path) as episode:
        actions, marks = episode.array("action"), episode.array("intervention")
    assert marks.sum() == 15
    np.testing.assert_array_equal(actions[:20], evaluated(checkpoint, 1000, 20))


def evaluated(checkpoint: Any, seed: int, steps: int) -> NDArray[np.float64]:
    """Return the first actions (steps, A) of an episode in which the policy alone acts."""
    from robo_manip_baselines.policy.checkpoint import load_model
    from robo_manip_baselines.policy.execution import PolicyRunner
    from robo_manip_baselines.rollout.workers import EnvConfig, LocalEnvs, StepRequest

    config = EnvConfig(checkpoint.env, checkpoint.spec)
    arrays, ids = np.zeros(1, config.row_type), np.zeros(1, np.intp)
    runner = PolicyRunner(
        load_model(checkpoint),
        checkpoint.spec,
        checkpoint.normalization,
        checkpoint.execution,
        encoding=checkpoint.encoding,
        skip=checkpoint.settings.skip,
        num_envs=1,
    )
    runner.reset(ids, [seed])
    actions = []
    with closing(LocalEnvs(config, arrays)) as envs:
        envs.submit([StepRequest(0, seed, False)])
        for _ in range(steps):
            envs.wait()
            arrays["actions"][0] = runner.act(arrays["vectors"], None, ids)[0]
            actions.append(arrays["actions"][0].astype(np.float64))
            envs.submit([StepRequest(0, None, False)])
    return np.array(actions)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--policy", "Act"], "--policy and --checkpoint: a policy that shares control needs both"),
        (["--policy", "Mlp", *SHIPPED[2:]], "unknown policy of this checkpoint 'Mlp'.*valid: Act"),
        (["--policy", "Act", "--checkpoint", "shipped:none"], "unknown shipped checkpoint 'none'"),
    ],
)
def test_policies_that_cannot_act_are_refused(
    options: list[str], message: str, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    with pytest.raises(RequestError, match=message):
        teleop.main(["FeedingEnv", *options, "--cameras", "none", "--out", str(out)])
    assert not out.exists()


def test_a_policy_of_another_task_is_refused(tmp_path: Path) -> None:
    with pytest.raises(RequestError, match=r"is of FeedingEnv, not of DrinkingEnv"):
        teleop.main(["DrinkingEnv", *SHIPPED, "--cameras", "none", "--out", str(tmp_path / "o")])
