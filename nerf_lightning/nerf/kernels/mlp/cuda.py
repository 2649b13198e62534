"""The MLP in bfloat16 for CUDA: a block of rows goes through all layers without leaving the registers.

A framework writes and reads the activations of each layer; these kernels write only what the backward pass needs.
Products are of bfloat16 numbers, sums are float32. `TRITON_INTERPRET=1` runs the kernels without a GPU.
"""

import functools
import logging
import math
from collections.abc import Sequence
from itertools import pairwise
from typing import Any, no_type_check

import torch
import triton
import triton.language as tl
from jaxtyping import BFloat16, Float, Int
from torch import Tensor
from triton.runtime.errors import OutOfResources

from nerf_lightning.nerf.kernels.padding import end_of_rows

log = logging.getLogger(__name__)

BLOCK, BACKWARD_BLOCK = 128, 64
FORWARD: dict[str, Any] = {"enable_fp_fusion": True}
# A pipeline would keep the rows of several iterations in shared memory: 124 KiB for layers 32-64-64-3, where most GPUs
# have 99. With one stage it is 16 to 32 KiB, and 64 for layers of 128. With larger blocks and fewer warps most sums
# would not fit into the registers.
# With 4 warps the code of Triton 3.6 ends in an illegal memory access on an H100 (triton-lang/triton, issue 11366).
BACKWARD: dict[str, Any] = {"enable_fp_fusion": True, "num_stages": 1, "num_warps": 8}
PROGRAMS = 4
"""Programs per multiprocessor: each sums gradients of the weights separately, and the order of all sums is fixed. On an
H100 four take two thirds of the time of two."""
ELSEWHERE = 64
"""Number of multiprocessors assumed in the interpreter."""
NARROWEST, WIDEST = 16, 128
LAYERS = (2, 3)
INTERPRETED = triton.knobs.runtime.interpret
"""Triton's interpreter cannot multiply bfloat16 numbers."""


@functools.cache
def takes(sizes: tuple[int, ...], device: torch.device) -> bool:
    """Return whether the kernels run here for an MLP of these widths, from inputs to outputs; tried once."""
    if len(sizes) - 1 not in LAYERS or max(sizes) > WIDEST:
        return False
    try:
        weights = [torch.zeros(outer, inner, device=device) for inner, outer in pairwise(sizes)]
        out, saved = forward(torch.zeros(BLOCK, sizes[0], device=device), weights, keep=True)
        backward(out, weights, saved, wants_points=True)
    except OutOfResources as error:
        log.warning(
            "%s has %d bytes of %s and the fused kernel for layers of widths %s needs %d: torch computes these layers "
            "instead, slower. trainer.precision=32-true or narrower layers avoid this.",
            torch.cuda.get_device_name(device) if device.type == "cuda" else device,
            error.limit,
            error.name,
            "-".join(map(str, sizes)),
            error.required,
        )
        return False
    return True


def forward(
    points: Float[Tensor, "points in"], weights: Sequence[Tensor], keep: bool, used: Int[Tensor, "1"] | None = None
) -> tuple[Float[Tensor, "points out"], BFloat16[Tensor, "saved words"]]:
    """Return the outputs, and the inputs of all layers if they are kept; zeros from row `used` on.

    Rounded up to a block: a program whose rows are all padding computes nothing.
    """
    widths, rows = _padded_widths(weights), points.shape[0]
    out = torch.empty(rows, weights[-1].shape[0], device=points.device)
    saved = out.new_empty(rows if keep else 0, sum(widths[:-1]), dtype=torch.bfloat16)
    if rows:
        arrays = points.contiguous(), *_three(weights), out, saved, used
        flags = len(weights), keep, BLOCK, INTERPRETED
        _forward[(triton.cdiv(rows, BLOCK),)](*arrays, rows, *_sizes(weights, widths), *flags, **FORWARD)
    return out, saved


def backward(
    grad: Float[Tensor, "points out"], weights: Sequence[Tensor], saved: BFloat16[Tensor, "points words"],
    wants_points: bool, used: Int[Tensor, "1"] | None = None,
) -> tuple[Float[Tensor, "points in"] | None, list[Tensor]]:  # fmt: skip
    """Return the gradients of the inputs and of the weights; `saved` is what `forward` returned for the same `used`."""
    widths, rows, inputs = _padded_widths(weights), grad.shape[0], weights[0].shape[1]
    of_points = torch.empty(rows if wants_points else 0, inputs, device=grad.device)
    shapes = [tuple(weight.shape) for weight in weights]
    sums = sums_of_programs(shapes, rows, grad.device)
    arrays = grad.contiguous(), *_three(weights), saved, of_points, sums, used
    flags = len(weights), wants_points, BACKWARD_BLOCK, INTERPRETED
    _backward[(len(sums),)](*arrays, rows, *_sizes(weights, widths), *flags, **BACKWARD)
    return of_points if wants_points else None, total(sums, shapes)


def trial(device: str = "cuda") -> None:
    """Run every kernel once on tiny input; it raises whatever the compiler or driver raises.

    Raises:
        RuntimeError: a product is wrong; all numbers here are powers of two, or three times one, and thus exact.
    """
    for hidden in range(1, max(LAYERS)):
        points, count = torch.ones(3, 16, device=device), 16.0**hidden
        weights = [torch.ones(16, 16, device=device) for _ in range(hidden)] + [torch.ones(3, 16, device=device)]
        out, saved = forward(points, weights, keep=True)
        of_points, of_weights = backward(torch.ones_like(out), weights, saved, wants_points=True)
        expected = torch.full_like(out, 16.0 * count), torch.full_like(points, 3.0 * count)
        if not (torch.equal(out, expected[0]) and of_points is not None and torch.equal(of_points, expected[1])):
            raise RuntimeError("a trial of its kernels gave wrong numbers")
        if not torch.equal(of_weights[-1], torch.full_like(of_weights[-1], 3.0 * count)):
            raise RuntimeError("a trial of its kernels gave wrong gradients")


@functools.cache
def _multiprocessors(device: torch.device) -> int:
    there = device.type == "cuda" and torch.cuda.is_available()
    return torch.cuda.get_device_properties(device).multi_processor_count if there else ELSEWHERE


def padded(width: int) -> int:
    """Return the next width that tensor cores support."""
    return max(NARROWEST, triton.next_power_of_2(width))


def sums_of_programs(shapes: Sequence[tuple[int, ...]], count: int, device: torch.device) -> Tensor:
    """Return where the programs of a backward pass over `count` rows store gradients of weights of these shapes."""
    programs = max(1, min(PROGRAMS * _multiprocessors(device), triton.cdiv(count, BACKWARD_BLOCK)))
    return torch.empty(programs, sum(padded(rows) * padded(columns) for rows, columns in shapes), device=device)


def total(sums: Tensor, shapes: Sequence[tuple[int, ...]]) -> list[Tensor]:
    """Return the gradients of weights of these shapes, added up over the programs, in a fixed order."""
    flat, gradients, offset = sums.sum(dim=0), [], 0
    for rows, columns in shapes:
        size = padded(rows), padded(columns)
        gradients.append(flat[offset : offset + math.prod(size)].view(size)[:rows, :columns])
        offset += math.prod(size)
    return gradients


def _padded_widths(weights: Sequence[Tensor]) -> list[int]:
    """Return the widths of all layers' inputs and of the output, padded."""
    return [*map(padded, (weights[0].shape[1], *(weight.shape[0] for weight in weights)))]


def _three(weights: Sequence[Tensor]) -> list[Tensor]:
    """Return three weights, as the kernels expect; with two layers they ignore the last one."""
    return [each.contiguous() for each in (*weights, weights[-1])[:3]]


def _sizes(weights: Sequence[Tensor], widths: Sequence[int]) -> tuple[int, ...]:
    """Return the layers' four widths, unpadded and padded; with two layers the last is repeated."""
    given = [weights[0].shape[1], *(weight.shape[0] for weight in weights)]
    return *(*given, given[-1])[:4], *(*widths, widths[-1])[:4]


@triton.jit
@no_type_check
def multiply(left, right, widen: tl.constexpr):
    """Return a product, in float32; widened: of float32 numbers."""
    if widen:
        left, right = left.to(tl.float32), right.to(tl.float32)
    return tl.dot(left, right)


@triton.jit
@no_type_check
def layer_weights(weight, n_in: tl.constexpr, n_out: tl.constexpr, inner: tl.constexpr, outer: tl.constexpr):
    """Return a layer's weights in bfloat16, with zeros around them."""
    row, column = tl.arange(0, outer)[:, None], tl.arange(0, inner)[None, :]
    there = (row < n_out) & (column < n_in)
    return tl.load(weight + row * n_in + column, mask=there, other=0.0).to(tl.bfloat16)


@triton.jit
@no_type_check
def rows_of(array, row, count, width: tl.constexpr, padded: tl.constexpr):
    """Return some rows of `width` numbers as bfloat16, zero-padded on the right and below."""
    column = tl.arange(0, padded)
    there = (row < count)[:, None] & (column < width)[None, :]
    return tl.load(array + row[:, None] * width + column[None, :], mask=there, other=0.0).to(tl.bfloat16)


@triton.jit
@no_type_check
def saved_at(saved, row, words: tl.constexpr, first: tl.constexpr, width: tl.constexpr):
    """Return where `width` of the words saved for each row are."""
    return saved + row[:, None] * words + first + tl.arange(0, width)[None, :]


@triton.jit
@no_type_check
def activated(
    x, weight, n_in: tl.constexpr, n_out: tl.constexpr, inner: tl.constexpr, outer: tl.constexpr, widen: tl.constexpr
):
    """Return a hidden layer, in bfloat16."""
    sums = multiply(x, tl.trans(layer_weights(weight, n_in, n_out, inner, outer)), widen)
    return tl.maximum(sums, 0.0, propagate_nan=tl.PropagateNan.ALL).to(tl.bfloat16)


@triton.jit
@no_type_check
def _forward(
    points, w0, w1, w2, out, saved, used, count,
    n0: tl.constexpr, n1: tl.constexpr, n2: tl.constexpr, n3: tl.constexpr,
    d0: tl.constexpr, d1: tl.constexpr, d2: tl.constexpr, d3: tl.constexpr,
    layers: tl.constexpr, keep: tl.constexpr, block: tl.constexpr, widen: tl.constexpr,
):  # fmt: skip
    row = (tl.program_id(0) * block + tl.arange(0, block)).to(tl.int64)
    valid = (row < count)[:, None]
    words: tl.constexpr = d0 + d1 if layers == 2 else d0 + d1 + d2
    if tl.program_id(0) * block >= end_of_rows(used, count):
        width: tl.constexpr = d3 if layers == 3 else d2
        column = tl.arange(0, width)[None, :]
        nothing = tl.zeros([block, width], tl.float32)
        tl.store(out + row[:, None] * n3 + column, nothing, mask=valid & (column < n3))
        return
    x = rows_of(points, row, count, n0, d0)
    y = activated(x, w0, n0, n1, d0, d1, widen)
    if keep:
        tl.store(saved_at(saved, row, words, 0, d0), x, mask=valid)
        tl.store(saved_at(saved, row, words, d0, d1), y, mask=valid)
    if layers == 3:
        z = activated(y, w1, n1, n2, d1, d2, widen)
        if keep:
            tl.store(saved_at(saved, row, words, d0 + d1, d2), z, mask=valid)
        sums = multiply(z, tl.trans(layer_weights(w2, n2, n3, d2, d3)), widen)
        column = tl.arange(0, d3)
    else:
        sums = multiply(y, tl.trans(layer_weights(w1, n1, n2, d1, d2)), widen)
        column = tl.arange(0, d2)
    tl.store(out + row[:, None] * n3 + column[None, :], sums, mask=valid & (column < n3)[None, :])


@triton.jit
@no_type_check
def passed_back(
    flowing, x, weight, n_in: tl.constexpr, n_out: tl.constexpr, inner: tl.constexpr, outer: tl.constexpr,
    widen: tl.constexpr,
):  # fmt: skip
    """Return the gradient of a layer's inputs x, before their ReLU."""
    sums = multiply(flowing, layer_weights(weight, n_in, n_out, inner, outer), widen)
    return tl.where(x.to(tl.float32) > 0.0, sums, 0.0).to(tl.bfloat16)


@triton.jit
@no_type_check
def store_sum(sums, first: tl.constexpr, of_weight, inner: tl.constexpr, outer: tl.constexpr):
    """Store the gradient of a weight."""
    tl.store(sums + first + tl.arange(0, outer)[:, None] * inner + tl.arange(0, inner)[None, :], of_weight)


@triton.jit
@no_type_check
def _backward(
    grad, w0, w1, w2, saved, of_points, sums, used, count,
    n0: tl.constexpr, n1: tl.constexpr, n2: tl.constexpr, n3: tl.constexpr,
    d0: tl.constexpr, d1: tl.constexpr, d2: tl.constexpr, d3: tl.constexpr,
    layers: tl.constexpr, wants_points: tl.constexpr, block: tl.constexpr, widen: tl.constexpr,
):  # fmt: skip
    words: tl.constexpr = d0 + d1 if layers == 2 else d0 + d1 + d2
    of_0, of_1 = tl.zeros([d1, d0], tl.float32), tl.zeros([d2, d1], tl.float32)
    of_2 = tl.zeros([d3, d2], tl.float32)
    last = end_of_rows(used, count)
    for start in range(tl.program_id(0) * block, last, tl.num_programs(0) * block):
        row = (start + tl.arange(0, block)).to(tl.int64)
        valid = (row < count)[:, None]
        if layers == 3:
            flowing = rows_of(grad, row, count, n3, d3)
            z = tl.load(saved_at(saved, row, words, d0 + d1, d2), mask=valid, other=0.0)
            of_2 += multiply(tl.trans(flowing), z, widen)
            flowing = passed_back(flowing, z, w2, n2, n3, d2, d3, widen)
        else:
            flowing = rows_of(grad, row, count, n3, d2)
        y = tl.load(saved_at(saved, row, words, d0, d1), mask=valid, other=0.0)
        of_1 += multiply(tl.trans(flowing), y, widen)
        flowing = passed_back(flowing, y, w1, n1, n2, d1, d2, widen)
        x = tl.load(saved_at(saved, row, words, 0, d0), mask=valid, other=0.0)
        of_0 += multiply(tl.trans(flowing), x, widen)
        if wants_points:
            column = tl.arange(0, d0)
            there = valid & (column < n0)[None, :]
            into = of_points + row[:, None] * n0 + column[None, :]
            tl.store(into, multiply(flowing, layer_weights(w0, n0, n1, d0, d1), widen), mask=there)
    if used is not None and wants_points:
        # The gradient of padding.
        column = tl.arange(0, d0)[None, :]
        first = (last + block - 1) // block * block
        for start in range(first + tl.program_id(0) * block, count, tl.num_programs(0) * block):
            row = (start + tl.arange(0, block)).to(tl.int64)[:, None]
            nothing = tl.zeros([block, d0], tl.float32)
            tl.store(of_points + row * n0 + column, nothing, mask=(row < count) & (column < n0))
    own = sums + tl.program_id(0) * (d0 * d1 + d1 * d2 + (d2 * d3 if layers == 3 else 0))
    store_sum(own, 0, of_0, d0, d1)
    store_sum(own, d0 * d1, of_1, d1, d2)
    if layers == 3:
        store_sum(own, d0 * d1 + d1 * d2, of_2, d2, d3)
