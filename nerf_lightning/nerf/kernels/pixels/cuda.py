"""Batches of pixels for CUDA in one kernel: which pixels, in keyed order, and their content.

It is `RayBatches.batch_at` for single pixels, bit for bit. `TRITON_INTERPRET=1` runs it without a GPU.
"""

from typing import no_type_check

import torch
import triton
import triton.language as tl
from jaxtyping import Int, UInt8
from torch import Tensor

from nerf_lightning.nerf.kernels.pixels.op import Domain, empty_batch
from nerf_lightning.nerf.kernels.random.cuda import mix
from nerf_lightning.nerf.randomness import FEISTEL_ROUNDS, grid_of
from nerf_lightning.nerf.types.rays import Batch, KnownDepths, PixelIndex
from nerf_lightning.nerf.types.scene import PixelStore

BLOCK = 64
"""Small, so that a batch of some thousand pixels keeps a whole GPU busy: each walks through its permutation."""


def fill(
    batch: Batch,
    size: int,
    known_size: int,
    candidates: int,
    domain: Domain,
    store: PixelStore,
    shares: UInt8[Tensor, "pixels"] | None,
    depths: KnownDepths | None,
    numbers: Int[Tensor, "6"],
) -> None:
    """Fill a batch (`op.ordered_batch`) by numbers on the device, in the order in which the kernel loads them."""
    count = batch.num_rays
    if count:
        _batch[(triton.cdiv(count, BLOCK),)](
            *(*batch.pixels.tensors(), batch.rgba, batch.weight, batch.distance, batch.certainty),
            *(numbers, count, size, *grid_of(size), known_size, *grid_of(known_size)),
            *(*domain, len(domain.ends), len(domain.ends).bit_length()),
            *(store.offset, store.width, store.rgba, store.mask, shares),
            *([None] * 5 if depths is None else depths.tensors()),
            *(candidates, FEISTEL_ROUNDS),
            BLOCK,
        )


def trial(device: str = "cuda") -> None:
    """Run every kernel once on tiny input; it raises whatever the compiler or driver raises.

    Raises:
        RuntimeError: the result is wrong.
    """
    ends, views = torch.tensor([[4, 8], [0, 1]], device=device)  # two pictures of 2 x 2
    domain, rgba = Domain(ends, 0 * views + 2, views, 0 * views, 0 * views), torch.arange(32, device=device)
    store = PixelStore(rgba.view(8, 4).to(torch.uint8), ends - 4, 0 * views + 2, 0 * views + 2, has_transparency=True)
    depths = KnownDepths(PixelIndex(views, views, 0 * views), views + 1.5, views + 0.5)
    numbers = torch.tensor([8, 0, 1, 0, 0, 1], device=device)
    found = empty_batch(10, numbers.device, True)
    fill(found, 8, 2, 1, domain, store, None, depths, numbers)
    number = 4 * found.pixels.view + 2 * found.pixels.y + found.pixels.x
    right = torch.equal(number[:8].sort().values, torch.arange(8, device=device))
    if not right or not torch.equal((255 * found.rgba[:, 0]).round(), 4.0 * number):
        raise RuntimeError("a trial of its kernels gave wrong pixels")


@triton.jit
@no_type_check
def _number(position, size, rows, columns, key, valid, rounds: tl.constexpr):
    """Return what is at places of the order (`randomness.permute`)."""
    epoch = position // size
    number = position - epoch * size
    start = mix(key ^ mix(epoch.to(tl.uint32)) ^ 0x5A5A5A5A)
    walks = valid
    while tl.max(walks.to(tl.int32), axis=0) > 0:
        row = number // columns
        column = number - row * columns
        for each in tl.static_range(rounds):
            word = mix((start + each * 0x1B873593).to(tl.uint32))
            if each % 2:
                column = (column + mix(word ^ row.to(tl.uint32)).to(tl.int64)) % columns
            else:
                row = (row + mix(word ^ column.to(tl.uint32)).to(tl.int64)) % rows
        number = tl.where(walks, row * columns + column, number)
        walks = walks & (number >= size)
    return number


@triton.jit
@no_type_check
def _pixel(number, ends, across, views, left, top, slots, steps, valid, block: tl.constexpr):
    """Return view, x and y of numbers of a domain: how many views end before each, by bisection."""
    low, high = tl.zeros([block], tl.int32), tl.full([block], slots, tl.int32)
    for _ in range(steps):
        middle = (low + high) // 2
        open = valid & (low < high)
        beyond = open & (tl.load(ends + middle, mask=open, other=0) <= number)
        high = tl.where(open & ~beyond, middle, high)
        low = tl.where(beyond, middle + 1, low)
    within = number - tl.load(ends + low - 1, mask=valid & (low > 0), other=0)
    side = tl.load(across + low, mask=valid, other=1)
    x = within % side + tl.load(left + low, mask=valid, other=0)
    return tl.load(views + low, mask=valid, other=0), x, within // side + tl.load(top + low, mask=valid, other=0)


@triton.jit(do_not_specialize=["count"])
@no_type_check
def _batch(
    out_view, out_x, out_y, colors, weight, out_distance, out_certainty,
    numbers, count, size, rows, columns, known_size, known_rows, known_columns,
    ends, across, views, left, top, slots, steps,
    offset, width, rgba, mask, shares,
    known_view, known_x, known_y, known_distance, known_certainty,
    candidates: tl.constexpr, rounds: tl.constexpr, block: tl.constexpr,
):  # fmt: skip
    index = tl.program_id(0).to(tl.int64) * block + tl.arange(0, block)
    several, first, key = tl.load(numbers), tl.load(numbers + 1), tl.load(numbers + 2)
    chooser, known_first, known_key = tl.load(numbers + 3), tl.load(numbers + 4), tl.load(numbers + 5)
    valid, is_known = index < count, index >= several
    # Rays have `candidates` places each, rays through pixels of known distance one.
    size = tl.where(is_known, known_size, size).to(tl.int64)
    rows = tl.where(is_known, known_rows, rows).to(tl.int64)
    columns = tl.where(is_known, known_columns, columns).to(tl.int64)
    key = tl.where(is_known, known_key, key).to(tl.uint32)
    position = tl.where(is_known, index - several + known_first, (index + first) * candidates)
    numbered = valid & ~is_known
    number = _number(position, size, rows, columns, key, valid, rounds)
    view, x, y = _pixel(number, ends, across, views, left, top, slots, steps, numbered, block)
    kept = tl.full([block], 1.0, tl.float32)
    if candidates > 1:
        total = tl.zeros([block], tl.int64)
        share = tl.zeros([block], tl.int64)
        for each in range(candidates):
            other = _number(position + each, size, rows, columns, key, numbered, rounds)
            view_of, x_of, y_of = _pixel(other, ends, across, views, left, top, slots, steps, numbered, block)
            flat = tl.load(offset + view_of, mask=numbered, other=0)
            flat += y_of * tl.load(width + view_of, mask=numbered, other=0) + x_of
            own = tl.load(shares + flat, mask=numbered, other=0).to(tl.int64)
            total += own
            word = mix((position + each).to(tl.uint32) ^ chooser.to(tl.uint32))
            taken = numbered & ((word >> 8).to(tl.int64) * total < (own << 24))
            view, x, y = tl.where(taken, view_of, view), tl.where(taken, x_of, x), tl.where(taken, y_of, y)
            share = tl.where(taken, own, share)
        ratio = tl.div_rn(total.to(tl.float32), tl.maximum(candidates * share, 1).to(tl.float32))
        kept = tl.where(is_known, kept, ratio)
    if known_view is not None:
        told = valid & is_known
        view = tl.where(told, tl.load(known_view + number, mask=told, other=0), view)
        x = tl.where(told, tl.load(known_x + number, mask=told, other=0), x)
        y = tl.where(told, tl.load(known_y + number, mask=told, other=0), y)
    tl.store(out_view + index, view, mask=valid)
    tl.store(out_x + index, x, mask=valid)
    tl.store(out_y + index, y, mask=valid)
    # The pixels' content.
    flat = tl.load(offset + view, mask=valid, other=0) + y * tl.load(width + view, mask=valid, other=0) + x
    channel, inside = tl.arange(0, 4)[None, :], valid[:, None]
    color = tl.load(rgba + 4 * flat[:, None] + channel, mask=inside, other=0).to(tl.float32)
    tl.store(colors + 4 * index[:, None] + channel, tl.div_rn(color, 255.0), mask=inside)
    if mask is not None:
        seen = tl.load(mask + flat, mask=valid, other=0).to(tl.float32)
        kept = kept * seen
    tl.store(weight + index, kept, mask=valid)
    if known_view is not None:
        tl.store(out_distance + index, tl.load(known_distance + number, mask=told, other=1.0), mask=valid)
        tl.store(out_certainty + index, kept * tl.load(known_certainty + number, mask=told, other=0.0), mask=valid)
