"""Checkpoints: whole or not there, read back as written, refused with the reason."""

from __future__ import annotations

import dataclasses
import json
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch

from robo_manip_baselines.data.demonstrations import Split
from robo_manip_baselines.data.normalization import Normalization
from robo_manip_baselines.observation import ObservationSpec
from robo_manip_baselines.policy.act.config import ActConfig
from robo_manip_baselines.policy.checkpoint import (
    Checkpoint,
    load_model,
    read_checkpoint,
    read_trainer,
    without_initial_weights,
    write_checkpoint,
)
from robo_manip_baselines.policy.mlp.config import MlpConfig
from robo_manip_baselines.policy.presets import ActionExecution, PolicyDims, TrainSettings
from robo_manip_baselines.policy.registry import make_model
from robo_manip_baselines.runs.checkpoints import checkpoint_folder, step_folder
from robo_manip_baselines.runs.errors import RequestError

FILES = ("model.safetensors", "config.json", "stats.json", "trainer.safetensors", "trainer.json")

CHECKPOINT = Checkpoint(
    folder=Path(),
    policy="Mlp",
    config=MlpConfig(chunk_size=2, hidden_size=4, hidden_layers=1, dropout=0.5),
    dims=PolicyDims(state=3, action=2, cameras=0, image=(480, 640)),
    spec=ObservationSpec(obs="current_pred", horizon=3, cameras=(), object_pose=True),
    env="FeedingEnv",
    execution=ActionExecution(temporal_ensemble=False, n_action_steps=3),
    # Numbers that need all digits of float32.
    normalization=Normalization(
        *(np.array(v, np.float32) for v in ([0.1, 1 / 3, -7e-9], [1.1, 1e-3, 2.0], [0, 3], [1, 2]))
    ),
    action_names=("right/waist", "right/gripper"),
    control_period=0.02,
    xml_hash="ab" * 32,
    step=7,
    train_seed=5,
    settings=TrainSettings(steps=9, ema_decay=0.5),
    split=Split(train=(0, 3), validation=(1,)),
    dataset={"folder": "dataset/FeedingEnv", "episodes": 3, "content_hash": "cd" * 32},
    versions={"torch": "2.13.0"},
)


TRAINER = {
    "step": 7,
    "seconds": 1.5,
    "optimizer_steps": {"layers.0.weight": 7},
    "metrics": {"names": ["loss"], "count": 2},
}


def weights() -> dict[str, torch.Tensor]:
    torch.manual_seed(1)
    return make_model("Mlp", CHECKPOINT.config, CHECKPOINT.dims).state_dict()


@pytest.fixture
def run(tmp_path: Path) -> Path:
    """A run folder with one checkpoint."""
    trainer = {"exp_avg/layers.0.weight": torch.arange(6.0).reshape(2, 3).T}  # not row by row
    write_checkpoint(step_folder(tmp_path, 7), CHECKPOINT, weights(), trainer, TRAINER)
    return tmp_path


def test_a_checkpoint_reads_back_as_it_was_written(run: Path) -> None:
    folder = run / "checkpoints" / "step_00000007"
    assert sorted(path.name for path in folder.iterdir()) == sorted([*FILES, "manifest.json"])
    read = read_checkpoint(folder)
    assert (read.folder, read_checkpoint(run).folder) == (folder, folder)
    for field in dataclasses.fields(Checkpoint):
        if field.name not in ("folder", "content_hash", "normalization"):
            assert getattr(read, field.name) == getattr(CHECKPOINT, field.name), field.name
    for field in dataclasses.fields(Normalization):
        expected = getattr(CHECKPOINT.normalization, field.name)
        value = getattr(read.normalization, field.name)
        assert value.dtype == np.float32
        np.testing.assert_array_equal(value, expected)
    assert len(read.content_hash) == 64
    tensors, trainer = read_trainer(read)
    assert vars(trainer) == TRAINER
    assert tensors["exp_avg/layers.0.weight"].tolist() == [[0.0, 3.0], [1.0, 4.0], [2.0, 5.0]]


def test_the_network_has_the_weights_and_is_in_evaluation_mode(run: Path) -> None:
    model = load_model(read_checkpoint(run))
    assert not any(module.training for module in model.modules())
    for name, value in weights().items():
        assert torch.equal(model.state_dict()[name], value)


def test_a_run_folder_means_its_newest_checkpoint(run: Path) -> None:
    for step in (100, 20):
        later = dataclasses.replace(CHECKPOINT, step=step)
        write_checkpoint(step_folder(run, step), later, weights(), {}, {})
    (run / "checkpoints" / ".step_00000999.1.partial").mkdir()
    assert read_checkpoint(run).step == 100


def test_the_hash_is_of_what_acts(run: Path) -> None:
    first = read_checkpoint(run)
    other = dataclasses.replace(CHECKPOINT, train_seed=6)
    changed = weights()
    changed["layers.0.bias"][0] += 1e-3
    hashes = {
        write_checkpoint(run / "same", CHECKPOINT, weights(), {}, {"step": 8}).content_hash,
        write_checkpoint(run / "config", other, weights(), {}, {}).content_hash,
        write_checkpoint(run / "model", CHECKPOINT, changed, {}, {}).content_hash,
    }
    assert first.content_hash in hashes  # the trainer's state is not part of it
    assert len(hashes) == 3


def test_evaluation_does_without_the_trainers_state(run: Path) -> None:
    folder = read_checkpoint(run).folder
    for name in ("trainer.safetensors", "trainer.json"):
        (folder / name).unlink()
    checkpoint = read_checkpoint(run)
    load_model(checkpoint)
    with pytest.raises(RequestError, match=r"incomplete: trainer\.safetensors is missing"):
        read_trainer(checkpoint)


def truncate(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-1])


def flip(path: Path) -> None:
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(bytes(data))


@pytest.mark.parametrize("name", FILES)
@pytest.mark.parametrize("damage", [truncate, flip, Path.unlink])
def test_damage_is_refused_with_the_files_name(
    run: Path, name: str, damage: Callable[[Path], None]
) -> None:
    folder = run / "checkpoints" / "step_00000007"
    damage(folder / name)
    with pytest.raises(RequestError) as caught:
        read_trainer(read_checkpoint(run))
    message = str(caught.value)
    assert name in message
    assert str(folder) in message
    assert "\n" not in message


def edit_manifest(folder: Path, **changes: object) -> None:
    path = folder / "manifest.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), **changes}))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"version": 2}, "version 2, this release reads .* 1"),
        ({"schema": "other/checkpoint"}, "schema 'other/checkpoint' version 1, this release reads"),
        ({"sha256": None}, "sha256: must be an object, not null"),
        ({"sha256": {}}, "model.safetensors is missing"),
    ],
)
def test_other_manifests_are_refused(run: Path, changes: dict, message: str) -> None:
    edit_manifest(run / "checkpoints" / "step_00000007", **changes)
    with pytest.raises(RequestError, match=message):
        read_checkpoint(run)


def test_other_folders_are_refused(run: Path, tmp_path: Path) -> None:
    with pytest.raises(RequestError, match="'nowhere' does not exist"):
        read_checkpoint("nowhere")
    (tmp_path / "empty" / "checkpoints").mkdir(parents=True)
    with pytest.raises(RequestError, match="its run has saved none yet"):
        read_checkpoint(tmp_path / "empty")
    with pytest.raises(RequestError, match=r"it has neither manifest.json nor checkpoints/step_"):
        read_checkpoint(tmp_path / "empty" / "checkpoints")
    (run / "checkpoints" / "step_00000007" / "manifest.json").write_text("{")
    with pytest.raises(RequestError, match=r"manifest\.json' is damaged"):
        read_checkpoint(run)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda c: c.update(policy="Gpt"), "unknown policy 'Gpt'"),
        (lambda c: c["config"].update(width=3), "width"),
        (lambda c: c["spec"].update(horizon=25), "horizon 25: must be 24 or less"),
        (lambda c: c.pop("acting"), "acting: is missing"),
        (lambda c: c.update(acting=[1]), "acting: must be an object, not a list of 1"),
        (lambda c: c["acting"].update(execute=0), "n_action_steps 0: must be 1 or more"),
        (lambda c: c["acting"].update(execute="3"), "n_action_steps: must be a whole number"),
        (lambda c: c["acting"].update(decay=None), "ensemble_decay: must be a number"),
        (lambda c: c.update(dataset=[1]), "dataset: must be an object"),
        (lambda c: c["dataset"].update(env_kwargs=[]), "dataset.env_kwargs: must be an object"),
        (lambda c: c["dataset"].update(colour=1), "dataset: unknown name 'colour'"),
        (lambda c: c["sizes"].update(state=-3), "sizes.state -3: must be 1 or more"),
        (
            lambda c: c["sizes"].update(state=10**10),
            "sizes.state 10000000000: must be 4096 or less",
        ),
        (lambda c: c["sizes"].update(state=4), "'state_mean' has 3 elements, the network 4"),
        (lambda c: c["sizes"].update(action=1), "'action_mean' has 2 elements, the network 1"),
        (lambda c: c["sizes"].update(image=[480]), r"sizes.image\[1\]: is missing"),
        (lambda c: c["sizes"].update(cameras=True), "sizes.cameras: must be a whole number"),
        (
            lambda c: c["config"].update(hidden_size=10**10),
            "hidden_size 10000000000: must be 65536",
        ),
        (lambda c: c["config"].update(hidden_size=10**400), "of more than 64 bits"),
        (lambda c: c["config"].update(dropout=float("nan")), "NaN is no finite number"),
        (lambda c: c["settings"].update(weight_decay=-1), "settings.weight_decay -1: must be"),
        (lambda c: c["settings"].update(schedule=3), "settings.schedule: must be text, not 3"),
        (lambda c: c.update(action_names=[1, 2]), r"action_names\[0\]: must be text, not 1"),
        (lambda c: c.update(action_names="ab"), "action_names: must be a list, not 'ab'"),
        (lambda c: c.update(control_period=0), "control_period 0: must be more than 0"),
        (lambda c: c.update(step=-1), "step -1: must be 0 or more"),
        (lambda c: c.update(train_seed=2**63 - 1), "train_seed 9223372036854775807: must be"),
        (lambda c: c.update(policy=["Mlp"]), "policy: must be text, not a list of 1"),
        (lambda c: c.update(split={"train": [0], "validation": [0]}), "none in both parts"),
        (lambda c: c.update(spec={"horizon": 2, "cameras": [[1]]}), r"cameras\[0\]: must be text"),
        (lambda c: c.update(versions={"torch": 2}), "versions.torch: must be text, not 2"),
    ],
)
def test_a_configuration_that_does_not_fit_is_refused(
    run: Path, change: Callable[[dict], object], message: str
) -> None:
    """Written by another version of the package: digests are right, contents are not known."""
    folder = run / "checkpoints" / "step_00000007"
    config = json.loads((folder / "config.json").read_text())
    change(config)
    with checkpoint_folder(run / "other") as other:
        for name in FILES:
            shutil.copy(folder / name, other)
        (other / "config.json").write_text(json.dumps(config))
    with pytest.raises(RequestError, match=message) as caught:
        read_checkpoint(run / "other")
    assert "does not fit this package" in str(caught.value)


@pytest.mark.parametrize("name", ["config.json", "stats.json", "trainer.json", "manifest.json"])
@pytest.mark.parametrize(
    "content",
    [b"[" * 100_000, b"[]", b"3", b"null", b"\xff", b"", b'{"a": 1, "a": 2}', b"9" * 5000, b"{}"],
)
def test_documents_that_are_none_are_refused_by_name(run: Path, name: str, content: bytes) -> None:
    folder = run / "checkpoints" / "step_00000007"
    with checkpoint_folder(run / "other") as other:
        for file in FILES:
            shutil.copy(folder / file, other)
        if name != "manifest.json":
            (other / name).write_bytes(content)
    if name == "manifest.json":
        (run / "other" / name).write_bytes(content)
    with pytest.raises(RequestError, match=name) as caught:
        read_trainer(read_checkpoint(run / "other"))
    assert len(str(caught.value)) < 600


def test_weights_of_another_shape_are_refused(run: Path) -> None:
    state = weights()
    state["layers.0.weight"] = torch.zeros(4, 5)
    checkpoint = write_checkpoint(run / "other", CHECKPOINT, state, {}, {})
    with pytest.raises(RequestError, match="does not fit Mlp"):
        load_model(checkpoint)


def test_a_folder_that_fails_halfway_is_not_there(tmp_path: Path) -> None:
    def fill(folder: Path) -> None:
        with checkpoint_folder(folder) as temporary:
            (temporary / "a").write_text("half")
            raise OSError("disk full")

    with pytest.raises(OSError, match="disk full"):
        fill(tmp_path / "step")
    assert list(tmp_path.iterdir()) == []


def test_a_checkpoint_is_never_overwritten(run: Path) -> None:
    with pytest.raises(FileExistsError):
        write_checkpoint(step_folder(run, 7), CHECKPOINT, weights(), {}, {})
    assert load_model(read_checkpoint(run))


def test_the_file_that_training_began_from_is_not_needed_again() -> None:
    config = ActConfig(backbone_weights="gone.safetensors")
    assert without_initial_weights(config) == ActConfig()
    assert without_initial_weights(CHECKPOINT.config) is CHECKPOINT.config


def test_reading_facts_needs_no_pytorch(run: Path) -> None:
    program = (
        "import sys; from robo_manip_baselines.policy.checkpoint import read_checkpoint; "
        f"assert read_checkpoint({str(run)!r}).step == 7; assert 'torch' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", program], check=True)
