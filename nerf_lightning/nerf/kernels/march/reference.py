"""The march in plain torch: every interval of the lattice is looked up. The reference."""

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from nerf_lightning.nerf.geometry.boxes import center_and_half
from nerf_lightning.nerf.kernels.march.grid import MarchState, OccupancyCells
from nerf_lightning.nerf.types.rays import RaggedSamples, RayBundle


def march_torch(
    rays: RayBundle,
    state: MarchState,
    lattice: Float[Tensor, "edges"],
    grid: OccupancyCells,
    limit: int | None,
    capacity: int | None,
) -> tuple[RaggedSamples, Int[Tensor, "rays"]]:
    """Return the occupied intervals and where each ray would continue."""
    keep, edges = occupied_intervals(rays, state, lattice, grid)
    number = torch.arange(keep.shape[1], device=edges.device)
    following = torch.full_like(state.next, number.numel())
    if limit is not None:
        rank = keep.cumsum(dim=-1)
        keep &= rank <= limit
        last = torch.where(keep & (rank == limit), number, number.numel() - 1).amin(dim=-1)
        following = torch.where(keep.sum(dim=-1) == limit, last + 1, following)
    return _packed(keep, edges, capacity, limit), following


def occupied_intervals(
    rays: RayBundle, state: MarchState, lattice: Float[Tensor, "edges"], grid: OccupancyCells
) -> tuple[Bool[Tensor, "rays k"], Float[Tensor, "rays e"]]:
    """Return which intervals of each ray may hold something, and the fenceposts of all.

    The shapes do not depend on the grid's content.
    """
    edges = lattice[:-1] + state.jitter[:, None] * (lattice[1:] - lattice[:-1])
    midpoints = 0.5 * (edges[:, :-1] + edges[:, 1:])
    number = torch.arange(midpoints.shape[1], device=edges.device)
    keep = (midpoints >= state.enter[:, None]) & (midpoints <= state.leave[:, None]) & (number >= state.next[:, None])
    return keep & in_occupied(rays.origins[:, None] + midpoints[..., None] * rays.directions[:, None], grid), edges


def in_occupied(positions: Float[Tensor, "*points 3"], grid: OccupancyCells) -> Bool[Tensor, "*points"]:
    """Return which positions are in an occupied cell."""
    resolution = grid.cells.shape[0]
    center, half = center_and_half(grid.aabb)
    scaled = (positions - center) / half
    cell = ((0.5 * scaled + 0.5) * resolution).long().clamp(0, resolution - 1)
    return (scaled.abs().amax(dim=-1) <= 1.0) & grid.cells[cell.unbind(dim=-1)].bool()


def _packed(
    keep: Bool[Tensor, "rays k"], edges: Float[Tensor, "rays e"], capacity: int | None, limit: int | None
) -> RaggedSamples:
    counts, intervals = keep.sum(dim=-1), keep.shape[1]
    found = counts.sum()
    bounds = torch.cat([counts.new_zeros(1), counts.cumsum(0)])
    if capacity is None:
        flat = keep.flatten().nonzero()[:, 0]
        filled = torch.ones_like(flat, dtype=torch.bool)
    else:
        # A fixed size, so that nothing is read on the host.
        flat = torch.nonzero_static(keep.flatten(), size=capacity)[:, 0]
        bounds = bounds.clamp(max=capacity)
        slot = torch.arange(capacity, device=keep.device)
        filled = slot < bounds[-1]
        flat = torch.where(filled, flat, slot % counts.numel() * intervals)
    ray = flat // intervals
    number = flat - ray * intervals
    starts, ends = edges[ray, number], edges[ray, number + 1]
    longest = intervals if limit is None else min(limit, intervals)
    return RaggedSamples(ray, starts * filled, ends * filled, bounds, found, longest)
