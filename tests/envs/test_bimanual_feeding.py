"""BimanualFeedingEnv: what one arm cannot do, the hand-over, and experts that do it."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

import mink
import mujoco
import numpy as np
import pytest

from robo_manip_baselines.commands import dataset, replay, rollout
from robo_manip_baselines.data import EpisodeReader, list_episodes
from robo_manip_baselines.envs.mujoco.cell.scene import ARM_BASES, CUBE_SIZE
from robo_manip_baselines.envs.mujoco.cell.vx300s import FINGER_OPEN, HOME_QPOS, arm_spec
from robo_manip_baselines.envs.mujoco.expert.kinematics import ArmKinematics
from robo_manip_baselines.envs.mujoco.tasks.bimanual_feeding import ENTRY
from robo_manip_baselines.envs.mujoco.tasks.bimanual_feeding.env import (
    CUBE_HIGH,
    CUBE_LOW,
    LEFT_HOME_QPOS,
    BimanualFeedingEnv,
)
from robo_manip_baselines.envs.mujoco.tasks.bimanual_feeding.expert import (
    FETCHING,
    HOLD_DEPTH,
    MEETING,
    PASSING,
    TAKING,
    along,
    downwards,
)
from robo_manip_baselines.envs.mujoco.tasks.bimanual_feeding.metrics import BimanualFeedingMetrics
from robo_manip_baselines.envs.mujoco.tasks.bimanual_feeding.success import Handover, Hands
from robo_manip_baselines.envs.mujoco.tasks.feeding.expert import CLEARANCE, GRASP_OFFSET, LIFT
from robo_manip_baselines.envs.mujoco.tasks.registry import make_env
from robo_manip_baselines.rollout.results import read_results
from robo_manip_baselines.runs.errors import RequestError
from robo_manip_baselines.training.config import TrainConfig

CORNERS = [
    np.array([x, y, CUBE_SIZE / 2])
    for x, y in itertools.product(*zip(CUBE_LOW, CUBE_HIGH, strict=True))
]
"""Centres of the cube at the corners of the area where it starts, (3,) m."""

UP = np.array([0.0, 0.0, 1.0])

FINGER_TIP = 0.018
"""m from the site of a gripper to the tips of its fingers."""

TOUCH = FINGER_TIP + CUBE_SIZE * np.sqrt(3) / 2
"""m from the site of a gripper to the cube's centre, beyond which no finger touches the cube."""


@pytest.fixture
def world() -> Iterator[BimanualFeedingEnv]:
    with closing(make_env("BimanualFeedingEnv", cameras=())) as env:
        assert isinstance(env.unwrapped, BimanualFeedingEnv)
        env.reset(seed=0)
        yield env.unwrapped


# -- one arm cannot do it -------------------------------------------------------------------------


def reach(arm: str, start: Sequence[float], path: Sequence[mink.SE3]) -> tuple[float, float]:
    """Go along a path by inverse kinematics; return how far (m, rad) its end is missed by."""
    kinematics, joints = ArmKinematics(arm), np.array(start)
    for pose in path:
        joints = kinematics.inverse(pose, joints)
    error = path[-1].minus(kinematics.forward(joints))
    return float(np.linalg.norm(error[:3])), float(np.linalg.norm(error[3:]))


def line(
    start: np.ndarray, end: np.ndarray, turn: mink.SO3, turned: mink.SO3 | None = None
) -> list[mink.SE3]:
    """Return poses on a straight line, all turned alike, or from ``turn`` to ``turned``."""
    return [
        mink.SE3.from_rotation_and_translation(
            turn.interpolate(turned or turn, share), start + share * (end - start)
        )
        for share in np.linspace(0.0, 1.0, 20)[1:]
    ]


@pytest.mark.parametrize("corner", CORNERS, ids=str)
def test_the_cube_starts_out_of_the_right_arms_reach(corner: np.ndarray) -> None:
    home = ArmKinematics("right").forward(np.array(HOME_QPOS)).translation()
    away = corner[:2] - np.array(ARM_BASES["right"][0])[:2]
    level = mink.SO3.from_z_radians(float(np.arctan2(away[1], away[0])))
    for turn in (level, downwards(0.0), downwards(np.pi / 2)):
        missed, _ = reach("right", HOME_QPOS, line(home, corner, turn))
        assert missed > TOUCH


def test_no_pose_of_the_right_arm_touches_a_cube_at_its_start() -> None:
    """The arm stretched out straight, its shoulder as near as it gets, is too short."""
    model = arm_spec().compile()
    lengths = [
        np.linalg.norm(model.body(link).pos)
        for link in ("upper_forearm_link", "lower_forearm_link", "wrist_link", "gripper_link")
    ]
    length = sum(lengths) + float(np.linalg.norm(model.site("gripper").pos))
    turntable, upper_arm = model.body("shoulder_link").pos, model.body("upper_arm_link").pos
    assert turntable[0] == turntable[1] == upper_arm[0] == upper_arm[1] == 0.0  # on the axis
    shoulder = np.array(ARM_BASES["right"][0]) + turntable + upper_arm
    nearest = np.clip(shoulder, [*CUBE_LOW, CUBE_SIZE / 2], [*CUBE_HIGH, CUBE_SIZE / 2])
    assert np.linalg.norm(nearest - shoulder) > length + TOUCH


@pytest.mark.parametrize("corner", CORNERS, ids=str)
def test_the_left_arm_reaches_the_cube_and_the_place_of_the_hand_over(corner: np.ndarray) -> None:
    home = ArmKinematics("left").forward(np.array(LEFT_HOME_QPOS))
    over, at = corner + (HOLD_DEPTH + CLEARANCE) * UP, corner + HOLD_DEPTH * UP
    fetch = [*line(home.translation(), over, home.rotation(), FETCHING), *line(over, at, FETCHING)]
    lifted = at + LIFT * UP
    carry = [
        *line(at, lifted, FETCHING),
        *line(lifted, MEETING + HOLD_DEPTH * UP, FETCHING, PASSING),
    ]
    for path in (fetch, [*fetch, *carry]):
        missed, turned = reach("left", LEFT_HOME_QPOS, path)
        # With its forearm turned over, which some ways lead to, the arm stops up to 8 mm and 0.1
        # rad short, at the limit of its wrist: the right gripper goes to where the cube is.
        assert missed < CUBE_SIZE / 4
        assert turned < 0.12  # rad


def test_the_right_arm_reaches_the_place_of_the_hand_over() -> None:
    home = ArmKinematics("right").forward(np.array(HOME_QPOS)).translation()
    missed, turned = reach(
        "right", HOME_QPOS, line(home, MEETING - GRASP_OFFSET * along(TAKING), TAKING)
    )
    assert missed < 1e-3
    assert turned < 1e-2


def test_the_grippers_hold_different_sides_of_the_cube() -> None:
    closing_left, closing_right = PASSING.as_matrix()[:, 1], TAKING.as_matrix()[:, 1]
    assert abs(closing_left @ closing_right) < 1e-9
    assert abs(closing_left @ along(TAKING)) == pytest.approx(1.0)


def test_the_right_arm_alone_is_refused() -> None:
    with pytest.raises(RequestError, match=r"^arms right: cannot do BimanualFeedingEnv; valid: "):
        make_env("BimanualFeedingEnv", cameras=(), arms="right")
    with pytest.raises(RequestError, match=r"^arms right: cannot do BimanualFeedingEnv; valid: "):
        TrainConfig.from_json({"policy": "Act", "env": "BimanualFeedingEnv", "arms": "right"})


def test_commands_take_both_arms_without_being_told() -> None:
    assert TrainConfig.from_preset("Act", "cpu", "BimanualFeedingEnv").spec.arms == "both"
    assert TrainConfig.from_preset("Act", "cpu", "FeedingEnv").spec.arms == "right"
    for arms in ([], ["--arms", "both"]):
        options, _ = rollout.parse_options(["BimanualFeedingEnv", "--scripted", *arms])
        assert "arms" not in rollout.to_collection(options).env_kwargs
    options, _ = rollout.parse_options(["BimanualFeedingEnv", "--scripted", "--arms", "right"])
    assert rollout.to_collection(options).env_kwargs["arms"] == "right"  # and is refused


# -- hand-over ------------------------------------------------------------------------------------

LEFT, RIGHT, BOTH, NONE = Hands(2, 0), Hands(0, 2), Hands(2, 2), Hands()


@pytest.mark.parametrize(
    ("steps", "expected"),
    [
        ([], None),
        ([LEFT, BOTH, RIGHT], 2),
        ([LEFT, BOTH, BOTH], None),
        ([LEFT, Hands(1, 2), RIGHT], 2),  # a finger of the left gripper still drags
        ([LEFT, BOTH, Hands(0, 1), RIGHT], 3),
        ([LEFT, Hands(0, 1), RIGHT], 2),
        ([LEFT, NONE, RIGHT], None),  # dropped, or thrown
        ([LEFT, BOTH, NONE, BOTH, RIGHT], None),
        ([RIGHT], None),  # the left hand had no part in it
        ([BOTH, RIGHT], 1),
        ([Hands(1, 0), Hands(1, 2), RIGHT], None),
        ([LEFT, BOTH, RIGHT, BOTH, RIGHT], 2),  # the first one counts
        ([LEFT, RIGHT, NONE], 1),
    ],
)
def test_hand_over(steps: list[Hands], expected: int | None) -> None:
    handover, is_carried = Handover(), True
    for time, hands in enumerate(steps):
        handover = handover.advance(time, hands, is_carried=is_carried)
        is_carried = is_carried and hands != NONE
    assert handover.time == expected


def test_there_is_no_hand_over_on_the_table() -> None:
    handover = Handover()
    for hands in (LEFT, BOTH, RIGHT):
        handover = handover.advance(0.0, hands, is_carried=False)
    assert handover == Handover()


def put_cube_between_fingers(world: BimanualFeedingEnv, arm: str) -> None:
    """Close a gripper of an arm at home around the cube, which weighs nothing."""
    site, quat = world.data.site(f"{arm}/gripper"), np.empty(4)
    mujoco.mju_mat2Quat(quat, site.xmat)
    world.data.joint("cube").qpos = (*site.xpos, *quat)
    world.data.joint("cube").qvel = 0.0
    for side, sign in (("left", 1.0), ("right", -1.0)):
        world.data.joint(f"{arm}/{side}_finger").qpos = sign * 0.0405  # both pads touch it
    world.model.opt.gravity[:] = 0.0


STAY_OPEN = np.array([*LEFT_HOME_QPOS, FINGER_OPEN, *HOME_QPOS, FINGER_OPEN], dtype=np.float32)


@pytest.mark.parametrize(("arm", "hands"), [("left", LEFT), ("right", RIGHT)])
def test_fingers_are_told_apart(world: BimanualFeedingEnv, arm: str, hands: Hands) -> None:
    put_cube_between_fingers(world, arm)
    _, _, _, _, info = world.step(STAY_OPEN)
    assert world._hands() == hands
    assert info["phase"] == "pass"
    _, _, _, _, info = world.step(STAY_OPEN)
    assert info["handover_time"] is None


def test_a_cube_in_the_right_gripper_that_was_not_handed_over_is_no_success(
    world: BimanualFeedingEnv,
) -> None:
    """The face comes to where the right gripper has a cube that it did not get from the left."""
    for was_left in (False, True):
        world.reset_task(np.random.default_rng(0))
        world.replay.mouth[:] = world.gripper_position
        for arm in ["left", "right"] if was_left else ["right"]:
            for _ in range(2):  # the first step lifts the cube
                put_cube_between_fingers(world, arm)
                world.step(STAY_OPEN)
        info = world.info()
        assert info["is_success"] is was_left
        assert info["handover_time"] == (pytest.approx(0.04) if was_left else None)


INFO: dict[str, Any] = {
    "is_success": False,
    "phase": "reach",
    "face_force": 0.0,
    "mouth_position": np.zeros(3),
    "utensil_position": np.zeros(3),
    "cube_offset": np.zeros(3),
    "time_since_lift": None,
    "handover_time": None,
}


@pytest.mark.parametrize(
    ("infos", "failure", "time"),
    [
        ([{}], "never_grasped", None),
        ([{"phase": "grasp"}], "never_grasped", None),
        ([{"phase": "pass", "time_since_lift": 3.0}], "not_handed_over", None),
        ([{"phase": "release", "time_since_lift": 3.0}], "dropped", None),
        (
            [{"phase": "carry", "utensil_position": np.array([0.2, 0.0, 0.0])}, {}],
            "too_late",
            2.0,
        ),
        (
            [{"phase": "carry", "utensil_position": np.array([0.0, 0.0, 0.03])}, {}],
            "missed_high",
            2.0,
        ),
        ([{"phase": "deliver"}, {"phase": "release", "is_success": True}], "", 2.0),
    ],
)
def test_failures(infos: list[dict[str, Any]], failure: str, time: float | None) -> None:
    metrics, common = BimanualFeedingMetrics(), INFO
    if time:
        common = {**INFO, "time_since_lift": 3.0, "handover_time": time}
    for changes in infos:
        metrics.update({**common, **changes})
    kind, columns = metrics.result({**common, **infos[-1]})
    assert kind == failure
    assert columns["handover_time"] == time
    assert not kind or kind in ENTRY.failures


# -- whole episodes -------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def demonstrations(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two episodes of the default expert."""
    out = tmp_path_factory.mktemp("runs") / "demonstrations"
    options = "BimanualFeedingEnv --scripted --cameras none --num_episodes 2 --preview 0"
    rollout.main([*options.split(), "--workers", "1", "--out", str(out)])
    return out


@pytest.mark.long
def test_the_expert_hands_over_and_feeds(demonstrations: Path) -> None:
    paths = list_episodes(demonstrations)
    assert len(paths) == 2
    for path in paths:
        with EpisodeReader(path) as episode:
            names = list(episode.attributes["phase_names"])
            phase, action = episode.array("phase"), episode.array("action")
            assert episode.array("joint_position").shape[1:] == (12,)
        assert action.shape[1:] == (14,)
        assert [names[p] for p, _ in itertools.groupby(phase)] == names  # in order, none twice


@pytest.mark.long
def test_episodes_are_whole_and_replay(demonstrations: Path) -> None:
    assert dataset.main(["verify", str(demonstrations)]) == 0
    assert replay.main([str(list_episodes(demonstrations)[0])]) == 0


@pytest.mark.long
def test_a_policy_is_trained_and_evaluated(demonstrations: Path, tmp_path: Path) -> None:
    train = pytest.importorskip("robo_manip_baselines.commands.train")
    run, out = tmp_path / "run", tmp_path / "results"
    options = "Mlp --env BimanualFeedingEnv --obs current_pred --steps 5 --device cpu --logger none"
    assert train.main([*options.split(), f"--dataset={demonstrations}", f"--out={run}"]) == 0
    options = "BimanualFeedingEnv --policy Mlp --num_episodes 1 --num_envs 1 --workers 0"
    rollout.main([*options.split(), f"--checkpoint={run}", f"--out={out}"])
    (result,) = read_results(out)
    assert result.failure in ENTRY.failures
    assert "handover_time" in result.columns


@pytest.mark.long
def test_a_left_hand_that_lets_go_too_early_drops_it(world: BimanualFeedingEnv) -> None:
    actor, metrics = ENTRY.make_expert("reactive", world), ENTRY.make_metrics()
    actor.reset()
    info: dict[str, Any] = world.info()
    for _ in range(400):
        action = actor.act()
        if world.progress.lift_time is not None:
            action[6] = FINGER_OPEN
        _, _, _, _, info = world.step(action)
        metrics.update(info)
        if info["phase"] == "release":
            break
    failure, columns = metrics.result(info)
    assert (failure, columns["handover_time"]) == ("dropped", None)
    assert not info["is_success"]


@pytest.mark.slow
@pytest.mark.parametrize("expert", sorted(ENTRY.experts))
def test_experts_succeed_nine_times_of_ten(world: BimanualFeedingEnv, expert: str) -> None:
    successes = 0
    for seed in range(20):
        world.reset(seed=seed)
        actor = ENTRY.make_expert(expert, world)
        actor.reset()
        for _ in range(600):
            _, _, terminated, _, _ = world.step(actor.act())
            if terminated:
                break
        successes += world.progress.is_success
    assert successes >= 18
