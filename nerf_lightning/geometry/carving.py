"""What the photographs' frames and alpha say of space before anything is learnt: seen at all, and not seen through."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import functional

from nerf_lightning.geometry.footprints import footprint
from nerf_lightning.geometry.spread import spread
from nerf_lightning.types.scene import Scene


def possible_cells(
    scene: Scene, centers: Float[Tensor, "cells 3"], half_diagonal: float, most_views: int = 48
) -> Bool[Tensor, "cells"]:
    """Tell the cells that training views see and through which none of them looks at nothing.

    A cell is left out where no view sees it, and where some view sees it whole and shows only pixels of alpha 0 there:
    a ray of alpha 0 meets nothing, so the cell is empty (space carving, Kutulakos and Seitz, 2000). Without alpha
    nothing is carved.

    Args:
        scene: cameras and pixels.
        centers: the cells' centres in scene units.
        half_diagonal: from a cell's centre to its corner.
        most_views: carving looks at so many views, evenly spread.
    """
    views = scene.splits["train"]
    seen = torch.zeros(centers.shape[0], dtype=torch.bool)
    for view in views:
        unseen = (~seen).nonzero()[:, 0]
        if not unseen.numel():
            break
        x, y, radius = footprint(scene.cameras, view, centers[unseen], half_diagonal)
        width, height = int(scene.cameras.width[view]), int(scene.cameras.height[view])
        seen[unseen] = (x > -radius) & (x < width + radius) & (y > -radius) & (y < height + radius) & (radius > 0)
    left = seen.nonzero()[:, 0]
    if scene.pixels.has_transparency:
        for view in spread(views, most_views):
            left = left[~_looked_through(scene, view, centers[left], half_diagonal)]
    possible = torch.zeros_like(seen)
    possible[left] = True
    return possible


def _looked_through(scene: Scene, view: int, centers: Tensor, half_diagonal: float) -> Tensor:
    x, y, radius = footprint(scene.cameras, view, centers, half_diagonal)
    width, height = int(scene.cameras.width[view]), int(scene.cameras.height[view])
    whole = (x - radius >= 0) & (x + radius <= width) & (y - radius >= 0) & (y + radius <= height) & (radius > 0)
    matter = scene.pixels.view(view)[..., 3] > 0
    kept = scene.pixels.kept(view)
    if kept is not None:
        matter = matter | ~kept  # what is masked may be anything
    # One window for all cells of a view: the largest footprint in pixels, and half a pixel for the rounding.
    reach = int(torch.ceil(radius[whole].max() + 0.5)) if bool(whole.any()) else 0
    if reach == 0 or 2 * reach + 1 > min(width, height):
        return torch.zeros_like(whole)
    covered = functional.max_pool2d(matter.float()[None, None], 2 * reach + 1, stride=1, padding=reach)[0, 0]
    column, row = x.long().clamp(0, width - 1), y.long().clamp(0, height - 1)
    return whole & (covered[row, column] == 0)
