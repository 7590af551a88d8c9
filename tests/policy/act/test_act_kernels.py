"""Operations with kernels of their own on a CUDA device, against PyTorch's plain ones."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest
import torch
from torch import Tensor, nn

from robo_manip_baselines.policy.act.model import AffineProduct
from robo_manip_baselines.policy.act.pooling import MaxPoolRelu, max_pool_relu
from robo_manip_baselines.policy.act.resnet import (
    CELL,
    FrozenBatchNorm,
    ResNet18,
    convolve,
    convolve_relu,
)
from robo_manip_baselines.training.step import CastParameters, LossModule

DEVICES = ["cpu", pytest.param("cuda", marks=pytest.mark.cuda)]


def draw(*shape: int, dtype: torch.dtype = torch.float64, device: str = "cpu") -> Tensor:
    generator = torch.Generator().manual_seed(len(shape) + sum(shape))
    return torch.randn(shape, generator=generator, dtype=torch.float64).to(device, dtype)


def channels_last(x: Tensor) -> Tensor:
    return x.contiguous(memory_format=torch.channels_last)


def assert_near(found: Tensor, expected: Tensor, tolerance: float) -> None:
    """Within a proportion of the largest element."""
    error = (found.double() - expected.double()).abs().max().item()
    assert error <= tolerance * max(expected.abs().max().item(), 1e-6)


@pytest.fixture(scope="module")
def net() -> ResNet18:
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(3)
        net = ResNet18()
        for module in net.modules():
            if isinstance(module, FrozenBatchNorm):  # 1 and 0 would hide mistakes
                for buffer in module.buffers():
                    buffer.uniform_(0.5, 1.5)
    return net.double()


def draw_images(*shape: int) -> Tensor:
    generator = torch.Generator().manual_seed(4)
    return torch.randint(0, 256, (*shape, 3), generator=generator, dtype=torch.uint8)


@pytest.mark.parametrize("with_shortcut", [False, True])
@pytest.mark.parametrize("stride", [1, 2])
def test_a_rectified_convolution_has_the_gradients_of_its_parts(
    net: ResNet18, stride: int, with_shortcut: bool
):
    block = net.get_submodule(f"layer{stride}")[0]
    conv, norm = (block.conv1, block.bn1) if stride == 2 else (block.conv2, block.bn2)
    x = channels_last(draw(2, conv.in_channels, 7, 9)).requires_grad_()
    size = -(-7 // stride), -(-9 // stride)
    shortcut = draw(2, conv.out_channels, *size).requires_grad_() if with_shortcut else None
    inputs = [x, conv.weight, *([shortcut] if with_shortcut else [])]
    plain = convolve(x, conv, norm)
    plain = torch.relu(plain if shortcut is None else plain + shortcut)
    found = convolve_relu(x, conv, norm, shortcut)
    torch.testing.assert_close(found, plain)
    gradient = draw(*found.shape)
    of_parts = torch.autograd.grad(plain, inputs, gradient)
    torch.testing.assert_close(torch.autograd.grad(found, inputs, gradient), of_parts)


@pytest.mark.parametrize("size", [(8, 12), (40, 70)])
def test_cells_are_convolved_to_what_pixels_are(net: ResNet18, size: tuple[int, int]):
    assert size[0] % CELL == size[1] % CELL == 0
    images = draw_images(2, *size)
    gradients = []
    for stem in (net._stem, net._stem_of_cells):
        y = max_pool_relu(stem(images))
        gradients.append((y, *torch.autograd.grad(y, net.conv1.weight, draw(*y.shape))))
    torch.testing.assert_close(gradients[0], gradients[1])


@pytest.mark.parametrize("device", DEVICES)
def test_the_gradient_of_a_bias_is_the_sum_over_tokens(device: str):
    x, weight, bias = (draw(*s, device=device) for s in ((120, 8), (6, 8), (6,)))
    inputs = [value.requires_grad_() for value in (x, weight, bias)]
    gradient = draw(120, 6, device=device)
    results = []
    for affine in (AffineProduct.apply, nn.functional.linear):
        y = affine(*inputs)
        results.append((y, *torch.autograd.grad(y, inputs, gradient)))
    torch.testing.assert_close(results[0], results[1])


def test_parameters_cast_together_give_the_gradients_of_autocast(make_model, make_batch):
    model, batch = make_model().train(), make_batch()
    loss, results = LossModule(model), []
    names = [f"model.{name}" for name in model.product_parameters()]
    assert "model.decoder.layers.0.memory_attention.key.weight" in names
    assert not [name for name in names if "norm" in name or "state_projection" in name]
    cast = CastParameters(loss, names, torch.bfloat16)
    with torch.no_grad():  # the copies are of the weights as they are then
        for parameter in model.parameters():
            parameter.mul_(1.1)
    for compute in (loss, cast):
        model.zero_grad()
        with torch.autocast("cpu", torch.bfloat16):
            value = compute(batch)["loss"]
        value.backward()
        if compute is cast:
            cast.copy_gradients()
        found = {n: p.grad.clone() for n, p in model.named_parameters() if p.grad is not None}
        results.append({"loss": value.detach(), **found})
    assert results[0].keys() == results[1].keys()
    for name, expected in results[0].items():
        assert torch.equal(results[1][name], expected), name


def compare_pooling(device: str) -> None:
    """Raise where the kernels' result or gradient is not PyTorch's; ties go to the first."""
    for shape in ((2, 8, 12, 10), (1, 16, 7, 9), (3, 8, 5, 6), (1, 4, 1, 1)):
        for dtype in (torch.float32, torch.bfloat16):
            x = channels_last(draw(*shape).mul(4.0).round().div(4.0).to(device, dtype))
            x.requires_grad_()
            plain = torch.relu(nn.functional.max_pool2d(x, 3, 2, 1))
            found = MaxPoolRelu.apply(x)
            assert torch.equal(found, plain)
            gradient = draw(*found.shape, dtype=dtype, device=device)
            ((expected,), (of_x,)) = (torch.autograd.grad(y, x, gradient) for y in (plain, found))
            # Four gradients add up, in another order and in fp32.
            assert_near(of_x, expected, 1e-6 if dtype == torch.float32 else 2e-2)
    x = channels_last(draw(1, 8, 6, 6).to(device, torch.float32))
    x[0, 3, 2, 2] = torch.nan
    plain = torch.relu(nn.functional.max_pool2d(x, 3, 2, 1))
    torch.testing.assert_close(MaxPoolRelu.apply(x), plain, equal_nan=True, rtol=0.0, atol=0.0)
    assert plain.isnan().any()


@pytest.mark.cuda
def test_pooling_on_a_gpu():
    compare_pooling("cuda")


@pytest.mark.long
def test_pooling_in_the_interpreter():
    pytest.importorskip("triton", reason="pip install triton")
    # In a process of its own: Triton reads the variable when a kernel is defined.
    code = f"import runpy; runpy.run_path({__file__!r})['compare_pooling']('cpu')"
    environment = {"TRITON_INTERPRET": "1", "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    subprocess.run([sys.executable, "-c", code], env={**os.environ, **environment}, check=True)


@pytest.mark.cuda
@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
def test_features_and_gradients_on_a_gpu(net: ResNet18, dtype: torch.dtype):
    images, results = draw_images(2, 96, 128), []
    for device, number in (("cpu", torch.float64), ("cuda", torch.float32)):
        placed = net.to(device, number)
        with torch.autocast(device, dtype, enabled=dtype != torch.float32 and device == "cuda"):
            features = placed(images.to(device))
        gradient = draw(*features.shape, dtype=features.dtype, device=device)
        weights = [placed.conv1.weight, placed.get_submodule("layer3.0.conv2").weight]
        found = (features, *torch.autograd.grad(features, weights, gradient))
        results.append([value.detach().cpu().double() for value in found])
    net.to("cpu", torch.float64)
    for expected, found in zip(*results, strict=True):
        # TF32 and bf16 round the factors of every layer to 11 and 8 bits; some are rectified then
        # that were not. On a processor bf16 gives 0.98.
        cosine = nn.functional.cosine_similarity(expected.flatten(), found.flatten(), dim=0)
        assert cosine > (0.99 if dtype == torch.float32 else 0.96)


@pytest.mark.cuda
def test_the_gradient_of_the_loss_on_a_gpu(make_model, make_batch):
    """Cast, with all kernels, it points where that of fp32 on the processor does."""
    model, batch = make_model(backbone_width=64).train(), make_batch()
    model.loss(batch)["loss"].backward()
    expected = {n: p.grad.clone() for n, p in model.named_parameters() if p.grad is not None}
    model.zero_grad(set_to_none=True)
    model.cuda()
    loss = LossModule(model)
    names = [f"model.{name}" for name in model.product_parameters()]
    cast = CastParameters(loss, names, torch.bfloat16)
    values = {k: v.cuda() if isinstance(v, Tensor) else v for k, v in vars(batch).items()}
    with torch.autocast("cuda", torch.bfloat16):
        cast(type(batch)(**values))["loss"].backward()
    cast.copy_gradients()
    for name, parameter in model.named_parameters():
        if name in expected and expected[name].norm() > 1e-4:
            assert parameter.grad is not None
            pair = parameter.grad.cpu().flatten(), expected[name].flatten()
            assert nn.functional.cosine_similarity(*pair, dim=0) > 0.95, name


@pytest.mark.cuda
def test_predictions_on_a_gpu(make_model, make_batch):
    model, batch = make_model(backbone_width=64).eval(), make_batch()
    expected = model.predict(batch.state, batch.images, None)
    copied = model.for_inference(torch.bfloat16).cuda()
    with torch.inference_mode():
        found = copied.predict(batch.state.cuda(), batch.images.cuda(), None)
    assert_near(found.cpu(), expected, 0.05)
