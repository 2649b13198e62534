"""What lies in front: the depth by which the page hides those parts of lines and cameras that the content covers."""

from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float

from nerf_lightning.nerf.geometry.cameras import all_pixels, rays_through_pixels
from nerf_lightning.nerf.types.rays import PixelIndex
from nerf_lightning.viewer.renderer import View

# Depths are sent losslessly, with every picture: more pixels cost time, fewer make ragged edges.
MOST_SIDE = 320
# viser sends depths as whole numbers of 1e-5 in three bytes: what is farther cannot be told.
FARTHEST = 167.0
SEEN = 0.5


def planar_depth(view: View) -> Float[np.ndarray, "height width"]:
    """Return how far along the camera's axis each pixel's content lies (scene units), at most 320 pixels a side.

    What light passes through, for more than half, hides nothing: it lies at `FARTHEST`.
    """
    step = max(1, -(-max(view.depth.shape) // MOST_SIDE))
    inner = slice(step // 2, None, step)
    pixels = all_pixels(view.camera, 0).map(lambda each: each[inner, inner])
    depth = view.depth[inner, inner] * _cosines(view, pixels)
    hidden = torch.where(view.opacity[inner, inner] > SEEN, depth, FARTHEST)
    return hidden.clamp(0.0, FARTHEST).cpu().numpy()


def _cosines(view: View, pixels: PixelIndex) -> Float[torch.Tensor, "height width"]:
    nothing = torch.zeros(1)
    rays = rays_through_pixels(replace(view.camera, ndc=None), pixels, nothing, nothing)
    return rays.directions @ -view.camera.c2w[0, :, 2]
