"""The surface where the density crosses a level, as a mesh: closed, the insides of things included."""

import logging

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from nerf_lightning.errors import InputError
from nerf_lightning.export.density_grid import Lattice, Report, sample_density
from nerf_lightning.export.marching_cubes import marching_cubes
from nerf_lightning.export.surface import surface_level
from nerf_lightning.nerf.models.base import Model
from nerf_lightning.nerf.types.scene import SceneRecord

# The density's grid, and as much again for the mesh.
BYTES_PER_POINT = 8
# So many times the surface's density, or so small a part of it, are as good as solid and as nothing.
RATIO = 10.0

log = logging.getLogger(__name__)


def mesh_of_density(
    model: Model, record: SceneRecord, lattice: Lattice, threshold: float | None, tile_points: int, report: Report
) -> tuple[Float[ndarray, "vertices 3"], Int[ndarray, "faces 3"]]:
    """Return vertices (scene frame) and faces of the surface where the density is `threshold`.

    Args:
        model: in evaluation mode.
        record: of the scene.
        lattice: where the density is asked.
        threshold: per scene unit; None: where rendering sees the surface (`surface_level`).
        tile_points: most points that go through the field at once.
        report: told how much of `density` and `surface` is done.

    Raises:
        InputError: there is no such surface.
    """
    density = sample_density(model, lattice, tile_points, report)
    if record.space == "bounded":
        _close(density)
    level = _level(model, record, density, threshold, tile_points)
    _to_log_ratio(density, level)
    vertices, faces = marching_cubes(density, 0.0, report)
    log.info("the surface is where the density is %.4g", level)
    return lattice.to_scene(vertices), faces


def _level(
    model: Model, record: SceneRecord, density: Float[ndarray, "x y z"], threshold: float | None, tile_points: int
) -> float:
    level = threshold or surface_level(model, record, tile_points)
    lowest, highest = float(density.min()), float(density.max())
    if level is not None and lowest < level < highest:
        return level
    found = f"the densities of its box go from {lowest:.3g} to {highest:.3g} per scene unit"
    if level is None:
        raise InputError(
            f"There is no surface to export: {found}, and no training view of {record.name} sees anything opaque "
            "there. Train longer, or say with what.threshold=DENSITY what counts as the surface."
        )
    raise InputError(
        f"There is no surface in {record.name} where the density is {level:.3g}: {found}. Give what.threshold="
        "DENSITY between the two, or train longer."
    )


def _to_log_ratio(density: Float[ndarray, "x y z"], level: float) -> None:
    """Replace densities by log(density / level), bounded: they grow by factors, and so their logarithm is straight."""
    density /= level
    np.clip(density, 1.0 / RATIO, RATIO, out=density)
    np.log(density, out=density)


def _close(density: Float[ndarray, "x y z"]) -> None:
    """Empty the outermost points: nothing lies outside of a bounded scene's box, and the surface is closed there."""
    for axis in range(3):
        faces = np.moveaxis(density, axis, 0)
        faces[0] = faces[-1] = 0.0
