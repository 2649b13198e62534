"""Multiresolution hash grid: features interpolated between the vertices of grids of growing resolution.

Sec. 3 of arXiv 2201.05989. Letters: R_l the cells along a side of level l, T the maximum number of entries of a level's
table, F the features of an entry.

Resolutions and the hash's primes: `layout.py`. `reference.py`, `cpu.py` and `cuda.py` interpolate alike.
"""

import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from types import ModuleType
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.autograd.function import FunctionCtx

from nerf_lightning.nerf.kernels.backends import cpu_backend, cuda_backend
from nerf_lightning.nerf.kernels.hash_grid.layout import HashGridLayout
from nerf_lightning.nerf.kernels.hash_grid.reference import interpolate_torch


def interpolate(
    table: Float[Tensor, "entries features"],
    points: Float[Tensor, "points 3"],
    layout: HashGridLayout,
    cached: Float[Tensor, "points out"] | None = None,
    used: Int[Tensor, "1"] | None = None,
    dtype: torch.dtype = torch.float32,
) -> Float[Tensor, "points out"]:
    """Return the trilinear features of points in the unit cube, level by level; points outside are clamped to it.

    Gradients flow to the table and, if needed, to the points. Once differentiable.

    Args:
        table: all levels' entries.
        points: in the unit cube.
        layout: where the levels' entries are.
        cached: what this function returned for the same arguments without gradients, to avoid recomputing it.
        used: on CUDA, the index from which all points are padding: kernels skip it, and it has no gradients.
        dtype: on CUDA, of the features.
    """
    backend = cpu_backend("hash_grid.cpu", points.device) or cuda_backend("hash_grid.cuda", points.device)
    if backend is None or table.dtype == torch.float64:
        return interpolate_torch(table, points, layout)
    for_cuda = (used, dtype) if points.is_cuda else ()
    return _Interpolate.apply(table, points.float().contiguous(), layout, backend, cached, for_cuda)


@dataclass(frozen=True)
class TableGradient:
    """A deferred contribution of a backward pass to a table's gradient."""

    table: Float[Tensor, "entries features"]
    points: Float[Tensor, "points 3"]
    grad: Float[Tensor, "points out"]
    layout: HashGridLayout
    kernels: ModuleType


def add_all(held: Sequence[TableGradient], scale: float = 1.0) -> None:
    """Add deferred gradients, those of one table together, so that threads are not woken for each."""
    for same in {(id(each.table), each.layout): each for each in held}.values():
        table, layout = same.table, same.layout
        if table.grad is None:
            table.grad = torch.zeros_like(table)
        alike = [each for each in held if each.table is table and each.layout == layout]
        contributions = [(each.points, each.grad if scale == 1.0 else each.grad * scale) for each in alike]
        same.kernels.add_table_gradients(table.grad, contributions, layout)


def table_gradient(
    table: Float[Tensor, "entries features"],
    points: Float[Tensor, "points 3"],
    grad: Float[Tensor, "points out"],
    layout: HashGridLayout,
    kernels: ModuleType,
    padding: tuple[Tensor | None, ...] = (),
) -> Float[Tensor, "entries features"] | None:
    """Return a table's gradient in a backward pass; None if it is deferred, or was added in place.

    Args:
        table: as autograd knows it.
        points: in the unit cube.
        grad: gradient of their features.
        layout: where the levels' entries are.
        kernels: the module with `add_table_gradient`.
        padding: on CUDA, where padding begins (`interpolate`).
    """
    if _held.gradients is not None:
        _held.gradients.append(TableGradient(table, points, grad, layout, kernels))
        return None
    # An optimizer that keeps its gradients allocated sets this flag: then they are added in place, since a new table of
    # zeros for each tile costs more than the gradients themselves.
    kept = table.grad if getattr(table, "grad_in_place", False) else None
    into = torch.zeros_like(table, dtype=torch.float32) if kept is None else kept
    kernels.add_table_gradient(into, points, grad, layout, *padding)
    return into if kept is None else None


@contextmanager
def defer_table_grads() -> Iterator[Sequence[TableGradient]]:
    """Make backward passes of this thread collect gradients of tables instead of adding them.

    Two threads must not add to the same table, and a table for each would cost more than the gradients themselves.
    """
    former, _held.gradients = _held.gradients, []
    try:
        yield _held.gradients
    finally:
        _held.gradients = former


class _Held(threading.local):
    gradients: list[TableGradient] | None = None


_held = _Held()


class _Interpolate(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, table: Tensor, points: Tensor, layout: HashGridLayout, backend: Any, cached: Any, for_cuda: Any
    ) -> Tensor:
        ctx.save_for_backward(table, points)
        ctx.layout, ctx.backend, ctx.padding = layout, backend, for_cuda[:1]
        if cached is not None:
            return cached.view_as(cached)
        return backend.forward(table.detach(), points.detach(), layout, *for_cuda)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: FunctionCtx, grad: Tensor) -> tuple[Tensor | None, ...]:
        table, points = ctx.saved_tensors  # type: ignore[attr-defined]
        layout, backend = ctx.layout, ctx.backend  # type: ignore[attr-defined]
        wants_table, wants_points = ctx.needs_input_grad[:2]  # type: ignore[attr-defined]
        grad = grad.contiguous() if grad.is_cuda else grad.float().contiguous()
        padding = ctx.padding  # type: ignore[attr-defined]
        grad_table = table_gradient(table, points, grad, layout, backend, padding) if wants_table else None
        grad_points = backend.point_gradient(table.detach(), points, grad, layout) if wants_points else None
        return grad_table, grad_points, None, None, None, None
