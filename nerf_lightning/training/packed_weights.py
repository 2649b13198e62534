"""Which weights of a model a checkpoint keeps in fewer bytes, and how."""

from typing import Any

from torch import Tensor

from nerf_lightning.checkpoints.packing import NumberType, pack_rows, pack_switches
from nerf_lightning.errors import InputError
from nerf_lightning.nerf.encoders.hash_grid import HashGridEncoder
from nerf_lightning.nerf.models.base import Model
from nerf_lightning.nerf.models.level import Level
from nerf_lightning.nerf.pruning.reach import reached_entries
from nerf_lightning.nerf.samplers.occupancy_grid import OccupancyGrid

LARGEST_FLOAT16 = 65504.0
SWITCHES = ("possible", "cells", "blocks")
"""Of an occupancy grid."""


def packed_weights(model: Model, tables: NumberType, drop_empty: bool) -> dict[str, Any]:
    """Return a model's weights that are not kept as they are, as `checkpoints.packing` has them.

    Args:
        model: with its weights, on the CPU.
        tables: the type of the numbers in hash tables.
        drop_empty: leave out what an occupancy grid rules out: entries of hash tables that no point of an occupied
            cell looks up, and the densities of empty cells.

    Raises:
        InputError: the model has no tables, or no such grid, or numbers that the type cannot hold.
    """
    encoders = {name: part for name, part in model.named_modules() if isinstance(part, HashGridEncoder)}
    grids = {name: part for name, part in model.named_modules() if isinstance(part, OccupancyGrid)}
    if tables != "float32" and not encoders:
        raise InputError(f"tables={tables}: this model has no hash tables. Leave it out.")
    if drop_empty and not grids:
        raise InputError(
            "drop_empty=true: this model has no occupancy grid, which would say what is empty. Leave it out."
        )
    reached = _reached(model) if drop_empty else {}
    rows: dict[str, Any] = {}
    switches: dict[str, Any] = {}
    for name, encoder in encoders.items() if tables != "float32" or reached else ():
        if tables == "float16" and float(encoder.table.abs().max()) > LARGEST_FLOAT16:
            raise InputError(
                f"tables=float16 holds numbers up to {LARGEST_FLOAT16:g}, and {name} has larger: int8 does."
            )
        starts = encoder.layout.offsets[:-1]
        rows[f"model.{name}.table"] = pack_rows(encoder.table, tables, starts, reached.get(name))
    for name, grid in grids.items() if drop_empty else ():
        kept = grid.cells.flatten().bool()
        rows[f"model.{name}.density"] = pack_rows(grid.density, "float32", kept=kept)
        switches |= {f"model.{name}.{each}": pack_switches(getattr(grid, each)) for each in SWITCHES}
    return {"rows": rows, "switches": switches}


def _reached(model: Model) -> dict[str, Tensor]:
    """Return which entries of a hash grid are looked up, by the encoder's name, where that can be told."""
    levels = {name: part for name, part in model.named_modules() if isinstance(part, Level)}
    found = {f"{name}.field.position_encoder": reached_entries(level) for name, level in levels.items()}
    return {name: each for name, each in found.items() if each is not None}
