"""``bin/Train.py`` from outside: signals, resuming, several processes, output."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from robo_manip_baselines.commands.train import main as train
from robo_manip_baselines.commands.train import parse_config
from robo_manip_baselines.observation.error_stats import DEFAULT_STATS, load_error_stats
from robo_manip_baselines.policy.checkpoint import load_model, read_checkpoint
from robo_manip_baselines.runs import threads
from robo_manip_baselines.runs.checkpoints import list_checkpoints
from robo_manip_baselines.runs.errors import RequestError
from robo_manip_baselines.runs.metrics import read_metrics
from robo_manip_baselines.training.config import TrainConfig, write_config
from robo_manip_baselines.training.requirements import prepare_pytorch
from robo_manip_baselines.training.trainer import train as train_config

pytestmark = pytest.mark.long

TINY = (
    "--preset cpu --chunk_size 3 --hidden_size 8 --batch_size 4 --validation_fraction 0.2 "
    "--log_every 5 --logger none"
)
LONG = 1_000_000  # steps that no test waits for
TIMEOUT = 120.0  # seconds; hangs fail, slow machines do not


@pytest.fixture
def line(episodes: Path, tmp_path: Path) -> str:
    """A tiny run into ``tmp_path/run``; the policy and the budget come from the test."""
    return f"{TINY} --dataset {episodes} --out {tmp_path / 'run'}"


def start(repository: Path, args: str, *, launcher: tuple[str, ...] = ()) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, *launcher, str(repository / "bin" / "Train.py"), *args.split()],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, "OMP_NUM_THREADS": "1"},
    )


def wait_for_step(process: subprocess.Popen[str], run: Path, step: int) -> None:
    end = time.monotonic() + TIMEOUT
    while not any(line["step"] >= step for line in read_metrics(run / "metrics.jsonl")):
        assert process.poll() is None, process.communicate()
        assert time.monotonic() < end
        time.sleep(0.05)


def losses(run: Path) -> list[tuple[str, int, float]]:
    return [(x["kind"], x["step"], x["loss"]) for x in read_metrics(run / "metrics.jsonl")]


def weights(run: Path) -> bytes:
    return (read_checkpoint(run).folder / "model.safetensors").read_bytes()


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_saves_and_names_the_next_command(
    number: signal.Signals, line: str, repository: Path, tmp_path: Path
) -> None:
    run = tmp_path / "run"
    process = start(repository, f"Mlp {line} --steps {LONG}")
    wait_for_step(process, run, 5)
    process.send_signal(number)
    _, errors = process.communicate(timeout=TIMEOUT)
    assert process.returncode == 130
    assert f"continue with: python bin/Train.py Mlp --out {run} --resume" in errors
    assert "Traceback" not in errors
    [(step, _)] = list_checkpoints(run)
    assert f"stopped at step {step}" in errors
    assert load_model(read_checkpoint(run))


def test_a_killed_run_goes_on_as_if_nothing_had_been(
    line: str, repository: Path, tmp_path: Path
) -> None:
    run, whole = tmp_path / "run", tmp_path / "whole"
    # Slow enough to be killed on the way: many layers, saved often.
    args = f"Mlp {line} --dropout 0.3 --ema_decay 0.9 --hidden_layers 9 --checkpoint_every 40"
    args += " --steps 200 --validate_every 30"
    process = start(repository, args)
    wait_for_step(process, run, 60)
    process.kill()
    process.communicate()
    (step, _), *_ = list_checkpoints(run)
    assert 0 < step < 200, "killed too late"
    partial = run / "checkpoints" / f".step_00000199.{process.pid}.partial"
    partial.mkdir()
    process = start(repository, f"Mlp --out {run} --resume")
    output, errors = process.communicate(timeout=TIMEOUT)
    assert process.returncode == 0, errors
    assert f"--policy Mlp --checkpoint {run}" in output
    assert (run / "curves.png").read_bytes().startswith(b"\x89PNG")
    process = start(repository, args.replace(str(run), str(whole)))
    process.communicate(timeout=TIMEOUT)
    assert weights(run) == weights(whole)
    assert losses(run) == losses(whole)
    assert not partial.exists()


def test_two_processes_train_as_one(line: str, repository: Path, tmp_path: Path) -> None:
    """With the same batches, hence the same losses but for the order of sums."""
    args = "Mlp {} --steps 20 --learning_rate 0.01 --clip_norm 1 --ema_decay 0.9"
    train(args.format(line).split())
    both = str(tmp_path / "both")
    two = args.format(line).replace(str(tmp_path / "run"), both)
    launcher = ("-m", "torch.distributed.run", "--standalone", "--nproc_per_node", "2")
    process = start(repository, two, launcher=launcher)
    output, errors = process.communicate(timeout=TIMEOUT)
    assert process.returncode == 0, errors
    assert output.count("next: python bin/Rollout.py") == 1  # one process speaks
    assert errors.count("budget:") == 1
    one, other = losses(tmp_path / "run"), losses(Path(both))
    assert [x[:2] for x in other] == [x[:2] for x in one]
    # float32 sums in another order, through 20 steps of AdamW
    assert [x[2] for x in other] == pytest.approx([x[2] for x in one], rel=1e-4)
    # The checkpoint is that of any run: one process goes on where two were.
    assert train(f"Mlp --out {both} --resume".split()) == 0


def test_two_processes_resume(line: str, repository: Path, tmp_path: Path) -> None:
    args = f"Mlp {line} --steps {LONG} --dropout 0.2"
    launcher = ("-m", "torch.distributed.run", "--standalone", "--nproc_per_node", "2")
    steps = []
    for extra in ("", " --resume"):
        process = start(repository, args + extra, launcher=launcher)
        wait_for_step(process, tmp_path / "run", 5 + (steps[-1] if steps else 0))
        process.send_signal(signal.SIGINT)
        _, errors = process.communicate(timeout=TIMEOUT)
        steps.append(read_checkpoint(tmp_path / "run").step)
        assert f"stopped at step {steps[-1]}" in errors
    assert steps[0] < steps[1]
    written = [x[1] for x in losses(tmp_path / "run") if x[0] == "train"]
    assert written == list(range(5, written[-1] + 1, 5))


def test_what_a_run_folder_holds_is_respected(
    line: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = tmp_path / "run"
    args = f"Mlp {line} --steps 6"
    assert train(args.split()) == 0
    for name in ("config.yaml", "metrics.jsonl", "curves.png", "checkpoints/step_00000006"):
        assert (run / name).exists(), name
    with pytest.raises(RequestError, match="holds this run, finished; choose another --out"):
        train(args.split())
    with pytest.raises(RequestError, match=r"with dropout 0\.0, not 0\.1"):
        train(f"{args} --dropout 0.1 --resume".split())
    capsys.readouterr()
    before = weights(run)
    assert train(f"{args} --resume --device cpu".split()) == 0
    assert f"--policy Mlp --checkpoint {run}" in capsys.readouterr().out
    assert weights(run) == before


def test_a_finished_run_is_extended_from_its_folder(line: str, tmp_path: Path) -> None:
    run = tmp_path / "run"
    assert train(f"Mlp {line} --steps 4".split()) == 0
    with pytest.raises(RequestError, match="with steps 4, not 6; --resume extends it"):
        train(f"Mlp {line} --steps 6".split())
    assert train(f"Mlp --out {run} --resume --steps 6".split()) == 0
    assert read_checkpoint(run).step == 6
    assert train(f"Mlp --out {run} --resume".split()) == 0  # the new budget is the run's own


@pytest.mark.parametrize("folder", ["act_currnet", "new/act_current", "."])
def test_a_mistyped_folder_is_not_a_new_run(line: str, folder: str, tmp_path: Path) -> None:
    for name in ("act_current", "act_baseline", "notes"):
        (tmp_path / name).mkdir()
        (tmp_path / name / ("notes.txt" if name == "notes" else "config.yaml")).touch()
    before = sorted(tmp_path.rglob("*"))
    given = tmp_path / folder
    with pytest.raises(RequestError, match=r"--resume: '.*' holds no run; ") as refusal:
        train(f"Mlp {line} --resume --out {given}".split())
    if folder == "act_currnet":
        near = f"there are '{tmp_path / 'act_current'}', '{tmp_path / 'act_baseline'}'"
        assert near in str(refusal.value)
    assert sorted(tmp_path.rglob("*")) == before


def test_a_run_without_a_checkpoint_yet_is_resumed_from_its_start(
    line: str, tmp_path: Path
) -> None:
    run = tmp_path / "run"
    train(f"Mlp {line} --steps 2".split())
    shutil.rmtree(run / "checkpoints")
    assert train(f"Mlp --out {run} --resume".split()) == 0
    assert read_checkpoint(run).step == 2


def test_an_unfinished_run_needs_resume(line: str, tmp_path: Path) -> None:
    run = tmp_path / "run"
    train(f"Mlp {line} --steps 4 --checkpoint_every 2".split())
    newest = list_checkpoints(run)[-1][1]
    for path in newest.iterdir():
        path.unlink()
    newest.rmdir()
    with pytest.raises(RequestError, match="at step 2; --resume continues it"):
        train(f"Mlp {line} --steps 4 --checkpoint_every 2".split())
    assert train(f"Mlp --out {run} --resume".split()) == 0
    assert read_checkpoint(run).step == 4


def test_other_demonstrations_are_not_resumed(line: str, episodes: Path, tmp_path: Path) -> None:
    train(f"Mlp {line} --steps 2 --num_episodes 6".split())
    fewer = tmp_path / "fewer"
    fewer.mkdir()
    for path in sorted(episodes.iterdir())[:5]:
        (fewer / path.name).symlink_to(path)
    more = f"--resume --dataset {fewer} --config {tmp_path / 'c.yaml'}"
    text = (tmp_path / "run" / "config.yaml").read_text()
    (tmp_path / "c.yaml").write_text(text)
    with pytest.raises(RequestError, match="holds 5 episodes, not 6"):
        train(f"Mlp --out {tmp_path / 'run'} {more}".split())
    train(f"Mlp {TINY} --dataset {episodes} --out {tmp_path / 'all'} --steps 2".split())
    with pytest.raises(RequestError, match=r"are not the ones that .* was trained on"):
        train(f"Mlp --out {tmp_path / 'all'} --resume --dataset {fewer}".split())


def test_other_error_statistics_are_not_resumed(line: str, tmp_path: Path) -> None:
    stats = tmp_path / "stats.json"
    stats.write_bytes(DEFAULT_STATS.read_bytes())
    more = f"--error uniform --error_stats {stats} --steps 2"
    train(f"Mlp {line} {more}".split())
    run = tmp_path / "run"
    corruption = read_checkpoint(run).spec.corruption
    assert corruption is not None
    assert corruption.stats_sha256 == load_error_stats().sha256
    assert train(f"Mlp --out {run} --resume".split()) == 0
    stats.write_bytes(DEFAULT_STATS.read_bytes() + b"\n")
    with pytest.raises(RequestError, match=r"error statistics are not the ones that .*/run'"):
        train(f"Mlp --out {run} --resume".split())


def test_missing_demonstrations_name_the_command(tmp_path: Path) -> None:
    with pytest.raises(RequestError, match=r"python bin/Rollout\.py FeedingEnv --scripted"):
        train(f"Act --preset cpu --dataset {tmp_path / 'no'} --out {tmp_path / 'run'}".split())
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("device", "message"), [("tpu", "must be auto, cpu, cuda"), ("cuda:99", "device 'cuda:99'")]
)
def test_devices_that_are_not_there(device: str, message: str, line: str) -> None:
    with pytest.raises(RequestError, match=message):
        train(f"Mlp {line} --device {device}".split())


def write_stat(path: Path, ticks: dict[int, tuple[int, int]]) -> None:
    """Write a file like /proc/stat: (busy, idle) of each core."""
    rows = [f"cpu{core} {busy} 0 0 {idle} 0 0 0 0 0 0" for core, (busy, idle) in ticks.items()]
    path.write_text("\n".join(["cpu  1 2 3 4 5 6 7 8 9 10", *rows, "intr 7", "ctxt 8"]))


@pytest.mark.parametrize(
    ("later", "taken"),
    [
        ({0: (100, 110), 1: (100, 110)}, 0),
        ({0: (110, 100), 1: (101, 109)}, 1),
        ({0: (110, 100), 1: (109, 101)}, 2),
        ({0: (110, 100), 1: (100, 110), 7: (900, 0)}, 1),  # a core that this process may not use
        ({0: (100, 100), 1: (100, 100)}, 0),  # no time has passed
    ],
)
def test_cores_that_others_keep_busy_are_counted(
    later: dict[int, tuple[int, int]], taken: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    stat = tmp_path / "stat"
    write_stat(stat, {0: (100, 100), 1: (100, 100), 7: (0, 0)})
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {0, 1})
    monkeypatch.setattr(threads.time, "sleep", lambda _: write_stat(stat, later))
    assert threads.taken_cores(stat) == taken


@pytest.mark.parametrize("content", [None, "", "cpu0 x y z", "cpu0 1"])
def test_without_a_load_no_core_is_taken(content: str | None, tmp_path: Path) -> None:
    stat = tmp_path / "stat"
    if content is not None:
        stat.write_text(content)
    assert threads.taken_cores(stat) == 0


@pytest.mark.parametrize(("taken", "spins"), [(0, "3000"), (1, "0")])
def test_threads_sleep_at_once_beside_other_programs(
    taken: int, spins: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("OMP_WAIT_POLICY", raising=False)
    monkeypatch.setenv("GOMP_SPINCOUNT", "")
    monkeypatch.delenv("GOMP_SPINCOUNT")
    monkeypatch.setattr(threads, "taken_cores", lambda: taken)
    prepare_pytorch()
    assert os.environ["GOMP_SPINCOUNT"] == spins
    prepare_pytorch()  # what was set stays
    monkeypatch.setenv("OMP_WAIT_POLICY", "ACTIVE")
    monkeypatch.delenv("GOMP_SPINCOUNT")
    prepare_pytorch()
    assert "GOMP_SPINCOUNT" not in os.environ


def test_missing_packages_name_the_command(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("GOMP_SPINCOUNT", "7")
    prepare_pytorch()
    assert os.environ["GOMP_SPINCOUNT"] == "7"
    monkeypatch.setattr("robo_manip_baselines.training.requirements.find_spec", lambda name: None)
    with pytest.raises(RequestError, match=r"policies need torch, .*pip install .*\[train\]"):
        prepare_pytorch()


def test_tensorboard_has_the_scalars(line: str, tmp_path: Path) -> None:
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    train(f"Mlp {line} --steps 10 --logger tensorboard".split())
    events = EventAccumulator(str(tmp_path / "run" / "tensorboard"))
    events.Reload()
    assert [x.step for x in events.Scalars("train/loss")] == [5, 10]
    assert [x.step for x in events.Scalars("validation/loss")] == [10]


def test_help_is_quick_and_without_pytorch(repository: Path) -> None:
    program = (
        "import sys, time; start = time.perf_counter();\n"
        "from robo_manip_baselines.commands.train import main\n"
        "try:\n    main(['--help'])\n"
        "except SystemExit:\n    print(time.perf_counter() - start, 'torch' in sys.modules)"
    )
    process = subprocess.run(
        [sys.executable, "-c", program], cwd=repository, capture_output=True, text=True, check=True
    )
    seconds, has_torch = process.stdout.splitlines()[-1].split()
    assert has_torch == "False"
    assert "--learning_rate" in process.stdout
    assert float(seconds) < 15.0  # 0.8 s on an idle machine; importing PyTorch takes several


def test_a_run_from_python_is_that_of_the_command(episodes: Path, tmp_path: Path) -> None:
    """`TrainConfig` and `train` without a command line."""
    args = f"Mlp {TINY} --dataset {episodes} --steps 6"
    assert train(f"{args} --out {tmp_path / 'typed'}".split()) == 0
    config = parse_config(args.split())
    config = TrainConfig.from_json({**config.to_json(), "out": str(tmp_path / "built")})
    assert train_config(config, resume=True) == 0
    assert weights(tmp_path / "built") == weights(tmp_path / "typed")
    assert losses(tmp_path / "built") == losses(tmp_path / "typed")


def test_a_folder_of_somebody_else_stays(line: str, tmp_path: Path) -> None:
    run = tmp_path / "run"
    (run / "tensorboard" / "other").mkdir(parents=True)
    (run / "tensorboard" / "other" / "events.out.tfevents.1").write_text("theirs")
    (run / "config.yaml").write_text("# why\nsteps: 2\n")
    with pytest.raises(RequestError, match=r"config\.yaml, tensorboard and no run of"):
        train(f"Mlp {line} --config {run / 'config.yaml'}".split())
    assert (run / "config.yaml").read_text() == "# why\nsteps: 2\n"
    assert sorted(path.name for path in run.rglob("*")) == [
        *("config.yaml", "events.out.tfevents.1", "other", "tensorboard"),
    ]


def test_a_run_that_was_stopped_early_begins_again_beside_the_logs_of_others(
    line: str, tmp_path: Path
) -> None:
    run = tmp_path / "run"
    words = f"Mlp {line} --steps 5 --logger tensorboard".split()
    write_config(run, parse_config(words))  # as a run leaves it that is killed at its first step
    theirs, ours = (run / "tensorboard" / f"events.out.tfevents.1{x}" for x in ("", ".run"))
    theirs.parent.mkdir()
    theirs.write_text("theirs")
    ours.write_text("ours")
    with pytest.raises(RequestError, match="holds a run with steps 5, not 6"):
        train([*words, "--steps", "6"])
    assert ours.exists()
    train(words)
    assert theirs.read_text() == "theirs"
    assert not ours.exists()


def test_demonstrations_and_run_at_paths_that_are_no_text(
    line: str, episodes: Path, tmp_path: Path
) -> None:
    dataset, run = (tmp_path / os.fsdecode(name) for name in (b"caf\xe9", b"m\xe9thode"))
    dataset.symlink_to(episodes)
    words = f"Mlp {TINY} --steps 5 --dataset".split()
    train([*words, str(dataset), "--out", str(run)])
    assert read_checkpoint(run).dataset["folder"] == str(dataset)
    train(["Mlp", "--out", str(run), "--resume"])
