"""Run folders: their options, their lock and their checkpoints; the configuration in JSON."""

from __future__ import annotations

import dataclasses
import json
import multiprocessing
from pathlib import Path
from typing import Any

import pytest
import yaml

from robo_manip_baselines.observation import Corruption
from robo_manip_baselines.policy.mlp.config import MlpConfig
from robo_manip_baselines.policy.registry import policy_names, policy_presets
from robo_manip_baselines.runs.checkpoints import list_checkpoints, prune_checkpoints, step_folder
from robo_manip_baselines.runs.errors import RequestError
from robo_manip_baselines.runs.files import locked
from robo_manip_baselines.training.config import (
    TrainConfig,
    read_config,
    require_same_config,
    write_config,
)

MLP = TrainConfig.from_preset("Mlp", "cpu", seed=1)


def changed(config: TrainConfig[Any], part: str, **changes: Any) -> TrainConfig[Any]:
    value = dataclasses.replace(getattr(config, part), **changes)
    return dataclasses.replace(config, **{part: value})


@pytest.mark.parametrize("policy", policy_names())
def test_json_keeps_everything(policy: str) -> None:
    for preset in policy_presets(policy):
        config = TrainConfig.from_preset(policy, preset)
        config = changed(config, "training", learning_rate=3e-5, epochs=7, steps=None)
        corruption = Corruption("uniform", delay=2, face_dropout=0.1, seed=3)
        config = changed(
            config, "spec", horizon=4, image_size=(30, 40), corruption=corruption, cameras=("top",)
        )
        config = dataclasses.replace(config, dataset=Path("a/b"), out=Path("c"), num_episodes=3)
        text = json.dumps(config.to_json(), allow_nan=False)
        assert TrainConfig.from_json(json.loads(text)) == config
        assert TrainConfig.from_json(yaml.safe_load(yaml.safe_dump(config.to_json()))) == config


def test_the_previous_releases_files_read_as_the_same_configuration() -> None:
    """They name every option of the corruption, null where it was not given."""
    values = MLP.to_json()
    assert values["error"] == "none"
    older = {name: value for name, value in values.items() if name not in ("out", "delay")}
    assert TrainConfig.from_json(older) == MLP
    given = {"error": "uniform", "delay": 0, "face_dropout_length": 4.0, "corruption_seed": None}
    read = TrainConfig.from_json({**older, **given}).spec.corruption
    assert read == Corruption("uniform", face_dropout_length=4.0)
    off = TrainConfig.from_json({**older, **given, "corruption": False})
    assert not off.spec.corruption
    assert TrainConfig.from_json({**older, "cameras": ["none"]}) == MLP


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"policy": "Mpl"}, "unknown policy 'Mpl' .*'Mlp'"),
        ({"policy": "Mlp", "preset": "paper"}, "unknown preset 'paper'"),
        ({"policy": "Mlp", "chunk_siez": 3}, "unknown option 'chunk_siez' .*'chunk_size'"),
        ({"policy": "Mlp", "steps": 0}, "steps 0: must be 1 or more"),
        ({"policy": "Mlp", "env": "Feeding"}, "unknown environment 'Feeding'"),
        ({"policy": "Mlp", "error": "some"}, "unknown error model 'some'"),
    ],
)
def test_wrong_values_are_named(values: dict[str, Any], message: str) -> None:
    with pytest.raises(RequestError, match=message):
        TrainConfig.from_json(values)


def test_config_reads_back(tmp_path: Path) -> None:
    write_config(tmp_path, dataclasses.replace(MLP, out=tmp_path, dataset=Path("ü: x")))
    values = read_config(tmp_path / "config.yaml")
    assert "out" not in values  # the folder may be moved
    assert TrainConfig.from_json(values) == dataclasses.replace(MLP, dataset=Path("ü: x"))


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (changed(MLP, "training", steps=6), "with steps 6000, not 6"),
        (dataclasses.replace(MLP, seed=2), "with seed 1, not 2"),
        (changed(MLP, "network", dropout=0.5), r"with dropout 0\.0, not 0\.5"),
        (changed(MLP, "spec", arms="both"), "with arms right, not both"),
    ],
)
def test_the_first_difference_is_named(
    tmp_path: Path, given: TrainConfig[MlpConfig], message: str
) -> None:
    write_config(tmp_path, MLP)
    with pytest.raises(RequestError, match=message):
        require_same_config(tmp_path, given)


def test_runtime_options_may_differ(tmp_path: Path) -> None:
    write_config(tmp_path, dataclasses.replace(MLP, device="cuda"))
    require_same_config(
        tmp_path, dataclasses.replace(MLP, device="cpu", log_every=3, dataset=Path("moved"))
    )


def test_two_newest_checkpoints_are_kept(tmp_path: Path) -> None:
    for step in (5, 100, 20, 7):
        step_folder(tmp_path, step).mkdir(parents=True)
    prune_checkpoints(tmp_path, 2)
    assert [step for step, _ in list_checkpoints(tmp_path)] == [20, 100]
    assert len(list((tmp_path / "checkpoints").iterdir())) == 2


def try_to_lock(run: str, answer: multiprocessing.SimpleQueue) -> None:
    try:
        with locked(Path(run)):
            answer.put("locked")
    except RequestError as error:
        answer.put(str(error))


@pytest.mark.long
def test_two_processes_do_not_write_to_one_folder(tmp_path: Path) -> None:
    context = multiprocessing.get_context("spawn")
    answer = context.SimpleQueue()
    answers = []
    with locked(tmp_path):
        process = context.Process(target=try_to_lock, args=(str(tmp_path), answer))
        process.start()
        answers.append(answer.get())
        process.join()
    try_to_lock(str(tmp_path), answer)
    answers.append(answer.get())
    assert "being written by another process; choose another --out" in answers[0]
    assert answers[1] == "locked"


def test_a_file_in_the_way_is_one_line(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(RequestError, match="cannot write to"), locked(tmp_path / "file"):
        pass
