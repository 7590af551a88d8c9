"""The ResNet-18 against one of PyTorch's own layers, and its names against torchvision's."""

from __future__ import annotations

import copy

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from robo_manip_baselines.policy.act.resnet import (
    MEAN,
    STD,
    FrozenBatchNorm,
    ResNet18,
    feature_size,
    fold_for_inference,
)


def torchvision_shapes() -> dict[str, tuple[int, ...]]:
    """Names and shapes in torchvision's resnet18, without classifier and counters."""

    def norm(name: str, width: int) -> dict[str, tuple[int, ...]]:
        parts = ("weight", "bias", "running_mean", "running_var")
        return {f"{name}.{part}": (width,) for part in parts}

    shapes: dict[str, tuple[int, ...]] = {"conv1.weight": (64, 3, 7, 7), **norm("bn1", 64)}
    wide = 64
    for stage, width in enumerate((64, 128, 256, 512), start=1):
        for block in range(2):
            name = f"layer{stage}.{block}"
            into = wide if block == 0 else width
            shapes[f"{name}.conv1.weight"] = (width, into, 3, 3)
            shapes |= norm(f"{name}.bn1", width)
            shapes[f"{name}.conv2.weight"] = (width, width, 3, 3)
            shapes |= norm(f"{name}.bn2", width)
            if into != width:
                shapes[f"{name}.downsample.0.weight"] = (width, into, 1, 1)
                shapes |= norm(f"{name}.downsample.1", width)
        wide = width
    return shapes


def randomize_constants(net: nn.Module) -> None:
    """Draw what frozen normalisation holds: 1 and 0 would hide mistakes."""
    generator = torch.Generator().manual_seed(2)
    for module in net.modules():
        if isinstance(module, FrozenBatchNorm):
            for buffer in (module.weight, module.running_var):
                buffer.copy_(0.5 + torch.rand(buffer.shape, generator=generator))
            for buffer in (module.bias, module.running_mean):
                buffer.copy_(0.3 * torch.randn(buffer.shape, generator=generator))


@pytest.fixture(scope="module")
def net() -> ResNet18:
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(1)
        net = ResNet18()
    randomize_constants(net)
    return net


def draw_images(number: int, height: int, width: int) -> Tensor:
    generator = torch.Generator().manual_seed(4)
    return torch.randint(0, 256, (number, height, width, 3), generator=generator, dtype=torch.uint8)


def obvious_resnet(state: dict[str, Tensor], images: Tensor) -> Tensor:
    """He et al. 2016, layer by layer, with PyTorch's own batch normalisation."""

    def conv(x: Tensor, name: str, stride: int) -> Tensor:
        weight = state[f"{name}.weight"]
        return nn.functional.conv2d(x, weight, None, stride, weight.shape[-1] // 2)

    def norm(x: Tensor, name: str) -> Tensor:
        layer = nn.BatchNorm2d(x.shape[1]).eval()
        layer.load_state_dict(
            {part: state.get(f"{name}.{part}", torch.tensor(0)) for part in layer.state_dict()}
        )
        return layer(x)

    x = images.permute(0, 3, 1, 2).float().contiguous() / 255
    x = (x - torch.tensor(MEAN)[:, None, None]) / torch.tensor(STD)[:, None, None]
    x = nn.functional.relu(norm(conv(x, "conv1", 2), "bn1"))
    x = nn.functional.max_pool2d(x, kernel_size=3, stride=2, padding=1)
    for stage in (1, 2, 3, 4):
        for block in (0, 1):
            name = f"layer{stage}.{block}"
            stride = 2 if stage > 1 and block == 0 else 1
            y = nn.functional.relu(norm(conv(x, f"{name}.conv1", stride), f"{name}.bn1"))
            y = norm(conv(y, f"{name}.conv2", 1), f"{name}.bn2")
            if f"{name}.downsample.0.weight" in state:
                x = norm(conv(x, f"{name}.downsample.0", stride), f"{name}.downsample.1")
            x = nn.functional.relu(x + y)
    return x


def test_frozen_normalisation_is_batch_normalisation_in_evaluation():
    ours = FrozenBatchNorm(6)
    randomize_constants(ours)
    theirs = nn.BatchNorm2d(6).eval()
    theirs.load_state_dict({**ours.state_dict(), "num_batches_tracked": torch.tensor(0)})
    x = torch.randn(2, 6, 4, 4, generator=torch.Generator().manual_seed(0))
    scale, shift = ours.scale_and_shift()
    torch.testing.assert_close(
        x * scale[:, None, None] + shift[:, None, None], theirs(x), rtol=1e-5, atol=1e-6
    )


def test_names_and_shapes_are_torchvisions(net: ResNet18):
    assert {k: tuple(v.shape) for k, v in net.state_dict().items()} == torchvision_shapes()


def test_convolutions_are_trained_and_normalisation_is_not(net: ResNet18):
    # torchvision's resnet18 has 11,689,512 parameters: 513,000 in the classifier, 9,600 in norms.
    assert sum(p.numel() for p in net.parameters()) == 11_689_512 - 513_000 - 9_600
    assert not [name for name, _ in net.named_parameters() if "bn" in name]


@pytest.mark.long
@pytest.mark.parametrize(("height", "width"), [(64, 96), (30, 41), (1, 1)])
def test_features_are_those_of_the_obvious_network(net: ResNet18, height: int, width: int):
    images = draw_images(2, height, width)
    expected = obvious_resnet(net.state_dict(), images)
    # 17 convolutions in fp32, of up to 4608 products each, in another order.
    torch.testing.assert_close(
        net(images), expected, rtol=1e-3, atol=1e-4 * expected.abs().max().item()
    )


@pytest.mark.parametrize(
    ("height", "width"), [(480, 640), (1, 1), (30, 40), (31, 33), (32, 64), (33, 65), (241, 319)]
)
def test_the_size_of_the_feature_map_is_known_beforehand(net: ResNet18, height: int, width: int):
    on_paper = copy.deepcopy(net).to("meta")  # shapes without numbers
    features = on_paper(torch.empty((1, height, width, 3), dtype=torch.uint8, device="meta"))
    assert tuple(features.shape[1:]) == (512, *feature_size((height, width)))


def test_a_narrow_network_has_fewer_channels_in_every_stage():
    narrow = ResNet18(16)
    assert narrow.features == 128
    shapes = torchvision_shapes()
    for name, value in narrow.state_dict().items():
        expected = [size if size in (3, 7, 1) else size // 4 for size in shapes[name]]
        assert list(value.shape) == expected, name
    assert narrow(draw_images(1, 33, 20)).shape == (1, 128, 2, 1)


def test_images_are_worked_on_in_the_order_they_come_in(net: ResNet18):
    assert net(draw_images(2, 64, 64)).is_contiguous(memory_format=torch.channels_last)


def test_folding_changes_no_feature(net: ResNet18):
    folded = copy.deepcopy(net)
    fold_for_inference(folded)
    assert not [m for m in folded.modules() if isinstance(m, FrozenBatchNorm)]
    images = draw_images(2, 40, 50)
    torch.testing.assert_close(folded(images), net(images), rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("picture", ["noise", "white", "gradient"])
def test_random_weights_neither_blow_up_nor_fade(picture: str):
    # Nothing rescales activations between the blocks; a factor of 10 either way would matter.
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        fresh = ResNet18()
    images = {
        "noise": draw_images(1, 96, 128),
        "white": torch.full((1, 96, 128, 3), 255, dtype=torch.uint8),
        "gradient": torch.from_numpy(
            np.linspace(0, 255, 96 * 128 * 3).reshape(1, 96, 128, 3).astype(np.uint8)
        ),
    }[picture]
    with torch.no_grad():
        features = fresh(images)
    assert 0.3 < features.square().mean().sqrt().item() < 10.0
