"""``bin/Rollout.py --policy`` as a user runs it."""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from robo_manip_baselines.commands.rollout import main, parse_options, to_evaluation
from robo_manip_baselines.envs.mujoco.face.motion import (
    DEFAULT_LIBRARY,
    LIBRARY_FILE,
    MotionLibrary,
    pin_library,
    read_library,
)
from robo_manip_baselines.observation import Corruption, ObservationSpec
from robo_manip_baselines.observation.error_stats import DEFAULT_STATS, load_error_stats
from robo_manip_baselines.policy.checkpoint import Checkpoint
from robo_manip_baselines.policy.execution import PolicyRunner
from robo_manip_baselines.policy.presets import ActionExecution
from robo_manip_baselines.rollout.evaluation import (
    EvaluationConfig,
    EvaluationPlan,
    choose_execution,
    evaluate,
    run_name,
)
from robo_manip_baselines.rollout.results import open_results, read_results
from robo_manip_baselines.runs.errors import RequestError
from robo_manip_baselines.runs.files import locked
from robo_manip_baselines.runs.npz import write_npz

pytestmark = pytest.mark.long

ROOT = Path(__file__).resolve().parents[2]
ROLLOUT = [sys.executable, str(ROOT / "bin" / "Rollout.py")]

MakeCheckpoint = Callable[..., Checkpoint]


@pytest.fixture(scope="module")
def run_folder(make_checkpoint: MakeCheckpoint, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run with one checkpoint."""
    run = tmp_path_factory.mktemp("runs") / "mlp_run"
    make_checkpoint(run / "checkpoints" / "step_00000005")
    return run


def command_line(run: Path, text: str = "", out: Path | None = None) -> list[str]:
    words = f"FeedingEnv --policy Mlp --checkpoint {run} --workers 0 --num_episodes 3 {text}"
    return [*words.split(), *([] if out is None else ["--out", str(out)])]


def config(run: Path, text: str = "", out: Path | None = None) -> EvaluationConfig:
    return to_evaluation(*parse_options(command_line(run, text, out)))


def test_evaluates_and_carries_on(
    run_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    once, pieces = tmp_path / "once", tmp_path / "pieces"
    main(command_line(run_folder, out=once))
    table = capsys.readouterr().out
    assert re.search(r"^success +0/3  0\.0% \(95 % interval 0\.0% to 56\.1%\)$", table, re.M)
    assert re.search(r"^failures +never_grasped 3$", table, re.M)
    results = read_results(once)
    assert [result.seed for result in results] == [1000, 1001, 1002]
    assert {(r.policy, r.condition, r.train_seed, r.steps) for r in results} == {
        ("Mlp", "current_pred_h2", 3, 30)
    }
    assert all(len(result.checkpoint) == 64 and result.versions["torch"] for result in results)
    summary = json.loads((once / "summary.json").read_text())
    assert (summary["episodes"], summary["failures"]["never_grasped"]) == (3, 3)

    evaluate(config(run_folder, "--seed 1001 --num_episodes 1 --num_envs 1", out=pieces))
    kept = (pieces / "results.jsonl").read_text()
    evaluate(config(run_folder, "--num_envs 3 --workers 1", out=pieces))
    assert (pieces / "results.jsonl").read_bytes() == (once / "results.jsonl").read_bytes()
    assert kept in (pieces / "results.jsonl").read_text()
    assert json.loads((pieces / "summary.json").read_text())["episodes"] == 3
    # Nothing left to do: the same table, nothing rewritten differently.
    capsys.readouterr()
    main(command_line(run_folder, out=pieces))
    assert re.search(r"^speed +-$", capsys.readouterr().out, re.M)


def test_what_a_killed_run_left_is_removed(run_folder: Path, tmp_path: Path) -> None:
    gone = 2**22 + 1  # no process has such a number
    videos = tmp_path / "videos"
    videos.mkdir()
    left = [
        tmp_path / f".results.jsonl.{gone}.partial",
        videos / f".seed_001000.mp4.{gone}.partial",
    ]
    for path in left:
        path.touch()
    settings = EvaluationPlan.of(config(run_folder, out=tmp_path)).settings
    with open_results(tmp_path, settings, {}):
        pass
    evaluate(config(run_folder, "--num_episodes 1", out=tmp_path))
    assert not [path for path in left if path.exists()]


def test_the_summary_is_of_the_whole_folder(run_folder: Path, tmp_path: Path) -> None:
    evaluate(config(run_folder, "--seed 1002 --num_episodes 2", out=tmp_path))
    _, last, _ = evaluate(config(run_folder, "--seed 1000 --num_episodes 1", out=tmp_path))
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert last.episodes == summary["episodes"] == len(read_results(tmp_path)) == 3
    assert summary["first_seed"] == 1000
    assert summary["failed_seeds"] == [1000, 1002, 1003]
    assert summary["episodes_per_second"] == pytest.approx(1 / summary["seconds"])


def copied_library(path: Path, scale: float = 1.0) -> Path:
    """Write the shipped motion library with mouth positions scaled."""
    kind = {"schema": np.array(LIBRARY_FILE.schema), "version": np.array(LIBRARY_FILE.version)}
    arrays = read_library(DEFAULT_LIBRARY)
    write_npz(path, {**kind, **arrays, "mouth": arrays["mouth"] * np.float32(scale)})
    return path


def test_a_motion_library_is_known_by_its_content(
    make_checkpoint: MakeCheckpoint, run_folder: Path, tmp_path: Path
) -> None:
    shipped, moved = tmp_path / "shipped", tmp_path / "moved"
    one = "--num_episodes 1 --num_envs 1"
    evaluate(config(run_folder, one, out=shipped))
    # The same motion in another file is the same motion; other motion in the same file is not.
    library = copied_library(tmp_path / "a.npz")
    evaluate(config(run_folder, f"{one} --motion_library {library}", out=shipped))
    copied_library(library, 1.01)
    with pytest.raises(RequestError, match="holds results with env_kwargs"):
        evaluate(config(run_folder, f"{one} --motion_library {library}", out=shipped))
    evaluate(config(run_folder, f"{one} --motion_library {library}", out=moved))
    rows = [
        (read_results(folder)[0].settings or {})["motion_sha256"] for folder in (shipped, moved)
    ]
    assert rows == [MotionLibrary.load().motion_sha256, MotionLibrary.load(library).motion_sha256]
    assert rows[0] != rows[1]
    # A policy goes on with the library of its demonstrations, and with no other in its place.
    kwargs = pin_library({"max_episode_steps": 30, "motion_library": str(library)})
    run = tmp_path / "run"
    make_checkpoint(run / "checkpoints" / "step_00000005", dataset={"env_kwargs": kwargs})
    EvaluationPlan.of(config(run, one))
    copied_library(library, 1.02)
    with pytest.raises(RequestError, match="holds other motion than what was used before"):
        EvaluationPlan.of(config(run, one))
    EvaluationPlan.of(config(run, f"{one} --motion_library {library}"))


def test_results_of_another_execution_are_not_mixed(run_folder: Path, tmp_path: Path) -> None:
    evaluate(config(run_folder, "--num_episodes 1 --execute 3", out=tmp_path))
    with pytest.raises(RequestError, match="holds results with acting"):
        evaluate(config(run_folder, "--num_episodes 1", out=tmp_path))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"checkpoint": "e" * 64}, "results with checkpoint e{12} .seed 1001., not [0-9a-f]{12};"),
        ({"condition": "current"}, "results with condition current .*, not current_pred_h2"),
        ({"versions": {"mujoco": "3.1.0"}}, "results with versions mujoco 3.1.0 .*, not 3"),
        ({"settings": None}, "results with settings not recorded, by an earlier release .*, not"),
    ],
)
def test_rows_from_elsewhere_are_not_continued(
    run_folder: Path, tmp_path: Path, changes: dict[str, Any], message: str
) -> None:
    evaluate(config(run_folder, "--num_episodes 2", out=tmp_path))
    path = tmp_path / "results.jsonl"
    first, second = path.read_text().splitlines()
    path.write_text(f"{first}\n{json.dumps({**json.loads(second), **changes})}\n")
    before = path.read_bytes()
    with pytest.raises(RequestError, match=message):
        evaluate(config(run_folder, "--num_episodes 3", out=tmp_path))
    assert path.read_bytes() == before


def test_killed_and_interrupted_it_goes_on_to_the_same_file(
    run_folder: Path, tmp_path: Path
) -> None:
    arguments = f"FeedingEnv --policy Mlp --checkpoint {run_folder} --num_envs 2 --workers 2"
    many = [*ROLLOUT, *arguments.split(), "--num_episodes", "100000"]
    once, out = tmp_path / "once", tmp_path / "stopped"
    for number, code in ((signal.SIGKILL, -9), (signal.SIGINT, 130)):
        before = len(read_results(out)) if out.exists() else 0
        process = subprocess.Popen(
            [*many, "--out", str(out)],
            cwd=tmp_path,
            stderr=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            start_new_session=True,
        )
        results = out / "results.jsonl"
        deadline = time.monotonic() + 60
        while not (results.exists() and len(read_results(out)) > before + 1):
            assert process.poll() is None, process.communicate()
            assert time.monotonic() < deadline
            time.sleep(0.02)
        if number == signal.SIGKILL:
            process.kill()  # the workers have to notice by themselves
        else:
            os.killpg(process.pid, number)  # as a terminal does it
        _, errors = process.communicate(timeout=30)
        assert process.returncode == code
        assert "Traceback" not in errors
        if code == 130:
            assert errors.splitlines()[-1] == "interrupted"
        while children_of_group(process.pid):
            assert time.monotonic() < deadline
            time.sleep(0.05)
    done = max(result.seed for result in read_results(out)) - 1000
    for folder in (out, once):
        evaluate(config(run_folder, f"--num_episodes {done + 1}", out=folder))
    assert (out / "results.jsonl").read_bytes() == (once / "results.jsonl").read_bytes()


def children_of_group(group: int) -> list[int]:
    """Processes of a process group that are still there, zombies apart."""
    found = []
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            state, _, process_group = stat.read_text().rpartition(")")[2].split()[:3]
        except OSError:
            continue
        if int(process_group) == group and state != "Z":
            found.append(int(stat.parent.name))
    return found


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("--policy Atc", "unknown policy 'Atc' (did you mean 'Act'?)"),
        ("--policy Act", "trained with policy Mlp, not Act"),
        ("--scripted", "--scripted and --policy: one of them acts"),
        ("--expert anticipatory", "--expert goes with --scripted"),
        ("--preview 1", "--preview goes with --scripted"),
        ("--obs current", "trained with obs current_pred, not current"),
        ("--horizon 3", "trained with horizon 2, not 3"),
        ("--cameras top,angle", "trained with cameras none, not top,angle"),
        ("--image_size 24x32", "trained with image_size 480x640, not 24x32"),
        ("--checkpoint nowhere", "checkpoint 'nowhere' does not exist"),
        ("--temporal_ensemble --execute 2", "--temporal_ensemble and --n_action_steps: give one"),
        ("--n_action_steps 0", "n_action_steps 0"),
        ("--execute 7", "n_action_steps 7: must be 1 to 6"),
        ("--num_envs 0", "num_envs 0"),
        ("--workers -1", "workers -1"),
        ("--video -1", "video -1"),
        ("--num_episodes 0", "num_episodes 0"),
        ("--num_episodes 10000000000", "num_episodes 10000000000: must be 1 to 1000000"),
        ("--seed -5", "seed -5"),
        ("--seed 9223372036854775807", "seed 9223372036854775807: must be 0 to 9007199254740991"),
        ("--seed 9007199254740990", "seed + num_episodes - 1 = 9007199254740992: must be 0 to"),
        ("--device abacus", "device 'abacus'"),
        ("--precision fp8", "unknown precision 'fp8'"),
        ("--clips me", "unknown clip 'me'"),
        ("--error uniform", "trained with no corruption, not with error uniform, stats_sha256"),
        (
            "--delay 3",
            "not with delay 3; leave the options as trained, or give --change_corruption",
        ),
        ("--change_corruption --error some", "unknown error model 'some'"),
        ("--change_corruption --error uniform --error_stats no.json", "cannot read 'no.json'"),
        ("--face_motion no", "unknown face motion 'no'"),
        ("--no_object_pose", "trained with object_pose True, not False"),
        ("--arms both", "trained with arms right, not both"),
    ],
)
def test_wrong_requests(run_folder: Path, tmp_path: Path, text: str, message: str) -> None:
    out = tmp_path / "out"
    with pytest.raises(RequestError) as raised:
        evaluate(config(run_folder, f"{text} --out {out}"))
    assert message in str(raised.value)
    assert not (out / "results.jsonl").exists() or not read_results(out)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("FeedingEnv", "nothing acts"),
        ("FeedingEnv --policy Act", "which checkpoint?"),
        ("FeedinEnv --policy Act", "unknown environment 'FeedinEnv'"),
        ("FeedingEnv --scripted --checkpoint runs/x", "--checkpoint goes with --policy"),
        ("FeedingEnv --scripted --execute 3", "--n_action_steps goes with --policy"),
        ("FeedingEnv --scripted --delay 3", "--delay goes with --policy"),
        ("FeedingEnv --scripted --no_corruption", "--no_corruption goes with --policy"),
    ],
)
def test_wrong_requests_get_one_line_and_exit_code_2(
    tmp_path: Path, text: str, message: str
) -> None:
    result = subprocess.run(
        [*ROLLOUT, *text.split()], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert result.returncode == 2, result.stderr
    assert message in result.stderr
    assert len(result.stderr.strip().splitlines()) == 1
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"xml_hash": "0" * 64}, "trained with model hash 000000000000; FeedingEnv has"),
        (
            {"action_names": ("left/waist", *"abcdef")},
            "trained with actions left/waist, a, b, c, d, e, f; FeedingEnv has right",
        ),
        ({"control_period": 0.05}, "trained with control period 0.05; FeedingEnv has 0.02"),
    ],
)
def test_an_environment_that_does_not_fit_is_refused(
    make_checkpoint: MakeCheckpoint, tmp_path: Path, changes: dict[str, object], message: str
) -> None:
    make_checkpoint(tmp_path / "other", **changes)
    with pytest.raises(RequestError, match=message) as raised:
        EvaluationPlan.of(config(tmp_path / "other"))
    assert "0.0.9" in str(raised.value)


def test_seeds_of_demonstrations_are_pointed_out(
    run_folder: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    evaluate(config(run_folder, "--seed 2", out=tmp_path))
    assert "1 of the seeds are also seeds of the demonstrations (the first is 2)" in caplog.text


def test_the_execution_is_the_trained_one_unless_changed() -> None:
    trained = ActionExecution(temporal_ensemble=False, ensemble_decay=0.1, n_action_steps=4)

    def chosen(**changes: Any) -> ActionExecution:
        return choose_execution(trained, EvaluationConfig(Path("run"), range(1), **changes))

    assert chosen() == trained
    assert chosen(n_action_steps=2) == replace(trained, n_action_steps=2)
    ensemble = chosen(temporal_ensemble=True)
    assert (ensemble.temporal_ensemble, ensemble.ensemble_decay) == (True, 0.1)
    assert chosen(strategy="ensemble") == ensemble
    late = chosen(strategy="naive", inference_delay=3)
    assert late == replace(trained, strategy="naive", inference_delay=3)
    assert chosen(inference_delay="measured") == trained  # until it is
    assert (
        choose_execution(ensemble, EvaluationConfig(Path("run"), range(1), strategy="synchronous"))
        == trained
    )


def test_a_measured_delay_is_that_of_the_clock_and_stays(
    run_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whole control steps of 0.02 s; results that are continued keep theirs."""
    took = [0.019, 0.065, 0.5]
    monkeypatch.setattr(PolicyRunner, "prediction_time", lambda _: took.pop(0))
    asked = "--inference_delay measured --strategy synchronous --n_action_steps 2"
    delays = [
        EvaluationPlan.of(config(run_folder, asked, out=tmp_path / "new")).execution.inference_delay
        for _ in range(2)
    ]
    assert delays == [0, 3]
    took[:] = [0.041, 0.5]
    for episodes in (1, 2):
        given = f"{asked} --num_episodes {episodes}"
        plan, summary, _ = evaluate(config(run_folder, given, out=tmp_path / "out"))
        assert (plan.execution.inference_delay, summary.episodes) == (2, episodes)
    assert took == [0.5]  # not measured again
    with pytest.raises(RequestError, match="holds results with acting"):
        evaluate(config(run_folder, asked.replace("measured", "1"), out=tmp_path / "out"))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"inference_delay": "soon"}, "inference_delay 'soon': unknown; valid: measured, a number"),
        ({"strategy": "fast"}, "unknown strategy 'fast'; valid: .*ensemble.*naive"),
        ({"strategy": "ensemble", "n_action_steps": 3}, "--strategy ensemble and --n_action_steps"),
        ({"strategy": "naive", "temporal_ensemble": True}, "and --strategy naive: give one"),
        ({"inference_delay": -1}, "inference_delay -1: must be 0 to"),
    ],
)
def test_wrong_executions_are_one_line(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(RequestError, match=message):
        EvaluationConfig(Path("run"), range(1), **changes)


def test_options_of_the_environment_come_from_the_demonstrations(
    run_folder: Path, make_checkpoint: MakeCheckpoint, tmp_path: Path
) -> None:
    late = tmp_path / "late"
    make_checkpoint(late, dataset={"env_kwargs": {"face_motion": "after_lift"}})
    assert EvaluationPlan.of(config(late)).env.env_kwargs == {"face_motion": "after_lift"}
    given = EvaluationPlan.of(config(late, "--face_motion episode"))
    assert given.env.env_kwargs == {"face_motion": "episode"}
    moved = EvaluationPlan.of(config(late, "--motion sway:amplitude=3e-2"))
    assert moved.env.env_kwargs == {"face_motion": "after_lift", "motion": "sway:amplitude=0.03"}
    assert config(run_folder).seeds == range(1000, 1003)


def test_a_policy_meets_people_whom_it_has_not_seen(
    make_checkpoint: MakeCheckpoint, tmp_path: Path
) -> None:
    run = tmp_path / "train"
    recorded = {"people": "train", "clips": ["latentsync_demo2"]}
    make_checkpoint(run, dataset={"env_kwargs": recorded})
    assert EvaluationPlan.of(config(run)).env.env_kwargs == {"people": "test"}
    same = EvaluationPlan.of(config(run, "--people train --clips latentsync_demo2"))
    assert same.env.env_kwargs == recorded
    with pytest.raises(RequestError, match=r"unknown people 'tests' .*'test'"):
        config(run, "--people tests")


def test_clips_of_the_demonstrations_are_left_out_where_nothing_is_recorded(
    make_checkpoint: MakeCheckpoint, tmp_path: Path
) -> None:
    make_checkpoint(tmp_path / "clip", dataset={"env_kwargs": {"clips": ["clm_cap12"]}})
    of = {
        motion: EvaluationPlan.of(config(tmp_path / "clip", f"--motion {motion}")).env.env_kwargs
        for motion in ("sway", "recorded+sway")
    }
    assert of["sway"] == {"motion": "sway"}
    assert of["recorded+sway"] == {"clips": ["clm_cap12"], "motion": "recorded+sway"}


@pytest.mark.parametrize(
    "text",
    [
        "",
        "--no_corruption",
        "--change_corruption --error uniform --delay 3 --video 2",
        "--n_action_steps 3 --clips clm_cap12 clm_cap13 --out here --seed 7",
    ],
)
def test_a_configuration_is_json(run_folder: Path, text: str) -> None:
    asked = config(run_folder, text)
    assert EvaluationConfig.from_json(json.loads(json.dumps(asked.to_json()))) == asked


def test_the_corruption_is_the_trained_one_unless_changed(
    run_folder: Path, make_checkpoint: MakeCheckpoint, tmp_path: Path
) -> None:
    trained = Corruption("uniform", delay=2).pinned()
    spec = ObservationSpec(obs="current_pred", cameras=(), object_pose=True, corruption=trained)
    run = tmp_path / "mlp_run"
    make_checkpoint(run, spec=spec)

    def planned(text: str = "", folder: Path = run) -> tuple[Corruption, str, str]:
        plan = EvaluationPlan.of(config(folder, text))
        return plan.env.spec.corruption, plan.condition, plan.out.name

    name, out = "current_pred_h2_uniform_delay2", "FeedingEnv_mlp_run"
    assert planned() == (trained, name, out)
    assert planned("--error uniform --delay 2") == (trained, name, out)
    copy = tmp_path / "copy.json"
    copy.write_bytes(DEFAULT_STATS.read_bytes())
    same = replace(trained, error_stats=str(copy))
    assert planned(f"--error_stats {copy}") == (same, name, out)
    with pytest.raises(RequestError, match=r"trained with error uniform, stats_sha256 .*, delay 2"):
        planned("--delay 3")
    assert planned("--change_corruption --delay 3") == (
        replace(trained, delay=3),
        f"{name}_under_uniform_delay3",
        f"{out}_under_uniform_delay3",
    )
    truth = (Corruption(), f"{name}_under_truth", f"{out}_under_truth")
    assert planned("--no_corruption") == truth
    assert planned("--change_corruption --error none --delay 0") == truth
    assert planned("--no_corruption", run_folder) == (Corruption(), "current_pred_h2", out)
    late = planned("--change_corruption --delay 1", run_folder)
    assert late == (Corruption(delay=1), "current_pred_h2_under_delay1", f"{out}_under_delay1")


def test_another_corruption_gives_other_episodes_in_another_folder(
    run_folder: Path, tmp_path: Path
) -> None:
    plain, noisy = tmp_path / "plain", tmp_path / "noisy"
    evaluate(config(run_folder, "--num_episodes 2", out=plain))
    changed = "--num_episodes 2 --change_corruption --error uniform --face_dropout 0.3"
    evaluate(config(run_folder, changed, out=noisy))
    results = read_results(noisy)
    assert {result.condition for result in results} == {"current_pred_h2_under_uniform_dropout0.3"}
    settings = json.loads((noisy / "evaluation.json").read_text())["settings"]
    assert settings["observation"]["corruption"]["face_dropout"] == 0.3
    assert settings["observation"]["corruption"]["stats_sha256"] == load_error_stats().sha256
    before = (noisy / "results.jsonl").read_bytes()
    evaluate(config(run_folder, f"{changed} --num_envs 1 --workers 1", out=noisy))
    assert (noisy / "results.jsonl").read_bytes() == before
    with pytest.raises(RequestError, match="holds results with observation"):
        evaluate(config(run_folder, "--num_episodes 2", out=noisy))
    assert {result.condition for result in read_results(plain)} == {"current_pred_h2"}


def test_names() -> None:
    assert ObservationSpec().name == "baseline"
    assert ObservationSpec("current_pred", horizon=5).name == "current_pred_h5"
    noisy = ObservationSpec("current_pred", horizon=3, corruption=Corruption("uniform"))
    assert noisy.name == "current_pred_h3_uniform"
    assert run_name(Path("runs/act_current")) == "act_current"
    assert run_name(Path("runs/x/checkpoints/step_00000005")) == "x_step_00000005"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("--execute 7", "n_action_steps 7: must be 1 to 6"),
        ("--device cuda:99", "device"),
        ("--motion_library absent.npz", "absent"),
        ("--clips absent", "absent"),
    ],
)
@pytest.mark.parametrize("is_there", [False, True])
def test_a_refused_request_leaves_the_folder_as_it_was(
    run_folder: Path, tmp_path: Path, text: str, message: str, is_there: bool
) -> None:
    out = tmp_path / "new" / "out"
    if is_there:
        out.mkdir(parents=True)
    with pytest.raises(RequestError, match=message):
        evaluate(config(run_folder, text, out))
    assert list(tmp_path.rglob("*")) == ([out.parent, out] if is_there else [])


@pytest.mark.parametrize("name", ["summary.json", "results.jsonl", "evaluation.json", "notes.txt"])
def test_files_of_others_stay(run_folder: Path, tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_text('{"mine": 1}')
    with pytest.raises(RequestError, match=r"another --out|another folder"):
        evaluate(config(run_folder, out=tmp_path))
    assert [path.name for path in tmp_path.iterdir()] == [name]
    assert (tmp_path / name).read_text() == '{"mine": 1}'


def test_a_summary_of_somebody_else_stays(run_folder: Path, tmp_path: Path) -> None:
    evaluate(config(run_folder, "--num_episodes 1", tmp_path))
    (tmp_path / "summary.json").write_text("{}")
    with pytest.raises(RequestError, match="in the way of --out"):
        evaluate(config(run_folder, out=tmp_path))
    assert (tmp_path / "summary.json").read_text() == "{}"
    assert len(read_results(tmp_path)) == 1


def test_one_folder_has_one_writer(run_folder: Path, tmp_path: Path) -> None:
    with locked(tmp_path), pytest.raises(RequestError, match="by another process"):
        evaluate(config(run_folder, out=tmp_path))
    assert [path.name for path in tmp_path.iterdir()] == [".lock"]


def test_a_path_that_is_no_text_is_kept(run_folder: Path, tmp_path: Path) -> None:
    run, out = (tmp_path / os.fsdecode(name) for name in (b"caf\xe9", b"r\xe9sultats"))
    shutil.copytree(run_folder, run)
    evaluate(config(run, "--num_episodes 1", out))
    text = (out / "evaluation.json").read_text(encoding="utf-8")
    folder = Path(json.loads(text)["checkpoint_folder"])
    assert folder.parent.parent == run
    assert len(read_results(out)) == 1
    evaluate(config(run, "--num_episodes 1", out))
