"""Weights from a file: torchvision's are taken, anything else is refused in one line."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from safetensors.torch import save_file
from torch import Tensor

from robo_manip_baselines.policy.act.resnet import ResNet18, load_backbone
from robo_manip_baselines.runs.errors import RequestError

pytestmark = pytest.mark.long  # files of 45 MB


@pytest.fixture(scope="module")
def state() -> dict[str, Tensor]:
    """A whole file as torchvision makes it, with classifier and counters."""
    found = {name: 2.0 * value + 0.25 for name, value in ResNet18().state_dict().items()}
    found["fc.weight"], found["fc.bias"] = torch.zeros(1000, 512), torch.zeros(1000)
    found["bn1.num_batches_tracked"] = torch.tensor(0)
    return found


@pytest.mark.parametrize("suffix", [".safetensors", ".pth"])
def test_torchvisions_file_is_taken(tmp_path: Path, state: dict[str, Tensor], suffix: str):
    path = tmp_path / f"resnet18{suffix}"
    (save_file if suffix == ".safetensors" else torch.save)(state, path)
    net = ResNet18()
    load_backbone(net, path)
    for name, value in net.state_dict().items():
        assert torch.equal(value, state[name]), name


def without(state: dict[str, Tensor], name: str) -> dict[str, Tensor]:
    return {key: value for key, value in state.items() if key != name}


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (lambda s: without(s, "layer3.0.bn2.bias"), "'layer3.0.bn2.bias' is not in it"),
        (lambda s: {**s, "layer1.2.conv1.weight": torch.zeros(1)}, "it has 'layer1.2.conv1"),
        (
            lambda s: {**s, "layer2.0.conv1.weight": torch.zeros(128, 64, 1, 1)},
            "'layer2.0.conv1.weight' is of shape (128, 64, 1, 1), not (128, 64, 3, 3)",
        ),
    ],
)
def test_another_network_is_refused(tmp_path: Path, state: dict[str, Tensor], change, reason: str):
    path = tmp_path / "other.safetensors"
    save_file(change(state), path)
    net = ResNet18()
    before = net.conv1.weight.clone()
    with pytest.raises(RequestError) as error:
        load_backbone(net, path)
    assert f"'{path}' is no state dict of torchvision's resnet18" in str(error.value)
    assert reason in str(error.value)
    assert torch.equal(net.conv1.weight, before)


class Surprise:
    """Payload of a hostile file, run when it is unpickled."""

    def __reduce__(self) -> tuple[object, tuple[str]]:
        return (exec, ("import pathlib; pathlib.Path('surprise').touch()",))


def test_a_file_that_runs_code_does_not_run_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(tmp_path)
    torch.save({"conv1.weight": Surprise()}, "hostile.pth")
    with pytest.raises(RequestError, match="holds more than tensors, or is damaged"):
        load_backbone(ResNet18(), "hostile.pth")
    assert not (tmp_path / "surprise").exists()


@pytest.mark.parametrize(
    ("name", "content", "reason"),
    [
        ("weights.bin", b"", "must be one of .safetensors, .pth, .pt"),
        ("weights.pth", b"garbage", "holds more than tensors, or is damaged"),
        ("weights.safetensors", b"garbage" * 9, "damaged or no safetensors file"),
        ("weights.safetensors", b"", "damaged or no safetensors file"),
        ("weights.pth", None, "there is no such file"),
    ],
)
def test_a_wrong_file_is_refused(tmp_path: Path, name: str, content: bytes | None, reason: str):
    path = tmp_path / name
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(RequestError, match=reason) as error:
        load_backbone(ResNet18(), path)
    assert str(path) in str(error.value)
    assert "\n" not in str(error.value)


def test_a_tensor_that_is_no_state_dict_is_refused(tmp_path: Path):
    torch.save(torch.zeros(3), tmp_path / "tensor.pth")
    with pytest.raises(RequestError, match="it is no state dict"):
        load_backbone(ResNet18(), tmp_path / "tensor.pth")


def test_weights_without_cameras_are_refused():
    with pytest.raises(RequestError, match="without cameras: leave one of the two out"):
        load_backbone(None, "resnet18.pth")
