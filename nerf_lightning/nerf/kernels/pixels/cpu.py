"""Batches of pixels and their contrast for the CPU, bit-identical to `RayBatches.batch_at` and `nerf.contrast`."""

from typing import no_type_check

import numpy as np
import torch
from jaxtyping import Int, UInt8
from numba import njit
from torch import Tensor

from nerf_lightning.nerf.contrast import FLAT, HIGHEST, SHIFT
from nerf_lightning.nerf.kernels.pixels.op import Domain, empty_batch
from nerf_lightning.nerf.kernels.random.cpu import mix
from nerf_lightning.nerf.kernels.threads import over_rows
from nerf_lightning.nerf.randomness import FEISTEL_ROUNDS, grid_of
from nerf_lightning.nerf.types.rays import Batch, KnownDepths
from nerf_lightning.nerf.types.scene import PixelStore


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
    """Fill a batch (`op.ordered_batch`)."""
    several, first, key, chooser, known_first, known_key = numbers.tolist()
    # Arrays that are absent are empty, so that there is one kernel for all cases.
    nothing, numbered, real = (torch.empty(0, dtype=kind) for kind in (torch.uint8, torch.int64, torch.float32))
    optional = [nothing if each is None else each for each in (store.mask, shares)]
    known = [*[numbered] * 3, *[real] * 2] if depths is None else depths.tensors()
    out = [*batch.tensors(), *([real] * 2 if depths is None else [])]
    over_rows(
        *(_batch, batch.num_rays, several, first, size, *grid_of(size), key, chooser, candidates),
        *(known_first, known_size, *grid_of(known_size), known_key),
        *(each.numpy() for each in (*domain, store.offset, store.width, store.rgba, *optional, *known, *out)),
    )


def contrast(rgba: UInt8[Tensor, "height width 4"]) -> UInt8[Tensor, "height width"]:
    """Return the shares of a picture's pixels."""
    out = torch.empty(rgba.shape[:2], dtype=torch.uint8)
    over_rows(_contrast, len(out), rgba.numpy(), FLAT, HIGHEST, SHIFT, out.numpy())
    return out


def trial() -> None:
    """Run every kernel once on tiny input; it raises whatever the compiler raises."""
    rgba, zero, one = torch.zeros(1, 1, 4, dtype=torch.uint8), torch.zeros(1).long(), torch.ones(1).long()
    shares = contrast(rgba).flatten()
    store = PixelStore(rgba.view(1, 4), zero, one, one, has_transparency=True)
    numbers = torch.tensor([1, 0, 0, 0, 0, 0])
    fill(empty_batch(1, zero.device, False), 1, 1, 2, Domain(one, one, zero, zero, zero), store, shares, None, numbers)


@njit
@no_type_check
def _change(here, other, channel):
    if channel == 3:
        return 255 * abs(np.int64(here[3]) - np.int64(other[3]))
    return abs(np.int64(here[3]) * np.int64(here[channel]) - np.int64(other[3]) * np.int64(other[channel]))


@njit(nogil=True, cache=True)
@no_type_check
def _contrast(first, last, rgba, flat, highest, shift, out):
    height, width = rgba.shape[:2]
    for y in range(first, last):
        above, below = max(y - 1, 0), min(y + 1, height - 1)
        for x in range(width):
            left, right, most = max(x - 1, 0), min(x + 1, width - 1), np.int64(0)
            for c in range(4):
                here = rgba[y, x]
                change = _change(here, rgba[above, x], c) + _change(here, rgba[below, x], c)
                change += _change(here, rgba[y, left], c) + _change(here, rgba[y, right], c)
                most = max(most, change)
            out[y, x] = min((most >> shift) + flat, highest)


@njit
@no_type_check
def _number(position, size, rows, columns, key):
    """Return what is at a place of the order (`randomness.permute`)."""
    epoch = position // size
    number = position - epoch * size
    start = mix(np.uint32(key) ^ mix(np.uint32(epoch)) ^ np.uint32(0x5A5A5A5A))
    while True:
        row = number // columns
        column = number - row * columns
        for each in range(FEISTEL_ROUNDS):
            word = mix(np.uint32(start + np.uint32(each) * np.uint32(0x1B873593)))
            if each % 2:
                column = (column + np.int64(mix(word ^ np.uint32(row)))) % columns
            else:
                row = (row + np.int64(mix(word ^ np.uint32(column)))) % rows
        number = row * columns + column
        if number < size:
            return number


@njit
@no_type_check
def _pixel(number, ends, across, views, left, top):
    """Return view, x and y of a number of a domain."""
    slot, high = 0, len(ends)
    while slot < high:
        middle = (slot + high) // 2
        if ends[middle] <= number:
            slot = middle + 1
        else:
            high = middle
    within = number - (ends[slot - 1] if slot > 0 else 0)
    row = within // across[slot]
    return views[slot], within - row * across[slot] + left[slot], row + top[slot]


@njit(nogil=True, cache=True)
@no_type_check
def _batch(
    begin, end, several, first, size, rows, columns, key, chooser, candidates,
    known_first, known_size, known_rows, known_columns, known_key,
    ends, across, views, left, top,
    offset, width, rgba, mask, shares,
    known_view, known_x, known_y, known_distance, known_certainty,
    out_view, out_x, out_y, colors, weight, out_distance, out_certainty,
):  # fmt: skip
    for i in range(begin, end):
        view, x, y = np.int64(0), np.int64(0), np.int64(0)
        distance, certainty, kept = np.float32(1), np.float32(0), np.float32(1)
        if i >= several:
            number = _number(i - several + known_first, known_size, known_rows, known_columns, known_key)
            view, x, y = known_view[number], known_x[number], known_y[number]
            distance, certainty = known_distance[number], known_certainty[number]
        else:
            total, share, start = np.int64(0), np.int64(0), (i + first) * candidates
            for position in range(start, start + candidates):
                number = _number(position, size, rows, columns, key)
                view_of, x_of, y_of = _pixel(number, ends, across, views, left, top)
                own = np.int64(1)
                if candidates > 1:
                    own = np.int64(shares[offset[view_of] + y_of * width[view_of] + x_of])
                total += own
                word = mix(np.uint32(position) ^ np.uint32(chooser))
                if position == start or np.int64(word >> np.uint32(8)) * total < (own << 24):
                    view, x, y, share = view_of, x_of, y_of, own
            kept = np.float32(total) / np.float32(max(candidates * share, 1))
        flat = offset[view] + y * width[view] + x
        if len(mask):
            kept = np.float32(kept * np.float32(mask[flat]))
        out_view[i], out_x[i], out_y[i], weight[i] = view, x, y, kept
        for c in range(4):
            colors[i, c] = np.float32(rgba[flat, c]) / np.float32(255)
        if len(out_distance):
            out_distance[i], out_certainty[i] = distance, np.float32(kept * certainty)
