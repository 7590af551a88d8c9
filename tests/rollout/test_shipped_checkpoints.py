"""Contract of the checkpoints that come with the package: they act, and say how they were made."""

from __future__ import annotations

import json
import shlex
import shutil
from collections.abc import Callable
from datetime import date
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from robo_manip_baselines.commands.rollout import parse_options, to_collection
from robo_manip_baselines.commands.train import parse_config
from robo_manip_baselines.policy import checkpoint as checkpoint_module
from robo_manip_baselines.policy.checkpoint import (
    ACTING_FILES,
    ORIGIN,
    SHIPPED,
    load_model,
    read_checkpoint,
    read_origin,
    shipped_checkpoints,
)
from robo_manip_baselines.rollout.evaluation import EvaluationConfig, EvaluationPlan, evaluate
from robo_manip_baselines.rollout.results import read_results
from robo_manip_baselines.runs.checkpoints import MANIFEST, read_manifest
from robo_manip_baselines.runs.errors import RequestError
from robo_manip_baselines.runs.files import file_digest

NAMES = ("baseline", "current", "forecast")


@pytest.fixture(scope="module")
def maker(load_script: Callable[[str], ModuleType]) -> ModuleType:
    """The command that made them."""
    return load_script("benchmarks/shipped_checkpoints.py")


def test_their_names() -> None:
    assert tuple(shipped_checkpoints()) == NAMES


@pytest.mark.parametrize("name", NAMES)
def test_a_folder_holds_what_acting_needs_and_no_more(name: str, maker: ModuleType) -> None:
    folder = SHIPPED / name
    assert {path.name for path in folder.iterdir()} == {MANIFEST, ORIGIN, *ACTING_FILES}
    assert sum(path.stat().st_size for path in folder.iterdir()) < maker.MAX_BYTES == 3_000_000
    digests = read_manifest(folder)
    assert all(file_digest(folder / file) == digest for file, digest in digests.items())
    assert digests.keys() == {ORIGIN, *ACTING_FILES}


@pytest.mark.parametrize("name", NAMES)
def test_its_origin_makes_it_again(name: str, maker: ModuleType) -> None:
    """The recorded commands have the settings that the checkpoint itself holds."""
    checkpoint = read_checkpoint(f"shipped:{name}")
    origin = read_origin(checkpoint)
    assert origin.demonstrations == checkpoint.dataset.get("content_hash")
    assert "/" not in checkpoint.dataset.get("folder", "")  # no place on the machine that made it
    assert origin.package_version == checkpoint.versions["robo_manip_baselines"]
    assert date.fromisoformat(origin.date) >= date(2025, 1, 1)
    recording, training = map(shlex.split, origin.commands)
    assert recording[:2] == ["python", "bin/Rollout.py"]
    collection = to_collection(parse_options(recording[2:])[0])
    kwargs = {k: v for k, v in collection.env_kwargs.items() if k not in ("cameras", "image_size")}
    assert kwargs == checkpoint.dataset.get("env_kwargs")
    assert len(collection.seeds) == checkpoint.dataset.get("episodes")
    assert collection.expert == maker.DEMONSTRATIONS["expert"]
    assert training[:2] == ["python", "bin/Train.py"]
    config = parse_config(training[2:])
    assert (config.policy, config.seed) == (checkpoint.policy, checkpoint.train_seed)
    assert config.network == checkpoint.config
    assert config.training == checkpoint.settings
    assert config.spec == checkpoint.spec


@pytest.mark.parametrize("name", NAMES)
def test_it_observes_what_its_name_says(name: str, maker: ModuleType) -> None:
    spec = read_checkpoint(f"shipped:{name}").spec
    wanted = maker.POLICIES[name]
    found = {"delay": spec.corruption.delay, **vars(spec)}
    assert {key: found[key] for key in wanted} == wanted
    assert (spec.cameras, spec.object_pose, spec.corruption.error) == ((), True, "none")


@pytest.mark.long
@pytest.mark.parametrize("name", NAMES)
def test_it_acts(name: str, tmp_path: Path) -> None:
    kwargs = {"max_episode_steps": 20}
    checkpoint = Path(f"shipped:{name}")
    config = EvaluationConfig(checkpoint, range(1000, 1001), tmp_path, kwargs, workers=0)
    plan, summary, _ = evaluate(config)
    assert summary.episodes == 1
    (result,) = read_results(tmp_path)
    assert result.checkpoint == read_checkpoint(checkpoint).content_hash
    assert result.motion == "dyskinetic"
    assert plan.env.env_kwargs["people"] == "test"
    weights = load_model(plan.checkpoint).state_dict().values()
    assert all(np.isfinite(tensor.numpy()).all() for tensor in weights)


def test_results_go_to_a_folder_of_its_name() -> None:
    plan = EvaluationPlan.of(EvaluationConfig(Path("shipped:current"), range(1000, 1001)))
    assert plan.out == Path("results/FeedingEnv_shipped_current")


@pytest.mark.parametrize("name", ["curent", "", "../shipped/current", "current/"])
def test_other_names_are_refused_with_the_valid_ones(name: str) -> None:
    with pytest.raises(RequestError, match="baseline, current, forecast") as refused:
        read_checkpoint(f"shipped:{name}")
    assert "\n" not in str(refused.value)


def test_a_command_line_names_one() -> None:
    line = "FeedingEnv --policy Act --checkpoint shipped:current"
    options, checkpoint = parse_options(line.split())
    assert checkpoint is not None
    assert checkpoint.spec == options.spec
    with pytest.raises(RequestError, match="did you mean 'current'"):
        parse_options(line.replace("current", "curent").split())


def test_one_of_another_model_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = tmp_path / "current"
    shutil.copytree(SHIPPED / "current", folder)
    for file, changes in (
        ("config.json", {"xml_hash": "0" * 64}),
        (MANIFEST, {"sha256": {**read_manifest(folder)}}),
    ):
        content = {**json.loads((folder / file).read_text()), **changes}
        if file == MANIFEST:
            content["sha256"]["config.json"] = file_digest(folder / "config.json")
        (folder / file).write_text(json.dumps(content))
    monkeypatch.setattr(checkpoint_module, "SHIPPED", tmp_path)
    with pytest.raises(RequestError, match="was trained with model hash 000000000000"):
        EvaluationPlan.of(EvaluationConfig(Path("shipped:current"), range(1000, 1001)))


def test_a_run_is_shipped_as_it_is(
    tmp_path: Path, maker: ModuleType, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its hash stays, so that results of the run are results of the shipped checkpoint."""
    run = tmp_path / "run"
    shutil.copytree(SHIPPED / "current", run / "checkpoints/step_00000050")
    (run / "config.yaml").write_text(f"policy: Act\ndataset: {tmp_path}\nobs: current\ndelay: 4\n")
    summary = {
        "expert": "servo",
        "env_kwargs": {"motion": "dyskinetic", "cameras": []},
        "first_seed": 0,
        "episodes": 400,
    }
    (tmp_path / "summary.json").write_text(json.dumps(summary))
    for _ in range(2):  # an earlier one is replaced
        made = maker.ship(run, tmp_path / "shipped/current")
    assert made.content_hash == read_checkpoint("shipped:current").content_hash
    assert read_origin(made).commands == (
        "python bin/Rollout.py FeedingEnv --scripted --expert servo --motion dyskinetic "
        "--cameras none --seed 0 --num_episodes 400",
        "python bin/Train.py Act --preset cpu --obs current --delay 4",
    )
    monkeypatch.setattr(maker, "MAX_BYTES", 1000)
    with pytest.raises(RequestError, match="more than 1000; train a smaller network"):
        maker.ship(run, tmp_path / "shipped/current")


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"names": ("curent",)}, "did you mean 'current'"),
        ({"given": ("current",)}, "must be NAME=RUN"),
        ({"names": ("current",), "given": ("forecast=x",)}, "valid: current"),
    ],
)
def test_wrong_requests_to_the_maker(given: dict, message: str, maker: ModuleType) -> None:
    with pytest.raises(RequestError, match=message):
        _ = maker.Options(**given).runs
