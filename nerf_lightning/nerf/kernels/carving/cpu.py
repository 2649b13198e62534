"""Carving by one view for the CPU, in the reference's order of operations and thus bit-identical; for pinholes.

The loops have no branches, read coordinates one axis after another, and take a camera as plain numbers, so that they
vectorize over cells.
"""

from typing import no_type_check

import numpy as np
import torch
from jaxtyping import Bool, Float
from numba import njit
from torch import Tensor

from nerf_lightning.nerf.kernels.carving.reference import widened
from nerf_lightning.nerf.kernels.threads import over_rows
from nerf_lightning.nerf.types.scene import Cameras

ZERO, ONE, WIDEST = np.float32(0.0), np.float32(1.0), np.float32(9.0)
NOWHERE = np.int32(-1)
CHUNK = 16384


def add_seen(
    cells: Bool[Tensor, "cells"],
    cameras: Cameras,
    view: int,
    centers: Float[Tensor, "cells 3"],
    half_diagonal: float,
) -> None:
    """Mark the cells that a view sees, even partly."""
    over_rows(
        _add_seen, cells.shape[0], cells.numpy(), *_axes(centers), *_camera(cameras, view), *_halves(half_diagonal)
    )


def carve(
    cells: Bool[Tensor, "cells"],
    cameras: Cameras,
    view: int,
    centers: Float[Tensor, "cells 3"],
    half_diagonal: float,
    matter: Bool[Tensor, "height width"],
) -> None:
    """Unmark the cells that a view sees entirely, with no matter in any of their pixels."""
    pixel, radius = torch.empty(cells.shape, dtype=torch.int32), torch.empty(cells.shape)
    given = (cells.numpy(), *_axes(centers), *_camera(cameras, view), *_halves(half_diagonal))
    over_rows(_find_pixels, cells.shape[0], *given, pixel.numpy(), radius.numpy())
    covered = widened(matter, radius)
    if covered is not None:
        over_rows(_keep_covered, cells.shape[0], cells.numpy(), pixel.numpy(), covered.reshape(-1).numpy())


def trial() -> None:
    """Run every kernel once on tiny input; it raises whatever the compiler raises."""
    size, cells = torch.tensor([8]), torch.zeros(1, dtype=torch.bool)
    lens, middle = torch.zeros(1, 6), torch.full((1, 2), 4.0)
    cameras = Cameras(torch.eye(4)[None, :3], torch.full((1, 2), 4.0), middle, lens, "pinhole", size, size)
    ahead = torch.tensor([[0.0, 0.0, -2.0]])
    add_seen(cells, cameras, 0, ahead, 0.1)
    carve(cells, cameras, 0, ahead, 0.1, torch.zeros(8, 8, dtype=torch.bool))


def _axes(centers: Tensor) -> list[np.ndarray]:
    return [axis.contiguous().numpy() for axis in centers.unbind(dim=1)]


def _camera(cameras: Cameras, view: int) -> tuple[tuple[np.float32, ...], np.int32, np.int32]:
    """Return the pose row by row, focal lengths and principal point; width; height."""
    numbers = torch.cat([cameras.c2w[view].reshape(-1), cameras.focal[view], cameras.center[view]])
    return tuple(numbers.numpy()), np.int32(cameras.width[view]), np.int32(cameras.height[view])


def _halves(half_diagonal: float) -> tuple[np.float32, np.float32]:
    """Return half the diagonal of a cell, and the depth within which a sphere is too close to decide."""
    return np.float32(half_diagonal), np.float32(2.0 * half_diagonal)


@njit(error_model="numpy")
@no_type_check
def _footprint(x, y, z, camera, half, nearest):
    # As geometry/footprints.py: where a sphere appears, and the radius of a disc that contains it; 0 if unseen.
    ax, bx, cx, ox, ay, by, cy, oy, az, bz, cz, oz, focal_x, focal_y, center_x, center_y = camera
    x, y, z = x - ox, y - oy, z - oz
    right, up, depth = x * ax + y * ay + z * az, x * bx + y * by + z * bz, -(x * cx + y * cy + z * cz)
    in_front = depth > nearest
    safe = depth if in_front else ONE
    stretch = (right * right + up * up + depth * depth) / (safe * safe)
    distance = safe - half
    radius = max(focal_x, focal_y) * half / (distance if distance > half else half)
    radius *= stretch if stretch < WIDEST else WIDEST
    return focal_x * right / safe + center_x, -focal_y * up / safe + center_y, radius if in_front else ZERO


@njit(error_model="numpy")
@no_type_check
def _see(cells, xs, ys, zs, camera, width, height, half, nearest):
    wide, high = np.float32(width), np.float32(height)
    for i in range(cells.shape[0]):
        x, y, radius = _footprint(xs[i], ys[i], zs[i], camera, half, nearest)
        cells[i] |= (x > -radius) & (x < wide + radius) & (y > -radius) & (y < high + radius) & (radius > ZERO)


@njit(error_model="numpy")
@no_type_check
def _find(cells, xs, ys, zs, camera, width, height, half, nearest, pixels, radii):
    wide, high = np.float32(width), np.float32(height)
    last_column, last_row = width - np.int32(1), height - np.int32(1)
    for i in range(cells.shape[0]):
        x, y, radius = _footprint(xs[i], ys[i], zs[i], camera, half, nearest)
        inside = (x - radius >= ZERO) & (x + radius <= wide) & (y - radius >= ZERO) & (y + radius <= high)
        whole = inside & (radius > ZERO) & cells[i]
        pixel = min(np.int32(y), last_row) * width + min(np.int32(x), last_column)
        pixels[i] = pixel if whole else NOWHERE
        radii[i] = radius if whole else ZERO


@njit(nogil=True, error_model="numpy", cache=True)
@no_type_check
def _add_seen(first, last, cells, xs, ys, zs, camera, width, height, half, nearest):
    for start in range(first, last, CHUNK):
        part = slice(start, min(last, start + CHUNK))
        _see(cells[part], xs[part], ys[part], zs[part], camera, width, height, half, nearest)


@njit(nogil=True, error_model="numpy", cache=True)
@no_type_check
def _find_pixels(first, last, cells, xs, ys, zs, camera, width, height, half, nearest, pixels, radii):
    # The center pixel of each cell's disc, and the disc's radius; -1 and 0 if the view does not show the whole disc.
    for start in range(first, last, CHUNK):
        part = slice(start, min(last, start + CHUNK))
        given = (cells[part], xs[part], ys[part], zs[part], camera, width, height, half, nearest)
        _find(*given, pixels[part], radii[part])


@njit(nogil=True, cache=True)
@no_type_check
def _keep_covered(first, last, cells, pixels, covered):
    for i in range(first, last):
        if pixels[i] >= 0 and not covered[pixels[i]]:
            cells[i] = False
