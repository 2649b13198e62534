"""Of a scene without bounds, what the photographs' light comes from: most of such a scene lies behind something."""

import numpy as np
import torch
from jaxtyping import Bool
from numpy import ndarray

from nerf_lightning.export.baking.density import DensityGrid, dilated
from nerf_lightning.export.baking.marcher import STEP
from nerf_lightning.nerf.geometry.cameras import all_pixels, at_most
from nerf_lightning.nerf.kernels.bricks.layout import kernels
from nerf_lightning.nerf.models.ray_generator import RayGenerator
from nerf_lightning.nerf.models.render_image import view_rays
from nerf_lightning.nerf.types.scene import SceneRecord

# Rays through the training views that are followed, at most: every other pixel tells as much.
RAYS = 1_000_000
# A scene that stops so much of their light is one that none comes from behind of.
CLOSED = 0.98
# Values at which all but so much of it is stopped are kept, and their neighbours: where the scene is closed, and where
# what is left out would let the background through.
LEFT_OUT_OF_CLOSED, LEFT_OUT = 0.01, 0.002


def lit(grid: DensityGrid, record: SceneRecord) -> tuple[Bool[ndarray, "x y z"], bool]:
    """Return which values stop the light that the training views see, and whether next to none gets past them all."""
    contraction = grid.contraction
    assert contraction is not None
    views = record.splits["train"]
    width, height = (side[list(views)].double() for side in (record.cameras.width, record.cameras.height))
    smaller = min(1.0, (RAYS / float((width * height).sum())) ** 0.5)
    cameras = at_most(record.cameras, max(8, int(smaller * float(torch.maximum(width, height).max()))))
    rays_of = RayGenerator(cameras, record.near, record.far)
    rays = [view_rays(rays_of, all_pixels(cameras, view))[0] for view in views]
    origins = torch.cat([contraction.unit(each.origins).reshape(-1, 3) for each in rays]).float().numpy()
    directions = torch.cat([each.directions.reshape(-1, 3) for each in rays]).float().numpy()
    near = contraction.near / contraction.half
    stopped = kernels("bricks.contracted").stopped_light(grid.optical, origins, directions, near, STEP)
    falling = np.sort(stopped[stopped > 0])[::-1]
    together = np.cumsum(falling, dtype=np.float64)
    if not len(falling):
        return stopped > 0, False
    closed = bool(together[-1] >= CLOSED * len(origins))
    share = 1.0 - (LEFT_OUT_OF_CLOSED if closed else LEFT_OUT)
    least = falling[min(int(np.searchsorted(together, share * together[-1])), len(falling) - 1)]
    return dilated(stopped >= least), closed
