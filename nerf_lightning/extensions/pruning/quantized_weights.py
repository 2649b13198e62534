"""Choose which weights of a model are quantized in a checkpoint, and how."""

import itertools
from typing import Any

import torch
from jaxtyping import Bool
from torch import Tensor

from nerf_lightning.extensions.pruning.quantize import NumberType, quantize_rows, quantize_switches
from nerf_lightning.messages.errors import InputError
from nerf_lightning.nerf.encoders.hash_grid import HashGridEncoder
from nerf_lightning.nerf.fields.ngp_field import NGPField
from nerf_lightning.nerf.kernels.hash_grid.layout import HashGridLayout
from nerf_lightning.nerf.kernels.hash_grid.reference import interpolate_torch
from nerf_lightning.nerf.models.base import Model
from nerf_lightning.nerf.models.level import Level
from nerf_lightning.nerf.samplers.occupancy import OccupancySampler
from nerf_lightning.nerf.samplers.occupancy_grid import OccupancyGrid

LARGEST_FLOAT16 = 65504.0
SWITCHES = ("possible", "cells", "blocks")
"""Of an occupancy grid."""
CROWDED = 4
"""Vertices in occupied cells per entry of a table: from here on only 1 entry in 50 is unused, and all are kept."""
MARGIN = 0.01
"""Share of the vertices' distance: positions are rounded for both grids."""
AT_ONCE = 1 << 18


def quantized_weights(model: Model, tables: NumberType, drop_empty: bool) -> dict[str, Any]:
    """Return a model's quantized weights, as written by `quantize`.

    Args:
        model: with its weights, on the CPU.
        tables: the type of the numbers in hash tables.
        drop_empty: drop what an occupancy grid rules out: entries of hash tables that no point of an occupied cell
            looks up, and the densities of empty cells.

    Raises:
        InputError: the model has no tables, or no such grid, or numbers that the type cannot represent.
    """
    encoders = {name: part for name, part in model.named_modules() if isinstance(part, HashGridEncoder)}
    grids = {name: part for name, part in model.named_modules() if isinstance(part, OccupancyGrid)}
    if tables != "float32" and not encoders:
        raise InputError(f"tables={tables}: this model has no hash tables. Leave it out.")
    if drop_empty and not grids:
        raise InputError(
            "drop_empty=true: this model has no occupancy grid, so what is empty is unknown. Leave it out."
        )
    levels = {name: part for name, part in model.named_modules() if isinstance(part, Level)} if drop_empty else {}
    reached = {f"{name}.field.position_encoder": reached_entries(level) for name, level in levels.items()}
    rows: dict[str, Any] = {}
    switches: dict[str, Any] = {}
    for name, encoder in encoders.items():
        if tables == "float32" and reached.get(name) is None:
            continue
        if tables == "float16" and float(encoder.table.abs().max()) > LARGEST_FLOAT16:
            raise InputError(
                f"tables=float16 holds numbers up to {LARGEST_FLOAT16:g}, and {name} has larger: int8 does."
            )
        starts = encoder.layout.offsets[:-1]
        rows[f"model.{name}.table"] = quantize_rows(encoder.table, tables, starts, reached.get(name))
    for name, grid in grids.items() if drop_empty else ():
        kept = grid.cells.flatten().bool()
        rows[f"model.{name}.density"] = quantize_rows(grid.density, "float32", mask=kept)
        switches |= {f"model.{name}.{each}": quantize_switches(getattr(grid, each)) for each in SWITCHES}
    return {"rows": rows, "switches": switches}


def reached_entries(level: Level) -> Bool[Tensor, "entries"] | None:
    """Return which entries of a level's hash grid its rays can look up; None if that is unknown.

    It is known if a field is evaluated only in the box of the occupancy grid that its rays march through.
    """
    sampler, field = level.sampler, level.field
    if not (isinstance(sampler, OccupancySampler) and isinstance(field, NGPField)):
        return None
    encoder, grid = field.position_encoder, sampler.grid
    if not isinstance(encoder, HashGridEncoder) or field.contracted.is_on():
        return None
    if not torch.equal(field.aabb, grid.aabb):
        return None
    return entries_of_cells(encoder.layout, grid.cells.bool().cpu())


def entries_of_cells(layout: HashGridLayout, occupied: Bool[Tensor, "side side side"]) -> Bool[Tensor, "entries"]:
    """Return which entries of a hash grid points in occupied cells of the unit cube look up, possibly a few more."""
    reached = torch.ones(layout.offsets[-1], dtype=torch.bool)
    cells, side = occupied.nonzero(), occupied.shape[0]
    for number, resolution in enumerate(layout.resolutions):
        first, last = layout.offsets[number : number + 2]
        if cells.shape[0] * (resolution / side) ** 3 < CROWDED * (last - first):
            vertices = _vertices(cells, side, resolution)
            reached[first:last] = _looked_up(
                vertices, HashGridLayout((resolution,), (0, last - first), layout.table_size)
            )
    return reached


def _vertices(cells: Tensor, side: int, resolution: int) -> Tensor:
    """Return the unique vertices of a grid between which points in cells of another grid are interpolated."""
    low = (cells * resolution / side - MARGIN).floor().long().clamp(min=0)
    high = ((cells + 1) * resolution / side + MARGIN).floor().long() + 1
    high = high.clamp(max=resolution)
    near = torch.zeros((resolution + 1,) * 3, dtype=torch.bool)
    span = int((high - low).max()) + 1 if cells.numel() else 0
    for step in itertools.product(range(span), repeat=3):
        near[(low + torch.tensor(step)).minimum(high).unbind(-1)] = True
    return near.nonzero()


def _looked_up(vertices: Tensor, layout: HashGridLayout) -> Tensor:
    """Return the entries of vertices: those with respect to which the features there have a gradient."""
    table = torch.zeros(layout.offsets[-1], 1, requires_grad=True)
    for part in vertices.split(AT_ONCE):
        interpolate_torch(table, part / layout.resolutions[0], layout).sum().backward()
    return torch.zeros(table.shape[0], dtype=torch.bool) if table.grad is None else table.grad[:, 0] != 0
