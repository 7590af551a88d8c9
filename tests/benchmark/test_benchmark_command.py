"""``bin/Benchmark.py`` from outside: what it refuses, what it says, what it leaves."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from robo_manip_baselines.benchmark.conditions import CONDITIONS
from robo_manip_baselines.benchmark.plan import PRESETS
from robo_manip_baselines.benchmark.work_item import ArtifactStore
from robo_manip_baselines.commands import benchmark as command
from robo_manip_baselines.commands.benchmark import (
    EXAMPLE,
    BenchmarkOptions,
    benchmark,
    parse_options,
    plan_of,
)
from robo_manip_baselines.envs.mujoco.face.motion import DEFAULT_LIBRARY, PREDICTION
from robo_manip_baselines.runs.errors import RequestError
from robo_manip_baselines.runs.versions import source_digest
from robo_manip_baselines.training import device as device_module

from .conftest import CONDITIONS as STUB_CONDITIONS
from .conftest import PRESET, contents


def options(line: str) -> BenchmarkOptions:
    return parse_options(line.split())


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("feding", "did you mean 'feeding'"),
        ("feeding --preset gpu", "cpu, cpu_images, paper, smoke"),
        ("feeding --executor slurm", "local, ray"),
        ("feeding --shard 3/2", "i from 1 to n"),
        ("feeding --shard 0/2", "i from 1 to n"),
        ("feeding --shard half", "'half'"),
        ("feeding --num_workers 0", "num_workers 0: must be 1 to"),
        ("feeding --num_episodes 0", "num_episodes 0: must be 1 to"),
        ("feeding --train_seeds 0", "train_seeds 0: must be 1 to"),
        ("feeding --executor ray --num_workers 2", "--executor local"),
        ("feeding --address auto", "--executor ray"),
        ("feeding --demonstrations 0", "demonstrations 0: must be 1 to"),
        ("feeding --device tpu", "cpu, cuda"),
        ("feeding --train_settings steps", "must be NAME=VALUE"),
    ],
)
def test_a_wrong_option_is_refused_in_one_line(line: str, words: str) -> None:
    with pytest.raises(RequestError) as refused:
        options(line)
    assert words in str(refused.value)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("feeding --conditions current,curent_pred_h2", "did you mean 'current_pred_h2'"),
        ("feeding --preset smoke --motion_library none.npz", "none.npz"),
        ("feeding --preset smoke --error_stats none.json", "none.json"),
        ("feeding --preset smoke --reference curent", "did you mean 'current'"),
        ("feeding --conditions_file none.yaml", "none.yaml"),
        ("feeding --preset smoke --train_settings step=3", "did you mean 'steps'"),
        ("feeding --preset smoke --train_settings steps=-3", "steps"),
    ],
)
def test_a_wrong_plan_is_refused_before_anything_is_written(
    line: str, words: str, tmp_path: Path
) -> None:
    with pytest.raises(RequestError, match=words):
        benchmark(options(f"{line} --out {tmp_path / 'out'}"))
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("has_shard", [False, True])
def test_a_preset_for_a_gpu_is_refused_where_there_is_none(
    has_shard: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import torch

    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    line = "feeding --preset paper" + " --shard 1/2" * has_shard
    with pytest.raises(RequestError, match="a CUDA device is needed"):
        benchmark(options(f"{line} --out {tmp_path / 'out'}"))
    assert not (tmp_path / "out").exists()


def test_size_is_that_of_the_options() -> None:
    line = "feeding --preset paper --demonstrations 3 --num_episodes 2 --device cpu"
    given = options(f"{line} --train_settings steps=7 hidden_size=64 --conditions baseline")
    plan = plan_of(given)
    (run,) = plan.runs
    config = run.training.settings["config"]
    assert [config[name] for name in ("steps", "epochs", "hidden_size")] == [7, None, 64]
    assert [config["device"], config["preset"]] == ["cpu", "paper"]
    assert sum(len(range(*item.settings["config"]["seeds"])) for item in run.training.needs) == 3
    assert sum(len(range(*item.settings["config"]["seeds"])) for item in run.evaluations) == 2
    default = plan_of(options("feeding --preset paper --conditions baseline")).runs[0].training
    assert [default.settings["config"][name] for name in ("steps", "epochs")] == [None, 2000]


def test_conditions_are_chosen_by_name_and_from_a_file(tmp_path: Path) -> None:
    def names(line: str) -> list[str]:
        return [c.name for c in plan_of(options(line)).conditions]

    assert names("feeding --preset smoke") == [
        "current",
        "current_pred_h2",
        "current_pred_h2_uniform",
    ]
    assert names("feeding --conditions baseline current") == ["baseline", "current"]
    assert names("delay --preset smoke") == names("delay --preset paper") == names("delay")
    assert names("feeding --conditions current,baseline") == ["baseline", "current"]
    mine = tmp_path / "mine.yaml"
    mine.write_text("conditions: [{name: a}, {name: b, delay: 3}]")
    assert names(f"mine --preset smoke --conditions_file {mine}") == ["a", "b"]
    assert names(f"mine --preset smoke --conditions_file {mine} --conditions b") == ["b"]
    with pytest.raises(RequestError, match="'b': is a condition; the benchmark's name comes first"):
        names(f"--conditions_file {mine} --conditions a b")


def test_a_condition_that_cannot_be_had_is_left_out_unless_it_is_named(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    bare = tmp_path / "bare.npz"
    with np.load(DEFAULT_LIBRARY) as archive:
        np.savez(bare, **{k: archive[k] for k in archive.files if k != PREDICTION})
    plan = plan_of(options(f"feeding --motion_library {bare}"))
    assert len(plan.conditions) == 15
    assert "left out: condition 'current_pred_h2_model'" in caplog.text
    with pytest.raises(RequestError, match="no predicted mouth"):
        plan_of(options(f"feeding --conditions current_pred_h2_model --motion_library {bare}"))
    assert len(plan_of(options(f"feeding --motion_library {DEFAULT_LIBRARY}")).conditions) == 16
    late = plan_of(options(f"foresight_policies --motion_library {bare}")).conditions
    assert len(late) == 35  # others than `residual` of the library


def test_a_budget_takes_the_place_of_another_one_and_a_device_of_its_share() -> None:
    given = options("feeding --preset smoke --train_settings epochs=5").size.train_settings
    assert given == {"hidden_size": 64, "feedforward_size": 128, "epochs": 5}
    training = plan_of(options("foresight_policies --train_settings epochs=5")).runs[0].training
    assert training
    assert [training.settings["config"][name] for name in ("steps", "epochs")] == [None, 5]
    assert options("feeding --preset paper").size.gpu_share == 0.125
    assert options("feeding --preset paper --device cpu").size.gpu_share == 0.0
    assert options("feeding --preset cpu --device cuda").size.gpu_share == 1.0


def test_the_precision_of_images_is_decided_once_for_all_nodes(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    for is_fast, precision in ((True, "bf16"), (False, "fp32")):
        monkeypatch.setattr(device_module, "_has_fast_bf16", lambda is_fast=is_fast: is_fast)
        plan = plan_of(options("feeding --preset cpu_images --conditions current"))
        training = plan.runs[0].training
        assert training
        assert training.settings["config"]["precision"] == precision
    without_images = plan_of(options("feeding --conditions current")).runs[0].training
    assert without_images
    assert without_images.settings["config"]["precision"] == "auto"


def test_a_file_may_have_other_numbers_than_the_preset(tmp_path: Path) -> None:
    size = plan_of(options("foresight_policies")).preset
    assert (size.demonstrations, size.train_seeds, size.num_episodes) == (400, 3, 100)
    assert size.train_settings == {"steps": 4000, "object_noise": 0.05}
    given = "foresight_policies --train_seeds 2 --train_settings steps=2000"
    size = plan_of(options(given)).preset
    assert (size.demonstrations, size.train_seeds) == (400, 2)
    assert size.train_settings == {"steps": 2000, "object_noise": 0.05}
    small = plan_of(options("foresight_policies --preset smoke"))
    assert small.preset == PRESETS["smoke"]
    mine = tmp_path / "mine.yaml"
    for text, problem in (
        ("cpu: {train_settings: {speed: 3}}", "training setting 'speed'"),
        ("cpu: {train_seeds: 0}", "train_seeds"),
        ("huge: {train_seeds: 2}", "preset in .*huge"),
    ):
        mine.write_text(f"sizes: {{{text}}}\nconditions: [{{name: a}}]")
        with pytest.raises(RequestError, match=problem):
            plan_of(options(f"mine --conditions_file {mine}"))


def test_a_dry_run_counts_and_writes_nothing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    line = f"feeding --preset smoke --train_seeds 2 --num_episodes 6 --out {out} --dry_run"
    assert benchmark(options(line)) == 0
    said = capsys.readouterr().out
    assert re.search(r"demonstrations +2 of 2 items", said)
    assert re.search(r"training +6 of 6 items", said)
    assert re.search(r"evaluation +12 of 12 items", said)  # 4 and 2 episodes
    assert not out.exists()


@pytest.fixture
def stub_command(stub: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> BenchmarkOptions:
    """A command whose preset and conditions are the stub's."""
    from robo_manip_baselines.commands import benchmark as options_module

    conditions = tmp_path / "stub.yaml"
    conditions.write_text(
        "conditions:\n- {name: current, obs: current}\n"
        "- {name: late, delay: 3, title: 'Prediction, late'}\n"
        "- {name: ahead, expert: anticipatory}\n"
    )
    monkeypatch.setitem(options_module.PRESETS, "smoke", PRESET)
    monkeypatch.setattr(command.sys, "argv", ["bin/Benchmark.py", "stub", "it's"])
    return options(f"stub --preset smoke --conditions_file {conditions} --out {tmp_path / 'out'}")


@pytest.mark.long
def test_shards_and_then_a_call_without_come_to_the_same(
    stub_command: BenchmarkOptions,
    reference: dict[str, bytes],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    out = tmp_path / "out"
    for part in ("1/2", "2/2"):
        assert benchmark(replace(stub_command, shard=part)) == 0
        assert set(contents(out)) == set()
    plan = plan_of(stub_command)
    store = ArtifactStore(out / "items")
    assert all(store.is_done(item) for item in plan.items())
    written = {item.key: store.manifest(item) for item in plan.items()}
    (out / "tables").mkdir()
    (out / "tables" / "old.md").write_text("of an earlier benchmark")
    (out / "tables" / "notes.md").write_text("of the user")
    (out / "configs.json").write_text(json.dumps({"files": ["tables/old.md", "../x"]}))
    assert benchmark(stub_command) == 0
    (out / "tables" / "notes.md").unlink()
    assert written == {
        item.key: store.manifest(item) for item in plan.items()
    }  # nothing done twice
    told = capsys.readouterr().out
    assert "Prediction, late" in told
    assert str(out / "report.html") in told
    found = contents(out)
    assert json.loads(found.pop("configs.json"))["command"] == (
        "python bin/Benchmark.py stub 'it'\"'\"'s'"
    )
    assert b"bin/Benchmark.py stub" in found.pop("report.html")
    assert found == {name: reference[name] for name in found}
    assert len(found) == len(reference) - 2
    assert [c.name for c in plan.conditions] == [c.name for c in STUB_CONDITIONS]


@pytest.fixture
def done(stub_command: BenchmarkOptions, reference_folder: Path) -> Path:
    """The folder of the command, with all items done."""
    shutil.copytree(reference_folder / "items", stub_command.folder / "items")
    return stub_command.folder


@pytest.mark.long
def test_the_reference_is_chosen_without_doing_anything_again(
    stub_command: BenchmarkOptions,
    reference: dict[str, bytes],
    done: Path,
    caplog: pytest.LogCaptureFixture,
) -> None:
    assert benchmark(replace(stub_command, reference="late")) == 0
    table = (done / "tables" / "success_differences.md").read_text()
    assert "Success against “Prediction, late”" in table
    assert b"Success against \xe2\x80\x9cCurrent only" in reference["tables/success_differences.md"]
    assert "other code" not in caplog.text


@pytest.mark.long
def test_a_dry_run_adds_up_what_is_done(
    stub_command: BenchmarkOptions, done: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for note in (done / "items" / "training").glob("*/item.json"):
        note.write_text(re.sub(r'"seconds": [\d.]+', '"seconds": 3600.0', note.read_text()))
    assert benchmark(replace(stub_command, dry_run=True)) == 0
    said = capsys.readouterr().out
    assert re.search(r"training +0 of 3 items", said)
    assert re.search(r"done +3 h 0\d min of work", said)


@pytest.mark.long
def test_items_of_other_code_are_used_and_said_to_be(
    stub_command: BenchmarkOptions, done: Path, caplog: pytest.LogCaptureFixture
) -> None:
    note = next((done / "items" / "training").glob("*/item.json"))
    note.write_text(note.read_text().replace(source_digest(), "ab" * 32))
    assert benchmark(stub_command) == 0
    assert "1 of 13 work items were done by other code of the package" in caplog.text
    assert str(done / "items") in caplog.text


@pytest.mark.long
def test_the_exit_code_says_that_items_failed(
    stub_command: BenchmarkOptions, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("STUB_FAIL", "delay")
    assert benchmark(stub_command) == 1
    assert contents(tmp_path / "out") == {}
    monkeypatch.delenv("STUB_FAIL")
    assert benchmark(stub_command) == 0
    assert "report.html" in contents(tmp_path / "out")


def page_of_help() -> str:
    script = Path(__file__).parents[2] / "bin" / "Benchmark.py"
    return subprocess.run(
        [sys.executable, str(script), "--help"],
        capture_output=True,
        text=True,
        env={**os.environ, "MUJOCO_GL": "disabled"},
        check=True,
    ).stdout


def test_help_names_the_options_and_an_example() -> None:
    page = page_of_help()
    for name in ("--preset", "--conditions_file", "--shard", "--executor", "--dry_run", EXAMPLE):
        assert name in page


def test_the_conditions_ship_with_the_package() -> None:
    assert {path.name for path in CONDITIONS.glob("*.yaml")} == {
        "bimanual_feeding.yaml",
        "delay.yaml",
        "demo.yaml",
        "drinking.yaml",
        "feeding.yaml",
        "foresight_horizons.yaml",
        "foresight_policies.yaml",
        "wiping.yaml",
    }


def test_options_of_an_earlier_release_are_read_with_a_note(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level("INFO")
    assert options("feeding --arms baseline current").conditions == ("baseline", "current")
    assert caplog.text.count("are called --conditions") == 1
    mine = tmp_path / "mine.yaml"
    for line in (f"x --arms_file {mine}", f"x --arms-file={mine} --arms=a"):
        assert options(line).conditions_file == mine
    assert "--arms" not in page_of_help()


def test_a_folder_of_an_earlier_release_is_left_alone(tmp_path: Path) -> None:
    (tmp_path / "units").mkdir()
    with pytest.raises(RequestError, match=r"earlier release.*another --out"):
        benchmark(options(f"feeding --preset smoke --out {tmp_path}"))
    assert [path.name for path in tmp_path.iterdir()] == ["units"]


def test_a_preset_that_does_not_exist_is_refused_in_a_file(tmp_path: Path) -> None:
    mine = tmp_path / "mine.yaml"
    mine.write_text("presets: {smok: [a]}\nconditions: [{name: a}]")
    with pytest.raises(RequestError, match=r"mine\.yaml.*did you mean 'smoke'"):
        plan_of(options(f"mine --conditions_file {mine}"))
