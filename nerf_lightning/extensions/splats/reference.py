"""The rasterizer in plain torch: slow, in any precision, differentiable by autograd. `rasterizer` equals it."""

import torch
from jaxtyping import Float
from torch import Tensor

from nerf_lightning.extensions.splats.gaussians import (
    LARGEST_ALPHA,
    LEAST_ALPHA,
    LEAST_LIGHT,
    Gaussians,
    Pinhole,
    colors,
    project,
)


def rasterize(gaussians: Gaussians, camera: Pinhole, background: Float[Tensor, "3"]) -> Float[Tensor, "height width 3"]:
    """Render the camera's view: sum of T_i alpha_i c_i, nearest splat first (Eq. 3, arXiv 2308.04079).

    alpha = min(0.99, opacity exp(-d^T conic d / 2)) for d from the splat's mean on the screen to the pixel's center.
    """
    seen = project(gaussians, camera)
    order = seen.depth.argsort(stable=True)
    order = order[(seen.depth > camera.near)[order]]
    x, y = torch.arange(camera.width) + 0.5, torch.arange(camera.height) + 0.5
    dx = x[None, None, :] - seen.means[order, 0, None, None]
    dy = y[None, :, None] - seen.means[order, 1, None, None]
    a, b, c = (each[order, None, None] for each in seen.conics.unbind(dim=-1))
    shape = torch.exp(-0.5 * (a * dx * dx + c * dy * dy) - b * dx * dy)
    alpha = (gaussians.opacity_logits.sigmoid()[order, None, None] * shape).clamp(max=LARGEST_ALPHA)
    alpha = torch.where(alpha >= LEAST_ALPHA, alpha, 0.0)
    rgb, light = colors(gaussians, camera.eye)[order], torch.ones_like(alpha[:1]).sum(dim=0)
    picture = torch.zeros(camera.height, camera.width, 3).to(alpha)
    for each, color in zip(alpha, rgb, strict=True):
        each = torch.where(light >= LEAST_LIGHT, each, 0.0)
        picture = picture + (light * each)[..., None] * color
        light = light * (1 - each)
    return picture + light[..., None] * background
