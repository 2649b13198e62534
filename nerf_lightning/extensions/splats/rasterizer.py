"""The rasterizer of `reference`, fast on the CPU: numba kernels on every core, forward and backward, in float32.

The result is deterministic: tiles are distributed over threads, and their gradients of a splat are added in a fixed
order.
Which contributions are too faint: `gaussians.py`.
"""

from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from numpy import ndarray
from torch import Tensor

from nerf_lightning.extensions.splats import projection, tiles
from nerf_lightning.extensions.splats.gaussians import Gaussians, Pinhole, jacobian_limits
from nerf_lightning.extensions.splats.projection import COLUMNS
from nerf_lightning.extensions.splats.tiles import SIDE
from nerf_lightning.nerf.kernels.threads import in_parallel, num_threads, over_rows, parts_of

ON_SCREEN = 9
"""Columns of the gradient on the screen."""


def rasterize(
    gaussians: Gaussians,
    camera: Pinhole,
    background: Float[Tensor, "3"],
    on_screen: Float[Tensor, "n 2"] | None = None,
) -> Float[Tensor, "height width 3"]:
    """Render the camera's view (`reference.rasterize`), with gradients for every tensor of the splats.

    Args:
        gaussians: float32, on the CPU. A splat with a number that is not finite is not drawn.
        camera: the camera to render.
        background: color behind the splats.
        on_screen: zeros that require a gradient: they receive that of each splat's mean on the screen (per pixel).
    """
    picture: Tensor = _Rasterize.apply(*gaussians.tensors().values(), on_screen, camera, background)
    return picture


class _Rasterize(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, *inputs: Any) -> Tensor:
        *tensors, _, camera, background = inputs
        splats = tuple(each.detach().contiguous().numpy() for each in tensors)
        across, down = -(-camera.width // SIDE), -(-camera.height // SIDE)
        screen, picture = (
            np.empty((len(splats[0]), COLUMNS), np.float32),
            np.empty((down * SIDE, across * SIDE, 3), np.float32),
        )
        taken = _arrays(camera)
        over_rows(projection.project, len(screen), splats, taken, screen)
        sorted_splats = tiles.sort_into_tiles(tiles.nearest_first(screen), screen, across, down)
        behind = background.detach().float().contiguous().numpy()
        _over_tiles(tiles.blend, across * down, across, screen, *sorted_splats, behind, picture)
        ctx.saved = splats, taken, screen, across, sorted_splats, picture
        return torch.from_numpy(picture)[: camera.height, : camera.width]

    @staticmethod
    def backward(ctx: Any, *grad: Tensor) -> Any:
        splats, taken, screen, across, (numbers, starts), picture = ctx.saved
        gradient = np.zeros_like(picture)
        height, width, _ = grad[0].shape
        gradient[:height, :width] = grad[0].numpy()
        parts, on_screen = (
            np.zeros((len(numbers), ON_SCREEN), np.float32),
            np.zeros((len(screen), ON_SCREEN), np.float32),
        )
        _over_tiles(tiles.blend_back, len(starts) - 1, across, screen, numbers, starts, picture, gradient, parts)
        tiles.add_parts(numbers, parts, on_screen)
        gradients = tuple(np.zeros_like(each) for each in splats)
        over_rows(projection.project_back, len(screen), splats, taken, screen, on_screen, gradients)
        of_means = torch.from_numpy(on_screen[:, :2]) if ctx.needs_input_grad[6] else None
        return *map(torch.from_numpy, gradients), of_means, None, None


def _over_tiles(kernel: Any, count: int, *arrays: Any) -> None:
    in_parallel(lambda part: kernel(*part, *arrays), parts_of(count, num_threads(), fewest=1))


def _arrays(camera: Pinhole) -> tuple[ndarray, ndarray, ndarray]:
    """Return a camera's parameters for kernels: rotation, eye, and f, c, limits of x / z and y / z, near, size."""
    lens = (*camera.focal, *camera.center, *jacobian_limits(camera), camera.near, camera.width, camera.height)
    rotation, eye = (each.detach().float().contiguous().numpy() for each in (camera.rotation, camera.eye))
    return rotation, eye, np.array(lens, np.float32)


def try_kernels() -> None:
    """Run a forward and a backward pass of one splat."""
    mean, turn, one = torch.tensor([[0.0, 0.0, 2.0]]), torch.tensor([[1.0, 0.0, 0.0, 0.0]]), torch.ones(1, 3)
    gaussians = Gaussians(mean, -2 * one, turn, torch.zeros(1), one.clone(), torch.ones(1, 3, 3))
    gaussians = gaussians.map(lambda each: each.requires_grad_())
    camera = Pinhole(torch.eye(3), torch.zeros(3), (8.0, 8.0), (4.0, 4.0), 8, 8, 0.1)
    rasterize(gaussians, camera, torch.zeros(3)).sum().backward()
