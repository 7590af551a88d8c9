"""``docs/formats.md`` names what the exports write."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from robo_manip_baselines.data import EpisodeReader, list_episodes
from robo_manip_baselines.data.formats.aloha import GRIPPER_CLOSED, GRIPPER_OPEN, aloha_arrays
from robo_manip_baselines.data.formats.rmb import DERIVED, rmb_arrays
from robo_manip_baselines.data.schema import EpisodeSchema
from robo_manip_baselines.envs.mujoco.tasks.registry import imported_entry

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "formats.md").read_text(encoding="utf-8")
WORDS = set(re.findall(r"`([^`\n]+)`", PAGE)) | set(re.findall(r"[\w/.]+", PAGE))


def test_keys_of_rmb(one_arm: Path) -> None:
    with EpisodeReader(list_episodes(one_arm)[0]) as episode:
        keys = set(rmb_arrays(episode)) - (set(episode.arrays) - set(DERIVED))
    named = {key for key in keys if not key.endswith("_rel")}
    assert named - WORDS == set()
    assert {"`…_joint_pos_rel`", "`…_eef_pose_rel`"} <= set(re.findall(r"`…\w+`", PAGE))


def test_variables_and_units_of_aloha(one_arm: Path) -> None:
    with EpisodeReader(list_episodes(one_arm)[0]) as episode:
        assert {f"/{name}" for name in aloha_arrays(episode)} <= WORDS
    assert f"at {GRIPPER_CLOSED:g} m, closed, and 1 at {GRIPPER_OPEN:g} m" in PAGE


def test_features_of_lerobot() -> None:
    pytest.importorskip("pyarrow", reason="the format lerobot needs the extra formats")
    from robo_manip_baselines.data.formats.lerobot_dataset import DEFAULT_FEATURES

    own = {"observation.state", "action", "next.reward", "next.success", "next.done"}
    assert (own | set(DEFAULT_FEATURES)) <= WORDS


def test_options_of_the_environments() -> None:
    name = "lerobot_env_robo_manip_baselines"
    source = (ROOT / "integrations" / name / name / "__init__.py").read_text(encoding="utf-8")
    body = source.split("class RoboManipBaselinesConfig")[1].split("def __post_init__")[0]
    options = set(re.findall(r"^    (\w+): ", body, flags=re.MULTILINE)) - {"task", "fps"}
    assert len(options) > 10
    assert options <= {word.removeprefix("--env.") for word in WORDS}


def test_attributes_of_imported_episodes() -> None:
    text = (ROOT / "docs" / "episode_format.md").read_text(encoding="utf-8")
    schema = EpisodeSchema.of(imported_entry())
    assert all(f"`{item.name}`" in text for item in schema.attributes)
