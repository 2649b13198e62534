"""Multiresolution hash grid: features interpolated between the vertices of grids of growing resolution.

Sec. 3 of arXiv 2201.05989. Letters: R_l the cells along a side of level l, T the most entries of a level's table,
F the features of an entry.
"""

from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import FunctionCtx

from nerf_lightning.kernels.backends import cpu_twin, cuda_twin
from nerf_lightning.kernels.hash_grid_torch import interpolate_torch


@dataclass(frozen=True)
class HashGridLayout:
    """Where each level's entries lie in the one table."""

    resolutions: tuple[int, ...]
    """R_l, cells along a side."""
    offsets: tuple[int, ...]
    """First entry of each level, and the number of entries in all."""
    table_size: int
    """T, a power of two."""

    def is_hashed(self, level: int) -> bool:
        """Tell whether a level has more vertices than its table has entries."""
        return (self.resolutions[level] + 1) ** 3 > self.table_size


def hash_grid_layout(num_levels: int, log2_table_size: int, min_resolution: int, max_resolution: int) -> HashGridLayout:
    """Return the layout: resolutions grow geometrically (Eq. 2, 3); dense where a level's vertices fit (Sec. 3).

    >>> hash_grid_layout(num_levels=2, log2_table_size=4, min_resolution=1, max_resolution=4)
    HashGridLayout(resolutions=(1, 4), offsets=(0, 8, 24), table_size=16)
    """
    growth = (max_resolution / min_resolution) ** (1.0 / max(1, num_levels - 1))
    resolutions = tuple(int(min_resolution * growth**level + 1e-6) for level in range(num_levels))
    offsets = [0]
    for resolution in resolutions:
        offsets.append(offsets[-1] + min(1 << log2_table_size, (resolution + 1) ** 3))
    return HashGridLayout(resolutions, tuple(offsets), 1 << log2_table_size)


def interpolate(
    table: Float[Tensor, "entries features"],
    points: Float[Tensor, "points 3"],
    layout: HashGridLayout,
    known: Float[Tensor, "points out"] | None = None,
) -> Float[Tensor, "points out"]:
    """Return the trilinear features of points in the unit cube, level by level; points outside are moved to its face.

    Gradients go to the table and, where asked for, to the points. Once differentiable.

    Args:
        table: the entries of all levels.
        points: in the unit cube.
        layout: where the levels' entries lie.
        known: what this function returned for the same arguments without gradients: it is not computed again.
    """
    twin = cpu_twin("hash_grid_numba", points.device) or cuda_twin("hash_grid_triton", points.device)
    if twin is None or table.dtype == torch.float64:
        return interpolate_torch(table, points, layout)
    return _Interpolate.apply(table, points.float().contiguous(), layout, twin, known)


class _Interpolate(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, table: Tensor, points: Tensor, layout: HashGridLayout, twin: Any, known: Any) -> Tensor:
        ctx.save_for_backward(table, points)
        ctx.layout, ctx.twin = layout, twin
        if known is not None:
            return known.view_as(known)
        return twin.forward(table.detach(), points.detach(), layout)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: FunctionCtx, grad: Tensor) -> tuple[Tensor | None, Tensor | None, None, None, None]:
        table, points = ctx.saved_tensors  # type: ignore[attr-defined]
        layout, twin = ctx.layout, ctx.twin  # type: ignore[attr-defined]
        wants_table, wants_points = ctx.needs_input_grad[:2]  # type: ignore[attr-defined]
        grad = grad.float().contiguous()
        grad_table = None
        if wants_table:
            # An optimizer that keeps its gradients allocated says so: then they are added in place, since a fresh
            # table of zeros for each tile costs more than the gradients themselves.
            kept = table.grad if getattr(table, "grad_in_place", False) else None
            into = torch.zeros_like(table, dtype=torch.float32) if kept is None else kept
            twin.add_table_gradient(into, points, grad, layout)
            grad_table = into if kept is None else None
        grad_points = twin.point_gradient(table.detach(), points, grad, layout) if wants_points else None
        return grad_table, grad_points, None, None, None
