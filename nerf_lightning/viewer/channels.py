"""A view as a picture of one of its channels: colour, depth, opacity, normals."""

from collections.abc import Callable
from dataclasses import replace

import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from nerf_lightning.evaluation.geometry import normals_from_depth
from nerf_lightning.export.pictures import color_map, faded, to_bytes, visible_range
from nerf_lightning.geometry.cameras import all_pixels, rays_through_pixels
from nerf_lightning.viewer.slices import View

COLOR = "colour"


def picture_of(view: View, channel: str) -> UInt8[Tensor, "height width 3"]:
    """Return a channel of a view as a picture.

    Depth is bright where it is near, over the range of what this view shows; normals are in the model's axes, each from
    -1 to 1 as red, green and blue. What light passes through fades to pale grey.
    """
    return to_bytes(CHANNELS[channel](view))


def _color(view: View) -> Float[Tensor, "height width 3"]:
    return view.rgb


def _depth(view: View) -> Float[Tensor, "height width 3"]:
    near, far = visible_range(view.depth, view.opacity)
    return faded(color_map(view.depth, low=far, high=near), view.opacity)


def _opacity(view: View) -> Float[Tensor, "height width 3"]:
    return view.opacity[..., None].expand(*view.opacity.shape, 3)


def _normals(view: View) -> Float[Tensor, "height width 3"]:
    nothing = torch.zeros(1)
    rays = rays_through_pixels(replace(view.camera, ndc=None), all_pixels(view.camera, 0), nothing, nothing)
    normals = normals_from_depth(rays.origins + view.depth[..., None] * rays.directions)
    return faded(0.5 + 0.5 * normals, view.opacity)


CHANNELS: dict[str, Callable[[View], Tensor]] = {
    COLOR: _color,
    "depth": _depth,
    "opacity": _opacity,
    "normals": _normals,
}
