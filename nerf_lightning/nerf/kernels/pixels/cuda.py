"""Pixels of a batch for CUDA: which they are, and what they show. `TRITON_INTERPRET=1` runs it without a GPU."""

from typing import no_type_check

import torch
import triton
import triton.language as tl
from jaxtyping import Float, Int, UInt8
from torch import Tensor

BLOCK = 256


def locate(
    number: Int[Tensor, "*rays"],
    ends: Int[Tensor, "views"],
    columns: Int[Tensor, "views"],
    views: Int[Tensor, "views"],
    left: Int[Tensor, "views"],
    top: Int[Tensor, "views"],
) -> tuple[Int[Tensor, "*rays"], Int[Tensor, "*rays"], Int[Tensor, "*rays"]]:
    """Return view, column and row of numbered pixels (`data.ray_batches.PixelDomain`).

    Args:
        number: of the pixels.
        ends: the number that follows each view's last pixel.
        columns: pixels in a row of each view that are numbered.
        views: which view each is.
        left: column of its first numbered pixel.
        top: row of it.
    """
    view, x, y = (torch.empty_like(number, memory_format=torch.contiguous_format) for _ in range(3))
    count, steps = number.numel(), len(ends).bit_length()
    if count:
        arrays = number.contiguous(), ends, columns, views, left, top, view, x, y
        _locate[(triton.cdiv(count, BLOCK),)](*arrays, count, len(ends), steps, BLOCK)
    return view, x, y


def gather(
    view: Int[Tensor, "*rays"],
    x: Int[Tensor, "*rays"],
    y: Int[Tensor, "*rays"],
    offset: Int[Tensor, "views"],
    width: Int[Tensor, "views"],
    rgba: UInt8[Tensor, "pixels 4"],
    mask: UInt8[Tensor, "pixels"] | None,
) -> tuple[Float[Tensor, "*rays 4"], Float[Tensor, "*rays"]]:
    """Return colors in [0, 1] and weights of pixels; the arrays are those of `PixelStore`."""
    colors = torch.empty(*view.shape, 4, device=rgba.device)
    weight = torch.empty(view.shape, device=rgba.device)
    count = view.numel()
    if count:
        pixels = (each.contiguous() for each in (view, x, y))
        masks = rgba if mask is None else mask
        arrays = *pixels, offset, width, rgba, masks, colors, weight
        _gather[(triton.cdiv(count, BLOCK),)](*arrays, count, mask is not None, BLOCK)
    return colors, weight


def trial(device: str = "cuda") -> None:
    """Run every kernel once on next to nothing; it raises whatever its compiler or driver raises.

    Raises:
        RuntimeError: they compute wrongly.
    """
    ends, views = torch.tensor([[4, 8], [0, 1]], device=device)  # two pictures of 2 x 2
    view, x, y = locate(ends - 1, ends, 0 * views + 2, views, 0 * views, 0 * views)  # their last pixels
    rgba = torch.arange(32, device=device).clamp(max=15).view(8, 4).to(torch.uint8)
    colors, weight = gather(view, x, y, ends - 4, 0 * views + 2, 17 * rgba, None)
    found = view.tolist(), x.tolist(), y.tolist(), colors[1].tolist(), weight.tolist()
    if found != ([0, 1], [1, 1], [1, 1], [1.0] * 4, [1.0, 1.0]):
        raise RuntimeError("a trial of its kernels gave wrong numbers")


@triton.jit
@no_type_check
def _locate(number, ends, columns, views, left, top, view, x, y, count, slots, steps, block: tl.constexpr):
    index = tl.program_id(0).to(tl.int64) * block + tl.arange(0, block)
    valid = index < count
    pixel = tl.load(number + index, mask=valid, other=0)
    # How many views end before the pixel: halving what is left.
    low, high = tl.zeros([block], tl.int32), tl.full([block], slots, tl.int32)
    for _ in range(steps):
        middle = (low + high) // 2
        beyond = (low < high) & (tl.load(ends + middle, mask=low < high, other=0) <= pixel)
        high = tl.where(beyond, high, middle)
        low = tl.where(beyond, middle + 1, low)
    start = tl.load(ends + low - 1, mask=valid & (low > 0), other=0)
    across = tl.load(columns + low, mask=valid, other=1)
    row = (pixel - start) // across
    tl.store(view + index, tl.load(views + low, mask=valid, other=0), mask=valid)
    tl.store(x + index, pixel - start - row * across + tl.load(left + low, mask=valid, other=0), mask=valid)
    tl.store(y + index, row + tl.load(top + low, mask=valid, other=0), mask=valid)


@triton.jit
@no_type_check
def _gather(
    views, xs, ys, offset, width, rgba, masks, colors, weight, count, masked: tl.constexpr, block: tl.constexpr
):
    index = tl.program_id(0).to(tl.int64) * block + tl.arange(0, block)
    valid = index < count
    view = tl.load(views + index, mask=valid, other=0)
    row, column = tl.load(ys + index, mask=valid, other=0), tl.load(xs + index, mask=valid, other=0)
    flat = tl.load(offset + view, mask=valid, other=0) + row * tl.load(width + view, mask=valid, other=0) + column
    channel, inside = tl.arange(0, 4)[None, :], valid[:, None]
    color = tl.load(rgba + 4 * flat[:, None] + channel, mask=inside, other=0).to(tl.float32)
    tl.store(colors + 4 * index[:, None] + channel, tl.div_rn(color, 255.0), mask=inside)
    kept = tl.full([block], 1.0, tl.float32)
    if masked:
        kept = tl.load(masks + flat, mask=valid, other=0).to(tl.float32)
    tl.store(weight + index, kept, mask=valid)
