"""What the photographs' frames and alpha say about space before training: cells that are seen, but not through.

What one view carves: `kernels/carving/reference.py`, and for pinholes `cpu.py`.
"""

import math

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import max_pool2d

from nerf_lightning.nerf.geometry.subset import evenly_spaced_subset
from nerf_lightning.nerf.kernels.carving.op import steps_for
from nerf_lightning.nerf.types.scene import Scene

WRONG_BY = math.radians(1.0)
"""Angle by which learned cameras may be wrong initially."""
AGREEING = 3
"""Number of learned cameras that must see through a cell."""


def possible_cells(
    scene: Scene, centers: Float[Tensor, "cells 3"], half_diagonal: float, most_views: int = 48
) -> Bool[Tensor, "cells"]:
    """Return the cells that training views see, and that none of them sees through.

    A cell is left out if no view sees it, or if some view sees it entirely and shows only pixels of alpha 0 there: a
    ray of alpha 0 meets nothing, so the cell is empty (space carving, Kutulakos and Seitz, 2000). Without alpha nothing
    is carved.

    Carving is permanent, and learned cameras may start at a wrong pose. They carve less: not within 1 degree of what
    their photographs show, and only what three of them agree on.

    Args:
        scene: cameras and pixels.
        centers: the cells' centers in scene units.
        half_diagonal: from a cell's center to its corner.
        most_views: maximum number of views used for carving, evenly spaced.
    """
    views, steps = scene.splits["train"], steps_for(scene.cameras, centers)
    centers = centers.t().contiguous().t()  # axis by axis in memory, as kernels read them fastest
    cells = torch.zeros(centers.shape[0], dtype=torch.bool)
    for view in views:
        if bool(cells.all()):
            break
        steps.add_seen(cells, scene.cameras, view, centers, half_diagonal)
    if scene.pixels.has_transparency:
        seen_through = torch.zeros(len(cells), dtype=torch.int16)
        for view in evenly_spaced_subset(views, most_views):
            left = cells.clone() if scene.refined else cells
            steps.carve(left, scene.cameras, view, centers, half_diagonal, _matter(scene, view))
            if scene.refined:
                seen_through += cells & ~left
                cells &= seen_through < AGREEING
    return cells


def _matter(scene: Scene, view: int) -> Bool[Tensor, "height width"]:
    matter = scene.pixels.view(view)[..., 3] > 0
    kept = scene.pixels.view_mask(view)
    matter = matter if kept is None else matter | ~kept  # masked pixels may be anything
    return _grown(matter, round(WRONG_BY * float(scene.cameras.focal[view].mean()))) if scene.refined else matter


def _grown(matter: Bool[Tensor, "height width"], pixels: int) -> Bool[Tensor, "height width"]:
    """Return where matter is at most `pixels` pixels away along both axes."""
    grown, side = matter[None].float(), 2 * pixels + 1
    for kernel, padding in (((side, 1), (pixels, 0)), ((1, side), (0, pixels))):
        grown = max_pool2d(grown, kernel, stride=1, padding=padding)
    return grown[0] > 0
