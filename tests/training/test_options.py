"""Options: preset, then file, then command line; every mistake in one line."""

from __future__ import annotations

from pathlib import Path

import pytest
import yaml

from robo_manip_baselines.commands.train import parse_config
from robo_manip_baselines.policy.act.config import PRESETS, ActConfig
from robo_manip_baselines.runs.errors import RequestError
from robo_manip_baselines.training.config import TrainConfig, require_same_config, write_config


def parse(line: str, *, has_gpu: bool = False) -> TrainConfig[ActConfig]:
    return parse_config(line.split(), has_gpu)


def write(folder: Path, text: str) -> Path:
    path = folder / "options.yaml"
    path.write_text(text)
    return path


@pytest.mark.parametrize(
    ("line", "has_gpu", "preset"),
    [
        ("Act", True, "paper"),
        ("Act", False, "cpu"),
        ("Act --preset auto", False, "cpu"),
        ("Act --preset paper", False, "paper"),
        ("Act --preset=cpu", True, "cpu"),
        ("Mlp", True, "cpu"),
    ],
)
def test_auto_takes_paper_where_there_is_a_gpu(line: str, has_gpu: bool, preset: str) -> None:
    assert parse(line, has_gpu=has_gpu).preset == preset


def test_what_auto_took_is_said(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level("INFO")
    parse("Act --preset cpu")
    assert caplog.messages == []
    parse("Act --obs current_pred")
    assert caplog.messages == ["--preset auto: PyTorch finds no GPU, so cpu"]


@pytest.mark.parametrize("name", ["paper", "cpu"])
def test_a_preset_gives_every_default(name: str) -> None:
    options, preset = parse(f"Act --preset {name}"), PRESETS[name]
    assert options.network == preset.config
    assert options.training == preset.training
    assert options.spec.cameras == preset.cameras
    assert options.spec.image_size == preset.image_size
    assert options.spec.object_pose == preset.object_pose


def test_the_paper_preset_is_table_iii() -> None:
    options = parse("Act --preset paper")
    assert (options.network.kl_weight, options.network.chunk_size) == (10.0, 100)
    assert (options.network.hidden_size, options.network.feedforward_size) == (512, 3200)
    assert (options.training.batch_size, options.training.learning_rate) == (8, 1e-5)
    assert (options.training.epochs, options.training.sampler) == (2000, "episode")
    assert options.spec.cameras == ("top", "angle", "front_close")


def test_the_command_line_goes_before_the_file_before_the_preset(tmp_path: Path) -> None:
    file = write(tmp_path, "chunk_size: 7\nkl_weight: 3\nbatch_size: 5\ncameras: [top, angle]\n")
    options = parse(f"Act --preset cpu --config {file} --kl_weight 4 --seed 9")
    assert options.network.chunk_size == 7
    assert options.network.kl_weight == 4.0
    assert options.training.batch_size == 5
    assert options.spec.cameras == ("top", "angle")
    assert options.network.hidden_size == PRESETS["cpu"].config.hidden_size
    assert options.seed == 9


def test_a_file_may_name_the_preset(tmp_path: Path) -> None:
    file = write(tmp_path, "preset: paper\n")
    assert parse(f"Act --config {file}").training.batch_size == 8
    assert parse(f"Act --config {file} --preset cpu").preset == "cpu"


@pytest.mark.parametrize(
    ("yaml_text", "line", "epochs", "steps"),
    [
        ("", "", None, PRESETS["cpu"].training.steps),
        ("", "--epochs 3", 3, None),
        ("", "--steps 4", None, 4),
        ("epochs: 5", "", 5, None),
        ("epochs: 5", "--steps 4", None, 4),
        ("steps: 6", "--epochs=3", 3, None),
        ("steps: 6\nepochs: null", "", None, 6),
    ],
)
def test_one_budget_replaces_the_other(
    tmp_path: Path, yaml_text: str, line: str, epochs: int | None, steps: int | None
) -> None:
    file = write(tmp_path, yaml_text)
    training = parse(f"Act --preset cpu --config {file} {line}").training
    assert (training.epochs, training.steps) == (epochs, steps)


@pytest.mark.parametrize(
    "line",
    [
        "Act --preset paper --paper_compat --cameras top --image_size 30x40 --object_pose",
        "Act --preset cpu --epochs 7 --obs baseline --no_object_pose --dataset a/b --compile",
        "Mlp --obs current --num_episodes 3 --arms both",
        "Act --preset cpu --error uniform --delay 3 --face_dropout 0.1 --dropout 0.2",
        "Mlp --obs current --detector_rate 10 --face_dropout_length 4 --corruption_seed 2",
        "Mlp --error gaussian --error_stats a/b.json --no_corruption",
        "Mlp --prediction autoregression --horizon 16 --delay 4 --relative",
        "Flow --preset cpu --norm mean_std --backbone unet --channels 16 32 --max_prefix 4",
    ],
)
def test_saved_options_read_back_as_they_were(tmp_path: Path, line: str) -> None:
    options = parse(line)
    file = write(tmp_path, yaml.safe_dump(options.to_json()))
    assert parse(f"{options.policy} --config {file}") == options


def test_runs_of_older_releases_are_the_same_runs(tmp_path: Path) -> None:
    """Their config.yaml knows of no corruption but ``error: none``."""
    values = parse("Mlp").to_json()
    new = (
        "error_stats",
        "prediction",
        "delay",
        "face_dropout",
        "face_dropout_length",
        "detector_rate",
    )
    dropped = (*new, "corruption_seed", "out")
    old = {name: value for name, value in values.items() if name not in dropped}
    assert old["error"] == "none"
    (tmp_path / "config.yaml").write_text(yaml.safe_dump(old))
    for same in ("", "--no_corruption --delay 2"):
        require_same_config(tmp_path, parse(f"Mlp {same}"))
    for changed in ("--delay 2", "--error uniform"):
        with pytest.raises(RequestError, match="holds a run with"):
            require_same_config(tmp_path, parse(f"Mlp {changed}"))


def test_the_previous_releases_file_resumes(tmp_path: Path) -> None:
    """Written by release 0.1.0 for ``Act --preset cpu --error uniform --delay 3 --steps 9``."""
    text = """\
policy: Act
chunk_size: 30
hidden_size: 128
feedforward_size: 512
num_heads: 4
encoder_layers: 1
decoder_layers: 1
state_layers: 2
latent_size: 32
cvae_layers: 1
use_cvae: true
kl_weight: 10.0
dropout: 0.0
pre_norm: false
backbone_learning_rate_factor: 1.0
backbone_weights: null
paper_compat: false
batch_size: 64
learning_rate: 0.001
weight_decay: 0.0001
schedule: cosine
warmup_steps: 100
clip_norm: 0.0
sampler: frame
epochs: null
steps: 9
state_noise: 0.2
clock_noise: 0.5
validation_fraction: 0.0
ema_decay: 0.999
precision: auto
compile: false
obs: current_pred
horizon: 2
error: uniform
error_stats: null
delay: 3
face_dropout: null
face_dropout_length: null
detector_rate: null
corruption_seed: null
env: FeedingEnv
dataset: null
num_episodes: null
preset: cpu
cameras:
- none
image_size: 480x640
object_pose: true
arms: right
seed: 0
device: auto
logger: tensorboard
log_every: 50
validate_every: 500
checkpoint_every: 1000
"""
    (tmp_path / "config.yaml").write_text(text)
    network = "--use_cvae --cvae_layers 1 --feedforward_size 512 --actions_per_query 1"
    given = parse(f"Act --preset cpu {network} --error uniform --delay 3 --steps 9")
    resumed = parse(f"Act --out {tmp_path} --resume")
    assert resumed.to_json() == {**given.to_json(), "out": str(tmp_path)}
    require_same_config(tmp_path, given)


def test_an_option_that_earlier_releases_had_not_is_written_where_it_is_used(
    tmp_path: Path,
) -> None:
    off, on = parse("Mlp --preset cpu"), parse("Mlp --preset cpu --object_noise 0.05")
    assert off.training.object_noise == 0.0
    assert "object_noise" not in off.to_document()
    assert on.to_document() == {**off.to_document(), "object_noise": 0.05}
    write_config(tmp_path, off)
    assert "object_noise" not in (tmp_path / "config.yaml").read_text()
    require_same_config(tmp_path, off)
    with pytest.raises(RequestError, match=r"a run with object_noise 0\.0, not 0\.05"):
        require_same_config(tmp_path, on)
    write_config(tmp_path, on)
    assert parse(f"Mlp --out {tmp_path} --resume").training.object_noise == 0.05


@pytest.mark.parametrize(
    ("line", "norm"),
    [
        ("Act", "mean_std"),
        ("Mlp --norm min_max", "min_max"),
        ("Flow", "action_min_max"),
        ("Diffusion --norm none", "none"),
    ],
)
def test_the_policy_has_a_norm_that_an_option_replaces(line: str, norm: str) -> None:
    assert parse(line).norm == norm


def test_dropout_of_the_network_is_not_that_of_the_face() -> None:
    options = parse("Act --preset cpu --dropout 0.3 --face_dropout 0.1")
    assert options.network.dropout == 0.3
    assert options.spec.corruption is not None
    assert options.spec.corruption.face_dropout == 0.1


def test_resuming_reads_the_options_of_the_run(tmp_path: Path) -> None:
    (tmp_path / "config.yaml").write_text("steps: 77\nchunk_size: 7\n")
    resumed = parse(f"Act --preset cpu --out {tmp_path} --resume")
    assert (resumed.training.steps, resumed.network.chunk_size) == (77, 7)
    assert parse(f"Act --preset cpu --out {tmp_path}").training.steps != 77


@pytest.mark.parametrize(
    ("line", "folder"),
    [
        ("Act --preset cpu", "runs/act_current_pred_h2_cpu_seed0"),
        ("Act --preset cpu --horizon 4 --seed 3", "runs/act_current_pred_h4_cpu_seed3"),
        ("Mlp --obs current", "runs/mlp_current_cpu_seed0"),
        ("Act --preset paper --obs baseline --out x/y", "x/y"),
        ("Act --preset cpu --error uniform", "runs/act_current_pred_h2_uniform_cpu_seed0"),
        ("Act --preset cpu --error none --delay 0", "runs/act_current_pred_h2_cpu_seed0"),
        ("Mlp --error uniform --no_corruption", "runs/mlp_current_pred_h2_cpu_seed0"),
        (
            "Mlp --error model --delay 3 --face_dropout 0.1 --detector_rate 10",
            "runs/mlp_current_pred_h2_model_delay3_dropout0.1_rate10_cpu_seed0",
        ),
    ],
)
def test_run_folders(line: str, folder: str) -> None:
    assert parse(line).folder == Path(folder)


def test_a_run_is_called_what_it_trains_wherever_it_lies() -> None:
    assert parse("Act --preset cpu --seed 3 --out x/y").name == "act_current_pred_h2_cpu_seed3"


@pytest.mark.parametrize(
    ("line", "parts"),
    [
        ("", ["name the policy to train first", "Act, Mlp"]),
        ("--preset cpu Act", ["name the policy to train first"]),
        ("act", ["unknown policy 'act'", "mean 'Act'"]),
        (
            "Act --preset papre",
            ["unknown preset 'papre'", "mean 'paper'", "cpu, cpu_images, paper"],
        ),
        ("Act --chunk_siez 3", ["'--chunk_siez'", "mean '--chunk_size'"]),
        ("Mlp --kl_weight 3", ["unknown option '--kl_weight'"]),
        ("Act --batch_size x", ["--batch_size is a whole number, not 'x'"]),
        ("Act --epochs x", ["--epochs", "'x'"]),
        ("Act --epochs 1 --steps 2", ["--epochs or as --steps, one of the two"]),
        ("Act --weight_decay nan", ["weight_decay nan: must be 0 or more, and finite"]),
        ("Act --clip_norm inf", ["clip_norm inf: must be 0 or more, and finite"]),
        ("Act --state_noise nan", ["state_noise nan: must be 0 or more, and finite"]),
        ("Act --clock_noise nan", ["clock_noise nan: must be 0 or more, and finite"]),
        ("Act --learning_rate nan", ["learning_rate nan: must be more than 0"]),
        ("Act --kl_weight nan", ["kl_weight nan: must be 0 or more, and finite"]),
        ("Act --hidden_size 100000000000000000000", ["hidden_size 100000000000000000000: must be"]),
        ("Act --seed 9223372036854775807", ["seed 9223372036854775807: must be 0 to"]),
        ("Act --num_episodes 10000000000", ["num_episodes 10000000000: must be 1 to 1000000"]),
        ("Act --batch_size -3", ["batch_size -3: must be 1 to 65536"]),
        ("Act --steps 0", ["steps 0: must be 1 to"]),
        ("Act --chunk_size 0", ["chunk_size 0: must be 1 to"]),
        ("Act --obs all", ["unknown observation preset 'all'", "valid: baseline"]),
        ("Act --horizon 25", ["horizon 25: must be 1 to 24"]),
        ("Act --error some", ["unknown error model 'some'", "valid: empirical, gaussian"]),
        ("Act --obs current --error uniform", ["'uniform' is one of forecasts", "current_pred"]),
        ("Act --obs baseline --delay 2", ["'delay2' corrupts the mouth"]),
        ("Act --face_dropout 1", ["face_dropout 1.0: must be 0 or more, less than 1"]),
        ("Act --delay x", ["--delay", "'x'"]),
        ("Act --cameras left", ["unknown camera 'left'", "top"]),
        ("Act --image_size big", ["image size 'big'", "480x640"]),
        ("Act --log_every 0", ["log_every 0: must be 1 to"]),
        ("Act --seed -1", ["seed -1: must be 0 to"]),
        ("Act --env Feeding", ["unknown environment 'Feeding'", "mean 'FeedingEnv'"]),
        (
            "Act --norm max",
            ["unknown norm 'max'", "valid: action_min_max, mean_std, min_max, none"],
        ),
        ("Act --config nowhere.yaml", ["cannot read 'nowhere.yaml'"]),
    ],
)
def test_wrong_command_lines(line: str, parts: list[str]) -> None:
    with pytest.raises(RequestError) as caught:
        parse(line)
    message = str(caught.value)
    assert "\n" not in message
    for part in parts:
        assert part in message


@pytest.mark.parametrize(
    ("text", "parts"),
    [
        ("chunk_siez: 3", ["unknown option 'chunk_siez'", "mean 'chunk_size'", "batch_size"]),
        ("batch_size: many", ["--batch_size is a whole number, not 'many'"]),
        ("batch_size: {a: 1}", ["batch_size must be one value or a list"]),
        ("schedule: linear", ["unknown schedule 'linear'; valid: constant, cosine"]),
        ("- 3", ["must be an object, not a list of 1"]),
        ("a: [", ["is no YAML"]),
        ("policy: Mlp", ["is of policy 'Mlp', not 'Act'"]),
        ("resume: true", ["unknown option 'resume'"]),
    ],
)
def test_wrong_files_are_named(tmp_path: Path, text: str, parts: list[str]) -> None:
    file = write(tmp_path, text)
    with pytest.raises(RequestError) as caught:
        parse(f"Act --preset cpu --config {file}")
    for part in [str(file), *parts]:
        assert part in " ".join(str(caught.value).split())


@pytest.mark.parametrize("line", ["--help", "Act --help", "Mlp --preset cpu -h"])
def test_help_shows_the_policys_own_defaults(line: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        parse(line)
    assert not stop.value.code
    page = capsys.readouterr().out
    assert "--learning_rate" in page
    assert ("--kl_weight" in page) == ("Mlp" not in line)
