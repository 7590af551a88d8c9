"""ResNet-18 without its classifier, its parameters named as torchvision names them.

Legend: I images, H and W their height and width, h = ceil(H / 32), w = ceil(W / 32).
"""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any, cast

import torch
from torch import Tensor, nn

from robo_manip_baselines.policy.act.pooling import max_pool_relu
from robo_manip_baselines.runs.errors import RequestError
from robo_manip_baselines.runs.tensors import read_tensors, require_finite

STRIDE = 32
"""Pixels of the image to a cell of the last feature map."""

WIDTH = 64
"""Channels of the first of the four stages (He et al. 2016); each later one has twice as many."""

STAGES = 4

CELL = 2
"""Pixels of a side of the cells that a GPU convolves in place of pixels: the first stride."""

CELL_CHANNELS = 16
"""Channels of a cell: 12 of four pixels, the others 0."""

# Mean and standard deviation of ImageNet's colours from 0 to 1, with which torchvision's weights
# were trained; public ACT uses them too.
MEAN = (0.485, 0.456, 0.406)
STD = (0.229, 0.224, 0.225)


class FrozenBatchNorm(nn.Module):
    """Batch normalisation whose statistics and scales never change (DETR): a constant y = a x + b.

    A batch of 8 is too small for statistics of its own. The constants are buffers, so they are
    saved and loaded but not trained.
    """

    weight: Tensor
    bias: Tensor
    running_mean: Tensor
    running_var: Tensor

    def __init__(self, channels: int, eps: float = 1e-5) -> None:
        super().__init__()
        self.eps = eps
        self.register_buffer("weight", torch.ones(channels))
        self.register_buffer("bias", torch.zeros(channels))
        self.register_buffer("running_mean", torch.zeros(channels))
        self.register_buffer("running_var", torch.ones(channels))

    def scale_and_shift(self) -> tuple[Tensor, Tensor]:
        """Return a and b, each of one element a channel."""
        scale = self.weight * torch.rsqrt(self.running_var + self.eps)
        return scale, self.bias - self.running_mean * scale


def for_products(x: Tensor) -> Tensor:
    """Return a tensor in the type of autocast's products, where there is autocast.

    What several layers read is thus cast once.
    """
    kind = x.device.type
    if kind in ("cpu", "cuda") and torch.is_autocast_enabled(kind):
        return x.to(torch.get_autocast_dtype(kind))
    return x


def convolve(x: Tensor, conv: nn.Conv2d, norm: nn.Module) -> Tensor:
    """Convolve and normalise in one pass over the image: the constants go into the kernel."""
    kernel, shift = _folded(conv, norm)
    return nn.functional.conv2d(x, kernel, shift, conv.stride, conv.padding)


def convolve_relu(
    x: Tensor, conv: nn.Conv2d, norm: nn.Module, shortcut: Tensor | None = None
) -> Tensor:
    """Convolve, normalise, add the shortcut and rectify; one kernel on a CUDA device."""
    if torch.compiler.is_compiling():
        y = convolve(x, conv, norm)
        return nn.functional.relu(y if shortcut is None else y + shortcut)
    kernel, shift = _folded(conv, norm)
    return _ConvolveRelu.apply(x, kernel, shift, shortcut, conv.stride, conv.padding, True)


def _folded(conv: nn.Conv2d, norm: nn.Module) -> tuple[Tensor, Tensor | None]:
    """Kernel and bias that do the work of both, in the type in which autocast convolves."""
    if isinstance(norm, FrozenBatchNorm):
        kernel, shift = _fold(conv, norm)
    else:
        kernel, shift = conv.weight, conv.bias
    return for_products(kernel), None if shift is None else for_products(shift)


def _fold(conv: nn.Conv2d, norm: FrozenBatchNorm) -> tuple[Tensor, Tensor]:
    """Kernel, in the order of memory that images come in, and bias that do the work of both."""
    scale, shift = norm.scale_and_shift()
    kernel = conv.weight * scale[:, None, None, None]
    return kernel.contiguous(memory_format=torch.channels_last), shift


class _ConvolveRelu(torch.autograd.Function):
    """relu(conv2d(x, kernel) + shift + shortcut), of which only the result is kept.

    Not differentiable in the shift, which is constant in training. ``is_rectified_back`` is False
    where what follows passes no gradient on to elements that are 0.
    """

    @staticmethod
    def forward(
        ctx: Any,
        x: Tensor,
        kernel: Tensor,
        shift: Tensor | None,
        shortcut: Tensor | None,
        stride: tuple[int, int],
        padding: tuple[int, int],
        is_rectified_back: bool,
    ) -> Tensor:
        x = x.to(kernel.dtype)
        shortcut = None if shortcut is None else shortcut.to(kernel.dtype)
        if x.is_cuda:
            others = shift, stride, padding, (1, 1), 1
            if shortcut is None:
                y = torch.cudnn_convolution_relu(x, kernel, *others)
            else:
                y = torch.cudnn_convolution_add_relu(x, kernel, shortcut, 1.0, *others)
        else:
            y = nn.functional.conv2d(x, kernel, shift, stride, padding)
            if shortcut is not None:
                y.add_(shortcut)
            nn.functional.relu(y, inplace=True)
        ctx.save_for_backward(x, kernel, y)
        ctx.settings = stride, padding, is_rectified_back
        return y

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        x, kernel, y = ctx.saved_tensors
        stride, padding, is_rectified_back = ctx.settings
        gradient = gradients[0]
        if is_rectified_back:
            gradient = torch.ops.aten.threshold_backward(gradient, y, 0)
        wanted = [*ctx.needs_input_grad[:2], False]
        others = stride, padding, (1, 1), False, (0, 0), 1, wanted
        of_x, of_kernel, _ = torch.ops.aten.convolution_backward(gradient, x, kernel, None, *others)
        beside = gradient if ctx.needs_input_grad[3] else None
        return of_x, of_kernel, None, beside, None, None, None


class BasicBlock(nn.Module):
    """Two 3x3 convolutions beside a shortcut."""

    def __init__(self, channels_in: int, channels_out: int, stride: int) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(channels_in, channels_out, 3, stride, 1, bias=False)
        self.bn1 = FrozenBatchNorm(channels_out)
        self.conv2 = nn.Conv2d(channels_out, channels_out, 3, 1, 1, bias=False)
        self.bn2 = FrozenBatchNorm(channels_out)
        self.downsample: nn.Sequential | None = None
        if stride != 1 or channels_in != channels_out:
            self.downsample = nn.Sequential(
                nn.Conv2d(channels_in, channels_out, 1, stride, bias=False),
                FrozenBatchNorm(channels_out),
            )

    def forward(self, x: Tensor) -> Tensor:
        """Return the feature map of the next block."""
        inner = convolve_relu(x, self.conv1, self.bn1)
        if self.downsample is not None:
            conv, norm = self.downsample
            x = convolve(x, cast("nn.Conv2d", conv), norm)
        return convolve_relu(inner, self.conv2, self.bn2, shortcut=x)


class ResNet18(nn.Module):
    """ResNet-18 from images to a feature map (He et al. 2016).

    Random weights are drawn as torchvision draws them (Kaiming, fan-out). Without batch
    statistics the sum of a block and its shortcut doubles the variance, but each strided stage
    halves it, so that activations grow fivefold over the whole network and need no other remedy.

    Args:
        width: channels of the first stage.

    Attributes:
        features: F, channels of the feature map, eight times ``width``.
    """

    mean: Tensor
    scale: Tensor

    def __init__(self, width: int = WIDTH) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(3, width, 7, 2, 3, bias=False)
        self.bn1 = FrozenBatchNorm(width)
        channels_in = width
        for stage in range(1, STAGES + 1):
            channels_out = width << (stage - 1)
            first = BasicBlock(channels_in, channels_out, 1 if stage == 1 else 2)
            second = BasicBlock(channels_out, channels_out, 1)
            self.add_module(f"layer{stage}", nn.Sequential(first, second))
            channels_in = channels_out
        self.features = channels_in
        mean, std = (255.0 * torch.tensor(values)[:, None, None] for values in (MEAN, STD))
        self.register_buffer("mean", mean, persistent=False)
        self.register_buffer("scale", 1.0 / std, persistent=False)
        for module in self.modules():
            if isinstance(module, nn.Conv2d):
                nn.init.kaiming_normal_(module.weight, mode="fan_out", nonlinearity="relu")

    def forward(self, images: Tensor) -> Tensor:
        """Return (I, F, h, w) for (I, H, W, 3) uint8 images."""
        in_cells = (
            images.is_cuda
            and not torch.compiler.is_compiling()
            and images.shape[1] % CELL == images.shape[2] % CELL == 0
        )
        x = self._stem_of_cells(images) if in_cells else self._stem(images)
        # Rectifying after the maximum gives the same numbers and has a quarter of them to do.
        x = max_pool_relu(x)
        for stage in range(1, STAGES + 1):
            x = self.get_submodule(f"layer{stage}")(x)
        return x

    def _stem(self, images: Tensor) -> Tensor:
        """Return (I, F / 8, H / 2, W / 2) of the first convolution."""
        # (H, W, 3) images seen as (3, H, W) are in the channels-last order already.
        x = (images.permute(0, 3, 1, 2) - self.mean) * self.scale
        return convolve(x.to(self.conv1.weight.dtype), self.conv1, self.bn1)

    def _stem_of_cells(self, images: Tensor) -> Tensor:
        """Return the same, rectified, from cells of 2x2 pixels; H and W are even.

        A kernel of 7x7 pixels that moves by 2 is one of 4x4 cells that moves by 1. A GPU multiplies
        8 channels at a time: of a pixel there are 3, of a cell 12.
        """
        count, height, width, _ = images.shape
        rows, columns = height // CELL, width // CELL
        cells = images.view(count, rows, CELL, columns, CELL, 3).transpose(2, 3)
        pixels = cells.reshape(count, rows, columns, CELL**2, 3)
        pixels = (pixels - self.mean.view(3)) * self.scale.view(3)
        kernel, shift = _folded(self.conv1, self.bn1)
        # Three pixels of zeros before and after are two cells before, with one pixel that a row and
        # a column of zeros in the kernel leave out, and one after.
        shape = count, rows + 3, columns + 3, CELL_CHANNELS
        x = torch.zeros(shape, dtype=kernel.dtype, device=images.device)
        x[:, 2:-1, 2:-1, : 3 * CELL**2] = pixels.flatten(3)
        kernel = nn.functional.pad(kernel, (1, 0, 1, 0))
        kernel = kernel.unflatten(3, (-1, CELL)).unflatten(2, (-1, CELL))
        kernel = kernel.permute(0, 3, 5, 1, 2, 4).flatten(1, 3)
        kernel = nn.functional.pad(kernel, (0, 0, 0, 0, 0, CELL_CHANNELS - kernel.shape[1]))
        kernel = kernel.contiguous(memory_format=torch.channels_last)
        x = x.permute(0, 3, 1, 2)
        return _ConvolveRelu.apply(x, kernel, shift, None, (1, 1), (0, 0), False)


def fold_for_inference(backbone: ResNet18) -> None:
    """Replace every convolution and its normalisation by one convolution that does both."""
    for parent in list(backbone.modules()):
        for conv_name, norm_name in (("conv1", "bn1"), ("conv2", "bn2"), ("0", "1")):
            conv, norm = getattr(parent, conv_name, None), getattr(parent, norm_name, None)
            if not isinstance(conv, nn.Conv2d) or not isinstance(norm, FrozenBatchNorm):
                continue
            kernel, shift = _fold(conv, norm)
            conv.weight, conv.bias = nn.Parameter(kernel), nn.Parameter(shift)
            setattr(parent, norm_name, nn.Identity())


def feature_size(image: tuple[int, int]) -> tuple[int, int]:
    """Return (h, w) of the feature map of an (H, W) image."""
    return -(-image[0] // STRIDE), -(-image[1] // STRIDE)


SUFFIXES = (".safetensors", ".pth", ".pt")

_IGNORED_PREFIX = "fc."  # the classifier
_IGNORED_SUFFIX = ".num_batches_tracked"  # how long the statistics were gathered


def load_backbone(backbone: ResNet18 | None, path: str | Path) -> None:
    """Load the state dict of a torchvision ResNet-18 into ``backbone``.

    A ``.pth`` file is read by PyTorch's reader of tensors alone, which runs no code of the file.

    Raises:
        RequestError: there is no backbone, no such file, or it holds something else.
    """
    path = Path(path)
    if backbone is None:
        raise RequestError(f"backbone_weights '{path}' without cameras: leave one of the two out")
    found = _read(path)
    for name in list(found):
        if name.startswith(_IGNORED_PREFIX) or name.endswith(_IGNORED_SUFFIX):
            del found[name]
    wanted = backbone.state_dict()
    for name in sorted(wanted.keys() | found.keys()):
        if name not in found:
            raise _refusal(path, f"'{name}' is not in it")
        if name not in wanted:
            raise _refusal(path, f"it has '{name}' too")
        if found[name].shape != wanted[name].shape:
            shapes = f"{tuple(found[name].shape)}, not {tuple(wanted[name].shape)}"
            raise _refusal(path, f"'{name}' is of shape {shapes}")
        if not found[name].is_floating_point():
            raise _refusal(path, f"'{name}' is of type {found[name].dtype}")
    require_finite(found, f"backbone_weights '{path}'")
    backbone.load_state_dict(found)


def _read(path: Path) -> dict[str, Tensor]:
    if path.suffix not in SUFFIXES:
        raise RequestError(f"backbone_weights '{path}': must be one of {', '.join(SUFFIXES)}")
    if not path.is_file():
        raise RequestError(f"backbone_weights '{path}': there is no such file")
    try:
        if path.suffix == ".safetensors":
            return read_tensors(path)[0]
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # about the age of the file's format
            found = torch.load(path, map_location="cpu", weights_only=True)
    except RequestError as error:
        raise _refusal(path, str(error).removeprefix(f"{path}: ")) from error
    except Exception as error:  # unpickling fails in every way there is
        raise _refusal(path, "it holds more than tensors, or is damaged") from error
    if not isinstance(found, dict) or not all(isinstance(v, Tensor) for v in found.values()):
        raise _refusal(path, "it is no state dict")
    return found


def _refusal(path: Path, reason: str) -> RequestError:
    return RequestError(
        f"backbone_weights '{path}' is no state dict of torchvision's resnet18: {reason}"
    )
