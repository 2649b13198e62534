"""Rays through pixels for CUDA, for pinholes and radial and tangential lenses.

One kernel does all of `geometry.cameras.rays_through_pixels`, including the iteration of `geometry.lenses` and the
sides of pixels. `TRITON_INTERPRET=1` runs it without a GPU.
"""

from typing import no_type_check

import torch
import triton
import triton.language as tl
from jaxtyping import Float
from torch import Tensor

from nerf_lightning.nerf.geometry.lenses import NEWTON_STEPS
from nerf_lightning.nerf.types.rays import PixelIndex, RayBundle
from nerf_lightning.nerf.types.scene import Cameras, LensModel

LENSES: tuple[LensModel, ...] = ("pinhole", "radial_tangential")
BLOCK = 128


def rays_through_pixels(
    cameras: Cameras,
    pixels: PixelIndex,
    near: Float[Tensor, "views"],
    far: Float[Tensor, "views"],
    subpixel_offset: Float[Tensor, "*#rays 2"] | None = None,
    per_side: int = 1,
) -> RayBundle | None:
    """Return the rays through the centers of pixels; None for other offsets, lenses, coordinates or gradients.

    Args:
        cameras: one per view.
        pixels: the pixels.
        near: where the rays of each view begin.
        far: where they end.
        subpixel_offset: each ray's offset from the center of its pixel; None: none.
        per_side: number of rays along each side of a pixel.
    """
    learnt = (cameras.c2w, cameras.focal, cameras.center, cameras.lens)
    if subpixel_offset is not None or cameras.ndc is not None or cameras.lens_model not in LENSES:
        return None
    if any(each.dtype != torch.float32 or each.requires_grad for each in learnt):
        return None
    shape, device = pixels.view.shape, cameras.c2w.device
    origins, directions = (torch.empty(*shape, 3, device=device) for _ in range(2))
    begin, end = (torch.empty(shape, device=device) for _ in range(2))
    side = torch.empty(*shape, 2, device=device)
    given = pixels.view, pixels.x, pixels.y, cameras.c2w, cameras.focal, cameras.center, cameras.lens, near, far
    count = pixels.view.numel()
    if count:
        arrays = *(each.contiguous() for each in given), origins, directions, begin, end, side
        steps = 0 if cameras.lens_model == "pinhole" else NEWTON_STEPS
        _rays[(triton.cdiv(count, BLOCK),)](*arrays, 1.0 / per_side, count, steps, BLOCK)
    return RayBundle(origins, directions, begin, end, view_directions=directions, pixel_side=side)


def trial(device: str = "cuda") -> None:
    """Run the kernel once on tiny input; it raises whatever the compiler or driver raises.

    Raises:
        RuntimeError: the result is wrong.
    """
    one, zero = torch.ones(2, device=device), torch.zeros(2, dtype=torch.int64, device=device)
    lens, size, c2w = torch.zeros(2, 6, device=device), zero + 1, torch.eye(3, 4, device=device).expand(2, 3, 4)
    given = c2w, one.expand(2, 2), 0.5 * one.expand(2, 2), lens
    pixel = PixelIndex(zero, zero, zero)
    # Along the axis.
    found = [rays_through_pixels(Cameras(*given, model, size, size), pixel, one, 2 * one) for model in LENSES]
    if not all(each is not None and torch.allclose(each.directions, -c2w[..., 2]) for each in found):
        raise RuntimeError("a trial of its kernels gave wrong numbers")


@triton.jit
@no_type_check
def _distorted(x, y, k1, k2, k3, k4, p1, p2):
    """Return where the lens shows a point of the plane, and its Jacobian there."""
    xx, xy, yy = x * x, x * y, y * y
    s = xx + yy
    radial = 1.0 + s * (k1 + s * (k2 + s * (k3 + s * k4)))
    slope = 2.0 * k1 + s * (4.0 * k2 + s * (6.0 * k3 + s * (8.0 * k4)))
    bent_x = x * radial + 2.0 * p1 * xy + p2 * (3.0 * xx + yy)
    bent_y = y * radial + p1 * (xx + 3.0 * yy) + 2.0 * p2 * xy
    along_x = radial + xx * slope + 2.0 * p1 * y + 6.0 * p2 * x
    along_y = radial + yy * slope + 6.0 * p1 * y + 2.0 * p2 * x
    return bent_x, bent_y, along_x, along_y, xy * slope + 2.0 * (p1 * x + p2 * y)


@triton.jit
@no_type_check
def _turned(row, x, y):
    """Return one world coordinate of (x, -y, -1), given a row of the camera's matrix."""
    return tl.load(row) * x - tl.load(row + 1) * y - tl.load(row + 2)


@triton.jit
@no_type_check
def _rays(
    views, xs, ys, c2w, focal, center, lens, nears, fars, origins, directions, begin, end, side,
    share, count, steps: tl.constexpr, block: tl.constexpr,
):  # fmt: skip
    index = tl.program_id(0).to(tl.int64) * block + tl.arange(0, block)
    valid = index < count
    view = tl.load(views + index, mask=valid, other=0)
    column, row = tl.load(xs + index, mask=valid, other=0), tl.load(ys + index, mask=valid, other=0)
    fx, fy = tl.load(focal + 2 * view), tl.load(focal + 2 * view + 1)
    plane_x = (column.to(tl.float32) + 0.5 - tl.load(center + 2 * view)) / fx
    plane_y = (row.to(tl.float32) + 0.5 - tl.load(center + 2 * view + 1)) / fy
    x, y, area = plane_x, plane_y, 1.0 / (fx * fy)
    if steps:
        k1, k2, k3 = tl.load(lens + 6 * view), tl.load(lens + 6 * view + 1), tl.load(lens + 6 * view + 2)
        k4, p1, p2 = tl.load(lens + 6 * view + 3), tl.load(lens + 6 * view + 4), tl.load(lens + 6 * view + 5)
        for _ in range(steps):
            bent_x, bent_y, along_x, along_y, across = _distorted(x, y, k1, k2, k3, k4, p1, p2)
            off_x, off_y, determinant = bent_x - plane_x, bent_y - plane_y, along_x * along_y - across * across
            x -= (along_y * off_x - across * off_y) / determinant
            y -= (along_x * off_y - across * off_x) / determinant
        _, _, along_x, along_y, across = _distorted(x, y, k1, k2, k3, k4, p1, p2)
        area /= along_x * along_y - across * across
    length = tl.sqrt(x * x + y * y + 1.0)
    area /= length * length * length
    tl.store(side + 2 * index, tl.zeros([block], tl.float32), mask=valid)
    tl.store(side + 2 * index + 1, tl.sqrt(tl.maximum(area, 0.0)) * share, mask=valid)
    matrix = c2w + 12 * view
    dx, dy, dz = _turned(matrix, x, y), _turned(matrix + 4, x, y), _turned(matrix + 8, x, y)
    length = tl.sqrt(dx * dx + dy * dy + dz * dz)
    tl.store(directions + 3 * index, dx / length, mask=valid)
    tl.store(directions + 3 * index + 1, dy / length, mask=valid)
    tl.store(directions + 3 * index + 2, dz / length, mask=valid)
    for axis in tl.static_range(3):
        tl.store(origins + 3 * index + axis, tl.load(matrix + 4 * axis + 3), mask=valid)
    tl.store(begin + index, tl.load(nears + view), mask=valid)
    tl.store(end + index, tl.load(fars + view), mask=valid)
