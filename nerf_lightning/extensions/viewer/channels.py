"""A view as a picture: one of its channels, or truth and render side by side; and the depth that occludes lines."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor
from torch.nn.functional import pad

from nerf_lightning.extensions.viewer.renderer import View
from nerf_lightning.nerf.geometry.cameras import all_pixels, rays_through_pixels
from nerf_lightning.nerf.geometry.surfaces import normals_from_depth
from nerf_lightning.nerf.types.rays import PixelIndex, RayBundle
from nerf_lightning.nerf.types.scene import SceneRecord
from nerf_lightning.visualization.pictures import color_map, faded, to_bytes, visible_range

COLOR, DEPTH, NORMALS = "Color", "Depth", "Normals"  # As on exported pages.
AROUND, LINE = 24, 255  # Gray levels: around a photograph, as on exported pages, and of the seam.
# Depths are sent losslessly with every picture: more pixels per side take time, fewer make ragged edges.
MOST_DEPTH_SIDE = 320
FARTHEST = 167.0  # viser sends depths as multiples of 1e-5 in three bytes: this is the maximum.


def picture_of(view: View, channel: str) -> UInt8[Tensor, "height width 3"]:
    """Return a channel of a view as a picture.

    Near depths are bright, over the range in this view; normals are in the model's axes, each from -1 to 1 as red,
    green and blue. Transparent parts fade to pale gray.
    """
    return to_bytes(CHANNELS[channel](view))


def depth_scale(view: View, record: SceneRecord) -> str:
    """Return the colors of a view's depths as HTML, with near and far in meters, or else in the capture's units."""
    length = float(record.to_user[:3, 0].norm()) * (record.metres_per_unit or 1.0)
    unit = "" if record.metres_per_unit is None else " m"
    near, far = (f"{length * depth:.3g}{unit}" for depth in visible_range(view.depth, view.opacity))
    bright_to_dark = to_bytes(color_map(torch.linspace(1, 0, 9)[None], 0.0, 1.0))[0].tolist()
    colors = ", ".join(f"rgb({r} {g} {b})" for r, g, b in bright_to_dark)
    ramp = f'<i style="flex:1;height:10px;border-radius:2px;background:linear-gradient(to right, {colors})"></i>'
    said = " In the capture's units." if record.metres_per_unit is None else ""
    line = f'<div style="display:flex;gap:8px;align-items:center">near {near} {ramp} far {far}</div>'
    return f'<div style="padding:0 1em 0.5em;font-size:0.85em">{line}Gray: no surface.{said}</div>'


def _depth(view: View) -> Float[Tensor, "height width 3"]:
    near, far = visible_range(view.depth, view.opacity)
    return faded(color_map(view.depth, low=far, high=near), view.opacity)


def _normals(view: View) -> Float[Tensor, "height width 3"]:
    rays = _rays(view, all_pixels(view.camera, 0))
    normals = normals_from_depth(rays.origins + view.depth[..., None] * rays.directions)
    return faded(0.5 + 0.5 * normals, view.opacity)


def _rays(view: View, pixels: PixelIndex) -> RayBundle:
    nothing = torch.zeros(1)
    return rays_through_pixels(replace(view.camera, ndc=None), pixels, nothing, nothing)


CHANNELS: dict[str, Callable[[View], Tensor]] = {
    COLOR: lambda view: view.rgb,
    DEPTH: _depth,
    "Opacity": lambda view: view.opacity[..., None].expand(-1, -1, 3),
    NORMALS: _normals,
}


def wiped(
    truth: UInt8[Tensor, "height width 3"], render: UInt8[Tensor, "height width 3"], share: float
) -> UInt8[Tensor, "height width 3"]:
    """Return the truth in the left `share` of the picture and the render in the rest, with a line between.

    >>> wiped(torch.zeros(1, 4, 3).byte(), torch.full((1, 4, 3), 9).byte(), 0.5)[0, :, 0].tolist()
    [0, 255, 9, 9]
    """
    cut = round(share * truth.shape[1])
    joined = torch.cat([truth[:, :cut], render[:, cut:]], dim=1)
    if 0 < cut < truth.shape[1]:
        joined[:, cut - 1] = LINE
    return joined


def in_window(picture: UInt8[Tensor, "height width 3"], aspect: float) -> UInt8[Tensor, "taller wider 3"]:
    """Return the picture centered on a background whose width over height is `aspect`.

    >>> in_window(torch.zeros(2, 2, 3).byte(), 2.0).shape
    torch.Size([2, 4, 3])
    """
    height, width, _ = picture.shape
    beside = max(0, round(height * aspect) - width)
    above = max(0, round(width / aspect) - height)
    edges = (0, 0, beside // 2, beside - beside // 2, above // 2, above - above // 2)
    return pad(picture, edges, value=AROUND)


def planar_depth(view: View) -> Float[np.ndarray, "height width"]:
    """Return the depth along the camera's axis of each pixel's content (scene units), at most 320 pixels per side.

    Pixels that are less than half opaque occlude nothing: their depth is `FARTHEST`.
    """
    step = max(1, -(-max(view.depth.shape) // MOST_DEPTH_SIDE))
    inner = slice(step // 2, None, step)
    rays = _rays(view, all_pixels(view.camera, 0).map(lambda each: each[inner, inner]))
    depth = view.depth[inner, inner] * (rays.directions @ -view.camera.c2w[0, :, 2])
    hidden = torch.where(view.opacity[inner, inner] > 0.5, depth, FARTHEST)
    return hidden.clamp(0.0, FARTHEST).cpu().numpy()
