"""The page on adding a policy, followed step by step: its code is the policy of this test."""

from __future__ import annotations

import re
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch

from robo_manip_baselines.commands import rollout as rollout_command
from robo_manip_baselines.commands import train as train_command
from robo_manip_baselines.data.demonstrations import load_demonstrations
from robo_manip_baselines.policy.checkpoint import load_model, read_checkpoint
from robo_manip_baselines.policy.execution import PolicyRunner
from robo_manip_baselines.policy.interface import PolicyModel
from robo_manip_baselines.policy.registry import ENTRY_POINT_GROUP, policy_entry, policy_names
from robo_manip_baselines.rollout.results import EpisodeResult
from robo_manip_baselines.rollout.rollout import Recording, rollout
from robo_manip_baselines.rollout.workers import EnvConfig, open_envs
from robo_manip_baselines.runs.errors import RequestError

SHORT = {
    "--scripted": "--num_episodes 4 --preview 0 --workers 1",
    "Train.py": "--steps 20 --batch_size 8 --hidden_size 16 --warmup_steps 2 --ema_decay 0.5 "
    "--logger none --device cpu --validation_fraction 0.3 --validate_every 10",
    "--policy": "--num_episodes 1 --workers 0 --device cpu",
}
"""Options added to the page's commands so that they take seconds."""


@pytest.fixture(scope="module")
def page(repository: Path) -> str:
    return (repository / "docs" / "add-a-policy.md").read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def package(page: str, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """The page's package as pip would install it."""
    folder = tmp_path_factory.mktemp("site")
    for code in re.findall(r"```python\n(# my_policy/.*?)```", page, re.DOTALL):
        path = folder / code.partition("\n")[0].removeprefix("# ")
        path.parent.mkdir(exist_ok=True)
        path.write_text(code)
    pattern = r'\[project\.entry-points\."(.+)"\]\n(\w+) = "(.+)"\n'
    (point,) = re.findall(pattern, page)
    info = folder / "my_policy-0.1.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: my_policy\nVersion: 0.1\n")
    (info / "entry_points.txt").write_text("[{}]\n{} = {}\n".format(*point))
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(folder))
        yield folder
    for name in [name for name in sys.modules if name.partition(".")[0] == "my_policy"]:
        del sys.modules[name]


@pytest.fixture(scope="module")
def run(page: str, package: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder in which the page's commands have been run."""
    folder = tmp_path_factory.mktemp("run")
    (commands,) = re.findall(r"```bash\n(python bin/Rollout.*?)```", page, re.DOTALL)
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        for command in commands.splitlines():
            program, *args = command.removeprefix("python bin/").split()
            more = next(text for word, text in SHORT.items() if word in command).split()
            main = {"Train.py": train_command.main, "Rollout.py": rollout_command.main}[program]
            assert not main([*args, *more])
    return folder


def test_an_installed_policy_is_found(package: Path) -> None:
    assert policy_names()[-1] == "MyFlow"
    assert policy_entry("MyFlow").normalization == "min_max"


def test_help_lists_the_options_of_an_installed_policy(
    package: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit):
        train_command.parse_config(["MyFlow", "--help"])
    assert "--integration_steps" in capsys.readouterr().out


@pytest.mark.parametrize("value", ["my_policy:NOTHING", "nowhere:ENTRY", "my_policy:PolicyEntry"])
def test_an_entry_point_that_leads_nowhere_is_one_line(
    package: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, value: str
) -> None:
    info = tmp_path / "broken-1.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: broken\nVersion: 1\n")
    (info / "entry_points.txt").write_text(f"[{ENTRY_POINT_GROUP}]\nBroken = {value}\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    with pytest.raises(RequestError, match=f"policy 'Broken': .*{value}"):
        policy_entry("Broken")


def test_the_table_names_members_of_the_interface(page: str) -> None:
    members = re.findall(r"^\| `(\w+)", page, flags=re.MULTILINE)
    assert {"n_obs_steps", "sample_noise_size", "loss", "predict"} <= set(members)
    assert all(
        hasattr(PolicyModel, name) or name in PolicyModel.__annotations__ for name in members
    )


@pytest.mark.long
def test_the_pages_commands_train_and_evaluate(run: Path) -> None:
    checkpoint = read_checkpoint(run / "runs/flow")
    assert (checkpoint.policy, checkpoint.step) == ("MyFlow", 20)
    assert (run / "results/flow/results.jsonl").read_text().count("\n") == 1
    given = load_demonstrations(run / "dataset/flow", checkpoint.spec)
    rows = given.rows(given.indices(checkpoint.split.train))
    scaled = checkpoint.normalization.normalize_action(given.action[rows])
    # The range, but for elements that hardly move; two roundings of float32.
    assert np.abs(scaled).max() == pytest.approx(1.0, abs=1e-5)


@pytest.mark.long
def test_sampled_actions_do_not_depend_on_environments_and_workers(run: Path) -> None:
    checkpoint = read_checkpoint(run / "runs/flow")
    config = EnvConfig(checkpoint.env, checkpoint.spec, {"max_episode_steps": 25})
    seeds, played = [1003, 1000, 1001], {}
    for num_envs in (1, 3):
        for workers in (0, 2):
            policy = PolicyRunner(
                load_model(checkpoint),
                checkpoint.spec,
                checkpoint.normalization,
                checkpoint.execution,
                num_envs=num_envs,
            )
            torch.rand(1)  # the global generator is not used
            recorded: dict[int, Recording] = {}

            def keep(
                result: EpisodeResult, recording: Recording, kept: dict[int, Recording] = recorded
            ) -> None:
                kept[result.seed] = recording

            with open_envs(config, num_envs, workers) as envs:
                results = rollout(policy, envs, seeds, on_episode=keep)
            played[num_envs, workers] = results, recorded
    results, recordings = played[1, 0]
    for other_results, other in played.values():
        assert other_results == results
        for seed in seeds:
            np.testing.assert_array_equal(other[seed].actions, recordings[seed].actions)
    assert len({recording.actions[0].tobytes() for recording in recordings.values()}) == 3
