"""Largest of 3x3 pixels, rectified, and its gradient, each in one kernel on a CUDA device.

PyTorch's own, for images whose channels lie side by side, take 1.5 of the 22 ms of a step at the
paper's size (H200), and keep eight bytes for each pixel to say which was the largest. These keep
one. They are written in Triton, which PyTorch brings along on Linux; without it PyTorch's own do
the work.

Legend: I images, H and W height and width before, h and w after, C channels.
"""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor, nn

if TYPE_CHECKING:
    triton: Any = None
    tl: Any = None
else:
    try:
        import triton
        import triton.language as tl
    except ImportError:
        triton = tl = None

logger = logging.getLogger(__name__)

PIXELS = 32
"""Pixels of a program of the GPU, with all of their channels."""

_is_usable = triton is not None


def max_pool_relu(x: Tensor) -> Tensor:
    """Return relu(max_pool2d(x, 3, 2, 1)), (I, C, h, w) from (I, C, H, W)."""
    global _is_usable
    channels = x.shape[1]
    fits = channels & (channels - 1) == 0 and x.is_contiguous(memory_format=torch.channels_last)
    if x.is_cuda and fits and _is_usable and not torch.compiler.is_compiling():
        try:
            return MaxPoolRelu.apply(x)
        except Exception as error:  # no C compiler, an old GPU: Triton fails in many ways
            _is_usable = False
            reason = str(error).splitlines()[:1]
            logger.warning("no kernel of Triton, so that pooling is slower: %s", *reason)
    return nn.functional.relu(nn.functional.max_pool2d(x, 3, 2, 1), inplace=True)


class MaxPoolRelu(torch.autograd.Function):
    """The kernels below as an operation with a gradient."""

    @staticmethod
    def forward(ctx: Any, x: Tensor) -> Tensor:
        """Return (I, C, h, w) from (I, C, H, W), both with the channels last in memory."""
        count, channels, height, width = x.shape
        rows, columns = (height + 1) // 2, (width + 1) // 2
        y = _empty(x, count, channels, rows, columns)
        place = torch.empty_like(y, dtype=torch.uint8)
        pixels = count * rows * columns
        sizes = height, width, rows, columns, pixels, channels, PIXELS
        _forward_kernel[(triton.cdiv(pixels, PIXELS),)](x, y, place, *sizes)
        ctx.save_for_backward(place)
        ctx.size = height, width
        return y

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> Tensor:
        """Return the gradient (I, C, H, W): the largest of the nine pixels has it."""
        (place,) = ctx.saved_tensors
        gradient = gradients[0].contiguous(memory_format=torch.channels_last)
        (count, channels, rows, columns), (height, width) = place.shape, ctx.size
        found = _empty(gradient, count, channels, height, width)
        pixels = count * height * width
        sizes = height, width, rows, columns, pixels, channels, PIXELS
        _backward_kernel[(triton.cdiv(pixels, PIXELS),)](gradient, place, found, *sizes)
        return found


def _empty(like: Tensor, *shape: int) -> Tensor:
    return torch.empty(
        shape, dtype=like.dtype, device=like.device, memory_format=torch.channels_last
    )


def _forward(
    x_ptr,
    y_ptr,
    place_ptr,
    height,
    width,
    rows,
    columns,
    pixels,
    channels: tl.constexpr,  # pyright: ignore[reportInvalidTypeForm]
    block: tl.constexpr,  # pyright: ignore[reportInvalidTypeForm]
):
    """Largest of the nine pixels, or 0, and which of them it is."""
    pixel = tl.program_id(0) * block + tl.arange(0, block)
    channel = tl.arange(0, channels)
    column, row = pixel % columns, pixel // columns % rows
    image = pixel // (columns * rows)
    best = tl.zeros((block, channels), tl.float32)
    place = tl.full((block, channels), 9, tl.int32)  # of nine pixels: none is above 0
    for down in tl.static_range(3):
        for right in tl.static_range(3):
            y, x = 2 * row - 1 + down, 2 * column - 1 + right
            inside = (pixel < pixels) & (y >= 0) & (y < height) & (x >= 0) & (x < width)
            source = ((image * height + y) * width + x).to(tl.int64)[:, None] * channels
            source += channel[None, :]
            value = tl.load(x_ptr + source, mask=inside[:, None], other=0.0).to(tl.float32)
            is_larger = (value > best) | (value != value)  # not a number stays visible
            best = tl.where(is_larger, value, best)
            place = tl.where(is_larger, 3 * down + right, place)
    target = pixel.to(tl.int64)[:, None] * channels + channel[None, :]
    kept = (pixel < pixels)[:, None]
    tl.store(y_ptr + target, best.to(y_ptr.dtype.element_ty), mask=kept)
    tl.store(place_ptr + target, place.to(tl.uint8), mask=kept)


def _backward(
    gradient_ptr,
    place_ptr,
    found_ptr,
    height,
    width,
    rows,
    columns,
    pixels,
    channels: tl.constexpr,  # pyright: ignore[reportInvalidTypeForm]
    block: tl.constexpr,  # pyright: ignore[reportInvalidTypeForm]
):
    """Sum of the gradients of the one, two or four results in which a pixel may be the largest."""
    pixel = tl.program_id(0) * block + tl.arange(0, block)
    channel = tl.arange(0, channels)
    x, y = pixel % width, pixel // width % height
    image = pixel // (width * height)
    total = tl.zeros((block, channels), tl.float32)
    for up in tl.static_range(2):
        for left in tl.static_range(2):
            row, column = (y + 1) // 2 - up, (x + 1) // 2 - left
            down, right = y - 2 * row + 1, x - 2 * column + 1
            inside = (pixel < pixels) & (row >= 0) & (row < rows) & (down < 3)
            inside = inside & (column >= 0) & (column < columns) & (right < 3)
            source = ((image * rows + row) * columns + column).to(tl.int64)[:, None] * channels
            source += channel[None, :]
            place = tl.load(place_ptr + source, mask=inside[:, None], other=9).to(tl.int32)
            gradient = tl.load(gradient_ptr + source, mask=inside[:, None], other=0.0)
            is_here = place == (3 * down + right)[:, None]
            total += tl.where(is_here, gradient.to(tl.float32), 0.0)
    target = pixel.to(tl.int64)[:, None] * channels + channel[None, :]
    kept = (pixel < pixels)[:, None]
    tl.store(found_ptr + target, total.to(found_ptr.dtype.element_ty), mask=kept)


_forward_kernel: Any = triton and triton.jit(_forward)
_backward_kernel: Any = triton and triton.jit(_backward)
