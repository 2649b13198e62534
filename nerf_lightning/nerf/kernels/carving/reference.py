"""Carving by one view in plain torch: the reference, also used for cameras with a lens."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import functional

from nerf_lightning.nerf.geometry.footprints import footprint
from nerf_lightning.nerf.types.scene import Cameras


def add_seen(
    cells: Bool[Tensor, "cells"],
    cameras: Cameras,
    view: int,
    centers: Float[Tensor, "cells 3"],
    half_diagonal: float,
) -> None:
    """Mark the cells that a view sees, even partly."""
    unseen = (~cells).nonzero()[:, 0]
    x, y, radius = footprint(cameras, view, centers[unseen], half_diagonal)
    width, height = int(cameras.width[view]), int(cameras.height[view])
    cells[unseen] = (x > -radius) & (x < width + radius) & (y > -radius) & (y < height + radius) & (radius > 0)


def carve(
    cells: Bool[Tensor, "cells"],
    cameras: Cameras,
    view: int,
    centers: Float[Tensor, "cells 3"],
    half_diagonal: float,
    matter: Bool[Tensor, "height width"],
) -> None:
    """Unmark the cells that a view sees entirely, with no matter in any of their pixels."""
    left = cells.nonzero()[:, 0]
    x, y, radius = footprint(cameras, view, centers[left], half_diagonal)
    height, width = matter.shape
    whole = (x - radius >= 0) & (x + radius <= width) & (y - radius >= 0) & (y + radius <= height) & (radius > 0)
    covered = widened(matter, torch.where(whole, radius, 0.0))
    if covered is not None:
        column, row = x.long().clamp(0, width - 1), y.long().clamp(0, height - 1)
        cells[left] = ~whole | covered[row, column]


def widened(
    matter: Bool[Tensor, "height width"], radius: Float[Tensor, "cells"]
) -> Bool[Tensor, "height width"] | None:
    """Return the pixels with matter in a square around them that holds the largest disc; None without such a square."""
    # One window for all cells of a view: the largest footprint in pixels, plus half a pixel for rounding.
    largest = float(radius.max()) if radius.numel() else 0.0
    reach = int(torch.ceil(torch.tensor(largest) + 0.5)) if largest > 0 else 0
    if reach == 0 or 2 * reach + 1 > min(matter.shape):
        return None
    # The square is separable: (2 r + 1) comparisons per pixel for each axis, instead of (2 r + 1)^2.
    size, pixels = 2 * reach + 1, matter.float()[None, None]
    columns = functional.max_pool2d(pixels, (size, 1), stride=1, padding=(reach, 0))
    return functional.max_pool2d(columns, (1, size), stride=1, padding=(0, reach))[0, 0] > 0
